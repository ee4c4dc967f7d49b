# SPDX-License-Identifier: Apache-2.0
"""A guard without work sleeps, and wakes up when something happens."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config, injected, since_linux
from testkit.harness import app_pid, wait_until
from testkit.init_peer import Init
from testkit.scenario import checkpoint

SLEEPS_S = 6.0
"""Two of the guard's longest sleeps (AVC_HEARTBEAT_NS)."""
WAKES = 6
"""In that time: it says that it lives, and has a moment to finish its last checkpoint."""

EXECUTES = """
import os, sys
held = os.open(sys.argv[1], os.O_WRONLY)  # O_CLOEXEC, as all of Python's
os.read(0, 1)
os.execv("/bin/sleep", ["sleep", "1000"])
"""


def wake_ups(pid: int) -> int:
    """How many times the process has gone to sleep."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("\nvoluntary_ctxt_switches:")[1].split()[0])


def has_open(pid: int, path: Path) -> bool:
    """Whether a process has that file open."""
    return any(Path(link).resolve() == path for link in Path(f"/proc/{pid}/fd").iterdir())


def test_it_sleeps(tmp_path: Path) -> None:
    """A guard sleeps between checkpoints, also that of a process tree."""
    for command in ("idle 1 2 --beat-us 1000", "tree 3"):
        with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
            assert guard.checkpoint()["kind"] == "checkpoint"
            time.sleep(1)  # its spare
            before = wake_ups(guard.pid)
            time.sleep(SLEEPS_S)
            assert wake_ups(guard.pid) - before <= WAKES, command


@since_linux(6, 11, "numbers of mounts and their namespaces that are never given twice")
def test_mounts_are_read_when_they_have_changed(tmp_path: Path) -> None:
    """To read them costs more than anything else in a checkpoint of a small process."""
    log = tmp_path / "calls"
    patient = config(freeze_deadline_s=PATIENCE_S)
    with Victim("idle 1 1 --beat-us 1000", tmp_path) as victim, GuardProcess(patient, [victim.pid]) as guard:
        mnt = Path(f"/proc/{victim.app}/ns/mnt")

        def reads(checkpoints: int) -> int:
            with injected(guard, "openat", "delay_enter=1", log):
                for _ in range(checkpoints):
                    checkpoint(guard)
            return log.read_text().count("/mountinfo")

        # Nothing that others mount for themselves comes here, and nothing of theirs goes: who removes a
        # directory takes what is mounted on it from everybody (fs/namei.c, vfs_rmdir(), detach_mounts()).
        alone = (
            "mount --make-rprivate / && cut -d' ' -f5 /proc/self/mountinfo | grep '^/.*/' | tac | xargs -r umount -l"
        )
        subprocess.run(["nsenter", f"--mount={mnt}", "sh", "-c", alone], check=True)
        checkpoint(guard)
        assert reads(3) == 0
        subprocess.run(["nsenter", f"--mount={mnt}", "mount", "-t", "tmpfs", "none", "/mnt"], check=True)
        assert reads(3) == 1
        subprocess.run(["nsenter", f"--mount={mnt}", "umount", "/mnt"], check=True)
        assert reads(3) == 1


def exec_until_closed_s(fifo: Path) -> float:
    """For a program that has run for a while: the time from its exec(2) until its close-on-exec file is closed."""
    os.mkfifo(fifo)
    ours = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    command = [sys.executable, "-S", "-c", EXECUTES, str(fifo)]
    with Init(command, pid1=True, stdin=subprocess.PIPE) as init, GuardProcess(config(), [init.pid]) as guard:
        wait_until(lambda: has_open(app_pid(init.pid), fifo), PATIENCE_S, "it has it open")
        assert guard.checkpoint()["kind"] == "checkpoint"
        time.sleep(1.7)  # looks around would be 200 ms apart by now
        began = time.monotonic()
        assert init.popen.stdin is not None
        init.popen.stdin.write(b"x")
        init.popen.stdin.flush()
        assert select.select([ours], [], [], PATIENCE_S)[0], "somebody has it open"
        took = time.monotonic() - began
        assert guard.wait("dropped")["reason"] == "executed"
    os.close(ours)
    return took


@pytest.mark.shared_machine("a guard that is told of an exec may have to wait for a CPU")
def test_an_exec_is_heard(tmp_path: Path) -> None:
    """O_CLOEXEC descriptors close at once, however long the program has run, and not at the guard's next look."""
    took = sorted(exec_until_closed_s(tmp_path / f"held-{number}") for number in range(5))
    assert took[1] < 0.03, took
