#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
#
# peers_world.sh TARBALL MOUNTPOINT PROGRAMS BOARDS CACHE: the first process of the peers'
# world, in mount, PID, network, IPC and UTS namespaces that it alone has (bench/peers_world.py
# starts it).  Everything is in memory: the system itself, containers, CRIU's images.
#
# pivot_root and not chroot: CRIU refuses a container whose mount namespace has another root
# than its process ("The root task has another root than mntns").
set -e
tarball=$1 root=$2 programs=$3 boards=$4 cache=$5

mount -t tmpfs -o mode=755 peers "$root"
tar -C "$root" --numeric-owner -xf "$tarball"
mount -t proc proc "$root/proc"
mount --rbind /sys "$root/sys"
mount --rbind /dev "$root/dev"
# Podman's lock file is in /dev/shm: not the host's.
mount -t tmpfs tmpfs "$root/dev/shm"
mount -t tmpfs -o mode=755 tmpfs "$root/run"
mount -t tmpfs tmpfs "$root/tmp"
mkdir -p "$root/programs" "$root/boards" "$root/cache" "$root/old" "$root/etc/containers"
mount --bind "$programs" "$root/programs"
mount --bind "$boards" "$root/boards"
mount --bind "$cache" "$root/cache"
ip link set lo up
cat >"$root/etc/containers/containers.conf" <<-END
	[containers]
	default_ulimits = ["nofile=$(ulimit -Hn):$(ulimit -Hn)", "nproc=4096:4096"]
	[engine]
	cgroup_manager = "cgroupfs"
	events_logger = "file"
END
cd "$root"
pivot_root . old
umount -l /old
echo up
# Reaps whatever loses its parent.
exec catatonit -P
