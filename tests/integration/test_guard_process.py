# SPDX-License-Identifier: Apache-2.0
"""The guards of a sidecar are processes: one that dies or hangs costs one container its protection for a moment."""

from __future__ import annotations

import os
import resource
import signal
from pathlib import Path
from typing import Any

import pytest

from testkit.guarded import BUILD
from testkit.harness import wait_until
from testkit.local_sidecar import Container, LocalSidecar
from testkit.procfs import status_of

pytestmark = pytest.mark.shared_machine("a guard that gets no CPU for long is taken for one that hangs")

SLEEPER = ["sleep", "infinity"]

CAP_SYS_MODULE, CAP_SYS_PTRACE, CAP_SYS_RAWIO, CAP_SYS_BOOT, CAP_SYS_TIME, CAP_MKNOD = 16, 19, 17, 22, 25, 27


def guard_of(local: LocalSidecar, container: Container) -> int:
    pid: int = local.wait_for(container, state="protected")["guard_pid"]
    assert Path(f"/proc/{pid}/comm").read_text().strip() == "avckpt-guard"
    return pid


def another_guard(local: LocalSidecar, container: Container, guard: int, timeout_s: float) -> dict[str, Any]:
    """The container's row once a new guard protects it."""
    row: dict[str, Any] = {}

    def replaced() -> bool:
        nonlocal row
        row = local.row(container)
        return row["guard_pid"] not in (0, guard) and row["state"] == "protected"

    wait_until(replaced, timeout_s, "another guard protects it", every_s=0.05)
    return row


def crash(local: LocalSidecar, container: Container, restores: int) -> None:
    """Kills the application and waits until it is restored."""
    os.kill(container.app_pid, signal.SIGKILL)
    local.wait_for(container, restores=restores, state="protected")


def test_one_that_dies_is_replaced_and_nobody_else_notices(local: LocalSidecar) -> None:
    web, cache = local.protected("web", SLEEPER), local.protected("cache", SLEEPER)
    guard, others = guard_of(local, web), guard_of(local, cache)
    app = web.app_pid
    crash(local, cache, 1)
    os.kill(guard, signal.SIGKILL)
    row = another_guard(local, web, guard, 10)
    assert web.app_pid == app
    assert "web: runs unprotected: its guard was killed by signal 9" in local.log
    row = local.wait_for(cache, state="protected")
    assert (row["guard_pid"], row["restores"]) == (others, 1)
    crash(local, web, 1)
    crash(local, cache, 2)


def test_one_that_hangs_is_killed_and_replaced(local: LocalSidecar) -> None:
    web, cache = local.protected("web", SLEEPER), local.protected("cache", SLEEPER)
    guard, others = guard_of(local, web), guard_of(local, cache)
    app = web.app_pid
    os.kill(guard, signal.SIGSTOP)
    another_guard(local, web, guard, 30)
    assert web.app_pid == app
    assert "web: runs unprotected: its guard gave no sign of life and was killed" in local.log
    assert local.row(cache)["guard_pid"] == others
    crash(local, web, 1)
    crash(local, cache, 1)


def test_one_that_dies_again_and_again_is_not_started_in_a_loop(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    guard = guard_of(local, web)
    os.kill(guard, signal.SIGKILL)
    second = another_guard(local, web, guard, 10)["guard_pid"]
    os.kill(second, signal.SIGKILL)
    row = local.wait_for(web, guard_pid=0)
    assert "its guard was killed by signal 9" in row["reason"]
    another_guard(local, web, second, 15)
    crash(local, web, 1)


def test_a_command_that_its_guard_cannot_answer_any_more_is_answered(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    guard = guard_of(local, web)
    os.kill(guard, signal.SIGSTOP)
    said = local.avckpt("checkpoint", "web", check=False)
    assert said.status != 0
    assert "its guard died before it could be done" in said.stderr


def test_what_it_may_do(local: LocalSidecar) -> None:
    guard = guard_of(local, local.protected("web", SLEEPER))
    status = dict(line.split(":\t", 1) for line in Path(f"/proc/{guard}/status").read_text().splitlines())
    for kind in ("CapPrm", "CapEff", "CapBnd"):
        caps = int(status[kind], 16)
        assert caps >> CAP_SYS_PTRACE & 1, kind
        for cap in (CAP_SYS_MODULE, CAP_SYS_RAWIO, CAP_SYS_BOOT, CAP_SYS_TIME, CAP_MKNOD):
            assert not caps >> cap & 1, (kind, cap)
    assert int(status["CapInh"], 16) == int(status["CapAmb"], 16) == 0
    assert status["NoNewPrivs"] == "1"
    assert (status["Seccomp"], status["Seccomp_filters"]) == ("2", "1")
    hard = resource.prlimit(guard, resource.RLIMIT_NOFILE)[1]
    assert hard <= 32768
    assert resource.prlimit(guard, resource.RLIMIT_DATA)[0] == 1 << 30
    assert resource.prlimit(guard, resource.RLIMIT_CORE) == (0, 0)
    # Of the sidecar's descriptors it has its own socket and what is written to standard error.
    assert not {name for fd in os.listdir(f"/proc/{guard}/fd") if "api.sock" in (name := read_link(guard, fd))}


def test_one_whose_filter_is_in_the_way_is_replaced(local: LocalSidecar) -> None:
    """The application installs a seccomp filter that has to be suspended; its neighbour keeps its guard."""
    web, cache = local.protected("web", [str(BUILD / "sandbox"), "--late"]), local.protected("cache", SLEEPER)
    guard, others = guard_of(local, web), guard_of(local, cache)
    app = web.app_pid
    os.kill(app, signal.SIGUSR1)
    another = another_guard(local, web, guard, 10)["guard_pid"]
    assert status_of(another)["Seccomp"] == "0"
    assert local.log.count("web: gets a guard without a seccomp filter: it takes one to suspend") == 1
    assert "web: runs unprotected" not in local.log
    assert web.app_pid == app
    crash(local, web, 1)
    # For good: the next guard, of an application that is as before.
    os.kill(another, signal.SIGKILL)
    assert status_of(another_guard(local, web, another, 15)["guard_pid"])["Seccomp"] == "0"
    assert local.row(cache)["guard_pid"] == others
    assert status_of(others)["Seccomp"] == "2"


def read_link(pid: int, fd: str) -> str:
    try:
        return os.readlink(f"/proc/{pid}/fd/{fd}")
    except FileNotFoundError:
        return ""


def test_they_end_with_the_sidecar(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    pidfd = os.pidfd_open(guard_of(local, web))
    app = web.app_pid
    try:
        assert local.stop(signal.SIGKILL) == -signal.SIGKILL
        wait_until(lambda: ended(pidfd), 10, "its guard has ended")
    finally:
        os.close(pidfd)
    assert web.app_pid == app


def ended(pidfd: int) -> bool:
    return "Pid:\t-1" in Path(f"/proc/self/fdinfo/{pidfd}").read_text()
