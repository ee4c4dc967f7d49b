# SPDX-License-Identifier: Apache-2.0
"""An application that hardly gets a CPU: checkpoints are missed, and nothing else happens to it."""

from __future__ import annotations

import contextlib
import os
import random
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from testkit.cgroups import freezer, throttle
from testkit.family import kill_main
from testkit.guarded import PATIENCE_S, WHERE, GuardProcess, Victim, config, injected
from testkit.harness import wait_until
from testkit.procfs import children_of, comm_of, status_of

pytestmark = [
    pytest.mark.alone("it takes a CPU away from everybody else"),
    pytest.mark.shared_machine("it takes CPU away itself, and what is left for the guard must suffice"),
]

ENOUGH = 6
"""Threads that were sent into the parasite and did not get there in time."""
SOME = 3
"""The same where the others of its process run."""
GUARDS = 60
"""Each is killed while a thread may be on its way home."""

LATE_S = 1.5
"""Longer than a checkpoint waits for a template, and than a restore used to."""

REAPED_S = 4.0
"""Longer than all attempts of a restore used to take."""

IN_STUB = 3
"""Threads that have not left the first injected instructions in time."""

# More important than the application, and awake nearly all the time.
HOG = """
import os, time
os.sched_setaffinity(0, {int(os.sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
print("ready", flush=True)
while True:
    end = time.monotonic() + float(os.sys.argv[2])
    while time.monotonic() < end:
        pass
    time.sleep(0.006)
"""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@contextlib.contextmanager
def hog(cpu: int, busy_s: float = 0.07) -> Iterator[None]:
    """Takes a CPU from all others except for a few milliseconds at a time.

    Real-time tasks may use 0.95 of each second (sched(7)).
    """
    with subprocess.Popen([sys.executable, "-c", HOG, str(cpu), str(busy_s)], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline() != b"ready\n":
                pytest.skip("no real-time scheduling here, so nobody can be starved")
            yield
        finally:
            process.kill()


def put_on(cpu: int, pid: int) -> None:
    """Moves all threads of a process to a CPU; threads that it starts later inherit this."""
    for tid in os.listdir(f"/proc/{pid}/task"):
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(int(tid), {cpu})


def too_late(event: dict[str, object]) -> bool:
    return event.get("kind") == "missed" and "get to run in time" in str(event)


def checkpoint_until_late(guard: GuardProcess, cpu: int, pause_s: Callable[[], float] = float) -> None:
    """Beside a hog, until threads have been too late often enough, or for 8 s and once; nobody dies of it."""
    with hog(cpu):
        begun, late = time.monotonic(), 0
        while late < ENOUGH and time.monotonic() < begun + (8 if late else 90):
            guard.command("checkpoint")
            time.sleep(pause_s())
            late = sum(map(too_late, guard.events))
    assert late
    assert not [event for event in guard.events if event.get("kind") == "died"]


@pytest.fixture
def cpus() -> tuple[int, int]:
    """One CPU for the application and the hog, and one for everything else."""
    found = sorted(os.sched_getaffinity(0))
    if len(found) < 2:
        pytest.skip("it takes a CPU for the guard and one for the application")
    return found[0], found[-1]


def test_a_starved_application_is_let_go(cpus: tuple[int, int], tmp_path: Path) -> None:
    """A thread that enters the parasite too late returns from it, and is not used any more."""
    rng = random.Random(1)
    with Victim("threads 6 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.command("checkpoint")
        put_on(cpus[0], victim.app)
        put_on(cpus[1], guard.pid)
        # It is home again in between.
        checkpoint_until_late(guard, cpus[0], lambda: rng.uniform(0, 0.1))
        for _ in range(10):
            assert guard.checkpoint()["kind"] == "checkpoint"
        victim.wait_beats(20)


def test_the_next_attempt_comes_at_once(cpus: tuple[int, int], tmp_path: Path) -> None:
    """Commands do not wait for a late one: its return from the parasite must not be taken for that of another."""
    with Victim("threads 6 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.command("checkpoint")
        put_on(cpus[0], victim.app)
        put_on(cpus[1], guard.pid)
        checkpoint_until_late(guard, cpus[0])
        wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 15, "checkpoints go on")
        victim.wait_beats(20)


def tracer(tid: int) -> int:
    """0: it has none, or has ended."""
    try:
        return int(status_of(tid)["TracerPid"])
    except (FileNotFoundError, ProcessLookupError):
        return 0


def test_nobody_waits_for_a_thread_that_is_late(cpus: tuple[int, int], tmp_path: Path) -> None:
    """While it is in the parasite, or on its way there, all others of its process run."""
    with Victim("threads 6 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        app = victim.app
        put_on(cpus[1], app)
        put_on(cpus[1], guard.pid)
        os.sched_setaffinity(app, {cpus[0]})
        late, end = 0, time.monotonic() + 90
        with hog(cpus[0]):
            while late < SOME and time.monotonic() < end:
                if not too_late(guard.command("checkpoint")):
                    continue
                others = [int(tid) for tid in os.listdir(f"/proc/{app}/task") if int(tid) != app]
                traced = [tid for tid in others if tracer(tid)]
                if tracer(app):
                    late += 1
                    assert traced == []
        assert late >= SOME
        victim.wait_beats(20)


@pytest.mark.parametrize("where", WHERE)
def test_the_way_home_stays_as_it_was(where: str, tmp_path: Path) -> None:
    """Guards die, or come too late, while threads wait for a CPU in code that they have written: nobody needs it less.

    A thread that goes home by itself gets its signals on the way, and their handlers return there.
    """
    with (
        throttle() as slow,
        Victim(f"steady {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        guard.command("checkpoint")
        for pid in {victim.app, victim.player}:
            slow.take(pid)
        slow.wait()
        for _ in range(GUARDS):
            guard.start_another(victim.pid)
            for _ in range(5):
                guard.command("checkpoint")
                victim.check()
        slow.go()
        wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 15, "checkpoints go on")
        victim.wait_beats(20)


def in_the_stub(event: dict[str, Any]) -> bool:
    error: dict[str, str] = event.get("error", {})
    return (error.get("operation"), error.get("detail")) == ("infect", "it did not get to run in time")


@pytest.mark.parametrize("command", ["sandbox", "steady"])
def test_who_is_late_in_the_stub_gets_home(command: str, tmp_path: Path) -> None:
    """Though its filters refuse the calls of the first injected instructions, or a signal comes every millisecond:
    not only its handler runs."""
    with (
        throttle() as slow,
        Victim(command, tmp_path) as victim,
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) as other,
    ):
        try:
            victim.wait_beats(5)
            blocked = status_of(victim.app)["SigBlk"]
            for pid in (victim.app, other.pid):
                slow.take(pid)
            late, end = 0, time.monotonic() + 60
            while late < IN_STUB and time.monotonic() < end:
                with GuardProcess(config(), [victim.pid]) as guard:
                    slow.wait()
                    for _ in range(30):
                        if guard.command("checkpoint")["kind"] == "checkpoint":
                            break
                    late += sum(map(in_the_stub, guard.events))
                    assert not [event for event in guard.events if event["kind"] == "died"]
                    slow.go()
                    victim.wait_beats(2)
                    guard.stop()
            assert late
        finally:
            other.kill()
        victim.wait_beats(5)
        wait_until(lambda: status_of(victim.app)["SigBlk"] == blocked, PATIENCE_S, "it has its signals")


def test_restored_while_starved(cpus: tuple[int, int], tmp_path: Path) -> None:
    """The newest generation is not given up because its template waits for a CPU."""
    with Victim("tcpecho 0", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        put_on(cpus[0], victim.app)
        put_on(cpus[1], guard.pid)
        with socket.create_connection(("127.0.0.1", victim.see().counter[1]), 5) as peer:
            peer.sendall(b"hello\n")
            assert peer.recv(100) == b"1 hello\n"
            wait_until(lambda: guard.command("checkpoint").get("generation") == 2, 15, "two generations")
        # Closed since: a template has to take another socket in its place, each time.
        with hog(cpus[0]):
            for n in range(12):
                since = guard.mark()
                # It dies at once, at any moment; only its template waits for the hog.
                put_on(cpus[1], victim.app)
                victim.wait_beats(1)
                time.sleep(n * 0.007)
                victim.kill_app()
                restored = guard.wait("restored", since=since)
                assert restored["generation"] == 2, (n, restored)
        victim.wait_beats(20)


@pytest.mark.parametrize("command", ["threads 6 1", "tree 8"])
@pytest.mark.parametrize("late_guard", [False, True])
def test_restored_by_and_by(late_guard: bool, command: str, tmp_path: Path) -> None:
    """Each step comes later than a checkpoint would wait for it, and than init waits for a guard that says nothing."""
    options = () if late_guard else ("--wait-ms", f"{LATE_S * 600:.0f}")
    with (
        freezer(1) as late,
        Victim(command, tmp_path, options=options) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        taken = guard.checkpoint()
        for pid in children_of(victim.pid):
            if comm_of(pid).startswith("avckpt-"):
                late.take(pid)  # what is forked from it will be there, too
        if late_guard:
            late.take(guard.pid)
        late.wait()
        kill_main(victim)
        ends: list[dict[str, Any]] = []
        while not ends:
            time.sleep(LATE_S)
            late.go()
            time.sleep(0.005)
            late.wait()
            ends = [event for event in guard.events if event["kind"] in ("restored", "gave_up", "ended")]
        late.go()
        assert (ends[0]["kind"], ends[0].get("generation")) == ("restored", taken["generation"]), ends
        victim.wait_beats(20)


def test_the_dead_are_reaped_late(tmp_path: Path) -> None:
    """init gets no CPU when it has reported the death.  Until it does, the dead children have their PIDs."""
    with Victim("tree 8", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        taken = guard.checkpoint()
        # The first finds the main process, the second nobody, or a child.
        with injected(victim, "wait4", f"delay_enter={REAPED_S * 1e6:.0f}:when=2"):
            kill_main(victim)
            end = guard.wait_for(lambda event: event["kind"] in ("restored", "gave_up"), "end")
        assert (end["kind"], end.get("generation")) == ("restored", taken["generation"]), end
        assert end["restore_s"] > REAPED_S / 2, "nobody was late"
        victim.wait_beats(10)


def test_who_was_killed_and_has_yet_to_die_takes_nothing(cpus: tuple[int, int], tmp_path: Path) -> None:
    """A killed child that still waits at a pipe would read what the restore puts back, and still has its PID."""
    with Victim("errands", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        [child] = children_of(victim.app)
        wait_until(lambda: victim.see().counter[0] == 1, 5, "an errand is in the pipe")
        assert guard.checkpoint()["kind"] == "checkpoint"
        assert victim.see().counter[0] == 1
        wait_until(lambda: victim.see().counter[0] == 2, 5, "the child waits for one")
        time.sleep(0.05)
        put_on(cpus[0], child)
        for pid in (victim.pid, victim.app, guard.pid):
            put_on(cpus[1], pid)
        since = guard.mark()
        with hog(cpus[0], busy_s=0.7):
            kill_main(victim)
            time.sleep(0.5)
            assert not [event for event in guard.events[since:] if event["kind"] == "restored"]
        guard.wait("restored", since=since)
        done = victim.see().counter[1]
        wait_until(lambda: victim.see().counter[1] > done + 3 or victim.see().violations, 10, "errands are run")
        assert not victim.see().violations, victim.said
