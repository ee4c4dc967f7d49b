# SPDX-License-Identifier: Apache-2.0
"""An application that hardly gets a CPU: checkpoints are missed, and that is all that happens to it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from native.guarded import GuardProcess, Victim, config

ENOUGH = 12
"""Threads that were sent into the pad and did not get there in time."""

# More important than the application, and awake nearly all the time.
HOG = """
import os, time
os.sched_setaffinity(0, {int(os.sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
print("ready", flush=True)
while True:
    end = time.monotonic() + 0.07
    while time.monotonic() < end:
        pass
    time.sleep(0.006)
"""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@contextlib.contextmanager
def hog(cpu: int) -> Iterator[None]:
    """Takes a CPU away from everybody else, but for a few milliseconds now and then."""
    with subprocess.Popen([sys.executable, "-c", HOG, str(cpu)], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline() != b"ready\n":
                pytest.skip("no real-time scheduling here, so nobody can be starved")
            yield
        finally:
            process.kill()


def put_on(cpu: int, pid: int) -> None:
    """All threads of a process; those to come inherit it."""
    for tid in os.listdir(f"/proc/{pid}/task"):
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(int(tid), {cpu})


def too_late(event: dict[str, object]) -> bool:
    return event.get("kind") == "missed" and "get to run in time" in str(event)


def test_a_starved_application_is_let_go(tmp_path: Path) -> None:
    """A thread that gets into the pad too late finds home, and what it does next is its own affair."""
    cpus = sorted(os.sched_getaffinity(0))
    if len(cpus) < 2:
        pytest.skip("it takes a CPU for the guard and one for the application")
    with (
        Victim("threads 6 1", tmp_path) as victim,
        GuardProcess(config(0.02), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=3)
        put_on(cpus[0], victim.app)
        put_on(cpus[-1], guard.pid)
        with hog(cpus[0]):
            guard.wait_for(too_late, f"{ENOUGH} threads too late", count=ENOUGH, timeout_s=90)
        assert not [event for event in guard.events if event.get("kind") == "died"]
        guard.wait("checkpoint", since=guard.mark(), count=10)
        victim.wait_beats(20)
