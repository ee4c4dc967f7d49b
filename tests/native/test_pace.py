# SPDX-License-Identifier: Apache-2.0
"""avckpt.interval=auto: the guard decides how often, and when; and what holds for any interval."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config, since_linux
from testkit.harness import app_pid, wait_until
from testkit.init_peer import Init

pytestmark = pytest.mark.shared_machine("a guard that gets no CPU for a second takes fewer checkpoints")
AUTO = config(3.0, interval_min_s=0.02, keep=3)


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def test_an_application_at_work_is_checkpointed_often_and_told_of_seldom(tmp_path: Path) -> None:
    with Victim("busy 4", tmp_path) as victim, GuardProcess(AUTO, [victim.pid]) as guard:
        first = guard.wait("checkpoint")
        assert (first["generation"], first["checkpoints"]) == (1, 1)
        # On a slow machine the first ones can be more than a second apart.
        guard.wait_for(lambda event: event["kind"] == "checkpoint" and event["checkpoints"] > 2, "several in a second")
        guard.wait("checkpoint", since=guard.mark(), count=3)
        told = [event for event in guard.events if event["kind"] == "checkpoint"]
        assert sum(event["checkpoints"] for event in told) == told[-1]["generation"]
        assert all(event["freeze_max_s"] >= event["freeze_s"] > 0 for event in told)
        assert all(0.02 <= event["interval_s"] <= 3 for event in told)
        # They are told a second apart: at_ns is that of the checkpoint, up to an interval before.
        assert (told[-1]["at_ns"] - told[0]["at_ns"]) / 1e9 / (len(told) - 1) > 0.8
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


SENDER = """
import socket, sys, time
to = ("127.0.0.1", int(sys.argv[1]))
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
n, due = 0, time.monotonic()
while True:
    out.sendto(str(n).encode(), to)
    n, due = n + 1, due + float(sys.argv[2])
    time.sleep(max(due - time.monotonic(), 0))
"""


@contextmanager
def sender(period_s: float) -> Iterator[tuple[Init, socket.socket]]:
    """A program that sends a number at intervals and is otherwise idle, and its receiver."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(30)
        command = [sys.executable, "-S", "-c", SENDER, str(peer.getsockname()[1]), str(period_s)]
        with Init(command, pid1=True) as init:
            peer.recv(64)
            yield init, peer


@since_linux(6, 6, "sock:sock_send_length")
def test_what_was_sent_is_remembered(tmp_path: Path) -> None:
    """If output were not noticed, so idle a program would have a checkpoint every 3 s only."""
    with sender(1.2) as (init, peer), GuardProcess(AUTO, [init.pid]) as guard:
        guard.wait("checkpoint", count=2)
        first, since = int(peer.recv(64)), guard.mark()
        guard.wait("checkpoint", since=since, count=7)
        peer.setblocking(False)
        with suppress(BlockingIOError):
            while True:
                sent = int(peer.recv(64)) - first
        taken = [event["checkpoints"] for event in guard.events[since:] if event["kind"] == "checkpoint"]
        assert sum(taken) > 0.7 * sent, (taken, sent)


def test_what_listens_is_given_up_with_the_application_that_it_listens_to(tmp_path: Path) -> None:
    with sender(0.1) as (init, peer), GuardProcess(AUTO, [init.pid]) as guard:
        guard.wait("checkpoint", count=3)
        fds = guard.fds().total()
        for _ in range(20):
            since = guard.mark()
            os.kill(app_pid(init.pid), signal.SIGKILL)
            guard.wait("restored", since=since)
            for _ in range(4):
                peer.recv(64)
        assert guard.fds().total() < fds + 10


@pytest.mark.parametrize("apart_s", [0.0, 1.5])
def test_a_fault_that_shows_late_needs_older_ones(tmp_path: Path, apart_s: float) -> None:
    """It poisons the state, and kills half a second later; a checkpoint every 50 ms."""
    often = config(0.05, keep=3, apart_s=apart_s, restore_max=3, restore_window_s=60.0)
    with Victim("poison 500", tmp_path) as victim, GuardProcess(often, [victim.pid]) as guard:
        guard.wait("checkpoint", count=10)
        wait_until(lambda: guard.command("list")["age_s"] >= apart_s, 2 * apart_s + PATIENCE_S, "an old one", 0.05)
        victim.kill_app(signal.SIGUSR1)
        if not apart_s:
            assert guard.wait("gave_up")["reason"] == "limit"
            return
        guard.wait_for(lambda event: event["kind"] == "restored" and event["age_s"] > 0.5, "an older one")
        victim.wait_beats(1000)


def test_it_runs_for_as_long_as_it_was_stopped(tmp_path: Path) -> None:
    """Where a freeze takes longer than the interval."""
    often = config(0.001, images=Images.FORK)
    with Victim("idle 200 4", tmp_path) as victim, GuardProcess(often, [victim.pid]) as guard:
        guard.wait("checkpoint", count=40)
        taken = [event for event in guard.events if event["kind"] == "checkpoint"]
    frozen_s = sum(event["freeze_s"] for event in taken[:-1])
    assert frozen_s / len(taken) > 0.001
    assert (taken[-1]["at_ns"] - taken[0]["at_ns"]) / 1e9 > 1.9 * frozen_s


def cpu_ticks(pid: int) -> tuple[int, int]:
    """What it has used, as a user and in the kernel."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return int(fields[11]), int(fields[12])


def test_it_is_not_kept_busy_by_copies_of_what_it_writes(tmp_path: Path) -> None:
    """23,000 pages: the first writes to them take longer than the interval, so there would be nothing else."""
    often = config(0.05, images=Images.FORK)
    with Victim("hoard 90 always", tmp_path) as victim, GuardProcess(often, [victim.pid]) as guard:
        guard.wait("checkpoint", count=4)
        before = cpu_ticks(victim.app)
        wait_until(lambda: sum(cpu_ticks(victim.app)) > sum(before) + 150, PATIENCE_S, "it has used 1.5 s")
        user, kernel = (now - then for now, then in zip(cpu_ticks(victim.app), before))
        victim.check()
    assert kernel < 0.75 * (user + kernel)
