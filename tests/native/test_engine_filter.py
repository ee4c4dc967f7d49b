# SPDX-License-Identifier: Apache-2.0
"""The guard's own seccomp filter: what it forbids, and that it stands in no application's way."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import select
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit import seccomp
from testkit.engine_program import link_with_engine
from testkit.guarded import GuardProcess, Victim, config, kill_at_random
from testkit.harness import wait_until
from testkit.procfs import children_of, comm_of, status_of

CAP_KILL, CAP_SYS_PTRACE, CAP_SYS_ADMIN = 1 << 5, 1 << 19, 1 << 21


@pytest.fixture(scope="module")
def filtered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tests/native/filtered.c."""
    return link_with_engine("filtered", tmp_path_factory.mktemp("filtered"))


def test_what_a_guard_may_not_do(filtered: Path) -> None:
    """Nothing that it does not do anyway: no other program, no namespaces, no code, no part of the kernel that it
    does not need."""
    lines = subprocess.run([filtered], check=True, capture_output=True, text=True, timeout=30).stdout.splitlines()
    refused = lines[1 : lines.index("allowed")]
    allowed = lines[lines.index("allowed") + 1 :]
    assert len(refused) > 20
    assert [line for line in refused if line.split()[1] != str(errno.ENOSYS)] == []
    assert [line.split()[1] for line in allowed] == [str(errno.ESRCH), *["0"] * (len(allowed) - 1)]


def filters_of(guard: GuardProcess) -> set[tuple[str, str]]:
    """Mode and number of the seccomp filters of each of its threads."""
    found = set()
    for task in Path(f"/proc/{guard.pid}/task").iterdir():
        status = status_of(int(task.name))
        found.add((status["Seccomp"], status["Seccomp_filters"]))
    return found


KERNEL = "the kernel cannot watch its memory"
FILTERED, PLAIN = {("2", "1")}, {("0", "0")}


@pytest.mark.parametrize("command", ["idle 10 4", "threads 8 10"])
def test_a_guard_is_under_its_filter(command: str, tmp_path: Path) -> None:
    """From the first checkpoint on, with all of its threads; and it restores."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        guard.wait("checkpoint")
        assert filters_of(guard) == FILTERED
        kill_at_random(guard, victim, 5, (0.02, 0.2))
        assert filters_of(guard) == FILTERED
        assert not [event for event in guard.events if event["kind"] == "guard_lost"]


def test_an_application_that_has_a_filter_gets_a_guard_without(tmp_path: Path) -> None:
    with Victim("sandbox", tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        guard.wait("checkpoint", count=2)
        assert filters_of(guard) == PLAIN
        assert not [event for event in guard.events if event["kind"] == "guard_lost"]
        kill_at_random(guard, victim, 3, (0.02, 0.1))


def test_one_that_installs_a_filter_gets_another_guard(tmp_path: Path) -> None:
    """It notices nothing, is told once, and is protected again at once."""
    with Victim("sandbox --late", tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        guard.wait("checkpoint", count=2)
        assert filters_of(guard) == FILTERED
        first = guard.pid
        since = guard.mark()
        victim.kill_app(signal.SIGUSR1)
        lost = guard.wait("guard_lost", since=since)
        assert lost["reason"] == "filter"
        guard.wait("checkpoint", since=guard.events.index(lost), count=3)
        assert guard.pid != first
        assert filters_of(guard) == PLAIN
        victim.wait_beats(5)
        assert victim.see().counter[1] == 1
        kill_at_random(guard, victim, 5, (0.02, 0.1))
        assert len([event for event in guard.events if event["kind"] == "guard_lost"]) == 1


def lives_on_unprotected(victim: Victim, guard: GuardProcess) -> None:
    lost = guard.wait("guard_lost")
    assert lost["reason"] == "filter"
    refused = guard.wait("unprotected", since=guard.events.index(lost))
    assert "may kill it" in refused["error"]["message"]
    victim.wait_beats(5)
    assert not [event for event in guard.events if event["kind"] in ("died", "restored")]


@pytest.mark.shared_machine("an application whose filter kills may die of it while it waits for a CPU in a checkpoint")
def test_a_filter_that_comes_at_any_moment_kills_nobody(tmp_path: Path) -> None:
    """Checkpoints back to back while the application installs a filter that kills it at calls of ours."""
    for i in range(6):
        with Victim("sandbox --kill --late", tmp_path) as victim, GuardProcess(config(0.005), [victim.pid]) as guard:
            guard.wait("checkpoint", count=3)
            time.sleep(0.0017 * i)
            victim.kill_app(signal.SIGUSR1)
            lives_on_unprotected(victim, guard)


def test_a_filter_for_all_threads_kills_none_that_is_in_the_parasite(tmp_path: Path) -> None:
    """One thread installs it for all the moment that another one is queried, or would, if it could run then."""
    for _ in range(6):
        with Victim("ambush", tmp_path) as victim, GuardProcess(config(0.005), [victim.pid]) as guard:
            guard.wait("checkpoint", count=2)
            victim.kill_app(signal.SIGUSR1)
            with contextlib.suppress(TimeoutError):
                wait_until(lambda: victim.see().counter[0], 1, "it saw a thread in there")
            victim.kill_app(signal.SIGUSR2)
            lives_on_unprotected(victim, guard)


REFUSES = {
    "close_range": seccomp.refusing("close_range"),
    "socketpair": seccomp.refusing("socketpair"),
}


@pytest.mark.parametrize("call", REFUSES)
def test_a_container_whose_filter_refuses_what_is_needed(call: str, tmp_path: Path) -> None:
    """The filter is the container's: avckpt-init has it, too."""
    install: Callable[[], None] = REFUSES[call]
    with (
        Victim("idle 10 4", tmp_path, preexec=install) as victim,
        GuardProcess(config(0.05), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        assert filters_of(guard) == PLAIN
        kill_at_random(guard, victim, 3, (0.02, 0.1))


def watchers_of(guard: GuardProcess) -> list[int]:
    return [pid for pid in children_of(guard.pid) if comm_of(pid) == "avckpt-watch"]


def copied_since(guard: GuardProcess, since: int) -> None:
    guard.wait_for(lambda event: event.get("images") == "dirty", "a copy", since=since)


@pytest.mark.parametrize("images", [Images.FORK, Images.DIRTY])
def test_a_container_that_may_not_have_its_memory_watched(images: Images, tmp_path: Path) -> None:
    """As in Podman's default profile: userfaultfd(2) is refused. The guard is confined nevertheless; a process of
    its own has the filter suspended, for that call alone."""
    install = seccomp.refusing("userfaultfd")
    with (
        Victim("idle 10 4", tmp_path, preexec=install) as victim,
        GuardProcess(config(0.05, images=images), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        assert filters_of(guard) == FILTERED
        if images is Images.FORK:
            assert watchers_of(guard) == []
            return
        copied_since(guard, 0)
        [watcher] = watchers_of(guard)
        status = status_of(watcher)
        assert (status["Seccomp"], int(status["CapEff"], 16)) == ("0", CAP_KILL | CAP_SYS_PTRACE | CAP_SYS_ADMIN)
        assert [fd.name for fd in Path(f"/proc/{watcher}/fd").iterdir()] == ["0"]
        for _ in range(3):
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            copied_since(guard, since)
        kill_at_random(guard, victim, 3, (0.02, 0.2))
        assert not refused_by_kernel(guard)
        os.kill(watcher, signal.SIGKILL)
        # It goes on with forks when it has to watch another process.
        since = guard.mark()
        victim.kill_app()
        guard.wait_for(lambda event: event.get("fork_reason") == KERNEL, "a fork", since=since)
        kill_at_random(guard, victim, 3, (0.02, 0.2))
        assert filters_of(guard) == FILTERED
        victim.check()


def refused_by_kernel(guard: GuardProcess) -> bool:
    return any(event.get("fork_reason") == KERNEL for event in guard.events)


def test_the_watcher_ends_with_its_guard(tmp_path: Path) -> None:
    with (
        Victim("idle 10 4", tmp_path, preexec=seccomp.refusing("userfaultfd")) as victim,
        GuardProcess(config(0.05, images=Images.DIRTY), [victim.pid]) as guard,
    ):
        copied_since(guard, 0)
        [watcher] = [os.pidfd_open(pid) for pid in watchers_of(guard)]
        guard.kill()
        assert select.select([watcher], [], [], 5.0)[0] == [watcher]
        os.close(watcher)
        victim.wait_beats(5)


def test_nothing_is_left_of_guards_that_die_as_they_begin_to_watch(tmp_path: Path) -> None:
    """For a moment the task that opens the userfaultfd has no tracer."""
    rng, watchers = random.Random(7), 0
    with (
        Victim("idle 10 4", tmp_path, preexec=seccomp.refusing("userfaultfd")) as victim,
        GuardProcess(config(0.02, images=Images.DIRTY), [victim.pid]) as guard,
    ):
        copied_since(guard, 0)
        for _ in range(20):
            guard.start_another(victim.pid)
            time.sleep(rng.uniform(0.02, 0.25))
            watchers += len(watchers_of(guard))
            guard.kill_guards()
            victim.wait_beats(3)
        assert watchers
        wait_until(lambda: not victim.others(), 10, "the tasks that waited for a watcher have ended")
        assert " uw " not in Path(f"/proc/{victim.app}/smaps").read_text()
        victim.check()
