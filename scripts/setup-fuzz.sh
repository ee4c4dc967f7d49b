#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# What `make fuzz` needs beyond the tests: clang with libFuzzer, and atheris in .venv.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
scripts/setup-system.sh fuzz
if ! .venv/bin/python -c 'import atheris' 2>/dev/null; then
	step atheris "installing atheris, the fuzzer for Python" \
		.venv/bin/python -m pip install --disable-pip-version-check -q 'atheris>=2.3' ||
		die "atheris could not be installed"
fi
