# SPDX-License-Identifier: Apache-2.0
"""The process that holds the engine is killed at random moments: no application notices, no template ever runs."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config, parasites, storm
from testkit.harness import wait_until
from testkit.procfs import threads

pytestmark = [
    pytest.mark.shared_machine("guards are killed at random moments, and each next one has to protect in time"),
    pytest.mark.timeout(700),  # storm() has its own
]

KILLS = 500
PTRACE_CALLS = 40
"""Of a checkpoint of one thread, and some."""
NEVER_RESTARTED = {"epoll_wait", "epoll_pwait", "epoll_pwait2", "semop", "semtimedop", "sigtimedwait"}
KINDS = 43
UNWOKEN = [9, 10, 11, 19, 22, 38]
CALLS_OF_READ = 8 + 12
"""On the board of eintr.c; see there."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.slow
def test_no_application_notices(tmp_path: Path) -> None:
    """Three kinds of application at once: each kill hits three guards at whatever they are doing."""
    with contextlib.ExitStack() as stack:
        victims = [stack.enter_context(Victim(command, tmp_path)) for command in ("threads 6 4", "fpu 2", "signals 4")]
        names = [threads(victim.app) for victim in victims[1:]]
        pids = [victim.app for victim in victims]
        said = storm(config(0.002), KILLS, 2, 1, *victims)
        assert said["kills"] == KILLS
        assert said["left"] == []
        assert said["unprotected"] == 0
        # The storm has hit what it was to hit: guards before, in and after checkpoints.
        hit = said["hit"]
        assert isinstance(hit, int)
        assert KILLS / 4 < hit < KILLS
        for victim in victims:
            victim.wait_beats(50)
        assert [victim.app for victim in victims] == pids
        assert [threads(victim.app) for victim in victims[1:]] == names
        # And the next guard protects as if nothing had been.
        with GuardProcess(config(0.05), [victim.pid for victim in victims]) as guard:
            for cookie, victim in enumerate(victims, 1):
                guard.wait("checkpoint", cookie=cookie, count=3)
                since = guard.mark()
                victim.kill_app()
                guard.wait("restored", since=since, cookie=cookie)
                victim.wait_beats(20)


def test_blocked_calls_go_on(tmp_path: Path) -> None:
    """A guard that dies between stopping a thread and mending its call cannot undo the stop.

    Calls that the kernel never restarts by itself (signal(7)) then fail once with EINTR, as after SIGSTOP and
    SIGCONT.  No other call may, and no call may be lost.  A recvmmsg that has received a message already leaves
    its error (512) to the socket's next call, which fails with it: this is an error in the kernel.
    """
    with Victim("eintr all 0", tmp_path) as victim, Victim("signals 4 --pending", tmp_path) as signals:
        said = storm(config(0.002), 60, 2, 2, victim, signals)
        assert said["left"] == []
        signals.wait_beats(20)
        calls = victim.see().counter[8 : 8 + KINDS]
        wait_until(lambda: victim.see().counter[CALLS_OF_READ] > calls[12] + 3, 5, "a few wake-ups")
        later = victim.see().counter[8 : 8 + KINDS]
        assert [n for n in range(KINDS) if later[n] == calls[n]] == UNWOKEN
        answered = set(re.findall(r"(\w+) answered (\w+)", victim.said))
        # All registers, masks and stacks are what they were.
        assert victim.said.count("VIOLATION") == len(re.findall(r"answered", victim.said))
        assert answered <= {*((call, "EINTR") for call in NEVER_RESTARTED), ("recvmmsg", "ERESTARTSYS")}
        assert victim.popen.poll() is None


def test_memory_of_dead_guards_is_given_back(tmp_path: Path) -> None:
    """Each guard maps pages into the application; its successor unmaps them."""
    with Victim("threads 4 1", tmp_path) as victim:
        storm(config(0.002), 20, 2, 3, victim)
        storm(config(0.002), 200, 0.6, 3, victim)  # many of them while they map theirs
        with GuardProcess(config(0.02), [victim.pid]) as guard:
            guard.wait("checkpoint", count=6)
            wait_until(lambda: parasites(victim.app) <= 2, 5, "old parasites go")
        victim.wait_beats(20)


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("strace"), reason="strace is what kills the guard; it is not installed")
def test_handlers_run_on_their_own_stack(tmp_path: Path) -> None:
    """The guard dies before its 1st, 2nd, ... ptrace call: a borrowed thread returns, and handlers find it whole."""
    with Victim("steady", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        for nth in range(1, PTRACE_CALLS + 1):
            guard.wait("checkpoint", since=guard.mark())
            kill = f"inject=ptrace:signal=KILL:when={nth}"
            trace = ["strace", "-f", "-qq", "-o", "/dev/null", "-e", "trace=ptrace", "-e", kill]
            subprocess.run([*trace, "-p", str(guard.pid)], timeout=15, check=False, stderr=subprocess.DEVNULL)
            victim.wait_beats(10)
            guard.start_another(victim.pid)


@contextlib.contextmanager
def locked(victim: Victim) -> Iterator[None]:
    """As by another guard."""
    path = victim.ctl_path()
    assert path is not None
    held = os.open(path, os.O_RDWR)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        yield
    finally:
        os.close(held)


def test_a_lock_that_is_still_held_is_waited_for(tmp_path: Path) -> None:
    """A helper of a guard that was killed shares its lock, until it gets a CPU to end."""
    with Victim("idle 1 1", tmp_path) as victim, contextlib.ExitStack() as lock:
        lock.enter_context(locked(victim))
        with GuardProcess(config(0.05), [victim.pid]) as guard:
            guard.wait("started")
            time.sleep(0.1)
            lock.close()
            guard.wait("checkpoint")
            assert "unprotected" not in [event["kind"] for event in guard.events]


def test_another_guard_is_told_of(tmp_path: Path) -> None:
    with Victim("idle 1 1", tmp_path) as victim, contextlib.ExitStack() as lock:
        lock.enter_context(locked(victim))
        with GuardProcess(config(0.05), [victim.pid]) as guard:
            guard.wait_for(lambda event: "another avckpt guards it" in str(event.get("error")), "it is told")
            lock.close()
            guard.wait("checkpoint")
