# SPDX-License-Identifier: Apache-2.0
"""Timers continue: with their ids, signals, values, threads, and deadlines."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config, kill_at_random

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; deadlines are compared with the clock"
)


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("command", ["timers", "alarm 20", "alarm 150"])
def test_timers(command: str, where: str, tmp_path: Path) -> None:
    with Victim(f"{command} {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 60, (0.005, 0.1))
