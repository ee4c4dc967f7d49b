# SPDX-License-Identifier: Apache-2.0
"""The guard dies before its 1st, 2nd, 3rd ... system call that changes something, one run each.

No application notices: each checks its own registers, stacks, masks, options and signals all the
time.  All of it is `make sweep`; otherwise a part of it, another one each hour, or the one that
AVCKPT_SWEEP names.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until

CHANGES = ",".join(
    (
        *("ptrace", "process_vm_writev", "pwrite64", "write", "setsockopt", "ioctl", "fcntl", "epoll_ctl"),
        *("kill", "tgkill", "pidfd_send_signal", "sendmsg", "clone", "execveat", "prlimit64"),
        *("sched_setscheduler", "sched_setattr", "mmap", "munmap", "close"),
    )
)
MOST = 4000
"""System calls of one checkpoint or restore; there are never so many."""
SWEEP = os.environ.get("AVCKPT_SWEEP") or str(int(time.time()) // 3600)
"""Which part: "all", or a number."""
PART = 1 if SWEEP == "all" else 16
FIRST = 1 if SWEEP == "all" else 1 + int(SWEEP) % PART

pytestmark = [
    pytest.mark.skipif(not shutil.which("strace"), reason="strace is what kills the guard; it is not installed"),
    pytest.mark.timeout(3600 if PART == 1 else 300),
    pytest.mark.shared_machine(
        "a guard is killed before each of its calls, hundreds of times, and each next one has to protect in time"
    ),
]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def numbers() -> Iterator[int]:
    """Of the calls before which it dies."""
    yield from range(FIRST, MOST, PART)


class Killer:
    """strace, which kills a guard before its `nth` call from now on."""

    def __init__(self, guard: GuardProcess, nth: int) -> None:
        self.guard = guard
        (pid,) = guard.guards
        kill = f"inject={CHANGES}:signal=KILL:when={nth}"
        self.process = subprocess.Popen(
            ["strace", "-f", "-qq", "-o", "/dev/null", "-e", f"trace={CHANGES}", "-e", kill, "-p", str(pid)],
            stderr=subprocess.DEVNULL,
        )
        status = Path(f"/proc/{pid}/status")
        wait_until(
            lambda: f"TracerPid:\t{self.process.pid}\n" in status.read_text(), PATIENCE_S, "strace traces it", 0.001
        )

    def __enter__(self) -> Killer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.process.kill()
        self.process.wait()

    def kills(self, command: str) -> bool:
        """Gives the command: is the guard killed before it has carried it out?"""
        since = self.guard.mark()
        ticket = self.guard.say_command(command)
        answer = self.guard.wait_for(
            lambda event: event.get("ticket") == ticket or event.get("kind") == "guard_lost", command, since=since
        )
        return answer.get("kind") == "guard_lost"


VICTIMS = ("steady", "steady --in-child", "peeker", "peeker --in-child", "signals 3")


@pytest.mark.parametrize("known", [False, True], ids=["first", "next"])
@pytest.mark.parametrize("command", VICTIMS)
def test_checkpoint(tmp_path: Path, command: str, known: bool) -> None:
    """The first one, for which everything is brought in, and one that finds it there."""
    with Victim(command, tmp_path) as victim:
        for nth in numbers():
            with GuardProcess(config(0.0), [victim.pid]) as guard:
                guard.wait("attached")
                if known:
                    guard.command("checkpoint")
                with Killer(guard, nth) as killer:
                    killed = killer.kills("checkpoint")
                victim.wait_beats(3)
            if not killed:
                break
        else:
            raise AssertionError("it is not done after so many calls")
        with GuardProcess(config(0.0), [victim.pid]) as guard:
            protects(guard)


def protects(guard: GuardProcess) -> None:
    """The next guard does: at once, or when a thread that waited for the one that died has gone home."""
    answers: list[dict[str, object]] = []

    def taken() -> bool:
        answers.append(guard.command("checkpoint"))
        return answers[-1]["kind"] == "checkpoint"

    wait_until(taken, PATIENCE_S, "the next guard takes a checkpoint", 0.05)
    for missed in answers[:-1]:
        assert "on its way home" in str(missed), missed


def wait_goes_on_or_ends(victim: Victim) -> None:
    """Whichever it is, it is soon."""
    beats = victim.see().beats
    wait_until(
        lambda: victim.popen.poll() is not None or victim.see().beats > beats + 3, PATIENCE_S, "it goes on, or ends"
    )


@pytest.mark.parametrize("command", ["steady", "steady --in-child"])
def test_restore(tmp_path: Path, command: str) -> None:
    """Nobody can finish it: then init ends at once, and nothing is left of the application."""
    for nth in numbers():
        with Victim(command, tmp_path) as victim:
            with GuardProcess(config(0.0), [victim.pid]) as guard:
                guard.command("checkpoint")
                with Killer(guard, nth) as killer:
                    killed = killer.kills("restore")
                if victim.popen.poll() is None and not killed:
                    victim.wait_beats(3)
                    return
                assert killed
            # Its own application, or init's end: with what it died of, or restored just in time.
            wait_goes_on_or_ends(victim)
            if victim.popen.poll() is None:
                victim.check()
            else:
                assert victim.see().violations == 0, victim.said
    raise AssertionError("it is not done after so many calls")
