#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Run by an emulated machine when it has booted: the tests that build/machine-arguments names, and
# how they ended, in its last line.
set -o pipefail
cd /opt/avckpt || exit 1
# An emulated machine is about ten times slower (testkit/harness.py).
export HOME=/root LANG=C.UTF-8 AVCKPT_SLOWNESS=10
mapfile -t arguments <build/machine-arguments
printf 'Linux %s, %s, %s\n' "$(uname -r)" "$(podman --version)" "$(stat -f -c %T /sys/fs/cgroup)"
case "${arguments[*]}" in
*tests/integration* | *tests/platform*)
	if [ -f build/images.tar ]; then podman load -q -i build/images.tar; fi
	{ make setup-images && scripts/setup-trees.sh; } | cat
	;;
esac && .venv/bin/python -m pytest -p no:cacheprovider --timeout 900 --color=no "${arguments[@]}"
printf 'machine: ended with %s\n' $?
