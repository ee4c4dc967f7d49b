# SPDX-License-Identifier: Apache-2.0
"""Writes that wait for room in a pipe: a checkpoint does not cut them short."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config, kill_at_random, since_linux


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@since_linux(6, 4, "writes into a pipe that do not wait")
@pytest.mark.parametrize("where", WHERE)
def test_a_write_is_not_cut_short(where: str, tmp_path: Path) -> None:
    """It waits for room in a pipe at nearly every checkpoint; a reader that gets no CPU may be given up."""
    checkpoints = 100
    with Victim(f"lengthy {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        victim.wait_beats()
        for _ in range(checkpoints):
            guard.checkpoint()
        victim.wait_beats()
        assert victim.see().counter[1] < checkpoints / 4


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("reader", ["", "--hang-up"])
def test_every_byte_is_written_once(reader: str, where: str, tmp_path: Path) -> None:
    """Of writes that were waiting for room in a pipe at the checkpoint, and went on in the running application;
    its reader may go away."""
    with Victim(f"lengthy {reader} {where}", tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        kill_at_random(guard, victim, 12, (0.01, 0.12))
