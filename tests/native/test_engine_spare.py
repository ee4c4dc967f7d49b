# SPDX-License-Identifier: Apache-2.0
"""The spare: a fork of the newest template, made while the application runs, whose memory a restore gives away."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from harness import wait_until
from native.family import ours
from native.guarded import BUILD, GuardProcess, Victim, config

MEGABYTES = 300


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def spares(victim: Victim) -> list[int]:
    return ours(victim, "avckpt-spare")


def wait_spare(victim: Victim, other_than: int = 0) -> int:
    """Until there is one, of one template."""
    wait_until(lambda: spares(victim) not in ([], [other_than]), 5, "a spare is made")
    (spare,) = spares(victim)
    return spare


def die_and_come_back(victim: Victim, guard: GuardProcess) -> None:
    since = guard.mark()
    victim.kill_app()
    guard.wait("restored", since=since)
    victim.wait_beats(3)


def test_it_is_used_up_and_made_again(tmp_path: Path) -> None:
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        spare = wait_spare(victim)
        template = ours(victim, "avckpt-tmpl")
        for _ in range(10):
            die_and_come_back(victim, guard)
            spare = wait_spare(victim, other_than=spare)
            assert ours(victim, "avckpt-tmpl") == template
        # Only the newest generation has one.
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        wait_until(lambda: ours(victim, "avckpt-tmpl") not in (template, []), 5, "another template")
        wait_spare(victim, other_than=spare)


def test_killed_it_is_no_loss(tmp_path: Path) -> None:
    """By the OOM killer, say: the template is still there."""
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        taken = guard.command("checkpoint")
        os.kill(wait_spare(victim), signal.SIGKILL)
        wait_until(lambda: not spares(victim), 5, "it is gone")
        since = guard.mark()
        victim.kill_app()
        assert guard.wait("restored", since=since)["generation"] == taken["generation"]
        victim.wait_beats(20)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_killed_while_it_is_made(tmp_path: Path) -> None:
    """The application dies at any moment of that; a death may wait for it, but comes to no harm."""
    rng = random.Random(1)
    with Victim(f"idle {MEGABYTES} 4", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(30):
            assert guard.command("checkpoint")["kind"] == "checkpoint"
            time.sleep(rng.uniform(0, 0.008))
            die_and_come_back(victim, guard)


def test_template_or_spare_killed_while_it_is_made(tmp_path: Path) -> None:
    """From inside the container, at any moment: it costs a generation at most, and is told."""
    rng = random.Random(2)
    with Victim(f"idle {MEGABYTES} 4", tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        for _ in range(30):
            assert guard.command("checkpoint")["kind"] == "checkpoint"
            since = guard.mark()
            time.sleep(rng.uniform(0, 0.008))
            for pid in ours(victim, rng.choice(["avckpt-tmpl", "avckpt-spare"])):
                with contextlib.suppress(ProcessLookupError):  # an old one, just ending
                    os.kill(pid, signal.SIGKILL)
            victim.wait_beats(3)
        kinds = {event["kind"] for event in guard.events[since:] if "kind" in event}
        assert kinds <= {"checkpoint", "dropped"}, kinds
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        die_and_come_back(victim, guard)


def test_none_when_checkpoints_are_too_frequent(tmp_path: Path) -> None:
    """It must not take much of a CPU."""
    command = f"idle {MEGABYTES} 1"
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.06), [victim.pid]) as guard:
        for _ in range(20):
            guard.wait("checkpoint", since=guard.mark())
            assert not spares(victim)
        die_and_come_back(victim, guard)


@contextlib.contextmanager
def limited(processes: int) -> Iterator[tuple[Victim, GuardProcess]]:
    """One of four threads that may have so many: with a holder and a template there are six."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # the victim is not root
        user = "/usr/bin/setpriv --reuid 54322 --regid 54322 --clear-groups --bounding-set -all --inh-caps -all"
        command = f"{user} /usr/bin/prlimit --nproc={processes}:{processes} {BUILD / 'idle'} 0 4"
        with Victim(command, Path(folder)) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
            yield victim, guard


def test_none_when_it_may_not_have_another_process() -> None:
    with limited(6) as (victim, guard):
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        time.sleep(0.1)
        assert not spares(victim)
        for _ in range(5):
            die_and_come_back(victim, guard)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_it_makes_room_for_a_template() -> None:
    """The next template is worth more than the spare of the last one."""
    with limited(7) as (victim, guard):
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        wait_spare(victim)
        for _ in range(5):
            answer = guard.command("checkpoint")
            assert answer["kind"] == "checkpoint", str(answer)
            time.sleep(0.1)
            assert not spares(victim)
            die_and_come_back(victim, guard)


def policies(victim: Victim, name: str) -> set[int]:
    return {os.sched_getscheduler(pid) for pid in ours(victim, name)}


def test_priorities_are_kept(tmp_path: Path) -> None:
    """It is made at an ordinary priority, so that the application runs; what is restored has its own."""
    with Victim("idle 50 2", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        os.sched_setscheduler(victim.app, os.SCHED_FIFO, os.sched_param(7))
        os.sched_setaffinity(victim.app, {0})
        for _ in range(3):
            assert guard.command("checkpoint")["kind"] == "checkpoint"
            wait_spare(victim)
            wait_until(lambda: policies(victim, "avckpt-spare") == {os.SCHED_FIFO}, 5, "the spare has it again")
            assert policies(victim, "avckpt-tmpl") == {os.SCHED_FIFO}
            for _ in range(2):
                die_and_come_back(victim, guard)
                assert os.sched_getscheduler(victim.app) == os.SCHED_FIFO
                assert os.sched_getparam(victim.app).sched_priority == 7
                assert os.sched_getaffinity(victim.app) == {0}
