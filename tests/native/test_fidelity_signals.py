# SPDX-License-Identifier: Apache-2.0
"""Signals that were sent and not delivered at the checkpoint are still to come after a restore."""

from __future__ import annotations

from pathlib import Path

import pytest
from native.guarded import GuardProcess, Victim, config, kill_at_random


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("command", ["pending 1", "pending 12", "signals 6 --pending"])
def test_pending_signals(command: str, tmp_path: Path) -> None:
    """With their values, codes and senders, in their order; none twice."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        kill_at_random(guard, victim, 60, (0.005, 0.08))
