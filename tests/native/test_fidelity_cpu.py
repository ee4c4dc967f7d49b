# SPDX-License-Identifier: Apache-2.0
"""Registers that not every CPU has."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from native.board import UNAVAILABLE_STATUS
from native.guarded import BUILD, GuardProcess, Victim, config, kill_at_random


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def skip_without(program: str) -> None:
    """Skips with what the victim says is missing."""
    done = subprocess.run([BUILD / program, "1", "--seconds", "0.05"], capture_output=True, text=True, check=False)
    if done.returncode == UNAVAILABLE_STATUS:
        pytest.skip(done.stderr.strip())


def test_tiles(tmp_path: Path) -> None:
    """AMX: a restored thread has to be given room for its tiles before it can have them."""
    skip_without("tiles")
    with Victim("tiles 3", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 40, (0.01, 0.12))
        assert not victim.see().violations
