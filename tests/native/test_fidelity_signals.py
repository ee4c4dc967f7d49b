# SPDX-License-Identifier: Apache-2.0
"""Signals that were sent and not delivered at the checkpoint are still to come after a restore."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from native.guarded import WHERE, GuardProcess, Victim, config, kill_at_random


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("command", ["pending 1", "pending 12", "signals 6 --pending"])
def test_pending_signals(command: str, where: str, tmp_path: Path) -> None:
    """With their values, codes and senders, in their order; none twice."""
    with Victim(f"{command} {where}", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        kill_at_random(guard, victim, 60, (0.005, 0.08))


@pytest.mark.parametrize("signum", [signal.SIGABRT, signal.SIGTERM, signal.SIGRTMIN])
def test_a_deadly_signal_is_in_no_image(signum: int, tmp_path: Path) -> None:
    """Sent while a checkpoint is being taken, it waits until the application runs: what has it pending can not live."""
    with Victim("busy 64", tmp_path) as victim, GuardProcess(config(0.001), [victim.pid]) as guard:
        guard.wait("checkpoint", count=5)
        for n in range(1, 21):
            since = guard.mark()
            victim.kill_app(signum)
            guard.wait("restored", since=since)
            victim.wait_beats(3)
            guard.wait("checkpoint", since=since)
            deaths = [event for event in guard.events if event.get("kind") == "died"]
            assert len(deaths) == n, deaths[-3:]
