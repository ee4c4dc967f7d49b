# SPDX-License-Identifier: Apache-2.0
"""A thread executes another program while its process is being stopped: it neither waits for its guard, nor for ever.

The kernel ends all other threads first, and gives it the number of the main one.
"""

from __future__ import annotations

import shutil
import signal
import time
from pathlib import Path

import pytest

from testkit.guarded import BUILD, WHERE, GuardProcess, Victim, config
from testkit.harness import SLOWNESS, wait_until

PROGRAMS = 300
SLOW_PROGRAMS = 6
SOON_S = 5.0 * SLOWNESS
"""The slow ones take 0.2 s."""
INTO_IT_S = 0.02


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def wait_for_program(victim: Victim, every_s: float = 0.02) -> None:
    """Waits until it has begun to execute another one."""
    done = victim.see().counter[0]
    wait_until(
        lambda: victim.see().counter[0] > done or victim.popen.poll() is not None, SOON_S, "another program", every_s
    )
    victim.check()


@pytest.mark.parametrize("where", WHERE)
def test_it_does_not_wait_for_threads_that_the_guard_has_stopped(where: str, tmp_path: Path) -> None:
    """While the guard waits until it may seize the one that executes."""
    with Victim(f"reexec 10 8 {where}", tmp_path) as victim, GuardProcess(config(0.001), [victim.pid]) as guard:
        guard.wait("checkpoint")
        for _ in range(PROGRAMS):
            wait_for_program(victim)
        assert not [event for event in guard.events if event["kind"] == "died"]


def be_late(victim: Victim, guard: GuardProcess) -> None:
    """A checkpoint comes while it executes a program, which runs soon."""
    wait_for_program(victim, 0.001)
    time.sleep(INTO_IT_S)
    ticket = guard.say_command("checkpoint")
    victim.wait_beats(1, SOON_S)
    guard.wait_for(lambda event: event.get("ticket") == ticket, "an answer")


@pytest.mark.parametrize("where", WHERE)
def test_it_runs_on_under_its_new_number(where: str, tmp_path: Path) -> None:
    """Though it was to be stopped under the old one, and was late for that: the kernel was busy with its arguments."""
    with Victim(f"reexec 100 4 --slow {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(SLOW_PROGRAMS):
            be_late(victim, guard)


@pytest.mark.parametrize("where", WHERE)
def test_a_program_with_more_privileges_gets_them(where: str, tmp_path: Path) -> None:
    """The kernel refuses them to a process whose directories others share."""
    copy = tmp_path / "copy"
    shutil.copyfile(BUILD / "rises", copy)
    copy.chmod(0o4755)
    with Victim(f"rises {copy} {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(2):
            assert guard.checkpoint()["kind"] == "checkpoint"
        victim.kill_app(signal.SIGUSR1)
        wait_until(lambda: "effectively" in victim.said, SOON_S, "another program")
        assert "effectively 0" in victim.said
