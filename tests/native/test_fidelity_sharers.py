# SPDX-License-Identifier: Apache-2.0
"""Processes that share a descriptor table, or directories: clone(2), CLONE_FILES, CLONE_FS."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, WHERE, GuardProcess, Victim, config, kill_at_random
from testkit.harness import wait_until
from testkit.procfs import below, children_of, comm_of, state_of
from testkit.scenario import KILLS, checkpoint, disturb_and_restore, disturb_app, wait_looked


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("kind", ["files", "many"])
def test_one_table_of_several(kind: str, where: str, tmp_path: Path) -> None:
    """What one opens is open in the others, and in no other process."""
    with (
        Victim(f"sharers {kind} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


def test_an_orphan_with_the_table_of_the_main_process(tmp_path: Path) -> None:
    with Victim(f"sharers orphans {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        app = guard.wait("attached")["app_pid"]
        for _ in range(2):
            checkpoint(guard)
            for _kill in range(KILLS):
                disturb_app(app, victim.see)
                before, since = victim.see().counter[1], guard.mark()
                os.kill(app, signal.SIGKILL)
                event = guard.wait("restored", since=since)
                assert "error" not in event, event
                app = event["app_pid"]
                wait_looked(victim, before)


def descriptors(pid: int) -> dict[str, str]:
    folder = f"/proc/{pid}/fd"
    return {number: os.readlink(f"{folder}/{number}") for number in os.listdir(folder)}


def others(victim: Victim, app: int) -> list[int]:
    """The other processes of the application."""
    return [
        pid
        for pid in sorted({*below(app), *children_of(victim.pid)} - {app})
        if comm_of(pid) == "sharers" and state_of(pid) not in "ZX"
    ]


def test_the_end_of_one_closes_nothing_of_the_others(tmp_path: Path) -> None:
    """Whoever of them ends; an orphan is protected with what it has of the main process."""
    with Victim(f"sharers files {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        app = guard.wait("attached")["app_pid"]
        checkpoint(guard)
        left = others(victim, app)
        had = {pid: descriptors(pid) for pid in [app, *left]}
        while left:
            os.kill(left.pop(0), signal.SIGKILL)
            wait_until(lambda: others(victim, app) == left, PATIENCE_S, "it has ended")
            checkpoint(guard)
            assert {pid: descriptors(pid) for pid in [app, *left]} == {pid: had[pid] for pid in [app, *left]}
        os.kill(app, signal.SIGKILL)
        assert descriptors(guard.wait("restored")["app_pid"]) == had[app]


def test_what_one_that_ends_has_left_to_another(tmp_path: Path) -> None:
    """Which has been made since the last checkpoint."""
    with Victim(f"sharers leaving {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        app = guard.wait("attached")["app_pid"]
        checkpoint(guard)
        disturb_app(app, victim.see)
        (heir,) = others(victim, app)
        had = descriptors(heir)
        assert str(tmp_path / "first") in had.values()
        checkpoint(guard)
        assert descriptors(heir) == had


@pytest.mark.parametrize("where", WHERE)
def test_again_and_again(where: str, tmp_path: Path) -> None:
    """Each goes on with its own memory."""
    with (
        Victim(f"sharers many {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(0.03), [victim.pid]) as guard,
    ):
        kill_at_random(guard, victim, 12, (0.01, 0.12))
