# SPDX-License-Identifier: Apache-2.0
"""The guard's own seccomp filter: what it forbids, and that it stands in no application's way."""

from __future__ import annotations

import contextlib
import errno
import platform
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit import seccomp
from testkit.guarded import GuardProcess, Victim, config, kill_at_random
from testkit.harness import ROOT, wait_until
from testkit.procfs import status_of

CPU = platform.machine()
LAYERS = ("base", f"base/{CPU}", "trace", "state", "files", "process", "checkpoint", "restore", "guard")


@pytest.fixture(scope="module")
def filtered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tests/native/filtered.c."""
    program = tmp_path_factory.mktemp("filtered") / "filtered"
    native = ROOT / "native"
    includes = [native / "include", native / "build", native / "parasite", native / "parasite" / CPU]
    includes += [native / "lastpid", *(native / "engine" / layer for layer in LAYERS)]
    flags = ["-std=gnu11", "-D_GNU_SOURCE", "-pthread", *(f"-I{folder}" for folder in includes)]
    source = Path(__file__).with_name("filtered.c")
    subprocess.run(["cc", *flags, source, native / "build/libavckpt.a", "-o", program], check=True, timeout=120)
    return program


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


@pytest.mark.parametrize("images", [Images.FORK, Images.DIRTY])
def test_a_container_that_may_not_have_its_memory_watched(images: Images, tmp_path: Path) -> None:
    """As in Podman's default profile: userfaultfd(2) is refused. Only where it is to be used does the guard have to
    suspend the filter."""
    install = seccomp.refusing("userfaultfd")
    with (
        Victim("idle 10 4", tmp_path, preexec=install) as victim,
        GuardProcess(config(0.05, images=images), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        assert filters_of(guard) == (FILTERED if images is Images.FORK else PLAIN)
        if images is Images.DIRTY:
            wait_until(lambda: any(event.get("images") == "dirty" for event in guard.events), 15, "a copy")
        kill_at_random(guard, victim, 3, (0.02, 0.2))
