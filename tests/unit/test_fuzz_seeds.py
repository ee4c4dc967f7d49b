# SPDX-License-Identifier: Apache-2.0
"""The fuzz targets in Python take their seeds: they include what the fuzzer has found."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.targets import TARGETS, home

CORPUS = Path(__file__).parents[1] / "fuzz" / "corpus"
SEEDS = [(name, path) for name in TARGETS for path in sorted((CORPUS / name).iterdir())]


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The run-time directory of the targets, and everything else as it was afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AVCKPT_RUN_DIR", "")  # before home() sets it, or that would be what is put back
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(home() / "run"))


@pytest.mark.parametrize(("name", "path"), SEEDS, ids=[f"{name}-{path.name}" for name, path in SEEDS])
def test_a_target_takes_its_seeds(name: str, path: Path) -> None:
    TARGETS[name](path.read_bytes())
