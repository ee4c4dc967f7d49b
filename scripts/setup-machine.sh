#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# setup-machine.sh KERNEL...: what `make test-kernels` and `make test-machine` boot.  In
# build/machine-SUITE: a Debian (AVCKPT_MACHINE: bookworm or trixie) with systemd, Podman and a
# compiler, and for each KERNEL a kernel as somebody ships it.
#
# The machines are emulated (QEMU's TCG): slow, and the same everywhere, with KVM or without.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
SUITE=${AVCKPT_MACHINE:-bookworm}
MACHINE=$BUILD/machine-$SUITE
WORLD=$MACHINE/root
KEYRING=$MACHINE/ubuntu.gpg
DEBIAN=${AVCKPT_MIRROR:-http://deb.debian.org/debian}
UBUNTU=${AVCKPT_UBUNTU_MIRROR:-http://archive.ubuntu.com/ubuntu}
PACKAGES=systemd,systemd-sysv,dbus,udev,kmod,initramfs-tools,zstd,iproute2,procps,ca-certificates
PACKAGES=$PACKAGES,podman,conmon,crun,catatonit,netavark,iptables,nftables,uidmap,mmdebstrap,debian-archive-keyring
PACKAGES=$PACKAGES,gcc,g++,libc6-dev,binutils,make,git,python3,python3-venv,python3-dev
PACKAGES=$PACKAGES,strace,gdb,psmisc,cyclonedds-dev,cyclonedds-tools
case $SUITE in
bookworm) ;;
# Shells, for the completion of commands; with AppArmor's parser Podman confines every container.
trixie) PACKAGES=$PACKAGES,zsh,fish,bash-completion,apparmor ;;
*) echo "AVCKPT_MACHINE is bookworm or trixie, not $SUITE" >&2 && exit 1 ;;
esac

# source_of KERNEL: the package, and where it comes from (sources.list(5), one line each).
source_of() {
	case $1 in
	bookworm) printf '%s\n' linux-image-cloud-amd64 "deb $DEBIAN $1 main" ;;
	# Not the cloud's: the one with all drivers, for the tests of a vehicle's devices.
	trixie) printf '%s\n' linux-image-amd64 "deb $DEBIAN $1 main" ;;
	backports) printf '%s\n' linux-image-cloud-amd64/trixie-backports "deb $DEBIAN trixie main" \
		"deb $DEBIAN trixie-backports main" ;;
	jammy | noble) printf '%s\n' linux-image-virtual "deb [signed-by=$KEYRING] $UBUNTU $1 main" \
		"deb [signed-by=$KEYRING] $UBUNTU $1-updates main" ;;
	*) die "no kernel is called $1: jammy (Linux 5.15), bookworm (6.1), noble (6.8), trixie (6.12) or backports (Debian 13's, the newest)" ;;
	esac
}

# Debian vouches for Ubuntu's, since Debian 13.
get_keyring() {
	local packages=$MACHINE/keyring.new
	rm -rf "$packages" || return
	mmdebstrap --variant=extract --include=ubuntu-keyring trixie "$packages" "$DEBIAN" || return
	cp "$packages/usr/share/keyrings/ubuntu-archive-keyring.gpg" "$KEYRING" || return
	rm -rf "$packages"
}

install_qemu() {
	apt-get update -q || return
	apt-get install -q -y --no-install-recommends qemu-system-x86 seabios ipxe-qemu e2fsprogs zstd \
		mmdebstrap debian-archive-keyring
}

make_world() {
	local new=$tarball.new.$$
	mmdebstrap --format=tar --variant=minbase --include="$PACKAGES" --dpkgopt='path-exclude=/usr/share/doc/*' \
		--dpkgopt='path-exclude=/usr/share/man/*' "$SUITE" "$new" "$DEBIAN" || return
	# Renamed only when whole: an interrupted run leaves no half tarball behind.
	mv "$new" "$tarball"
}

unpack_world() {
	rm -rf "$WORLD" || return
	mkdir -p "$WORLD" || return
	tar -C "$WORLD" --numeric-owner -xf "$tarball" || return
	# Its kernels are others', and its first disk is whole; the second is the checkout.
	printf '/dev/vda / ext4 rw,relatime 0 0\n/dev/vdb /opt/avckpt ext4 rw,relatime 0 0\n' >"$WORLD/etc/fstab" || return
	mkdir -p "$WORLD/opt/avckpt" || return
	echo machine >"$WORLD/etc/hostname" || return
	# AppArmor's service would compile the profiles of a hundred programs, for minutes; Podman loads its own.
	chroot "$WORLD" systemctl -q mask apt-daily.timer apt-daily-upgrade.timer systemd-networkd-wait-online.service \
		apparmor.service || return
	# The network, for what has to be fetched inside: QEMU's own, by DHCP.
	printf '[Match]\nName=en*\n[Network]\nDHCP=yes\n' >"$WORLD/etc/systemd/network/10-machine.network" || return
	chroot "$WORLD" systemctl -q enable systemd-networkd.service || return
	cp scripts/machine.service "$WORLD/etc/systemd/system/avckpt-machine.service" || return
	chroot "$WORLD" systemctl -q enable avckpt-machine.service || return
	printf '%s\n' "$key" >"$MACHINE/world"
}

# The kernel's own packages and nothing of what they depend on is put to use.
make_kernel() {
	local kernel=$1 there=$MACHINE/$1 packages modules release sources
	mapfile -t sources < <(source_of "$kernel")
	packages=$there.new
	rm -rf "$there" "$packages" || return
	[ -e "$KEYRING" ] || get_keyring || return
	printf '%s\n' "${sources[@]:1}" | mmdebstrap --variant=extract --include="${sources[0]}" \
		--aptopt='APT::Install-Recommends "false"' "$SUITE" "$packages" - || return
	for modules in "$packages"/lib/modules/* "$packages"/usr/lib/modules/*; do
		if [ -d "$modules/kernel" ]; then break; fi
	done
	release=${modules##*/}
	# The tools of Debian 12 do not unpack them.
	find "$modules" -name '*.ko.zst' -exec zstd -q -d --rm {} + || return
	rm -rf "$WORLD/lib/modules/$release" || return
	mkdir -p "$WORLD/lib/modules" "$WORLD/boot" || return
	cp -a "$modules" "$WORLD/lib/modules/" || return
	cp "$(find "$packages/boot" "$modules" -maxdepth 1 \( -name "config-$release" -o -name config \) | head -n 1)" \
		"$WORLD/boot/config-$release" || return
	chroot "$WORLD" depmod "$release" || return
	chroot "$WORLD" mkinitramfs -o "/boot/initrd-$release" "$release" || return
	mkdir -p "$there" || return
	cp "$(find "$packages/boot" "$modules" -maxdepth 1 \( -name "vmlinuz-$release" -o -name vmlinuz \) | head -n 1)" \
		"$there/vmlinuz" || return
	mv "$WORLD/boot/initrd-$release" "$there/initrd" || return
	rm -rf "$packages" || return
	printf '%s\n' "$release" >"$there/release"
}

[ $# -gt 0 ] || die "which kernels? setup-machine.sh KERNEL..."
[ "$(uname -m)" = x86_64 ] || die "the machines are x86-64, as avckpt is; this one is $(uname -m)"
[ "$(id -u)" = 0 ] || die "it takes root to make a machine's file system"
for kernel in "$@"; do source_of "$kernel" >/dev/null; done
if ! have qemu-system-x86_64 || ! have mke2fs || ! have mmdebstrap || ! have zstd; then
	have apt-get || die "needed: qemu-system-x86_64, mke2fs, mmdebstrap, zstd"
	step machine-qemu "installing QEMU" install_qemu || die "QEMU could not be installed"
fi
mkdir -p "$MACHINE"
key=$(content_key scripts/setup-machine.sh scripts/machine.service)
cached "machine-$SUITE" "$(content_key -- "$DEBIAN" "$PACKAGES" "$(declare -f make_world)")"
[ -f "$tarball" ] || step machine-world "making a Debian ($SUITE) to boot" make_world || die "no machine: $SUITE could not be fetched from $DEBIAN"
drop_older "machine-$SUITE"
if [ "$(cat "$MACHINE/world" 2>/dev/null)" != "$key" ]; then
	rm -rf "${MACHINE:?}"/*
	step machine-unpack "unpacking it" unpack_world || die "no machine: $tarball could not be unpacked"
fi
for kernel in "$@"; do
	if [ -f "$MACHINE/$kernel/release" ]; then
		note "kernel of $kernel: $(cat "$MACHINE/$kernel/release") is there"
	else
		step "machine-$kernel" "getting the kernel of $kernel" make_kernel "$kernel" || die "no machine: the kernel of $kernel could not be fetched"
	fi
done
