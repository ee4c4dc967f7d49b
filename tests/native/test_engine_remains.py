# SPDX-License-Identifier: Apache-2.0
"""The memory of the dead is kept for whoever reads it, within bounds: docs/events.md, core files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until
from testkit.init_peer import Init
from testkit.procfs import comm_of, state_of

pytestmark = pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long")

KEPT = 2
"""REMAINS_MAX of guard.h."""
LONG_S = 600.0
SHORT_S = 1.0

EXECUTES = """
import os, time
os.read(0, 1)
os.execv("/bin/sleep", ["sleep", "1000"])
"""


def is_kept(pid: int) -> bool:
    """Whether its memory can be read."""
    return comm_of(pid) == "avckpt-hold" and state_of(pid) not in "ZX"


def die(guard: GuardProcess, app: int) -> int:
    """Kills it; the task that has its memory, once it is restored."""
    since = guard.mark()
    os.kill(app, signal.SIGKILL)
    guard.wait("restored", since=since)
    remains = int(guard.wait("died", since=since)["remains_pid"])
    assert remains
    return remains


def test_of_the_last_two_deaths(tmp_path: Path) -> None:
    """A crash is often followed by another one before the core of the first is written."""
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(remains_s=LONG_S), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        dead: list[int] = []
        for _ in range(4):
            dead.append(die(guard, victim.app))
            assert guard.checkpoint()["kind"] == "checkpoint"
            victim.wait_beats(20)  # what is released goes meanwhile
            assert [is_kept(pid) for pid in dead[-KEPT:]] == [True] * len(dead[-KEPT:])
        wait_until(lambda: not any(is_kept(pid) for pid in dead[:-KEPT]), PATIENCE_S, "there are no more")
    wait_until(lambda: not any(is_kept(pid) for pid in dead), PATIENCE_S, "all have gone with the guard")


def test_not_for_longer_than_asked(tmp_path: Path) -> None:
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(remains_s=SHORT_S), [victim.pid]) as guard:
        dead = []
        for _ in range(2):
            # One that is killed as soon as it is restored has nobody yet that holds its memory.
            assert guard.checkpoint()["kind"] == "checkpoint"
            dead.append(die(guard, victim.app))
        wait_until(lambda: not any(is_kept(pid) for pid in dead), PATIENCE_S, "both are gone")
        victim.wait_beats()


def test_not_when_the_application_leaves_its_descriptors(tmp_path: Path) -> None:
    """They share its table, in which everything would stay open that another program closes."""
    command = [sys.executable, "-S", "-c", EXECUTES]
    with (
        Init(command, pid1=True, stdin=subprocess.PIPE) as init,
        GuardProcess(config(remains_s=LONG_S), [init.pid]) as guard,
    ):
        assert guard.checkpoint()["kind"] == "checkpoint"
        remains = die(guard, int(guard.wait("attached")["app_pid"]))
        assert is_kept(remains)
        assert init.popen.stdin is not None
        init.popen.stdin.write(b"x")
        init.popen.stdin.flush()
        guard.wait("dropped")
        wait_until(lambda: not is_kept(remains), PATIENCE_S, "it is gone")
