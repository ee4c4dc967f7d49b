# SPDX-License-Identifier: Apache-2.0
"""avckpt.interval=auto: a guard that finds out itself how often, and when."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config

AUTO = config(3.0, interval_min_s=0.02, keep=3)


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def test_an_application_at_work_is_checkpointed_often_and_told_of_seldom(tmp_path: Path) -> None:
    with Victim("busy 4", tmp_path) as victim, GuardProcess(AUTO, [victim.pid]) as guard:
        first = guard.wait("checkpoint")
        assert (first["generation"], first["checkpoints"]) == (1, 1)
        guard.wait("checkpoint", count=4)
        told = [event for event in guard.events if event["kind"] == "checkpoint"]
        assert sum(event["checkpoints"] for event in told) == told[-1]["generation"] > 6
        assert all(event["freeze_max_s"] >= event["freeze_s"] > 0 for event in told)
        assert all(0.02 <= event["interval_s"] <= 3 for event in told)
        gaps = [(b["at_ns"] - a["at_ns"]) / 1e9 for a, b in zip(told, told[1:])]
        assert min(gaps) > 0.9, gaps
        victim.check()


def test_a_death_is_told_after_the_checkpoints_before_it(tmp_path: Path) -> None:
    with Victim("busy 4", tmp_path) as victim, GuardProcess(AUTO, [victim.pid]) as guard:
        guard.wait("checkpoint", count=2)
        for _ in range(5):
            since = guard.mark()
            victim.wait_beats(200)
            victim.kill_app()
            restored = guard.wait("restored", since=since)
            newest = max(event["generation"] for event in guard.events if event["kind"] == "checkpoint")
            assert restored["generation"] == newest
            assert restored["freeze_s"] > 0
            victim.wait_beats(20)


def test_an_application_that_does_nothing_is_left_alone(tmp_path: Path) -> None:
    with Victim("idle 4 6 --beat-us 600000000", tmp_path) as victim, GuardProcess(AUTO, [victim.pid]) as guard:
        guard.wait("checkpoint")
        time.sleep(8)
        assert guard.command("checkpoint")["generation"] <= 3
        # It goes back to that one all the same.
        victim.kill_app()
        assert guard.wait("restored")["restores"] == 1


def test_what_fails_is_not_told_twenty_times_a_second(tmp_path: Path) -> None:
    tight = dataclasses.replace(AUTO, freeze_deadline_s=1e-9)
    with Victim("busy 4", tmp_path) as victim, GuardProcess(tight, [victim.pid]) as guard:
        guard.wait("missed")
        time.sleep(4)
        assert 3 <= sum(event["kind"] == "missed" for event in guard.events) <= 12
        victim.check()
