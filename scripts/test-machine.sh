#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# test-machine.sh KERNEL [ARGUMENT...]: boots the machine of setup-machine.sh with that kernel and
# this checkout, and runs pytest in it with the arguments.  Its output is shown as it comes and
# kept in build/logs; its status is this one's.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
[ $# -gt 0 ] || die "which kernel? test-machine.sh KERNEL [ARGUMENT...]"
KERNEL=$1
shift
MACHINE=$BUILD/machine
WORLD=$MACHINE/root
LIMIT=${LIMIT:-3h}
[ $# -gt 0 ] || set -- tests/native

save_images() {
	local images
	# Where they cannot be made here, they are made there.
	{ have podman && make -s setup-images && scripts/setup-trees.sh; } || return 0
	mapfile -t images < <(podman images --format '{{.Repository}}:{{.Tag}}' --filter 'reference=localhost/avckpt-*' |
		grep -v -e '-build:' -e '-ros' -e '-programs')
	[ ${#images[@]} = 0 ] || podman save -q -m -o "$1" "${images[@]}"
}

# Compiled here, in the machine's own root: in the machine it would take minutes.
install_checkout() {
	local there=$WORLD/opt/avckpt file
	# A test that is gone is not run.
	rm -rf "$there"/tests/{native,unit,platform,integration} || return
	mkdir -p "$there" || return
	list_sources . | tar --null -T - --ignore-failed-read -cf - | tar -C "$there" -xf - || return
	printf '%s\n' "$@" >"$MACHINE/arguments" || return
	install -D -m 644 "$MACHINE/arguments" "$there/build/machine-arguments" || return
	for file in /etc/resolv.conf /etc/hosts /etc/ssl/certs/ca-certificates.crt /etc/pip.conf; do
		[ ! -e "$file" ] || cp -L "$file" "$WORLD$file" || return
	done
	# What was made here need not be made there, where it takes a quarter of an hour.
	mkdir -p "$WORLD/root/.cache/avckpt" || return
	for file in "$CACHE"/base-*.tar "$CACHE"/trees-*.tar; do
		[ ! -e "$file" ] || cp -u "$file" "$WORLD/root/.cache/avckpt/" || return
	done
	rm -f "$there/build/images.tar" || return
	case "$*" in
	*tests/integration* | *tests/platform*) save_images "$there/build/images.tar" || return ;;
	esac
	# shellcheck disable=SC2016 # the words are for that shell
	unshare --mount bash -c '
		for name in proc sys dev; do mount --rbind "/$name" "$1/$name" || exit; done
		exec chroot "$1" make -C /opt/avckpt build-tests' - "$WORLD"
}

make_disk() {
	rm -f "$MACHINE/$KERNEL/disk" || return
	truncate -s 16G "$MACHINE/$KERNEL/disk" || return
	mke2fs -q -t ext4 -d "$WORLD" "$MACHINE/$KERNEL/disk"
}

[ -f "$MACHINE/$KERNEL/release" ] || die "there is no machine with the kernel of $KERNEL: scripts/setup-machine.sh $KERNEL makes it"
step machine-build "compiling this checkout for the machine" install_checkout "$@" || die "it could not be compiled"
step machine-disk "making its disk" make_disk || die "no disk could be made"
log=$LOGS/machine-$KERNEL.log
say "${BOLD}==>${PLAIN} booting Linux $(cat "$MACHINE/$KERNEL/release"), emulated; what it says is in ${LOGS#"$ROOT"/}/machine-$KERNEL.console"
timeout --foreground "$LIMIT" qemu-system-x86_64 -accel tcg,thread=multi -cpu max -smp 2 -m "${MEMORY:-6G}" \
	-display none -no-reboot -kernel "$MACHINE/$KERNEL/vmlinuz" -initrd "$MACHINE/$KERNEL/initrd" \
	-append 'root=/dev/vda rw console=ttyS0 panic=1' -drive "file=$MACHINE/$KERNEL/disk,format=raw,if=virtio,cache=unsafe" \
	-nic user,model=virtio-net-pci -serial "file:$LOGS/machine-$KERNEL.console" -serial stdio </dev/null | sed -u 's/\r$//' | tee "$log" || true
rm -f "$MACHINE/$KERNEL/disk"
grep -q '^machine: ended with 0$' "$log" || die "the tests did not pass on the kernel of $KERNEL ($(tail -n 1 "$log"))"
