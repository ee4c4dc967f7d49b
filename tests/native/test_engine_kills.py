# SPDX-License-Identifier: Apache-2.0
"""Every victim under fast checkpoints, killed at random moments: it continues, and finds nothing wrong."""

from __future__ import annotations

import os
import random
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from testkit.family import kill_main, look
from testkit.guarded import GuardProcess, Victim, config, kill_at_random, sleep_exactly
from testkit.harness import SLOWNESS, wait_until
from testkit.procfs import children_of, inside

SHARED = pytest.mark.shared_machine("a kill has to come within the milliseconds of a restore")

KILLS = 12


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize(
    "command",
    [
        "threads 20 16",
        "threads 4 1 --no-churn",
        "leave 8",
        "fpu 4",
        "rseq 4",
        "signals 6 --pending",
        "busy 16",
        "crash",
        "tcpecho 0",
        "idle 20 40",
        "mappings 0 --inherited",
    ],
)
@pytest.mark.parametrize("interval_s", [0.05])
def test_killed_at_random_moments(command: str, interval_s: float, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(config(interval_s), [victim.pid]) as guard:
        kill_at_random(guard, victim, KILLS, (0.0, 3 * interval_s))
        victim.wait_beats(20)


@SHARED
@pytest.mark.parametrize("how", ["segv", "kill"])
def test_dies_as_soon_as_it_is_restored(how: str, tmp_path: Path) -> None:
    """Hundreds of times, at any step of the restore; at last it ends, and nothing hangs."""
    again = config(0.02, restore_window_s=0.000001)
    with Victim(f"crash {how} {SLOWNESS} --threads 6", tmp_path) as victim, GuardProcess(again, [victim.pid]) as guard:
        guard.wait("restored")
        time.sleep(4 * SLOWNESS)
        if victim.popen.poll() is None:
            # It would go on for ever: no two deaths are within the window.
            guard.wait("restored", since=guard.mark(), count=3)
            victim.kill(signal.SIGKILL)
        # init cannot end before every tracee was reaped.
        victim.end(5)
        assert guard.wait("ended")
        assert sum(event["kind"] == "restored" for event in guard.events if "kind" in event) > 20


def numbered(init: int, number: int, old: int) -> int:
    """The child of init with this number inside that is not `old`, also one that does not run yet; 0: none."""
    return next((m.pid for m in map(look, children_of(init)) if m and m.inside == number and m.pid != old), 0)


@SHARED
@pytest.mark.parametrize("command", ["threads 6 4 --no-churn", "tree 3"])
def test_is_killed_while_it_is_restored(command: str, tmp_path: Path) -> None:
    """By somebody else, and there is only one generation: that is as good as before."""
    rng, during = random.Random(1), 0
    only_one = config(0, keep=1, restore_window_s=0.000001)
    with Victim(command, tmp_path) as victim, GuardProcess(only_one, [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        number = inside(victim.app)
        for kills in range(400):  # how many hit it depends on the machine
            if during > 3 and kills >= 40:
                break
            dead, since = victim.app, guard.mark()
            os.kill(dead, signal.SIGKILL)
            again = wait_until(partial(numbered, victim.pid, number, dead), 5, "it is there again", 0.0001)
            sleep_exactly(rng.uniform(0, 0.0005))
            os.kill(again, signal.SIGKILL)
            guard.wait("restored", since=since)
            victim.wait_beats(3)
            restored = [event for event in guard.events[since:] if event.get("kind") == "restored"]
            during += len(restored) == 1
        assert during > 3


def templates_of(victim: Victim) -> int:
    """The container's templates, zombies included."""
    return sum(m is not None and m.name == "avckpt-tmpl" for m in map(look, children_of(victim.pid)))


def test_what_is_left_of_old_templates_is_reaped(tmp_path: Path) -> None:
    """The guard does not wait for a template's slow exit, but a zombie would keep the container from ending."""
    with Victim("threads 4 100 --no-churn", tmp_path) as victim, GuardProcess(config(0, keep=1), [victim.pid]) as guard:
        for _ in range(10):
            assert guard.checkpoint()["kind"] == "checkpoint"
        # The one that the next checkpoint is copied to stays.
        wait_until(lambda: templates_of(victim) <= 2, 5, "old templates go")


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("command", ["threads 4 20 --no-churn", "idle 8 64", "tree 8"])
def test_templates_that_go_with_their_container_are_no_news(
    command: str, signum: signal.Signals, tmp_path: Path
) -> None:
    """Also where the application is asked to end, and init tells of it while the templates go."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.05, keep=16), [victim.pid]) as guard:
        guard.wait("checkpoint", count=16)
        since = guard.mark()
        os.kill(victim.pid, signum)
        guard.wait("ended", since=since)
        assert not [event for event in guard.events[since:] if event.get("kind") == "dropped"]


def test_why_it_ended_is_what_is_told_last(tmp_path: Path) -> None:
    """A checkpoint that falls due while init ends is not reported as missed."""
    often = config(0.001, restore_on_signal=False)
    with Victim("tree 8", tmp_path) as victim, GuardProcess(often, [victim.pid]) as guard:
        guard.wait("checkpoint")
        since = guard.mark()
        kill_main(victim)
        guard.wait("ended", since=since)
        kinds = [event["kind"] for event in guard.events[since:]]
        assert kinds[kinds.index("gave_up") :] == ["gave_up", "ended"]
