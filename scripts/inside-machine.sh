#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Run by an emulated machine when it has booted: the demo, if build/machine-arguments begins with
# that word, and the tests that it names; and how they ended, in its last line.
set -o pipefail
cd /opt/avckpt || exit 1
# An emulated machine is about ten times slower (testkit/harness.py).
export HOME=/root LANG=C.UTF-8 AVCKPT_SLOWNESS="${AVCKPT_SLOWNESS:-10}"
# Tests may install packages, which no other machine wants.
export AVCKPT_DISPOSABLE=1
mapfile -t arguments <build/machine-arguments
status=0
printf 'Linux %s, %s, %s, %s, systemd %s, %s\n' "$(uname -r)" "$(podman --version)" "$(crun --version | head -n 1)" \
	"$(conmon --version | head -n 1)" "$(systemctl --version | awk 'NR == 1 { print $2 }')" "$(stat -f -c %T /sys/fs/cgroup)"
case "${arguments[*]}" in
demo* | *tests/integration* | *tests/platform*)
	# They are on the disk, unless they could not be made before.
	if podman image exists localhost/avckpt-sidecar:latest; then
		scripts/setup-podman.sh || status=1
	else
		{ make setup-images && scripts/setup-trees.sh; } | cat || status=1
	fi
	;;
esac
if [ "${arguments[0]}" = demo ]; then
	arguments=("${arguments[@]:1}")
	.venv/bin/python -m scripts.demo | cat || status=1 # its spinner is for a terminal
fi
if [ ${#arguments[@]} != 0 ]; then
	.venv/bin/python -m pytest -p no:cacheprovider --timeout 900 --color=no "${arguments[@]}" || status=1
fi
printf 'machine: ended with %s\n' "$status"
