# SPDX-License-Identifier: Apache-2.0
"""Timers continue: with their ids, signals, values, threads, and deadlines."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config, kill_at_random
from testkit.harness import wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; deadlines are compared with the clock"
)


MOST = 60
"""That are kept (docs/fidelity.md)."""
OWN = 5
"""Of the victim `timers`, without those that are asked for."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("command", ["timers", "alarm 20", "alarm 150"])
def test_timers(command: str, where: str, tmp_path: Path) -> None:
    with Victim(f"{command} {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 60, (0.005, 0.1))
        if command != "timers":
            rung = victim.see().counter[0]
            wait_until(lambda: victim.see().counter[0] > rung + 2, 10, "they ring on")
            victim.check()


@pytest.mark.parametrize("where", WHERE)
def test_as_many_as_are_kept(where: str, tmp_path: Path) -> None:
    with Victim(f"timers {MOST - OWN} {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        victim.wait_beats()


@pytest.mark.parametrize("many", [MOST - OWN + 1, 1000])
def test_more_than_are_kept_are_told(many: int, tmp_path: Path) -> None:
    with Victim(f"timers {many}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        taken = guard.checkpoint()
        assert taken["kind"] == "checkpoint"
        assert f"more than {MOST} POSIX timers" in taken["error"]["message"]


@pytest.mark.parametrize("kind", ["alarm", "timer", "ticks"])
def test_a_watchdog_has_its_time_again(kind: str, tmp_path: Path) -> None:
    """The state gone back to is older than the time after which it kills."""
    watched_s = 1.0
    with (
        Victim(f"alarm {watched_s * 1000:.0f} {kind}", tmp_path) as victim,
        GuardProcess(config(60), [victim.pid]) as guard,
    ):
        guard.checkpoint()
        for _ in range(3):
            time.sleep(watched_s * 1.5)
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats(20)
            assert [event["kind"] for event in guard.events[since:]].count("restored") == 1
