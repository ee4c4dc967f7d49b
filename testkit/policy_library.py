# SPDX-License-Identifier: Apache-2.0
"""What the guard decides (native/engine/guard/policy.c) for tests: no process, no clock, no root."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

from cffi import FFI

from native.bind.build_native import NATIVE, declarations

HEADERS = ("include/avckpt/error.h", "include/avckpt/engine.h", "engine/guard/policy.h")


class Library:
    """policy.c, compiled alone: only with the public headers and its own."""

    def __init__(self, folder: Path) -> None:
        self.object, shared = folder / "policy.o", folder / "policy.so"
        cc = ["cc", "-std=gnu11", "-O1", "-fPIC", f"-I{NATIVE}/include", f"-I{NATIVE}/engine/guard"]
        subprocess.run([*cc, "-c", str(NATIVE / "engine/guard/policy.c"), "-o", str(self.object)], check=True)
        subprocess.run(["cc", "-shared", str(self.object), "-o", str(shared)], check=True)
        self.ffi = FFI()
        self.ffi.cdef(declarations(*(NATIVE / header for header in HEADERS)))
        self.calls: Any = self.ffi.dlopen(str(shared))
