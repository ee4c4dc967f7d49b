#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The image localhost/avckpt-trees: programs of many processes from Debian's own
# packages, for the tests of process trees (`make test-trees`).
#
# Tagged with a key of what it is made from; the tarball is kept in the user's
# cache, as setup-base.sh does with the base image.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

SUITE=${AVCKPT_SUITE:-bookworm}
MIRROR=${AVCKPT_MIRROR:-http://deb.debian.org/debian}
PACKAGES=nginx-light,gunicorn,python3,postgresql,procps
IMAGE=localhost/avckpt-trees
CACHE=${XDG_CACHE_HOME:-${HOME:-/root}/.cache}/avckpt

bootstrap() {
	local slim=(path-exclude=/usr/share/doc/* path-exclude=/usr/share/man/* path-exclude=/usr/share/locale/*
		path-exclude=/usr/lib/llvm* path-exclude=/usr/lib/postgresql/*/lib/bitcode/*)
	local new=$tarball.new.$$ root
	# No database yet: each test makes its own.
	local no_cluster='mkdir -p "$1/etc/postgresql-common" && echo create_main_cluster = false > "$1/etc/postgresql-common/createcluster.conf"'
	if have mmdebstrap; then
		mmdebstrap --format=tar --variant=minbase --include="$PACKAGES" "${slim[@]/#/--dpkgopt=}" \
			--essential-hook="$no_cluster" "$SUITE" "$new" "$MIRROR" || return
	else
		root=$(mktemp -d) || return
		# shellcheck disable=SC2064 # the folder's name as it is now
		trap "rm -rf '$root'" EXIT
		debootstrap --variant=minbase --include="$PACKAGES" "$SUITE" "$root" "$MIRROR" || return
		rm -rf "${root:?}"/var/cache/apt/archives/*.deb "${root:?}"/var/lib/apt/lists/* "${root:?}"/dev/*
		rm -rf "${root:?}"/var/lib/postgresql/*/main
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
tarball=$CACHE/trees-$SUITE-$key.tar

if podman image exists "$IMAGE:$key" 2>/dev/null; then
	# `latest` may have been moved by another tree with another key.
	podman tag "$IMAGE:$key" "$IMAGE:latest"
	note "image for the tests of process trees: $IMAGE is there"
	exit 0
fi

mkdir -p "$CACHE"
rm -f "$CACHE"/trees-*.tar.new.*
if [ ! -f "$tarball" ]; then
	step trees "making a Debian ($SUITE) with nginx, gunicorn and PostgreSQL for the tests of process trees" bootstrap ||
		die "no image for the tests of process trees: $SUITE could not be fetched from $MIRROR (AVCKPT_MIRROR names another mirror)"
fi
step trees-import "importing it as $IMAGE" import || die "podman could not import $tarball"
remove_other_tags "$key" "$IMAGE"
find "$CACHE" -name "trees-*.tar" ! -name "$(basename "$tarball")" -delete
