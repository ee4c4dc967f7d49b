#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The image localhost/avckpt-ros2 from examples/ros2: CycloneDDS from Debian,
# zenoh from PyPI, and the nodes that are measured.  An unchanged tree builds
# nothing.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
BASE=localhost/avckpt-base
IMAGE=localhost/avckpt-ros2
WHEELS=$BUILD/wheels-ros2
ZENOH='eclipse-zenoh==1.10.2'

.venv/bin/python -c 'import matplotlib' 2>/dev/null ||
	step matplotlib "installing matplotlib, for the plots" \
		.venv/bin/python -m pip install --disable-pip-version-check -q 'matplotlib>=3.8' ||
	die "matplotlib could not be installed"

base_id=$(podman image inspect --format '{{.Id}}' "$BASE:latest") || die "no base image: make setup builds it"
key=$(content_key examples/ros2 -- "$base_id" "$ZENOH")
if podman image exists "$IMAGE:$key"; then
	podman tag "$IMAGE:$key" "$IMAGE:latest"
	note "image for ROS 2's transports: $IMAGE is there"
	exit 0
fi

# On the host, which knows how to reach a package index; its wheels are of the stable ABI.
fetch_wheels() {
	rm -rf "$WHEELS"
	mkdir -p "$WHEELS" || return
	.venv/bin/python -m pip --disable-pip-version-check download -d "$WHEELS" --only-binary=:all: --no-deps \
		--python-version 3.11 --abi abi3 --platform "manylinux_2_28_$(uname -m)" \
		--platform "manylinux_2_17_$(uname -m)" --platform "manylinux2014_$(uname -m)" "$ZENOH"
}

build() {
	allowed_limits
	podman build --network=host --pull=never --build-arg "BASE=$BASE" -v "$WHEELS:/wheels:ro" \
		--ulimit "nofile=$MAX_FILES:$MAX_FILES" --ulimit "nproc=$MAX_PROCS:$MAX_PROCS" \
		-t "$IMAGE:$key" examples/ros2 || return
	podman tag "$IMAGE:$key" "$IMAGE:latest"
}

step ros2-wheels "fetching zenoh" fetch_wheels || die "$ZENOH could not be fetched"
step ros2-image "building the image with CycloneDDS and zenoh" build || die "the image could not be built"
remove_other_tags "$key" "$IMAGE"
