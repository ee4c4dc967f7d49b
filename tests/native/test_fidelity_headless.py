# SPDX-License-Identifier: Apache-2.0
"""A process whose main thread has ended while others continue."""

from __future__ import annotations

import random
import signal
import time
from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config, kill_at_random, since_linux
from testkit.procfs import state_of, threads

pytestmark = since_linux(6, 9, "pidfds of threads")


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def test_it_is_restored_without_its_main_thread(tmp_path: Path) -> None:
    """The other threads are the same; the main thread has ended, as it had before."""
    with Victim("headless 5", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        before = threads(victim.app)
        kill_at_random(guard, victim, 40, (0.01, 0.12))
        assert state_of(victim.app) == "Z"
        assert threads(victim.app) == before


def test_the_end_of_the_last_thread(tmp_path: Path) -> None:
    """It is the end of the process."""
    plain = config(restore_on_exit=False)
    with Victim("headless 3", tmp_path) as victim, GuardProcess(plain, [victim.pid]) as guard:
        guard.wait("attached")
        assert guard.checkpoint()["kind"] == "checkpoint"
        victim.kill_app()
        guard.wait("restored")
        victim.wait_beats()
        victim.kill_app(signal.SIGUSR1)
        assert victim.end(5) == 7


def test_it_is_rolled_back_when_asked(tmp_path: Path) -> None:
    """Even though the thread that stood for the process at the checkpoint has ended since."""
    with Victim("headless 3 --changing", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        for _ in range(5):
            guard.wait("checkpoint", since=guard.mark())  # some are missed: that thread ends meanwhile
            time.sleep(random.uniform(0.0, 0.05))
            assert guard.command("restore", timeout_s=5)["kind"] == "restored"
            victim.wait_beats()


def test_a_guard_that_comes_later(tmp_path: Path) -> None:
    """It recognizes the process as the application."""
    with Victim("headless 2", tmp_path) as victim:
        with GuardProcess(config(0.03), [victim.pid]) as guard:
            guard.wait("checkpoint", count=3)
        with GuardProcess(config(0.03), [victim.pid]) as guard:
            kill_at_random(guard, victim, 3, (0.05, 0.1))
