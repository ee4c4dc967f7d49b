#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
#
# Cross-compiles everything for aarch64, below build/aarch64: native (guard, init, exec, the
# client's library), the Python binding, the tests' victims.

# shellcheck source=scripts/lib.sh
. "$(dirname "$0")/lib.sh"

cd "$ROOT"
HERE=$BUILD/aarch64
CROSS=aarch64-linux-gnu-
cross=(ARCH=aarch64 "CC=${CROSS}gcc" "CXX=${CROSS}g++" "AR=${CROSS}ar" "OBJCOPY=${CROSS}objcopy")

# cffi's extension keeps to Python's stable interface: of the configuration it takes no more
# than that an int has 32 bits and a pointer 64, as here.
make_binding() {
	local include version
	include=$("${PYTHON:-python3}" -c 'import sysconfig; print(sysconfig.get_paths()["include"])') || return
	version=${include##*/}
	mkdir -p "$HERE/include/aarch64-linux-gnu/$version" || return
	printf '#include "%s"\n' "$(find "/usr/include/$(uname -m)-linux-gnu/$version" "$include" -name pyconfig.h 2>/dev/null | head -n 1)" \
		>"$HERE/include/aarch64-linux-gnu/$version/pyconfig.h" || return
	(cd sidecar && PYTHONPATH=../native/bind ../.venv/bin/python -c '
import sys, build_native
build_native.ffibuilder.emit_c_code(sys.argv[1])' "$HERE/_native.c") || return
	"${CROSS}gcc" -std=gnu11 -O2 -shared -fPIC -I"$HERE/include" -I"$include" -Inative/include \
		-o "$HERE/_native.abi3.so" "$HERE/_native.c" "$HERE/native/libavckpt-client.a" -pthread
}

mkdir -p "$HERE"
step aarch64-native "compiling the engine and avckpt-init for aarch64" \
	make --no-print-directory -j2 -C native "${cross[@]}" "OUT=$HERE/native"
step aarch64-binding "the Python binding for aarch64" make_binding
step aarch64-victims "the tests' programs for aarch64" \
	make --no-print-directory -j2 -C tests/victims "${cross[@]}" "OUT=$HERE/victims"
