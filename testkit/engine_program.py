# SPDX-License-Identifier: Apache-2.0
"""C programs in tests/native that call the engine's functions."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

from testkit.harness import ROOT

CPU = platform.machine()
LAYERS = ("base", f"base/{CPU}", "trace", "state", "files", "process", "checkpoint", "restore", "guard")


def link_with_engine(name: str, folder: Path) -> Path:
    """Compiles tests/native/NAME.c into `folder`, with the headers of all layers and the engine's library."""
    native, program = ROOT / "native", folder / name
    includes = [native / "include", native / "build", native / "parasite", native / "parasite" / CPU]
    includes += [native / "lastpid", *(native / "engine" / layer for layer in LAYERS)]
    flags = ["-std=gnu11", "-D_GNU_SOURCE", "-pthread", *(f"-I{folder}" for folder in includes)]
    source = ROOT / "tests/native" / f"{name}.c"
    subprocess.run(["cc", *flags, source, native / "build/libavckpt.a", "-o", program], check=True, timeout=120)
    return program
