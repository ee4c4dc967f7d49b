# SPDX-License-Identifier: Apache-2.0
"""Locates the files that avckpt installs or starts.

They are either inside the installed package (a wheel) or in a source
checkout. The package's own copy takes precedence, so that an installed avckpt
never picks up a stray build.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from avckpt.errors import ConfigError

PACKAGE = Path(__file__).resolve().parent
CHECKOUT = PACKAGE.parent.parent


def init_binary() -> Path:
    """The static program avckpt-init.  Raises ConfigError when it is missing."""
    return _program("avckpt-init")


def inside_binary() -> Path:
    """The static program avckpt-exec (`inside.py`).  Raises ConfigError when it is missing."""
    return _program("avckpt-exec")


def guard_binary() -> Path:
    """The static program avckpt-guard (`native.py`).  Raises ConfigError when it is missing."""
    return _program("avckpt-guard")


def hooks_source() -> Path:
    """The directory of the Python package avckpt_hooks.  Raises ConfigError when it is missing."""
    candidates = (PACKAGE.parent / "avckpt_hooks", CHECKOUT / "hooks" / "avckpt_hooks")
    for path in candidates:
        if (path / "__init__.py").is_file():
            return path
    raise ConfigError(_nowhere("the package avckpt_hooks", candidates, "install avckpt again"))


def oci_hooks_source() -> Path:
    """The directory of the hook JSON files.  Raises ConfigError when it is missing."""
    candidates = (PACKAGE / "oci-hooks.d", CHECKOUT / "oci-hooks.d")
    for path in candidates:
        if any(path.glob("*.json")):
            return path
    raise ConfigError(_nowhere("the directory oci-hooks.d", candidates, "install avckpt again"))


def packaging(name: str) -> Path:
    """A file of the folder `packaging`.  Raises ConfigError when it is missing."""
    candidates = (PACKAGE / "packaging" / name, CHECKOUT / "packaging" / name)
    for path in candidates:
        if path.is_file():
            return path
    raise ConfigError(_nowhere(name, candidates, "install avckpt again"))


def build_id() -> str:
    """Twelve hex digits of a hash of all programs: builds between two releases share one version.

    Raises ConfigError.
    """
    digest = hashlib.sha256()
    for package in (PACKAGE, hooks_source()):
        for path in sorted(package.glob("**/*.py")):
            digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes() + b"\0")
    for program in (init_binary(), inside_binary(), guard_binary()):
        digest.update(program.read_bytes())
    return digest.hexdigest()[:12]


def _program(name: str) -> Path:
    candidates = (PACKAGE / "libexec" / name, CHECKOUT / "native" / "build" / name)
    for path in candidates:
        if path.is_file() and os.access(path, os.X_OK):
            return path
    raise ConfigError(_nowhere(f"the program {name}", candidates, "build it with: make -C native"))


def _nowhere(what: str, candidates: tuple[Path, ...], remedy: str) -> str:
    return f"{what} is not in {' or '.join(str(path) for path in candidates)}: {remedy}"
