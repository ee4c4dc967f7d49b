# shellcheck shell=bash
# SPDX-License-Identifier: Apache-2.0
#
# Images of Debian's own packages, made without a registry of container images.
# Sourced, never run.
#
# An image is tagged with a key of what it is made from; the tarball is kept in
# the user's cache, so that a fresh clone does not fetch everything again.

# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"

SUITE=${AVCKPT_SUITE:-bookworm}
MIRROR=${AVCKPT_MIRROR:-http://deb.debian.org/debian}

# What may be left out of packages, beside documentation; a command for the new
# root ($1) before they are unpacked; what is removed from it where there is only
# debootstrap, which knows neither.
EXCLUDES=()
ESSENTIAL_HOOK=
REMOVED=

bootstrap() {
	local slim=('/usr/share/doc/*' '/usr/share/man/*' '/usr/share/locale/*' "${EXCLUDES[@]}") options=() new=$tarball.new.$$ root
	if [ -n "$ESSENTIAL_HOOK" ]; then options=("--essential-hook=$ESSENTIAL_HOOK"); fi
	if have mmdebstrap; then
		mmdebstrap --format=tar --variant=minbase --include="$PACKAGES" "${slim[@]/#/--dpkgopt=path-exclude=}" \
			"${options[@]}" "$SUITE" "$new" "$MIRROR" || return
	else
		root=$(mktemp -d) || return
		# shellcheck disable=SC2064 # the folder's name as it is now
		trap "rm -rf '$root'" EXIT
		debootstrap --variant=minbase --include="$PACKAGES" "$SUITE" "$root" "$MIRROR" || return
		# shellcheck disable=SC2086 # patterns, for the new root
		(cd "$root" && rm -rf var/cache/apt/archives/*.deb var/lib/apt/lists/* dev/* $REMOVED) || return
		tar -C "$root" --numeric-owner -cf "$new" . || return
	fi
	# Renamed only when whole: an interrupted run leaves no half tarball behind.
	mv "$new" "$tarball"
}

import() {
	podman import --change 'ENV PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin' \
		--change 'CMD ["/bin/sh"]' "$tarball" "$image:$key" || return
	podman tag "$image:$key" "$image:latest"
}

# debian_image NAME TITLE PACKAGES: localhost/avckpt-NAME, also as `latest`.
debian_image() {
	local name=$1 title=$2 PACKAGES=$3 image=localhost/avckpt-$1 key tarball
	# The recipe itself is part of the key.
	key=$(content_key -- "$SUITE" "$MIRROR" "$PACKAGES" "${EXCLUDES[@]}" "$ESSENTIAL_HOOK" "$(declare -f bootstrap import)")
	cached "$name" "$SUITE-$key"
	# The very first podman command on a machine complains about network plugins that
	# are not used; what matters is said by the import.
	if podman image exists "$image:$key" 2>/dev/null; then
		# `latest` may have been moved by another tree with another key.
		podman tag "$image:$key" "$image:latest"
		note "$title: $image is there"
		return 0
	fi
	if [ ! -f "$tarball" ]; then
		step "$name" "making a small Debian ($SUITE): $title" bootstrap ||
			die "no $title: $SUITE could not be fetched from $MIRROR (AVCKPT_MIRROR names another mirror)"
	fi
	step "$name-import" "importing it as $image" import || die "podman could not import $tarball"
	remove_other_tags "$key" "$image"
	drop_older "$name"
}
