#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The base image localhost/avckpt-base: a small Debian made from Debian's own
# packages, so that no registry of container images is needed.  Demo, tests and
# the sidecar image start from it.
#
# The image is tagged with a key of what it is made from; the tarball is kept in
# the user's cache, so that a fresh clone does not fetch everything again.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

SUITE=${AVCKPT_SUITE:-bookworm}
MIRROR=${AVCKPT_MIRROR:-http://deb.debian.org/debian}
# python3, redis-server: programs that are protected in tests; the rest is for
# looking around inside a container.
PACKAGES=python3,redis-server,procps,iproute2
IMAGE=localhost/avckpt-base
CACHE=${XDG_CACHE_HOME:-${HOME:-/root}/.cache}/avckpt

bootstrap() {
	local slim=(path-exclude=/usr/share/doc/* path-exclude=/usr/share/man/* path-exclude=/usr/share/locale/*)
	local new=$tarball.new.$$ root
	if have mmdebstrap; then
		mmdebstrap --format=tar --variant=minbase --include="$PACKAGES" "${slim[@]/#/--dpkgopt=}" "$SUITE" "$new" "$MIRROR" ||
			return
	else
		root=$(mktemp -d) || return
		# shellcheck disable=SC2064 # the folder's name as it is now
		trap "rm -rf '$root'" EXIT
		debootstrap --variant=minbase --include="$PACKAGES" "$SUITE" "$root" "$MIRROR" || return
		rm -rf "${root:?}"/var/cache/apt/archives/*.deb "${root:?}"/var/lib/apt/lists/* "${root:?}"/dev/*
		tar -C "$root" --numeric-owner -cf "$new" . || return
	fi
	# Renamed only when whole: an interrupted run leaves no half tarball behind.
	mv "$new" "$tarball"
}

import() {
	podman import --change 'ENV PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin' \
		--change 'CMD ["/bin/sh"]' "$tarball" "$IMAGE:$key" || return
	podman tag "$IMAGE:$key" "$IMAGE:latest"
}
# The recipe itself is part of the key.
key=$(content_key -- "$SUITE" "$MIRROR" "$PACKAGES" "$(declare -f bootstrap import)")
tarball=$CACHE/base-$SUITE-$key.tar

# The very first podman command on a machine complains about network plugins that
# are not used; what matters is said by the import.
if podman image exists "$IMAGE:$key" 2>/dev/null; then
	# `latest` may have been moved by another tree with another key.
	podman tag "$IMAGE:$key" "$IMAGE:latest"
	note "base image: $IMAGE is there"
	exit 0
fi

mkdir -p "$CACHE"
rm -f "$CACHE"/*.tar.new.*
if [ ! -f "$tarball" ]; then
	step base "making a small Debian ($SUITE) for the base image" bootstrap ||
		die "no base image: $SUITE could not be fetched from $MIRROR (AVCKPT_MIRROR names another mirror)"
fi
step base-import "importing it as $IMAGE" import || die "podman could not import $tarball"
remove_other_tags "$key" "$IMAGE"
find "$CACHE" -name "base-*.tar" ! -name "$(basename "$tarball")" -delete
