#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# What `make bench-peers` compares with, as a tarball of a whole Debian 13 in the
# user's cache: Podman 5, crun, runc and CRIU.  Nothing of it is installed on the
# host, whose own Podman and CRIU may be of any age; bench/peers_world.sh unpacks
# it into memory for as long as the measurement runs.
#
# CRIU comes from the next Debian: CRIU before 4.2 cannot dump a TCP socket on
# Linux 6.16 and newer ("Can't get 1:16 opt: Operation not supported").

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
SUITE=trixie
NEXT=forky
MIRROR=${AVCKPT_MIRROR:-http://deb.debian.org/debian}
PACKAGES=podman,crun,runc,criu,libcriu2,conmon,netavark,catatonit,iptables,nftables,iproute2,procps

# From the next Debian, if there is one: CRIU and what it links that is too old in this one.
PREFER="Package: criu libcriu2 libcompel1 libnl-*
Pin: release n=$NEXT
Pin-Priority: 1001"

bootstrap() {
	local slim=(path-exclude=/usr/share/doc/* path-exclude=/usr/share/man/* path-exclude=/usr/share/locale/*)
	local new=$tarball.new.$$ sources=$BUILD/peers.sources.list prefer=$BUILD/peers.pref
	# apt reads files without a suffix or with this one.
	printf '%s\n' "$PREFER" >"$prefer" || return
	# A mirror's copy of the next Debian may be some days behind; it is signed all the same.
	cat >"$sources" <<-END || return
		deb $MIRROR $SUITE main
		deb [check-valid-until=no] $MIRROR $NEXT main
	END
	mmdebstrap --format=tar --variant=minbase --include="$PACKAGES" "${slim[@]/#/--dpkgopt=}" \
		--aptopt="APT::Default-Release \"$SUITE\"" \
		--setup-hook="copy-in '$prefer' /etc/apt/preferences.d" \
		"$SUITE" "$new" "$sources" || return
	# Renamed only when whole: an interrupted run leaves no half tarball behind.
	mv "$new" "$tarball"
}

have mmdebstrap || die "mmdebstrap is needed to make the peers' Debian (debootstrap cannot mix two releases)"
key=$(content_key -- "$SUITE" "$NEXT" "$MIRROR" "$PACKAGES" "$PREFER" "$(declare -f bootstrap)")
cached peers "$SUITE-$key"
if [ -f "$tarball" ]; then
	note "the peers' Debian: $tarball is there"
else
	step peers "making a Debian ($SUITE) with Podman and CRIU to compare with" bootstrap ||
		die "no peers: $SUITE could not be fetched from $MIRROR (AVCKPT_MIRROR names another mirror)"
fi
drop_older peers
