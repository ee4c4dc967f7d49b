# SPDX-License-Identifier: Apache-2.0
"""A process that holds a lock on an open file of the application does not block its guard; commands and events reach
their ends, and a final death waits for one of them."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import avckpt.engine
import pytest
from avckpt.engine import Engine
from avckpt.events.vocabulary import Kind
from avckpt.guard import Command, Event

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config, kill_at_random
from testkit.harness import SLOWNESS, wait_until
from testkit.procfs import children_of, comm_of, state_of

SHARED = pytest.mark.shared_machine("how long it waits is compared with the clock")
HOLD = """
import os, socket, sys
ours, theirs = socket.socketpair()
pipe = os.open(sys.argv[1], os.O_WRONLY)
print("ready", flush=True)
os.splice(theirs.fileno(), pipe, 1)
"""
"""Waits in splice(2) for what is to go into a pipe, with the pipe's lock."""
PR_SET_CHILD_SUBREAPER = 36
SEEN_S = 0.2
"""SEEN_NS of guard.c."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", ["", " --in-child"])
def test_a_thread_waits_in_splice(tmp_path: Path, where: str) -> None:
    with Victim("splicer" + where, tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        guard.wait("checkpoint", count=20)
        kill_at_random(guard, victim, 5, (0.05, 0.2))
        moved = victim.see().counter[0]
        wait_until(lambda: victim.see().counter[0] > moved, PATIENCE_S, "another byte")
        victim.check()


@SHARED
def test_somebody_else_waits_in_splice(tmp_path: Path) -> None:
    """The pipe's contents are unknown then; the application runs on, and the guard does not wait."""
    with Victim("splicer --leave", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        end = f"/proc/{victim.app}/fd/{victim.see().counter[2]}"
        with subprocess.Popen([sys.executable, "-c", HOLD, end], stdout=subprocess.PIPE) as holder:
            try:
                assert holder.stdout is not None
                holder.stdout.readline()
                wchan = Path(f"/proc/{holder.pid}/stat")
                wait_until(lambda: wchan.read_text().rsplit(")", 1)[1].split()[0] == "S", PATIENCE_S, "it waits")
                for _ in range(8):  # more than may be left behind at a time
                    begun = time.monotonic()
                    taken = guard.checkpoint()
                    assert taken["kind"] == "checkpoint", str(taken)
                    assert time.monotonic() - begun < 5 * SLOWNESS
                    victim.wait_beats(3)
            finally:
                holder.kill()
        # Those that were left behind come back, and everything is as before.
        wait_until(lambda: len(os.listdir(f"/proc/{guard.pid}/task")) <= 2, PATIENCE_S, "they end")
        assert guard.checkpoint()["kind"] == "checkpoint"
        assert guard.command("restore")["kind"] == "restored"
        victim.wait_beats(3)


def test_a_last_command_that_it_does_not_read_hides_no_event(tmp_path: Path) -> None:
    """The kernel reports it in place of the events that the guard sent before it exited."""
    with (
        Victim("idle 1 1", tmp_path) as victim,
        Victim("idle 1 1", tmp_path) as other,
        GuardProcess(config(), [victim.pid, other.pid]) as guard,
    ):
        guard.wait("attached", cookie=1)
        os.kill(guard.pid, signal.SIGSTOP)
        victim.kill(signal.SIGKILL)
        victim.end()
        guard.say_command("list", cookie=1)
        guard.command("list", cookie=2)  # so the first one has been sent
        guard.process.send_signal(signal.SIGSTOP)
        os.kill(guard.pid, signal.SIGCONT)
        wait_until(lambda: state_of(guard.pid) == "Z", PATIENCE_S, "it has exited")
        guard.process.send_signal(signal.SIGCONT)
        guard.wait_for(lambda event: event["kind"] in ("ended", "guard_lost"), "an end")
        assert not [event for event in guard.events if event["kind"] == "guard_lost"]


def test_every_command_reaches_it(tmp_path: Path) -> None:
    with Victim("idle 1 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for command in Command:
            guard.say_command(command.name)
        assert guard.command("list")["kind"] == "held"


def final_death_s(folder: Path, *, seen: bool) -> float:
    """How long a container waits at its final death, when the guard is told that its memory was looked at, or not."""
    with (
        Victim("idle 1 1", folder) as victim,
        GuardProcess(config(restore_on_signal=False, remains_s=1.0), [victim.pid]) as guard,
    ):
        assert guard.checkpoint()["kind"] == "checkpoint"
        victim.kill_app()
        died = guard.wait("died")
        if seen:
            guard.say_seen(died["remains_pid"])
        over = guard.wait("gave_up")
        assert over["reason"] == "policy"
        victim.end()
        waited: float = (over["at_ns"] - died["died_ns"]) / 1e9
        return waited


def test_init_has_no_priority_of_a_dead_guard(tmp_path: Path) -> None:
    """A guard lends init its own for a moment, and may be killed just then."""
    lent = os.SCHED_RR | os.SCHED_RESET_ON_FORK
    with Victim("idle 1 1", tmp_path) as victim:
        os.sched_setscheduler(victim.pid, lent, os.sched_param(1))
        assert os.sched_getscheduler(victim.pid) == lent
        with GuardProcess(config(), [victim.pid]) as guard:
            guard.wait("attached")
            assert os.sched_getscheduler(victim.pid) == os.SCHED_OTHER


@SHARED
def test_a_final_death_waits_until_it_has_been_looked_at(tmp_path: Path) -> None:
    assert final_death_s(tmp_path, seen=False) >= SEEN_S
    # One of five: the word itself may be late.
    assert any(final_death_s(tmp_path, seen=True) < SEEN_S for _ in range(5))


@pytest.fixture
def reaper() -> Iterator[None]:
    """Orphans become our children, and nobody reaps them: the machine's init has more to do."""
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(PR_SET_CHILD_SUBREAPER, 1) == 0
    yield
    assert libc.prctl(PR_SET_CHILD_SUBREAPER, 0) == 0
    for pid in children_of(os.getpid()):
        if comm_of(pid) == "avckpt-pid":
            os.waitpid(pid, 0)


@pytest.mark.usefixtures("reaper")
def test_a_final_death_leaves_no_orphan(tmp_path: Path) -> None:
    """The container's init exits only when all of its PID namespace are reaped."""
    for _ in range(5):
        final_death_s(tmp_path, seen=False)


def test_nobody_waits_for_a_guard_that_does_not_end(
    tmp_path: Path, victims_built: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has exited as far as its socket tells, and waits for a file server that has its request."""
    program = tmp_path / "guard"
    program.write_text(f"#!/bin/sh\nexec 3>&-\nexec head {tmp_path}/mount/served\n")
    program.chmod(0o755)
    monkeypatch.setattr(avckpt.engine, "guard_binary", lambda: program)
    pidfd = os.pidfd_open(os.getpid())
    with subprocess.Popen([victims_built / "server", tmp_path, "head"], stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        if server.stdout.readline() != b"ready\n":
            pytest.skip("/dev/fuse is not available here")
        try:
            engine = Engine()
            guard = engine.start_guard(pidfd, config(), 1)
            wait_until(lambda: state_of(guard.pid) == "S" and comm_of(guard.pid) == "head", 10, "it waits")
            events: list[Event] = []
            longest_s = 0.0
            begun = time.monotonic()
            while not events and time.monotonic() < begun + 30:
                since = time.monotonic()
                guard.check(0.5)
                events = [event for event in [engine.next_event()] if event is not None]
                longest_s = max(longest_s, time.monotonic() - since)
                time.sleep(0.05)
            assert [event.kind for event in events] == [Kind.GUARD_LOST]
            assert "does not end" in str(events[0].error)
            assert longest_s < 0.5
            engine.close()
        finally:
            server.kill()
            subprocess.run(["umount", "-l", tmp_path / "mount"], check=True)
            os.close(pidfd)
