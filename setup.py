# SPDX-License-Identifier: Apache-2.0
"""The package's build: native code first, then the cffi extension that links it.

Everything declarative is in pyproject.toml.  What is done here: `make -C
native` (avckpt-guard, avckpt-init and avckpt-exec), the extension `avckpt._native`, and putting
into the wheel what `avckpt install` needs on a machine without this source
tree: the programs and the hook JSON.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent

# setuptools wants paths relative to this folder, and runs us from it.
os.chdir(ROOT)


def make_native() -> None:
    """Builds what is native, below native/build; does nothing when they are new."""
    subprocess.run(["make", "--no-print-directory", "-C", str(ROOT / "native")], check=True)


class BuildExt(build_ext):
    """Builds the library before the extension that links it."""

    def run(self) -> None:
        make_native()
        super().run()


class BuildPy(build_py):
    """Adds the files that are data to Python but live in folders of their own."""

    def run(self) -> None:
        make_native()
        super().run()
        if not self.editable_mode:
            for source, target in data_files(Path(self.build_lib)):
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, target)


def data_files(build_lib: Path) -> list[tuple[Path, Path]]:
    """Where each data file comes from and where in the wheel it goes."""
    package = build_lib / "avckpt"
    programs = ("avckpt-init", "avckpt-exec", "avckpt-guard")
    pairs = [(ROOT / "native" / "build" / name, package / "libexec" / name) for name in programs]
    share = ("avckpt-sidecar.container", "Containerfile")
    pairs += [(ROOT / "packaging" / name, package / "packaging" / name) for name in share]
    pairs += [(path, package / "oci-hooks.d" / path.name) for path in sorted((ROOT / "oci-hooks.d").glob("*.json"))]
    return pairs


setup(
    package_dir={"avckpt": "sidecar/avckpt", "avckpt_hooks": "hooks/avckpt_hooks"},
    packages=find_packages("sidecar") + find_packages("hooks"),
    package_data={"avckpt": ["py.typed", "web/page/*"], "avckpt_hooks": ["py.typed"]},
    cffi_modules=["native/bind/build_native.py:ffibuilder"],
    cmdclass={"build_ext": BuildExt, "build_py": BuildPy},
    # The binding is built against the stable ABI: one wheel for every Python from this one on.
    options={"bdist_wheel": {"py_limited_api": "cp39"}},
)
