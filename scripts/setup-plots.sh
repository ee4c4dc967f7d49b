#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# matplotlib into .venv, for the benchmarks that draw plots.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
if ! .venv/bin/python -c 'import matplotlib' 2>/dev/null; then
	step matplotlib "installing matplotlib, for the plots" \
		.venv/bin/python -m pip install --disable-pip-version-check -q 'matplotlib>=3.8' ||
		die "matplotlib could not be installed"
fi
