#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Removes the project's images and the cached base, and nothing else.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

have podman || exit 0
for repository in localhost/avckpt-programs localhost/avckpt-programs-build localhost/avckpt-sidecar \
	localhost/avckpt-sidecar-build localhost/avckpt-trees \
	localhost/avckpt-ros localhost/avckpt-ros2 localhost/avckpt-base; do
	podman images --format '{{.Repository}}:{{.Tag}}' --filter "reference=$repository" |
		while read -r image; do podman rmi "$image" || warn "$image is in use and stays"; done
done
rm -rf "${CACHE:?}"
