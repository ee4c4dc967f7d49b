# SPDX-License-Identifier: Apache-2.0
"""A restored process keeps its place: session and group, parent, terminal."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.family import kill_main
from testkit.guarded import WHERE, GuardProcess, Victim, config, kill_at_random, sleep_exactly


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def run(command: str, folder: Path) -> None:
    with Victim(command, folder) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 12, (0.01, 0.12))


@pytest.mark.parametrize("where", WHERE)
def test_those_that_have_ended(where: str, tmp_path: Path) -> None:
    """Zombies of every signal, SIGKILL included, in sessions and groups of their own: with their status."""
    run(f"places ended {where}", tmp_path)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("kind", ["leader", "terminal", "front"])
def test_a_main_process_that_leads_a_session(kind: str, where: str, tmp_path: Path) -> None:
    """Since before its first checkpoint: nothing of avckpt's takes the session's number, and it keeps its terminal."""
    run(f"places {kind} {where}", tmp_path)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("kind", ["stayed", "adopted", "groups"])
def test_sessions_and_groups_whose_leader_is_gone(kind: str, where: str, tmp_path: Path) -> None:
    """Or has left them since: each process is in the session and group with the numbers of the checkpoint."""
    run(f"places {kind} {where}", tmp_path)


@pytest.mark.parametrize("kind", ["orphans", "unwaited"])
def test_orphans_of_sessions_whose_leaders_are_gone(kind: str, tmp_path: Path) -> None:
    """Children of init in two such sessions; or the leader is a zombie."""
    with Victim(f"places {kind}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        for _ in range(12):
            since = guard.mark()
            guard.wait("checkpoint", since=since)
            kill_main(victim)
            guard.wait("restored", since=since)
            victim.wait_beats(3)


@pytest.mark.shared_machine("a holder that is not made in time after a restore is made by the next checkpoint")
def test_killed_again_before_the_next_checkpoint(tmp_path: Path) -> None:
    """The first time during a checkpoint, in which nobody can be asked any more; the terminal is a child's alone."""
    with Victim("places terminal --in-child", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.checkpoint()
        for turn in range(30):
            since = guard.mark()
            guard.say_command("checkpoint")
            sleep_exactly(turn % 10 * 1e-4)
            victim.kill_app()
            guard.wait("restored", since=since)
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats(3)
