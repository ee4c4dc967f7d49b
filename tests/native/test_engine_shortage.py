# SPDX-License-Identifier: Apache-2.0
"""The guard itself has no descriptors, memory or tasks left for a moment: which says nothing about the application.

It is neither taken for dead nor let go of, and what the guard says is what it lacks.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.guard import Files, GuardConfig, Images

from testkit.guarded import WHERE, GuardProcess, Victim, config, injected
from testkit.scenario import disturb, wait_looked

ENDS = ("restored", "gave_up")
KINDS_OF_LOSS = ("dropped", "unprotected", "gave_up")
MOMENT_S = 0.1
FEW = 16
"""So many can be waited for, poll(2), and it has more open."""
LEVELS = 8
"""With so many free ones it has all that it takes."""


OPENERS = "openat,pidfd_open,pidfd_getfd,memfd_create,socket"
MAKERS = f"{OPENERS},openat2,socketpair,pipe2,epoll_create1,eventfd2,timerfd_create"


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@contextlib.contextmanager
def limited(guard: GuardProcess, what: int, limit: int) -> Iterator[None]:
    soft, hard = resource.prlimit(guard.pid, what)
    resource.prlimit(guard.pid, what, (limit, hard))
    try:
        yield
    finally:
        resource.prlimit(guard.pid, what, (soft, hard))


def limit_for(guard: GuardProcess, free: int) -> int:
    """The limit under which it can open so many more files."""
    used = {int(number) for number in os.listdir(f"/proc/{guard.pid}/fd")}
    return [number for number in range(len(used) + free + 1) if number not in used][free]


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def losses(guard: GuardProcess) -> list[object]:
    return [event for event in guard.events if event.get("kind") in KINDS_OF_LOSS]


def check_says(answer: dict[str, object], number: int, words: str) -> None:
    error = answer["error"]
    assert isinstance(error, dict)
    assert (error["kind"], error["errno"]) == ("kernel", number), answer
    assert words in error["detail"]


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("first", [True, False], ids=["first", "another"])
def test_descriptors(first: bool, where: str, tmp_path: Path) -> None:
    with Victim(f"idle 1 2 {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.wait("attached")
        if not first:
            assert guard.checkpoint()["kind"] == "checkpoint"
        missed = 0
        for free in range(LEVELS):
            with limited(guard, resource.RLIMIT_NOFILE, limit_for(guard, free)):
                answer = guard.command("checkpoint")
            if answer["kind"] == "missed" and answer["error"]["kind"] != "deadline":
                check_says(answer, errno.EMFILE, "its guard may not open any more files")
                missed += 1
        assert missed
        assert not losses(guard)
        assert guard.checkpoint()["kind"] == "checkpoint"
        victim.wait_beats()


def test_memory(tmp_path: Path) -> None:
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.wait("attached")
        with limited(guard, resource.RLIMIT_AS, 1):
            answer = guard.command("checkpoint")
        check_says(answer, errno.ENOMEM, "its guard gets no more memory")
        assert not losses(guard)
        assert guard.checkpoint()["kind"] == "checkpoint"
        victim.wait_beats()


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("limit", [1, FEW])
def test_a_death_while_there_are_no_descriptors(limit: int, where: str, tmp_path: Path) -> None:
    with Victim(f"idle 1 2 {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        taken = guard.checkpoint()
        with limited(guard, resource.RLIMIT_NOFILE, limit):
            victim.kill_app()
            guard.wait("died")  # told while it tries
        event = guard.wait_for(lambda event: event.get("kind") in ENDS, "end of the restore")
        assert event["kind"] == "restored", event
        assert event["generation"] == taken["generation"]
        assert not losses(guard)
        victim.wait_beats()
        assert guard.checkpoint()["kind"] == "checkpoint"


def test_there_are_none_for_long(tmp_path: Path) -> None:
    """The application cannot be brought back, and who waits for its end is not kept waiting."""
    with Victim("idle 1 2", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.checkpoint()
        with limited(guard, resource.RLIMIT_NOFILE, FEW):
            victim.kill_app()
            check_says(guard.wait("gave_up"), errno.EMFILE, "its guard may not open any more files")


def test_more_are_waited_for_than_may_be_open(tmp_path: Path) -> None:
    with Victim("idle 1 2", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.checkpoint()
        with limited(guard, resource.RLIMIT_NOFILE, 1):
            answer = guard.command("checkpoint")
            before = cpu_s(guard.pid)
            time.sleep(MOMENT_S * 10)
            assert cpu_s(guard.pid) - before < MOMENT_S * 5
        check_says(answer, errno.EMFILE, "its guard may not open any more files")
        assert not losses(guard)
        assert guard.checkpoint()["kind"] == "checkpoint"
        victim.wait_beats()


@pytest.mark.parametrize("first", [True, False], ids=["first", "another"])
@pytest.mark.parametrize(
    ("command", "images"),
    [("tree 2", Images.FORK), ("idle 1 2 --in-child", Images.FORK), ("hoard 40", Images.DIRTY)],
)
def test_each_descriptor_is_not_to_be_had_once(command: str, images: Images, first: bool, tmp_path: Path) -> None:
    """It is said, or does not matter; and the next checkpoint is as any other one."""
    settings, log = config(images=images), tmp_path / "log"
    with Victim(command, tmp_path) as victim, GuardProcess(settings, [victim.pid]) as guard:
        guard.checkpoint()
        for n in itertools.count(1):
            if first:
                guard.start_another(victim.pid)
            since = guard.mark()
            with injected(guard, OPENERS, f"error=EMFILE:when={n}", log):
                answer = guard.command("checkpoint")
            failed = [line for line in log.read_text().splitlines() if "INJECTED" in line]
            if not failed:
                break
            if answer["kind"] == "missed" and answer["error"]["kind"] != "deadline":
                assert answer["error"]["errno"] == errno.EMFILE, (answer, failed)
            elif answer["kind"] != "missed":
                assert (answer["kind"], answer.get("error")) == ("checkpoint", None), (answer, failed)
            assert not [event for event in guard.events[since:] if event.get("kind") in KINDS_OF_LOSS], failed
            assert guard.checkpoint()["kind"] == "checkpoint", failed
        assert n > LEVELS
        victim.wait_beats()


def check_each_is_lacking_once(victim: Victim, settings: GuardConfig, error: str, *, disturbs: bool) -> None:
    """Each thing that is opened during a restore: nothing is restored around it, and another try finds it all."""
    log = victim.board.path.with_suffix(".log")
    with GuardProcess(settings, [victim.pid]) as guard:
        for n in itertools.count(1):
            guard.checkpoint()
            if disturbs:
                disturb(victim)
            since, before = guard.mark(), victim.see().counter[1]
            with injected(guard, MAKERS, f"error={error}:when={n}", log):
                victim.kill_app()
                event = guard.wait_for(lambda event: event.get("kind") in ENDS, "end of the restore", since=since)
            failed = [line for line in log.read_text().splitlines() if "INJECTED" in line]
            if not failed:
                break
            # An older generation is as good: only then does the error say that something was lacking.
            assert event["kind"] == "restored", (event, failed)
            said = event.get("error", {"kind": "kernel", "errno": getattr(errno, error)})
            assert (said["kind"], said["errno"]) == ("kernel", getattr(errno, error)), (event, failed)
            if disturbs:
                wait_looked(victim, before)
            else:
                victim.wait_beats()
        assert n > LEVELS


@pytest.mark.parametrize(
    ("command", "error"),
    [
        *(("tree 2", error) for error in ("EMFILE", "ENFILE", "ENOMEM")),
        ("idle 1 2 --in-child", "EMFILE"),
    ],
)
def test_each_descriptor_is_not_to_be_had_once_in_a_restore(command: str, error: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim:
        check_each_is_lacking_once(victim, config(), error, disturbs=False)


@pytest.mark.parametrize(
    "scenario",
    [
        *("descriptors closed", "descriptors content", "descriptors epoll"),
        *("events timers", "sockets messages", "sockets shut"),
    ],
)
def test_each_is_not_to_be_had_once_where_much_is_put_back(scenario: str, tmp_path: Path) -> None:
    with Victim(f"{scenario} {tmp_path}", tmp_path) as victim:
        check_each_is_lacking_once(victim, config(), "EMFILE", disturbs=True)


@pytest.mark.parametrize("files", [Files.STRICT, Files.AUTO])
def test_a_file_that_cannot_be_looked_at_once_was_not_written(files: Files, tmp_path: Path, memory: Path) -> None:
    with Victim(f"descriptors quiet {tmp_path}", memory) as victim:
        os.utime(tmp_path / "data", (0, 0))  # what is written right before a checkpoint counts as written since
        check_each_is_lacking_once(victim, config(files=files), "EMFILE", disturbs=False)
