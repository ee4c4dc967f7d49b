#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Debian's docker.io, containerd and runc, unpacked below build/docker for the tests of
# avckpt-runtime: nothing is installed, no service is started.  Elsewhere than on
# Debian or Ubuntu, and without a way to the packages, those tests are skipped.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

ROOT_DIR=$BUILD/docker/root
[ ! -x "$ROOT_DIR/usr/sbin/dockerd" ] || exit 0
have apt-get || { note "no apt-get: the tests of Docker are skipped"; exit 0; }

unpack() {
	local folder more
	folder=$(mktemp -d) || return
	chmod 0755 "$folder" || return
	# Debian 12's needs a library, and Debian 13's has the command in a package of its own.
	mapfile -t more < <(apt-cache depends docker.io | sed -n 's/.*: \(libdevmapper.*\|docker-cli\)$/\1/p')
	(cd "$folder" && apt-get download docker.io containerd runc tini "${more[@]}") || return
	rm -rf "$BUILD/docker.new" && mkdir -p "$BUILD/docker.new" || return
	for deb in "$folder"/*.deb; do dpkg -x "$deb" "$BUILD/docker.new/root" || return; done
	rm -rf "$folder" "$BUILD/docker" || return
	mv "$BUILD/docker.new" "$BUILD/docker"
}
step docker "fetching Docker and containerd for their tests" unpack || warn "the tests of Docker are skipped"
