# SPDX-License-Identifier: Apache-2.0
"""Plays what tests/victims/scenario.h describes: state disturbed after a checkpoint, looked at after a restore."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from testkit.board import Seen
from testkit.guarded import PATIENCE_S, GuardProcess, Json, Victim
from testkit.harness import wait_until

KILLS = 6


def checkpoint(guard: GuardProcess) -> Json:
    """Takes one, once the guard has found the victim."""
    taken = guard.checkpoint()
    assert taken["kind"] == "checkpoint", taken
    return taken


def disturb_app(app: int, see: Callable[[], Seen]) -> None:
    """Makes the victim that is the process `app` change its state, and waits until it has."""
    before = see().counter[2]
    os.kill(app, signal.SIGUSR1)
    wait_until(lambda: see().counter[2] > before or see().violations, PATIENCE_S, "it has", 0.001)


def disturb(victim: Victim) -> None:
    """The same."""
    disturb_app(victim.app, victim.see)


def wait_looked(victim: Victim, before: int) -> None:
    """Until it has looked at its state more often than `before`, and found nothing wrong."""
    wait_until(lambda: victim.see().counter[1] > before or victim.see().violations, PATIENCE_S, "it has looked", 0.001)
    victim.check()


def restored(victim: Victim, guard: GuardProcess, *, looks: bool = True) -> Json:
    """Kills it, and waits until it is there again, and has looked at its state."""
    before = victim.see().counter[1]
    since = guard.mark()
    victim.kill_app()
    event = guard.wait("restored", since=since)
    print(event)  # whether it told of what is found wrong now
    if looks:
        wait_looked(victim, before)
    victim.check()
    return event


def restore_twice(victim: Victim, guard: GuardProcess) -> None:
    """From one checkpoint, disturbed before the first time: everything is put back, with nothing to be told."""
    checkpoint(guard)
    disturb(victim)
    for _ in range(2):
        event = restored(victim, guard)
        assert "error" not in event, event


def disturb_and_restore(victim: Victim, guard: GuardProcess) -> None:
    """Again and again from each of two checkpoints: everything is put back, with nothing to be told."""
    for _ in range(2):
        checkpoint(guard)
        for _kill in range(KILLS):
            disturb(victim)
            event = restored(victim, guard)
            assert "error" not in event, event
