#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Makes `podman run` work where the machine keeps it from working, and only
# there: a Podman that can start a container is left exactly as it is.
#
# What is done is found by trying:
#   - rlimits that may not be raised (no CAP_SYS_RESOURCE): a drop-in file with
#     limits that this machine allows;
#   - crun refuses "hybrid" cgroups while a controller is left in cgroup2:
#     hugetlb, which nothing here uses, is mounted as cgroup v1.
# `setup-podman.sh --undo` takes both back.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

IMAGE=localhost/avckpt-base
DROP_IN=/etc/containers/containers.conf.d/10-avckpt-machine.conf
HUGETLB=/sys/fs/cgroup/hugetlb
MOUNTED=/run/avckpt-mounted-hugetlb

if [ "${1:-}" = --undo ]; then
	rm -f "$DROP_IN"
	if [ -e "$MOUNTED" ]; then
		umount "$HUGETLB" && rmdir "$HUGETLB" && rm -f "$MOUNTED"
	fi
	exit 0
fi

[ "$(id -u)" = 0 ] || die "avckpt protects containers of root's Podman: run this as root (sudo make ...)"

# Prints what Podman said when no container could be started.
try_run() {
	podman run --pull=never --rm --name "avckpt-probe-$$" "$@" "$IMAGE" true 2>&1
}

limit_rlimits() {
	allowed_limits
	mkdir -p "$(dirname "$DROP_IN")"
	# Soft and hard are equal: Podman 4.3's service takes one for the other.
	cat >"$DROP_IN.new" <<-END
		# Written by avckpt's scripts/setup-podman.sh: this machine does not let Podman
		# raise resource limits, and without this no container starts here.
		[containers]
		default_ulimits = ["nofile=$MAX_FILES:$MAX_FILES", "nproc=$MAX_PROCS:$MAX_PROCS"]
	END
	mv "$DROP_IN.new" "$DROP_IN"
	note "containers get the resource limits this machine allows ($DROP_IN)"
	if [ -n "${CONTAINERS_CONF:-}" ]; then
		warn "CONTAINERS_CONF is set: Podman reads $CONTAINERS_CONF only, and not $DROP_IN"
	fi
}

empty_cgroup2() {
	mkdir -p "$HUGETLB" || return 1
	mount -t cgroup -o hugetlb cgroup "$HUGETLB" || return 1
	: >"$MOUNTED"
	note "the hugetlb controller was moved to cgroup v1 ($HUGETLB): crun refuses mixed cgroups"
}

# Each remedy at most once.
limited='' emptied=''
until said=$(try_run --network=none); do
	case $said in
	*setrlimit*)
		[ -z "$limited" ] || die "containers do not start, also with lower resource limits: $said"
		limited=yes
		limit_rlimits
		;;
	*"hybrid mode not supported"*)
		[ -z "$emptied" ] || die "crun does not work with this machine's cgroups, and runc is another way: $said"
		emptied=yes
		empty_cgroup2 || die "crun refuses this machine's hybrid cgroups and $HUGETLB cannot be mounted: install runc and name it in containers.conf ([engine] runtime=\"runc\")"
		;;
	*)
		die "podman cannot start a container here: $said"
		;;
	esac
done

if ! said=$(try_run); then
	warn "containers on Podman's default (bridge) network do not start here, host network does: $said"
fi
note "podman: $(podman --version | cut -d' ' -f3) starts containers"
