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
