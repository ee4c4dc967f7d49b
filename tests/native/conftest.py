# SPDX-License-Identifier: Apache-2.0
"""Builds the programs that the native tests run, and what several of them need."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.harness import ROOT


def make(folder: str, *goals: str) -> None:
    """Runs make; its output is the error message if it fails."""
    done = subprocess.run(
        ["make", "-s", "-C", str(ROOT / folder), *goals],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout


@pytest.fixture(scope="session")
def init_built() -> None:
    """native/build/avckpt-init, brought up to date."""
    make("native", "build/avckpt-init")


@pytest.fixture(scope="session")
def victims_built() -> Path:
    """The folder of the built tests/victims."""
    make("tests/victims")
    return ROOT / "tests/victims/build"


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder for the board; on a disk its writable mapping would count as data."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)


@pytest.fixture
def huge_pages() -> Iterator[None]:
    """Adds a few pages to the machine's pool for the length of a test."""
    pool = Path("/proc/sys/vm/nr_hugepages")
    before = int(pool.read_text())
    pool.write_text(str(before + 8))
    try:
        if int(pool.read_text()) < before + 8:
            pytest.skip("the kernel finds no 8 huge pages")
        yield
    finally:
        pool.write_text(str(before))
