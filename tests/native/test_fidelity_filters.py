# SPDX-License-Identifier: Apache-2.0
"""Seccomp filters of children and of single threads are in force again after a restore."""

from __future__ import annotations

import contextlib
import signal
from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config, forks_beside, kill_at_random
from testkit.harness import wait_until
from testkit.procfs import children_of, comm_of, inside, status_of
from testkit.seccomp import refusing

pytestmark = pytest.mark.shared_machine(
    "supervised processes stop at each call: a checkpoint that comes too late drops the generations"
)


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def confinement(victim: Victim) -> dict[int, tuple[str, str]]:
    """What each thread of each process is under: mode and number of filters, by its number in the container."""
    found, left = {}, [victim.app]
    # A template that is just being made, or ends, looks like one of them.
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        while left:
            pid = left.pop()
            left += children_of(pid)
            for task in Path(f"/proc/{pid}/task").iterdir():
                status = status_of(int(task.name))
                found[inside(int(task.name))] = (status["Seccomp"], status["Seccomp_filters"])
    return found


def wait_confined(victim: Victim) -> None:
    """Until all of `cells` have come under their filters."""
    wait_until(lambda: victim.see().counter[4] >= 5, 10, "all are confined")


def kill_each_checkpoint(guard: GuardProcess, victim: Victim, kills: int) -> None:
    """So many kills, each soon after a checkpoint of its own."""
    for _ in range(kills):
        guard.wait("checkpoint", since=guard.mark())
        kill_at_random(guard, victim, 1, (0.0, 0.03))


@pytest.mark.parametrize("command", ["cells", "sandbox --in-child", "under harmless cells"])
def test_children_and_threads_are_under_their_filters_again(command: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        if "cells" in command:
            wait_confined(victim)
        guard.wait("checkpoint", since=guard.mark(), count=2)
        before = confinement(victim)
        assert len(set(before.values())) > 1
        kill_each_checkpoint(guard, victim, 10)
        wait_until(lambda: confinement(victim) == before, 5, "everybody is under his filters")


def test_threads_that_got_a_wrong_number_are_gone(tmp_path: Path) -> None:
    """Otherwise they would be in the way of checkpoints."""
    with Victim("cells", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        wait_confined(victim)
        guard.wait("checkpoint", since=guard.mark(), count=2)
        before = confinement(victim)
        with forks_beside(victim):
            kill_each_checkpoint(guard, victim, 20)
        wait_until(lambda: confinement(victim) == before, 5, "nobody else is there")


def test_threads_that_shared_their_filters_share_them_again(tmp_path: Path) -> None:
    """Otherwise none of them could install another one for all (SECCOMP_FILTER_FLAG_TSYNC)."""
    with Victim("cells", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 1, (0.01, 0.12))
        victim.board.set_counter(1, 1)
        wait_until(lambda: victim.see().counter[2], 5, "it has tried")
        assert victim.see().counter[2] == 1
        guard.wait("checkpoint", since=guard.mark(), count=2)
        kill_at_random(guard, victim, 2, (0.01, 0.12))


def filters_of_holders(victim: Victim) -> set[str]:
    """The numbers of their seccomp filters."""
    holders = [pid for pid in children_of(victim.pid) if comm_of(pid) == "avckpt-hold"]
    return {status_of(pid)["Seccomp_filters"] for pid in holders}


@pytest.mark.parametrize("before", ["", "under harmless "])
def test_a_child_that_installs_one_later(before: str, tmp_path: Path) -> None:
    """Its holder, which shares its memory, comes under it, too."""
    with (
        Victim(before + "sandbox --late --in-child", tmp_path) as victim,
        GuardProcess(config(0.03), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        (child,) = children_of(victim.app)
        since = guard.mark()
        victim.kill_app(signal.SIGUSR1)
        if not before:
            assert guard.wait("guard_lost", since=since)["reason"] == "filter"
        wait_until(lambda: victim.see().counter[1], 5, "it is confined")
        guard.wait("checkpoint", since=guard.mark(), count=2)
        number = status_of(child)["Seccomp_filters"]
        assert number == ("2" if before else "1")
        assert number in filters_of_holders(victim)
        for _ in range(5):
            guard.wait("checkpoint", since=guard.mark())
            kill_at_random(guard, victim, 1, (0.0, 0.03))
        (child,) = children_of(victim.app)
        assert status_of(child)["Seccomp_filters"] == number


@pytest.mark.parametrize("kind", ["program", "call", "other"])
def test_none_runs_without_its_filters(kind: str, tmp_path: Path) -> None:
    """What a child changes in the parasite frees it of nothing, and makes no call that it may not make."""
    folder = tmp_path / "forged"
    with (
        Victim(f"cells --forge {kind} {folder}", tmp_path) as victim,
        GuardProcess(config(0.02), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=9)  # the parasite of a guard before is gone
        victim.board.set_counter(1, 1)
        # The newest checkpoint may be younger than what it has forged.
        for _ in range(20):
            victim.board.set_counter(3, 0)
            wait_until(lambda: victim.see().counter[3] > 3, 10, "it has forged something")
            since = guard.mark()
            victim.kill_app()
            end = guard.wait_for(lambda event: event["kind"] in ("restored", "gave_up"), "end", since=since)
            assert victim.see().violations == 0
            assert not folder.exists()
            if end["kind"] == "gave_up":
                break
        assert end["kind"] == "gave_up"
        assert end["error"]["syscall"] == "seccomp"


def test_children_found_in_a_freeze_are_under_filters(tmp_path: Path) -> None:
    """Those of the container, as everything there: make -j4 had 2 checkpoints of 21."""
    with (
        Victim("churn 8", tmp_path, preexec=refusing("userfaultfd")) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        seen = guard.burst(100)
        assert not [reason for reason in seen["reasons"] if "filters have just changed" in reason], seen
        victim.wait_beats()
