#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# test-aarch64.sh PYTEST-ARGUMENT...: boots a Debian 12 for aarch64 with this checkout, compiled by
# build-aarch64.sh, and runs pytest in it.  CPU_MODEL=max has SVE, pointer authentication and MTE.
#
# Nothing of that Debian can be executed here, so its packages are unpacked, not installed: there is
# no systemd in it, and its first process is inside-aarch64.sh.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
HERE=$BUILD/aarch64
MACHINE=$BUILD/machine-aarch64
WORLD=$MACHINE/root
CHECKOUT=$MACHINE/checkout
DEBIAN=${AVCKPT_MIRROR:-http://deb.debian.org/debian}
LIMIT=${LIMIT:-3h}
PACKAGES=linux-image-cloud-arm64,busybox-static,base-files,base-passwd,bash,dash,coreutils,util-linux,mount
PACKAGES=$PACKAGES,kmod,iproute2,procps,psmisc,grep,sed,findutils,mawk,libc-bin,ncurses-base
PACKAGES=$PACKAGES,python3,gcc,libc6-dev,make,strace,gdb
MODULES=(virtio_pci virtio_blk ext4)

install_qemu() {
	apt-get update -q || return
	apt-get install -q -y --no-install-recommends qemu-system-arm ipxe-qemu e2fsprogs cpio kmod \
		mmdebstrap debian-archive-keyring
}

make_world() {
	local new=$tarball.new.$$
	mmdebstrap --format=tar --variant=extract --architectures=arm64 --include="$PACKAGES" \
		--aptopt='APT::Install-Recommends "false"' --hook-dir=/usr/share/mmdebstrap/hooks/merged-usr \
		bookworm "$new" "$DEBIAN" || return
	# Renamed only when whole: an interrupted run leaves no half tarball behind.
	mv "$new" "$tarball"
}

# A file system in memory that loads what it takes to read the disk.
make_initrd() {
	local early=$MACHINE/early module path
	rm -rf "$early" || return
	mkdir -p "$early"/{bin,dev,proc,root,modules} || return
	cp "$WORLD/usr/bin/busybox" "$early/bin/" || return
	{
		printf '#!/bin/busybox sh\n/bin/busybox mount -t devtmpfs dev /dev\n'
		for module in "${MODULES[@]}"; do modprobe -d "$WORLD" -S "$release" --show-depends "$module"; done |
			awk '$1 == "insmod" && !seen[$2]++ { print $2 }' | while read -r path; do
			cp "$path" "$early/modules/" || return
			printf '/bin/busybox insmod /modules/%s\n' "${path##*/}"
		done
		printf '/bin/busybox mount -t ext4 /dev/vda /root\n/bin/busybox mount --move /dev /root/dev\n'
		printf 'exec /bin/busybox switch_root /root /sbin/avckpt-machine\n'
	} >"$early/init" || return
	chmod 755 "$early/init" || return
	(cd "$early" && find . | cpio --quiet -o -H newc) | gzip >"$MACHINE/initrd"
}

make_machine() {
	local release python
	rm -rf "$WORLD" "$MACHINE/disk" || return
	mkdir -p "$WORLD" || return
	tar -C "$WORLD" --numeric-owner -xf "$tarball" || return
	# What the packages' own scripts would have done.
	cp "$WORLD/usr/share/base-passwd/passwd.master" "$WORLD/etc/passwd" || return
	cp "$WORLD/usr/share/base-passwd/group.master" "$WORLD/etc/group" || return
	ln -sf mawk "$WORLD/usr/bin/awk" || return
	printf '127.0.0.1 localhost machine\n' >"$WORLD/etc/hosts" || return
	python=$(find "$WORLD/usr/lib" -maxdepth 1 -name 'python3.*' -printf '%f\n') || return
	.venv/bin/python -m pip install --disable-pip-version-check -q --only-binary=:all: \
		--platform manylinux2014_aarch64 --implementation cp --python-version "${python#python}" \
		--target "$WORLD/usr/local/lib/$python/dist-packages" 'pytest>=8.0' 'pytest-timeout>=2.2' 'cffi>=1.15' psutil || return
	# In the machine it would take a minute with each start.
	if [ "$("$PYTHON" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')" = "$python" ]; then
		"$PYTHON" -m compileall -q -j 0 -s "$WORLD" "$WORLD/usr/lib/$python" "$WORLD/usr/local/lib/$python" >/dev/null || true
	fi
	cp scripts/inside-aarch64.sh "$WORLD/usr/sbin/avckpt-machine" || return
	mkdir -p "$WORLD"/{opt/avckpt,proc,sys,dev,run,tmp} || return
	release=$(find "$WORLD/usr/lib/modules" -mindepth 1 -maxdepth 1 -printf '%f\n') || return
	depmod -b "$WORLD" "$release" || return
	make_initrd || return
	cp "$WORLD/boot/vmlinuz-$release" "$MACHINE/vmlinuz" || return
	truncate -s 4G "$MACHINE/disk" || return
	mke2fs -q -t ext4 -d "$WORLD" "$MACHINE/disk" || return
	printf '%s\n' "$key" >"$MACHINE/key"
}

# Where tests expect them, and newer than what they are made from.
make_checkout_disk() {
	rm -rf "$CHECKOUT" "$MACHINE/checkout.disk" || return
	mkdir -p "$CHECKOUT"/{native,tests/victims,build} || return
	list_sources . | tar --null -T - --ignore-failed-read -cf - | tar -C "$CHECKOUT" -xf - || return
	cp -a "$HERE/native" "$CHECKOUT/native/build" || return
	cp -a "$HERE/victims" "$CHECKOUT/tests/victims/build" || return
	cp "$HERE/_native.abi3.so" "$CHECKOUT/sidecar/avckpt/" || return
	printf '%s\n' "$@" >"$CHECKOUT/build/machine-arguments" || return
	truncate -s 2G "$MACHINE/checkout.disk" || return
	mke2fs -q -t ext4 -d "$CHECKOUT" "$MACHINE/checkout.disk"
}

PATH=$PATH:/usr/sbin:/sbin
PYTHON=${PYTHON:-python3}
[ $# -gt 0 ] || set -- tests/native
[ "$(id -u)" = 0 ] || die "it takes root to make a machine's file system"
[ -e "$HERE/_native.abi3.so" ] || die "nothing is compiled for aarch64: make build-aarch64"
if ! have qemu-system-aarch64 || ! have mke2fs || ! have mmdebstrap || ! have cpio || ! have depmod; then
	have apt-get || die "needed: qemu-system-aarch64, mke2fs, mmdebstrap, cpio, depmod"
	step machine-qemu "installing QEMU" install_qemu || die "QEMU could not be installed"
fi
mkdir -p "$MACHINE"
cached machine-aarch64 "$(content_key -- "$DEBIAN" "$PACKAGES" "$(declare -f make_world)")"
[ -f "$tarball" ] || step machine-world "fetching a Debian for aarch64 to boot" make_world ||
	die "no machine: it could not be fetched from $DEBIAN"
drop_older machine-aarch64
key=$(content_key scripts/inside-aarch64.sh -- "$tarball" "$(declare -f make_machine make_initrd)")
[ "$(cat "$MACHINE/key" 2>/dev/null)" = "$key" ] || step machine-disk "making its disk" make_machine || die "no disk could be made"
step machine-checkout "putting the checkout on a disk" make_checkout_disk "$@" || die "no disk could be made"
log=$LOGS/machine-aarch64.log
say "${BOLD}==>${PLAIN} booting it, emulated (${CPU_MODEL:=cortex-a76})"
disk() { printf -- '-drive\nfile=%s,format=raw,if=virtio,cache=unsafe,snapshot=on\n' "$1"; }
mapfile -t disks < <(disk "$MACHINE/disk" && disk "$MACHINE/checkout.disk")
timeout --foreground "$LIMIT" qemu-system-aarch64 -M virt,mte="$([ "$CPU_MODEL" = max ] && echo on || echo off)" -cpu "$CPU_MODEL" \
	-accel tcg,thread=multi -smp "${CPUS:-2}" -m "${MEMORY:-3G}" -display none -no-reboot -nic none \
	-kernel "$MACHINE/vmlinuz" -initrd "$MACHINE/initrd" \
	-append "console=ttyAMA0 quiet panic=1" "${disks[@]}" -serial stdio </dev/null | sed -u 's/\r$//' | tee "$log" || true
grep -q '^machine: ended with 0$' "$log" || die "the tests did not pass on aarch64 ($(tail -n 1 "$log"))"
