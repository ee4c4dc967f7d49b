# SPDX-License-Identifier: Apache-2.0
"""Builds the cffi (API mode) extension `avckpt._native` from the C headers.

The declarations are the headers themselves, run through the C preprocessor:
there is one truth, and the C compiler checks it against libavckpt-client.a.
Named in setup.py (`cffi_modules`); run by itself it builds in place.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from cffi import FFI

NATIVE = Path(__file__).resolve().parent.parent
HEADERS = ("avckpt/error.h", "avckpt/engine.h")


if __name__ == "__main__":
    # In place: the extension goes beside the package's sources.
    subprocess.run(["make", "-s", "-C", str(NATIVE)], check=True)
    os.chdir(NATIVE.parent / "sidecar")


def declarations(*headers: Path) -> str:
    """Headers as cffi's cdef() wants them: no #include, no comments."""
    text = []
    for header in headers:
        lines = header.read_text().splitlines()
        text += [line for line in lines if not line.startswith("#include")]
    preprocessed = subprocess.run(
        [os.environ.get("CC", "cc"), "-E", "-P", "-x", "c", "-"],
        input="\n".join(text),
        capture_output=True,
        text=True,
        check=True,
    )
    return preprocessed.stdout


def relative(path: Path) -> str:
    """setuptools wants paths relative to the directory of setup.py."""
    return os.path.relpath(path)


ffibuilder = FFI()
ffibuilder.cdef(declarations(*(NATIVE / "include" / header for header in HEADERS)))
ffibuilder.set_source(
    "avckpt._native",
    "".join(f'#include "{header}"\n' for header in HEADERS),
    include_dirs=[relative(NATIVE / "include")],
    extra_objects=[relative(NATIVE / "build" / "libavckpt-client.a")],
    depends=[relative(NATIVE / "build" / "libavckpt-client.a")],
    extra_compile_args=["-std=gnu11", "-O2", f"-ffile-prefix-map={NATIVE.parent}=."],
    libraries=["pthread"],
)

if __name__ == "__main__":
    ffibuilder.compile(verbose=False)
