#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
#
# The first process of the machine of test-aarch64.sh: runs the tests that build/machine-arguments
# names, says how they ended, and turns the machine off.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8
# An emulated machine is about ten times slower (testkit/harness.py).
export AVCKPT_SLOWNESS="${AVCKPT_SLOWNESS:-10}" AVCKPT_DISPOSABLE=1
export PYTHONPATH=/opt/avckpt/sidecar:/opt/avckpt/hooks

mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t cgroup2 cgroup2 /sys/fs/cgroup
mkdir -p /dev/pts /dev/shm
mount -t devpts -o mode=620,ptmxmode=666 devpts /dev/pts
mount -t tmpfs shm /dev/shm
mount -t tmpfs run /run
mount -t ext4 /dev/vdb /opt/avckpt
mkdir -p /run/lock
chmod 1777 /tmp /dev/shm
echo machine >/proc/sys/kernel/hostname
ip link set lo up
# As systemd would.
ulimit -Hn 524288
echo 4194304 >/proc/sys/kernel/pid_max

cd /opt/avckpt || exit
mapfile -t arguments <build/machine-arguments
printf 'Linux %s, %s, %s\n' "$(uname -rm)" "$(python3 --version)" "$(stat -f -c %T /sys/fs/cgroup)"
status=0
setsid --wait python3 -m pytest -p no:cacheprovider --timeout 900 --color=no "${arguments[@]}" </dev/null || status=1
printf 'machine: ended with %s\n' "$status"
sync
busybox poweroff -f
