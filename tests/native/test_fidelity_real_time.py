# SPDX-License-Identifier: Apache-2.0
"""A thread of real-time priority does not stand still while others take their time to stop."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config

pytestmark = pytest.mark.shared_machine("a thread of real-time priority gets its CPU late where others have more")

SLOW_S = 0.02
"""What a freeze takes that waits for the ordinary thread, most of the time that one's child lives."""
FREEZES = 5


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
def test_it_is_stopped_last(where: str, tmp_path: Path) -> None:
    gaps: list[float] = []
    with (
        Victim(f"urgent 60 {where}".strip(), tmp_path) as victim,
        GuardProcess(config(freeze_deadline_s=1.0), [victim.pid]) as guard,
    ):
        guard.command("checkpoint")
        guard.command("checkpoint")  # by now it is known which thread that is
        while len(gaps) < FREEZES:
            victim.board.forget_gap()
            freeze_s = guard.command("checkpoint").get("freeze_s", 0.0)
            victim.wait_beats(5)
            if freeze_s > SLOW_S:
                gaps.append(victim.see().gap_ns / 1e9 / freeze_s)
    assert sorted(gaps)[FREEZES // 2] < 0.5, gaps
