# SPDX-License-Identifier: Apache-2.0
"""What a container can cost its guard: memory, descriptors, time."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from testkit.family import kill_main
from testkit.guarded import BUILD, GuardProcess, Victim, config
from testkit.harness import SLOWNESS, app_pid, wait_until
from testkit.init_peer import Init
from testkit.procfs import peak_kb

pytestmark = pytest.mark.shared_machine(
    "a checkpoint is missed when the application does not stop in time, and how far a guard got is looked at"
)

CHILDREN = 40
USER = 54322 + os.getpid()  # who has no other processes
PATIENCE_S = 30.0 * SLOWNESS


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def guard_of(peer: GuardProcess, cookie: int = 1) -> int:
    """The guard process of that container."""
    return peer.guards[cookie - 1]


def fds(pid: int) -> int:
    """How many descriptors a process has open."""
    return len(os.listdir(f"/proc/{pid}/fd"))


def test_shared_memory_costs_no_descriptors(tmp_path: Path) -> None:
    """Neither one for each area of a process, nor one for each generation."""
    with (
        Victim("crowd shared 1 1", tmp_path) as small,
        Victim(f"crowd shared {CHILDREN} 60", tmp_path) as crowd,
        GuardProcess(config(shm_bytes=64_000_000), [small.pid, crowd.pid]) as guard,
    ):
        counts = []
        for cookie in (1, 2):
            guard.wait("attached", cookie=cookie)
            before = fds(guard_of(guard, cookie))
            for _ in range(3):
                taken = guard.command("checkpoint", cookie, PATIENCE_S)
                assert taken["kind"] == "checkpoint", taken
            counts.append(fds(guard_of(guard, cookie)) - before)
        # What each process and each template takes.
        assert counts[1] < (CHILDREN + 1) * counts[0]


def test_shared_memory_is_bounded_for_all_processes_together(tmp_path: Path) -> None:
    with (
        Victim(f"crowd shared {CHILDREN} 60", tmp_path) as crowd,
        GuardProcess(config(shm_bytes=1_000_000), [crowd.pid]) as guard,
    ):
        told = guard.command("checkpoint", timeout_s=PATIENCE_S)["error"]["message"]
        assert "avckpt.shm has no room" in told


def test_memory_that_was_never_touched_costs_nothing(tmp_path: Path) -> None:
    with (
        Victim(f"crowd wiped {CHILDREN} 4", tmp_path) as crowd,
        GuardProcess(config(), [crowd.pid]) as guard,
    ):
        guard.wait("attached")
        before = peak_kb(guard_of(guard))
        for _ in range(2):
            taken = guard.command("checkpoint", timeout_s=PATIENCE_S)
            assert taken["kind"] == "checkpoint", taken
        assert peak_kb(guard_of(guard)) - before < CHILDREN << 10


@pytest.mark.timeout(300)
def test_as_many_processes_as_are_supported(tmp_path: Path) -> None:
    """They fit into the guard's memory, whose limit also counts what it reserves, and a death is answered in time
    although a checkpoint of them may take longer than init waits."""
    with (
        Victim("crowd shared 500 0", tmp_path) as crowd,
        GuardProcess(config(0.2, freeze_deadline_s=2.0), [crowd.pid]) as guard,
    ):
        for kill in range(3):
            guard.wait("checkpoint", since=guard.mark(), timeout_s=4 * PATIENCE_S)
            time.sleep(0.4 * kill)
            since = guard.mark()
            kill_main(crowd)
            assert guard.wait("restored", since=since, timeout_s=PATIENCE_S)["threads"] == 501
            crowd.wait_beats()


def test_as_many_descriptors_as_can_be_read_in_time(tmp_path: Path) -> None:
    """40,000: a process that was asked waits until those of the others are read, longer than for a clone."""
    with (
        Victim("crowd watched 4 4000", tmp_path) as crowd,
        GuardProcess(config(freeze_deadline_s=1.0), [crowd.pid]) as guard,
    ):
        for _ in range(2):
            told = guard.command("checkpoint", timeout_s=PATIENCE_S)
            assert told["kind"] == "checkpoint", told
        since = guard.mark()
        kill_main(crowd)
        guard.wait("restored", since=since, timeout_s=PATIENCE_S)
        crowd.wait_beats()


def test_templates_that_nobody_has_reaped_are_not_counted(tmp_path: Path) -> None:
    """Init gets no CPU to wait for those of dropped generations, which are its children."""
    with (
        Victim("crowd shared 260 0", tmp_path) as crowd,
        GuardProcess(config(keep=1, freeze_deadline_s=2.0), [crowd.pid]) as guard,
    ):
        assert guard.command("checkpoint", timeout_s=PATIENCE_S)["kind"] == "checkpoint"
        os.kill(crowd.pid, signal.SIGSTOP)
        try:
            for _ in range(3):
                told = guard.command("checkpoint", timeout_s=PATIENCE_S)
                assert told["kind"] == "checkpoint", told
        finally:
            os.kill(crowd.pid, signal.SIGCONT)
        crowd.wait_beats()


@pytest.mark.parametrize(("limit", "fits"), [(250, True), (110, True), (90, False)])
def test_a_limit_of_tasks_is_left_to_the_application(limit: int, fits: bool, tmp_path: Path) -> None:
    """A quarter of what it leaves free stays free; where there is no room for templates, nothing is begun."""
    processes = 20
    most = (limit - processes - 2) * 3 // 4  # it has a main process, and init
    with (
        Victim(f"crowd shared {processes} 0", tmp_path) as crowd,
        GuardProcess(config(tasks_max=limit, freeze_deadline_s=1.0), [crowd.pid]) as guard,
    ):
        for _ in range(4):
            told = guard.checkpoint()
            assert told["kind"] == ("checkpoint" if fits else "unprotected"), told
        if not fits:
            assert f"may have {limit} tasks" in told["error"]["message"]
            most = 0
        wait_until(lambda: len(crowd.others()) <= most, PATIENCE_S, "those that were killed have ended")
        if fits:
            since = guard.mark()
            kill_main(crowd)
            guard.wait("restored", since=since, timeout_s=PATIENCE_S)
        crowd.wait_beats()


def test_a_checkpoint_that_finds_no_room_leaves_none_of_its_tasks() -> None:
    """The limit of its user, which avckpt does not know beforehand: holders would take what it still has."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # the victim is not root
        user = f"/usr/bin/setpriv --reuid {USER} --regid {USER} --clear-groups --bounding-set -all --inh-caps -all"
        command = f"{user} /usr/bin/prlimit --nproc=30:30 {BUILD / 'crowd'} shared 20 0"
        with Victim(command, Path(folder)) as crowd, GuardProcess(config(), [crowd.pid]) as guard:
            for _ in range(3):
                answer = guard.command("checkpoint", timeout_s=PATIENCE_S)
                assert answer["kind"] == "missed", answer
            wait_until(lambda: not crowd.others(), PATIENCE_S, "nothing of ours is left")
            crowd.wait_beats()


def most_are_taken(guard: GuardProcess, tries: int, least: float = 0.67) -> list[str]:
    """Of so many checkpoints that are asked for; gives the kinds of all answers."""
    taken = [guard.command("checkpoint", timeout_s=PATIENCE_S)["kind"] for _ in range(tries)]
    assert taken.count("checkpoint") > tries * least, taken
    return taken


@pytest.mark.parametrize(("kinds", "tries", "least"), [("exec spawn again", 60, 0.95), ("stopped", 100, 0.975)])
def test_children_that_come_and_go_all_the_time(kinds: str, tries: int, least: float, tmp_path: Path) -> None:
    """In many freezes one has just executed a program, which takes another attempt; or SIGCONT stops one whose
    thread makes calls of ours once more."""
    with (
        Victim(f"turnover {kinds}", tmp_path) as victim,
        GuardProcess(config(freeze_deadline_s=1.0), [victim.pid]) as guard,
    ):
        most_are_taken(guard, tries, least)
        victim.wait_beats()


def test_a_child_that_is_killed_ends_at_once(tmp_path: Path) -> None:
    """Its threads that are traced just then have to be reaped, before the guard does anything that takes long."""
    with (
        Victim("turnover kill slain stopped --in-child", tmp_path) as victim,
        GuardProcess(config(freeze_deadline_s=1.0), [victim.pid]) as guard,
    ):
        for _ in range(150):
            guard.command("checkpoint")
            time.sleep(0.02)
        told, late = victim.see().counter[0], victim.see().counter[3]
        victim.check()
        assert late <= 8, f"{late} of {told} ends were told after more than 10 ms"


def test_workers_that_are_killed_and_replaced_all_the_time(tmp_path: Path) -> None:
    """One of them is nearly always dying, which takes a moment, and one new in nearly every freeze."""
    with (
        Victim("crowd renewed 10", tmp_path) as crowd,
        GuardProcess(config(freeze_deadline_s=1.0), [crowd.pid]) as guard,
    ):
        taken = most_are_taken(guard, 40, 0.85)
        assert "unprotected" not in taken, taken
        crowd.wait_beats()


def test_shells_that_redirect_what_they_have_inherited(tmp_path: Path) -> None:
    """There are always some that do so between the look at their descriptors and the freeze."""
    with (
        Victim("crowd shells 60", tmp_path) as crowd,
        GuardProcess(config(freeze_deadline_s=1.0), [crowd.pid]) as guard,
    ):
        most_are_taken(guard, 12)
        since = guard.mark()
        kill_main(crowd)
        guard.wait("restored", since=since, timeout_s=PATIENCE_S)
        crowd.wait_beats()


def test_workers_of_many_generations(tmp_path: Path) -> None:
    """Each has others of them, which are kept as long as it is: more than there may be at once."""
    generations, workers = 12, 100
    with (
        Victim(f"crowd renewed {workers}", tmp_path) as crowd,
        GuardProcess(config(keep=generations, freeze_deadline_s=1.0), [crowd.pid]) as guard,
    ):
        taken: list[str] = []
        while taken.count("checkpoint") < generations:
            taken.append(guard.command("checkpoint", timeout_s=PATIENCE_S)["kind"])
            assert "unprotected" not in taken
            crowd.wait_beats(workers)
        since = guard.mark()
        kill_main(crowd)
        assert guard.wait("restored", since=since, timeout_s=PATIENCE_S)["threads"] >= workers
        crowd.wait_beats(workers)


def test_what_it_has_open_is_bounded(tmp_path: Path) -> None:
    """File names alone would take 200 MB; the reason is reported in words, and the guard lives on."""
    with (
        Victim(f"crowd named 4 18000 {tmp_path}", tmp_path) as crowd,
        GuardProcess(config(), [crowd.pid]) as guard,
    ):
        told = guard.command("checkpoint", timeout_s=PATIENCE_S)
        assert told["kind"] == "unprotected"
        assert "more than 128 MB" in told["error"]["message"]
        assert peak_kb(guard_of(guard)) < 400 << 10
        crowd.wait_beats()


DESCRIPTORS = {"ports": 4000}  # there are 28,000, for all
MOST_DESCRIPTORS = 15_000
URGENT_S = 1.0
"""More CPU time than a restore may take with a real-time priority, which keeps others from the CPU."""


def thread_s(pid: int) -> float:
    """CPU time of the main thread."""
    fields = Path(f"/proc/{pid}/task/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def urgent_s(pid: int, is_over: Callable[[], bool]) -> float:
    """How much CPU time its main thread takes with a real-time priority until then."""
    total, before = 0.0, thread_s(pid)
    while not is_over():
        now, is_urgent = thread_s(pid), os.sched_getscheduler(pid) == os.SCHED_RR
        total, before = total + (now - before if is_urgent else 0), now
        time.sleep(0.005)
    return total


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("streams", "dies"),
        ("datagrams", "dies"),
        ("ends", "closes"),
        ("pipes", "closes again"),
        ("listeners", "closes again"),
        ("ports", "closes again"),
        ("locks", "dies"),
    ],
)
def test_a_restore_of_many_descriptors_leaves_the_cpus_to_others(kind: str, how: str, tmp_path: Path) -> None:
    """Each was compared with all others, for seconds, in which no other container got that CPU."""
    _, _, again = how.partition(" ")
    with (
        Victim(f"horde {DESCRIPTORS.get(kind, MOST_DESCRIPTORS)} {kind} {again}", tmp_path) as horde,
        GuardProcess(config(), [horde.pid]) as guard,
    ):
        assert guard.checkpoint()["kind"] == "checkpoint"
        if how != "dies":
            os.kill(horde.app, signal.SIGUSR1)
            wait_until(lambda: horde.see().counter[0] > 0, PATIENCE_S, "they are closed")
        since = guard.mark()
        horde.kill_app()
        assert urgent_s(guard.pid, lambda: guard.mark() > since + 1) < URGENT_S
        guard.wait("restored", since=since)
        horde.wait_beats()


LOCKS = """
import fcntl, sys, time
file = open(sys.argv[1], "w")
for byte in range(0, 16000, 2):
    fcntl.lockf(file, fcntl.LOCK_EX, 1, byte)
print("ready", file=file, flush=True)
time.sleep(1000)
"""


def test_what_is_not_taken_again_is_told_by_its_name(tmp_path: Path) -> None:
    """Here POSIX locks, which were told as watches of epoll."""
    file = tmp_path / "file"
    with Init(["/usr/bin/python3", "-c", LOCKS, file], pid1=True, options=("--wait-ms", "60000")) as init:
        wait_until(lambda: file.exists() and file.read_text(), PATIENCE_S, "it has its locks")
        with GuardProcess(config(freeze_deadline_s=1.0), [init.pid]) as guard:
            assert guard.checkpoint()["kind"] == "checkpoint"
            since = guard.mark()
            os.kill(app_pid(init.pid), signal.SIGKILL)
            assert "locks" in guard.wait("restored", since=since)["error"]["message"]


def test_watches_that_cannot_be_told_apart_do_not_occupy_the_guard(tmp_path: Path) -> None:
    """To find what each of 15,000 watches of one number is of would take hours."""
    with (
        Victim(f"horde {MOST_DESCRIPTORS} watches", tmp_path) as horde,
        GuardProcess(config(), [horde.pid]) as guard,
    ):
        told = guard.command("checkpoint", timeout_s=PATIENCE_S)
        assert told["kind"] == "missed", told
        assert "takes longer" in told["error"]["message"]
        horde.wait_beats()
