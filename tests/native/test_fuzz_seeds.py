# SPDX-License-Identifier: Apache-2.0
"""The fuzz targets in C take their seeds, under ASan and UBSan: they include what the fuzzer has found."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from testkit.harness import ROOT

FUZZ = ROOT / "tests" / "fuzz"
TARGETS = sorted(path.stem for path in FUZZ.glob("*.c") if path.stem not in ("seeds", "rubbish"))


@pytest.fixture(scope="module")
def programs() -> Path:
    """The folder of the built targets."""
    subprocess.run(["make", "-s", "-C", str(FUZZ), "SEEDS=1"], check=True, timeout=600)
    return FUZZ / "build-seeds"


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", TARGETS)
def test_a_target_takes_its_seeds(name: str, programs: Path) -> None:
    seeds = sorted(map(str, (FUZZ / "corpus" / name).iterdir()))
    done = subprocess.run(
        [str(programs / name), *seeds],
        env={**os.environ, "UBSAN_OPTIONS": "print_stacktrace=1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout.decode(errors="replace")
