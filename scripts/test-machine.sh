#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# test-machine.sh KERNEL [demo] [ARGUMENT...]: boots the machine of setup-machine.sh (of the Debian
# that AVCKPT_MACHINE names) with that kernel and this checkout, and runs the demo and pytest in it
# with the arguments, and with AVCKPT_LONG.  Its output is shown as it comes and kept in build/logs;
# its status is this one's.
#
# The installed machine, with the images that tests need, is a disk that is kept: a run writes to
# it, and QEMU forgets that.  The checkout is a second disk.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
[ $# -gt 0 ] || die "which kernel? test-machine.sh KERNEL [demo] [ARGUMENT...]"
KERNEL=$1
shift
MACHINE=$BUILD/machine-${AVCKPT_MACHINE:-bookworm}
WORLD=$MACHINE/root
CHECKOUT=$MACHINE/checkout
DISK=$MACHINE/disk
LIMIT=${LIMIT:-3h}
[ $# -gt 0 ] || set -- tests/native

# in_world COMMAND...: in the machine's own root, with the checkout in its place.  /dev/shm is its
# own: Podman's locks are there.
in_world() {
	# shellcheck disable=SC2016 # the words are for that shell
	unshare --mount --pid --fork bash -c '
		mount --bind "$1" "$1" || exit # Podman changes how its root is mounted
		for name in sys dev; do mount --rbind "/$name" "$1/$name" || exit; done
		mount -t proc proc "$1/proc" && mount -t tmpfs shm "$1/dev/shm" && mount -t tmpfs run "$1/run" || exit
		mount --bind "$2" "$1/opt/avckpt" || exit
		root=$1; shift 2
		exec chroot "$root" "$@"' - "$WORLD" "$CHECKOUT" "$@"
}

# Compiled here, in the machine's own root: in the machine it would take minutes.
install_checkout() {
	local file
	mkdir -p "$CHECKOUT" "$WORLD/opt/avckpt" || return
	# A test that is gone is not run.
	rm -rf "$CHECKOUT"/tests/{native,unit,platform,integration} || return
	list_sources . | tar --null -T - --ignore-failed-read -cf - | tar -C "$CHECKOUT" -xf - || return
	printf '%s\n' "$@" >"$MACHINE/arguments" || return
	install -D -m 644 "$MACHINE/arguments" "$CHECKOUT/build/machine-arguments" || return
	for file in /etc/resolv.conf /etc/hosts /etc/ssl/certs/ca-certificates.crt /etc/pip.conf; do
		[ ! -e "$file" ] || cp -L "$file" "$WORLD$file" || return
	done
	case "$*" in
	*tests/native*) in_world make -C /opt/avckpt build-tests || return ;;
	*) in_world sh -c 'make -C /opt/avckpt setup-build && make -s -C /opt/avckpt/tests/victims' || return ;;
	esac
	case "$*" in
	*test_docker*) in_world sh -c 'apt-get update -q && /opt/avckpt/scripts/setup-docker.sh' || return ;;
	esac
	case "$*" in
	*test_upgrade*)
		in_world make -C /opt/avckpt deb || return
		scripts/make-deb-image.sh || return
		cp -u "$BUILD"/avckpt-sidecar-image_*.deb "$CHECKOUT/build/" || return
		;;
	esac
}

make_checkout_disk() {
	rm -f "$MACHINE/checkout.disk" || return
	truncate -s 4G "$MACHINE/checkout.disk" || return
	mke2fs -q -t ext4 -d "$CHECKOUT" "$MACHINE/checkout.disk"
}

# What `make setup-images` makes here need not be made there, where it takes a quarter of an hour.
list_images() {
	{ have podman && make -s setup-images >&2 && scripts/setup-trees.sh >&2; } || return 0
	podman images --format '{{.Repository}}:{{.Tag}} {{.Id}}' --filter 'reference=localhost/avckpt-*' |
		grep -E '^localhost/avckpt-(base|trees|sidecar):' | sort
}

load_images() {
	local names
	mapfile -t names < <(cut -d ' ' -f 1 <<<"$images" | grep .)
	[ ${#names[@]} != 0 ] || return 0
	rm -f "$CHECKOUT/build/images.tar" || return # Podman adds to none
	podman save -q -m -o "$CHECKOUT/build/images.tar" "${names[@]}" || return
	in_world sh -c 'podman rmi --all --force && podman load -q -i /opt/avckpt/build/images.tar' || return
	rm -f "$CHECKOUT/build/images.tar"
}

make_disk() {
	rm -f "$DISK" "$DISK.key" || return
	mkdir -p "$CHECKOUT/build" || return
	load_images || return
	truncate -s 24G "$DISK" || return
	mke2fs -q -t ext4 -d "$WORLD" "$DISK" || return
	printf '%s\n' "$key" >"$DISK.key"
}

[ -f "$MACHINE/$KERNEL/release" ] || die "there is no machine with the kernel of $KERNEL: scripts/setup-machine.sh $KERNEL makes it"
images=
case "$*" in
demo* | *tests/integration* | *tests/platform*) images=$(list_images) ;;
esac
key=$(content_key -- "$(cat "$MACHINE/world" "$MACHINE"/*/release)" "$images")
step machine-build "compiling this checkout for the machine" install_checkout "$@" || die "it could not be compiled"
[ "$(cat "$DISK.key" 2>/dev/null)" = "$key" ] || step machine-disk "making its disk" make_disk || die "no disk could be made"
step machine-checkout "putting the checkout on a disk" make_checkout_disk || die "no disk could be made"
log=$LOGS/machine-$KERNEL.log
say "${BOLD}==>${PLAIN} booting Linux $(cat "$MACHINE/$KERNEL/release"), emulated; what it says is in ${LOGS#"$ROOT"/}/machine-$KERNEL.console"
disk() { printf -- '-drive\nfile=%s,format=raw,if=virtio,cache=unsafe,snapshot=on\n' "$1"; }
mapfile -t disks < <(disk "$DISK" && disk "$MACHINE/checkout.disk")
timeout --foreground "$LIMIT" qemu-system-x86_64 -accel tcg,thread=multi -cpu max -smp "${CPUS:-2}" -m "${MEMORY:-6G}" \
	-display none -no-reboot -kernel "$MACHINE/$KERNEL/vmlinuz" -initrd "$MACHINE/$KERNEL/initrd" \
	-append "root=/dev/vda rw console=ttyS0 panic=1 systemd.default_device_timeout_sec=3600 systemd.setenv=AVCKPT_LONG=${AVCKPT_LONG:-}" "${disks[@]}" \
	-nic user,model=virtio-net-pci -serial "file:$LOGS/machine-$KERNEL.console" -serial stdio </dev/null | sed -u 's/\r$//' | tee "$log" || true
grep -q '^machine: ended with 0$' "$log" || die "the tests did not pass on the kernel of $KERNEL ($(tail -n 1 "$log"))"
