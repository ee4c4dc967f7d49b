#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# The virtual environment in .venv, with this package installed editable and
# everything the tests need.  The package's own build compiles native/.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
PYTHON=${PYTHON:-python3}
STAMPS=$BUILD/stamps
mkdir -p "$STAMPS"

# The interpreter is part of the key: after an upgrade of the system's Python an
# old environment does not start any more.
version=$("$PYTHON" -c 'import sys; print(sys.version, sys.base_prefix)')
key=$(content_key pyproject.toml setup.py hooks/avckpt_hooks/__init__.py -- "$version" "$ROOT")

if [ ! -x .venv/bin/python ] || ! .venv/bin/python -c '' 2>/dev/null; then
	rm -rf .venv "$STAMPS/venv"
	step venv "making the virtual environment .venv" "$PYTHON" -m venv .venv
fi

# The C parts change more often than the environment.  What is old, make and the
# extension's dependency on libavckpt.a find out by themselves.
native_key=$(content_key native setup.py -- "$key")
native_is_new() {
	[ "$(cat "$STAMPS/native" 2>/dev/null)" = "$native_key" ] && [ -x native/build/avckpt-init ]
}

# On its own, before pip does it: a compiler's message is not buried in pip's.
native_is_new || step native "compiling the engine and avckpt-init" make --no-print-directory -j"$(nproc)" -C native

if [ "$(cat "$STAMPS/venv" 2>/dev/null)" != "$key" ]; then
	# Built without isolation, so that a change of the C sources needs no network.
	step pip-build "installing the build's own tools" \
		.venv/bin/python -m pip install --disable-pip-version-check -q -U 'setuptools>=77' 'cffi>=1.15'
	step pip-install "installing avckpt (editable) with the tests' tools" \
		.venv/bin/python -m pip install --disable-pip-version-check -v --no-build-isolation -e '.[test]'
	printf '%s\n' "$key" >"$STAMPS/venv"
fi

if ! native_is_new || ! .venv/bin/python -c 'import avckpt._native' 2>/dev/null; then
	step binding "building the Python binding" .venv/bin/python setup.py build_ext --inplace
	.venv/bin/python -c 'import avckpt._native' || die "the Python binding was built but does not load"
	printf '%s\n' "$native_key" >"$STAMPS/native"
fi
