# SPDX-License-Identifier: Apache-2.0
"""The spare: a fork of the newest template, made while the application runs, whose memory a restore uses."""

from __future__ import annotations

import contextlib
import os
import random
import select
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from avckpt.guard import Images

from testkit.cgroups import Cgroup, freezer, throttle
from testkit.family import ours
from testkit.guarded import BUILD, PATIENCE_S, GuardProcess, Victim, config, forks_beside, sleep_exactly
from testkit.harness import wait_until
from testkit.procfs import KCMP_VM, children_of, share

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "a spare is there only if the guard had the time to make it"
)

MEGABYTES = 300


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def spares(victim: Victim) -> list[int]:
    return ours(victim, "avckpt-spare")


def wait_spare(victim: Victim, other_than: int = 0) -> int:
    """Waits until there is a spare of exactly one template: an older template's goes before a new one comes."""
    found: list[int] = []

    def is_made() -> bool:
        found[:] = spares(victim)
        return len(found) == 1 and found != [other_than]

    wait_until(is_made, PATIENCE_S, "a spare is made")
    return found[0]


def wait_template(victim: Victim) -> int:
    """The only one; a spare that was forked a moment ago still has its name."""
    found: list[int] = []

    def is_alone() -> bool:
        found[:] = ours(victim, "avckpt-tmpl")
        return len(found) == 1

    wait_until(is_alone, PATIENCE_S, "one template")
    return found[0]


def open_spare(victim: Victim) -> int:
    """A pidfd of the spare."""
    while True:
        with contextlib.suppress(ProcessLookupError):  # an old one, just gone
            return os.pidfd_open(wait_spare(victim))


def die_and_come_back(victim: Victim, guard: GuardProcess) -> None:
    since = guard.mark()
    victim.kill_app()
    guard.wait("restored", since=since)
    victim.wait_beats(3)


def test_it_is_used_up_and_made_again(tmp_path: Path) -> None:
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        spare = wait_spare(victim)
        template = ours(victim, "avckpt-tmpl")
        for _ in range(10):
            die_and_come_back(victim, guard)
            spare = wait_spare(victim, other_than=spare)
            assert ours(victim, "avckpt-tmpl") == template
        # Only the newest generation has one.
        assert guard.checkpoint()["kind"] == "checkpoint"
        wait_until(lambda: ours(victim, "avckpt-tmpl") not in (template, []), PATIENCE_S, "another template")
        wait_spare(victim, other_than=spare)


def test_killed_it_is_no_loss(tmp_path: Path) -> None:
    """By the OOM killer, for example: the template is still there."""
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        taken = guard.checkpoint()
        os.kill(wait_spare(victim), signal.SIGKILL)
        wait_until(lambda: not spares(victim), PATIENCE_S, "it is gone")
        since = guard.mark()
        victim.kill_app()
        assert guard.wait("restored", since=since)["generation"] == taken["generation"]
        victim.wait_beats(20)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


@pytest.mark.parametrize("command", ["threads 4 1", "tree 3"])
def test_killed_while_it_is_used(command: str, tmp_path: Path) -> None:
    """From inside the container, at any moment of a restore."""
    rng = random.Random(3)
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(60):
            taken = guard.checkpoint()
            spare, since = open_spare(victim), guard.mark()
            dead = os.pidfd_open(victim.app)
            after_s = rng.uniform(0, 0.002)
            victim.kill_app()
            select.select([dead], [], [])
            sleep_exactly(after_s)
            with contextlib.suppress(ProcessLookupError):  # it was used already
                signal.pidfd_send_signal(spare, signal.SIGKILL)
            os.close(spare)
            os.close(dead)
            assert guard.wait("restored", since=since)["generation"] == taken["generation"]
            victim.wait_beats(5)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_killed_while_it_is_made(tmp_path: Path) -> None:
    """The application dies at any moment of that; the restore may have to wait, and succeeds."""
    rng = random.Random(1)
    with Victim(f"idle {MEGABYTES} 4", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(30):
            assert guard.checkpoint()["kind"] == "checkpoint"
            time.sleep(rng.uniform(0, 0.008))
            die_and_come_back(victim, guard)


def test_template_or_spare_killed_while_it_is_made(tmp_path: Path) -> None:
    """From inside the container, at any moment: this costs one generation at most, and is reported."""
    rng = random.Random(2)
    with Victim(f"idle {MEGABYTES} 4", tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        for _ in range(30):
            assert guard.checkpoint()["kind"] == "checkpoint"
            since = guard.mark()
            time.sleep(rng.uniform(0, 0.008))
            for pid in ours(victim, rng.choice(["avckpt-tmpl", "avckpt-spare"])):
                with contextlib.suppress(ProcessLookupError):  # an old one, just ending
                    os.kill(pid, signal.SIGKILL)
            victim.wait_beats(3)
        kinds = {event["kind"] for event in guard.events[since:] if "kind" in event}
        assert kinds <= {"checkpoint", "dropped"}, kinds
        assert guard.checkpoint()["kind"] == "checkpoint"
        die_and_come_back(victim, guard)


def test_made_while_the_container_ends_it_is_no_news(tmp_path: Path) -> None:
    """Its template was killed with all other processes, but its end is not visible yet."""
    rng = random.Random(4)
    with Victim("idle 1 1", tmp_path) as first, GuardProcess(config(), [first.pid]) as guard:
        for n in range(40):
            (tmp_path / str(n)).mkdir()
            with Victim("threads 4 20 --no-churn", tmp_path / str(n)) as victim:
                guard.start_another(victim.pid)
                since = guard.mark()
                guard.checkpoint()
                time.sleep(rng.uniform(0.009, 0.014))
                os.kill(victim.pid, signal.SIGKILL)
                guard.wait("ended", since=since)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_killed_before_there_is_one_while_others_fork(tmp_path: Path) -> None:
    """While the kernel copies so much memory, another process could take the PID."""
    with (
        Victim(f"idle {MEGABYTES} 2", tmp_path) as victim,
        forks_beside(victim),
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        for _ in range(10):
            assert guard.command("checkpoint", timeout_s=30)["kind"] == "checkpoint"
            die_and_come_back(victim, guard)


def test_none_when_checkpoints_are_too_frequent(tmp_path: Path) -> None:
    """Spares must not take a large part of a CPU."""
    command = f"idle {MEGABYTES} 1"
    forks = config(0.03, images=Images.FORK)
    with Victim(command, tmp_path) as victim, GuardProcess(forks, [victim.pid]) as guard:
        for _ in range(20):
            guard.wait("checkpoint", since=guard.mark())
            assert not spares(victim)
        die_and_come_back(victim, guard)


USER = 1_000_000 + os.getpid()
"""The limit counts a user's tasks on all of the machine: those of another run of these tests must not be among them."""
SOMEBODY = f"/usr/bin/setpriv --reuid {USER} --regid {USER} --clear-groups --bounding-set -all --inh-caps -all"
DEATHS = 20


def processes_of(user: int) -> list[int]:
    return [process.pid for process in psutil.process_iter(["uids"]) if process.info["uids"].real == user]


@contextlib.contextmanager
def limited(processes: int, victim: str = "idle 0 4") -> Iterator[tuple[Victim, GuardProcess]]:
    """A container with that limit of tasks; four threads with a holder and a template are six."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # the victim is not root
        command = f"{SOMEBODY} /usr/bin/prlimit --nproc={processes}:{processes} {BUILD}/{victim}"
        forks = config(keep=1, images=Images.FORK)
        with Victim(command, Path(folder)) as made, GuardProcess(forks, [made.pid]) as guard:
            yield made, guard
        wait_until(lambda: not processes_of(USER), PATIENCE_S, "nobody is left who counts with the next ones")


def test_none_when_it_may_not_have_another_process() -> None:
    with limited(6) as (victim, guard):
        assert guard.checkpoint()["kind"] == "checkpoint"
        time.sleep(0.1)
        assert not spares(victim)
        for _ in range(5):
            die_and_come_back(victim, guard)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_a_thread_with_a_wrong_number_is_one_too_many() -> None:
    """Others take numbers of its threads, and the thread that got another one instead has yet to end."""
    with limited(6) as (victim, guard), forks_beside(victim):
        assert guard.checkpoint()["kind"] == "checkpoint"
        for _ in range(DEATHS):
            die_and_come_back(victim, guard)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_it_makes_room_for_a_template() -> None:
    """At the limit of tasks the next template is worth more than the last one's spare."""
    with limited(7) as (victim, guard):
        assert guard.checkpoint()["kind"] == "checkpoint"
        wait_spare(victim)
        for _ in range(5):
            answer = guard.checkpoint()
            assert answer["kind"] == "checkpoint", str(answer)
            time.sleep(0.1)
            assert not spares(victim)
            die_and_come_back(victim, guard)


def test_it_is_one_process_too_many() -> None:
    """The limit was lowered since the spare was made: the template alone is as good."""
    with limited(7) as (victim, guard):
        taken = guard.checkpoint()
        wait_spare(victim)
        for pid in ours(victim):
            subprocess.run([*SOMEBODY.split(), "/usr/bin/prlimit", f"--pid={pid}", "--nproc=6:7"], check=True)
        for _ in range(3):
            die_and_come_back(victim, guard)
        assert {event["generation"] for event in guard.events if event.get("kind") == "restored"} == {
            taken["generation"]
        }
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_there_is_no_room_for_copies_of_a_big_parent() -> None:
    """Seven processes with their holders and templates, and a program that takes PIDs: no copies are made."""
    with limited(21, "prefork 6 12") as (victim, guard), forks_beside(victim):
        assert guard.checkpoint()["kind"] == "checkpoint"
        for _ in range(3):
            die_and_come_back(victim, guard)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_there_is_room_for_one_again(tmp_path: Path) -> None:
    """Its container may have more tasks: before, there was room for a holder and templates only."""
    forks = config(images=Images.FORK, keep=1, tasks_max=7)
    with Victim("idle 0 4", tmp_path) as victim, GuardProcess(forks, [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        time.sleep(0.1)
        assert not spares(victim)
        guard.say_tasks(100)
        assert guard.checkpoint()["kind"] == "checkpoint"
        wait_spare(victim)


def test_there_is_room_for_one_when_others_of_its_user_have_ended() -> None:
    """The limit of tasks that is not the container's: nobody tells."""
    with subprocess.Popen([*SOMEBODY.split(), "/usr/bin/sleep", "1000"]) as other:
        try:
            wait_until(lambda: processes_of(USER), PATIENCE_S, "it is that user's")
            with limited(8) as (victim, guard):
                assert guard.checkpoint()["kind"] == "checkpoint"
                wait_spare(victim)
                assert guard.checkpoint()["kind"] == "checkpoint"
                assert not spares(victim)
                other.kill()
                other.wait()

                def has_one() -> bool:
                    return guard.checkpoint()["kind"] == "checkpoint" and bool(spares(victim))

                wait_until(has_one, PATIENCE_S, "a spare", every_s=1.0)
        finally:
            other.kill()


def policies(victim: Victim, name: str) -> set[int]:
    found = set()
    for pid in ours(victim, name):
        with contextlib.suppress(ProcessLookupError):  # it has been replaced
            found.add(os.sched_getscheduler(pid))
    return found


def test_priorities_are_kept(tmp_path: Path) -> None:
    """Spares are made at normal priority, so that the application runs; the restored process has its own."""
    with Victim("idle 50 2", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        os.sched_setscheduler(victim.app, os.SCHED_FIFO, os.sched_param(7))
        os.sched_setaffinity(victim.app, {0})
        for _ in range(3):
            assert guard.checkpoint()["kind"] == "checkpoint"
            wait_spare(victim)
            wait_until(
                lambda: policies(victim, "avckpt-spare") == {os.SCHED_FIFO}, PATIENCE_S, "the spare has it again"
            )
            assert policies(victim, "avckpt-tmpl") == {os.SCHED_FIFO}
            for _ in range(2):
                die_and_come_back(victim, guard)
                assert os.sched_getscheduler(victim.app) == os.SCHED_FIFO
                assert os.sched_getparam(victim.app).sched_priority == 7
                assert os.sched_getaffinity(victim.app) == {0}


@contextlib.contextmanager
def inside(cgroup: Cgroup, command: str, folder: Path) -> Iterator[tuple[Victim, GuardProcess]]:
    """The container's processes; at the end there are those that should be, and no others."""
    with cgroup, Victim(command, folder) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        cgroup.take(victim.pid)
        cgroup.take(victim.app)
        yield victim, guard
        victim.check()
        wait_until(
            lambda: len(spares(victim)) == 1 and len(ours(victim)) == 3, PATIENCE_S, "template, spare, holder, no more"
        )


def pause_before_spare(pause: Cgroup, victim: Victim, guard: GuardProcess, pause_s: float = 0.8) -> dict[str, Any]:
    """Takes a checkpoint whose spare is not made yet when the container is paused."""
    for _ in range(10):
        old = {*spares(victim)}
        taken = guard.checkpoint()
        assert taken["kind"] == "checkpoint", str(taken)
        wait_until(partial(lambda old: old.isdisjoint(spares(victim)), old), PATIENCE_S, "the last one is gone", 0.001)
        pause.wait()
        time.sleep(pause_s)
        if not spares(victim):
            return taken
        pause.go()
    pytest.fail("each time a spare was made before the pause")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("pause_s", [0.05, 1.5])
def test_paused_before_it_is_made(version: int, pause_s: float, tmp_path: Path) -> None:
    """A template that failed to make its spare can still be restored from."""
    pause = freezer(version)
    with inside(pause, "threads 4 1", tmp_path) as (victim, guard):
        taken = pause_before_spare(pause, victim, guard, pause_s)
        victim.kill_app()
        pause.go()
        assert guard.wait("restored")["generation"] == taken["generation"]
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_made_late_it_is_used(tmp_path: Path) -> None:
    """Its template was frozen meanwhile; the restored process shares that template's memory until it is ended."""
    pause = freezer(2)
    with inside(pause, "threads 4 1", tmp_path) as (victim, guard):
        shared = False
        for _ in range(10):
            pause_before_spare(pause, victim, guard)
            (template,) = ours(victim, "avckpt-tmpl")
            pause.go()
            wait_until(lambda: len(ours(victim)) == 3, PATIENCE_S, "it is there")
            (late,) = {*ours(victim, "avckpt-tmpl"), *spares(victim)} - {template}
            since = guard.mark()
            victim.kill_app()
            until = time.monotonic() + 1
            while not shared and time.monotonic() < until:
                shared = any(share(KCMP_VM, late, pid) for pid in children_of(victim.pid) if pid != late)
            guard.wait("restored", since=since)
            victim.wait_beats(5)
            if shared:
                break
        assert shared


def test_made_late_it_makes_room_for_a_template() -> None:
    """It counts towards the limit of processes even before the guard has seen it."""
    with freezer(2) as pause, limited(7) as (victim, guard):
        pause.take(victim.pid)
        pause.take(victim.app)
        pause_before_spare(pause, victim, guard)
        pause.go()
        answer = guard.checkpoint()
        assert answer["kind"] == "checkpoint", str(answer)
        time.sleep(0.1)
        # Holder and template, and a spare if none had been begun before the pause: there was room then.
        assert len(ours(victim)) <= 3
        die_and_come_back(victim, guard)


def slow_ones() -> list[Any]:
    return [pytest.param(partial(freezer, 1), id="1"), pytest.param(partial(freezer, 2), id="2"), throttle]


@pytest.mark.parametrize("slow", slow_ones())
def test_made_slowly(slow: Callable[[], Cgroup], tmp_path: Path) -> None:
    """The application dies after its template was told to make a spare, before or after it has made it."""
    rng, cgroup = random.Random(1), slow()
    with inside(cgroup, "idle 200 2", tmp_path) as (victim, guard):
        for number in range(10):
            taken = guard.checkpoint()
            time.sleep(rng.uniform(0.015, 0.03))
            cgroup.wait()
            time.sleep(rng.choice([0.02, 0.6, 1.0]))
            since = guard.mark()
            victim.kill_app()
            cgroup.go()
            assert guard.wait("restored", since=since)["generation"] == taken["generation"], number
            victim.wait_beats(5)


@pytest.mark.parametrize("slow", slow_ones())
def test_its_template_is_killed_in_the_making(slow: Callable[[], Cgroup], tmp_path: Path) -> None:
    """The guard does not know yet whether there is a spare; none may be left."""
    rng, cgroup = random.Random(2), slow()
    with inside(cgroup, "idle 200 2", tmp_path) as (victim, guard):
        for _ in range(6):
            guard.checkpoint()
            template = wait_template(victim)
            time.sleep(rng.uniform(0.015, 0.03))
            cgroup.wait()
            time.sleep(rng.choice([0.6, 1.0]))
            since = guard.mark()
            os.kill(template, signal.SIGKILL)
            time.sleep(rng.choice([0.0, 0.1]))
            cgroup.go()
            guard.wait("dropped", since=since)
            wait_until(lambda: len(ours(victim)) == 1, PATIENCE_S, "the holder alone")
            victim.wait_beats(5)
        guard.checkpoint()


@pytest.mark.parametrize("slow", slow_ones())
def test_the_guard_stops_in_the_making(slow: Callable[[], Cgroup], tmp_path: Path) -> None:
    with slow() as cgroup, Victim("idle 200 2", tmp_path) as victim:
        with GuardProcess(config(keep=1), [victim.pid]) as guard:
            cgroup.take(victim.pid)
            cgroup.take(victim.app)
            guard.checkpoint()
            cgroup.wait()
            time.sleep(0.8)
            # Who is frozen is not ended by SIGKILL before it thaws, with version 1.
            later = threading.Timer(1, cgroup.go)
            later.start()
            guard.stop()
            later.join()
        victim.wait_beats(5)
        wait_until(lambda: not ours(victim), PATIENCE_S, "nothing of ours is left")
