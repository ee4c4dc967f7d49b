# SPDX-License-Identifier: Apache-2.0
"""What an application that lives closes is closed at once, whoever looks at it or shares it."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, WHERE, GuardProcess, Victim, config, injected
from testkit.harness import app_pid, wait_until
from testkit.init_peer import Init
from testkit.procfs import children_of

HELD_US = 20_000
"""So long a guard has each duplicate of a descriptor; the application allows for a millisecond."""
CHECKPOINTS = 10

LEAVES = """
import ctypes, os, sys, time
libc = ctypes.CDLL(None, use_errno=True)
held = os.open(sys.argv[1], os.O_WRONLY)
if "--in-child" in sys.argv and os.fork():
    os.close(held)
    os.wait()
os.read(0, 1)
assert libc.syscall(436, 3, 0xFFFFFFFF, 2) == 0  # close_range(2), CLOSE_RANGE_UNSHARE
time.sleep(1000)
"""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("kind", ["events", "port", "listen", "lock", "pipe", "program"])
def test_nobody_has_it_open(kind: str, tmp_path: Path) -> None:
    """Of an epoll set, an address, a lock or a program shows when a guard has a duplicate of what is closed."""
    with Victim(f"closer {kind}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        with injected(guard, "pidfd_getfd", f"delay_exit={HELD_US}"):
            for _ in range(CHECKPOINTS):
                guard.command("checkpoint")
                victim.wait_beats(3)
        wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", PATIENCE_S, "it is protected")


def has_open(pid: int, path: Path) -> bool:
    return any(Path(link).resolve() == path for link in Path(f"/proc/{pid}/fd").iterdir())


@pytest.mark.parametrize("where", WHERE)
def test_a_table_that_it_leaves(where: str, tmp_path: Path) -> None:
    """Then only its holder and templates have that, which have to close it."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    ours = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    command = [sys.executable, "-S", "-c", LEAVES, str(fifo), where]
    with Init(command, pid1=True, stdin=subprocess.PIPE) as init, GuardProcess(config(), [init.pid]) as guard:

        def only_one_has_it() -> bool:
            app = app_pid(init.pid)
            return [has_open(pid, fifo) for pid in [*children_of(app), app]] == ([True, False] if where else [True])

        wait_until(only_one_has_it, PATIENCE_S, "it has it open")
        for _ in range(2):
            assert guard.checkpoint()["kind"] == "checkpoint"
        assert init.popen.stdin is not None
        init.popen.stdin.write(b"x")
        init.popen.stdin.flush()
        assert select.select([ours], [], [], PATIENCE_S)[0], "somebody has it open"
        if not where:
            assert guard.wait("dropped", count=2)["reason"] == "unshared"
        answer = guard.command("checkpoint")
        assert answer["generations"] == (2 if where else 1), answer
        since = guard.mark()
        assert guard.command("restore")["kind"] == "restored"
        assert not [event for event in guard.events[since:] if event["kind"] == "gave_up"]
    os.close(ours)
