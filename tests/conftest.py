# SPDX-License-Identifier: Apache-2.0
"""Fixtures for tests on real containers, and diagnostics when one fails."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import signal
import subprocess
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from testkit import devices, harness
from testkit.harness import CommandFailed, ContainerFactory, Podman, Sidecar

if TYPE_CHECKING:
    from testkit.local_sidecar import LocalSidecar

CONTAINERS = pytest.StashKey[ContainerFactory]()


def pytest_configure(config: pytest.Config) -> None:
    """Signals as a login shell would leave them.

    make starts programs with posix_spawn(3), whose child, in glibc, ignores the
    two signals that libc keeps for itself (32 and 33), and what is ignored stays
    so over execve(2): every program under test would inherit it from `make test`.
    A shell ignores SIGINT and SIGQUIT in what it starts with `&`.
    """
    config.addinivalue_line(
        "markers", "machine: takes hooks and sidecar of this machine; added to who takes the fixture"
    )
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGQUIT) == signal.SIG_IGN:
        signal.signal(signal.SIGQUIT, signal.SIG_DFL)
    for number in (32, 33):
        reset_if_ignored(number)


def reset_if_ignored(number: int) -> None:
    """SIG_IGN becomes SIG_DFL.  By the system call itself: libc's sigaction() refuses these two."""
    libc = ctypes.CDLL(None, use_errno=True)
    rt_sigaction = {"x86_64": 13, "aarch64": 134}[platform.machine()]
    # struct kernel_sigaction: handler, flags, (restorer,) mask; all zero is SIG_DFL.
    now = (ctypes.c_ulong * 4)()
    default = (ctypes.c_ulong * 4)()
    if libc.syscall(rt_sigaction, number, None, now, 8) != 0:
        raise OSError(ctypes.get_errno(), "rt_sigaction")
    if now[0] == signal.SIG_IGN and libc.syscall(rt_sigaction, number, default, None, 8) != 0:
        raise OSError(ctypes.get_errno(), "rt_sigaction")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whatever takes these fixtures is marked so; a mark that asks for a favour says why.  Raises UsageError."""
    for item in items:
        for name in ("shared_machine", "alone"):
            mark = item.get_closest_marker(name)
            if mark is not None and not (len(mark.args) == 1 and str(mark.args[0]).strip()):
                raise pytest.UsageError(f'{item.nodeid}: write @pytest.mark.{name}("why")')
        for name in ("podman", "machine"):
            if name in getattr(item, "fixturenames", ()):
                item.add_marker(name)


def pytest_report_collectionfinish(items: list[pytest.Item]) -> str:
    """How many tests may be retried: a number that should not grow."""
    marked = sum(item.get_closest_marker("shared_machine") is not None for item in items)
    return f"marked shared_machine (may be retried): {marked}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Adds logs to the report of a failed test, while its containers are still there."""
    report = yield
    if report.failed:
        for title, text in evidence(item):
            report.sections.append((title, text))
    return report


def evidence(item: pytest.Item) -> Iterator[tuple[str, str]]:
    """What a person wants to see of a test that failed: its containers' logs, `avckpt ps`, the sidecar's log."""
    funcargs: dict[str, object] = getattr(item, "funcargs", {})
    factory = item.stash.get(CONTAINERS, None)
    for made in factory.made if factory is not None else []:
        yield f"podman logs {made.name}", attempt(made.logs)
    sidecar = funcargs.get("sidecar")
    if isinstance(sidecar, Sidecar):
        yield "avckpt ps --json", attempt(lambda: sidecar.avckpt("ps", "--json").stdout)
        yield "podman logs avckpt-sidecar", attempt(sidecar.logs)


def attempt(look: Callable[[], str]) -> str:
    """Evidence is best effort: a failure to get it must not hide the test's own."""
    try:
        return look()[-8000:]
    except (CommandFailed, subprocess.TimeoutExpired, OSError) as error:
        return f"(could not be had: {error})"


@pytest.fixture
def local(tmp_path: Path) -> Iterator[LocalSidecar]:
    """A sidecar without Podman, which runs."""
    # What it imports takes seconds where the native tests run alone, in an emulated machine.
    from testkit.local_sidecar import local_sidecar

    with local_sidecar(tmp_path) as sidecar:
        sidecar.start()
        yield sidecar


@pytest.fixture(scope="session")
def podman() -> Podman:
    """Root's Podman, which can start containers (`make setup` sees to that)."""
    if shutil.which("podman") is None:
        pytest.skip("no Podman on this machine: run `make setup`")
    if os.geteuid() != 0:
        pytest.skip("not root: avckpt protects containers of root's Podman")
    return Podman()


@pytest.fixture(scope="session")
def base_image(podman: Podman) -> str:
    """Name of the base image: Debian with python3 and redis-server."""
    if podman.run("image", "exists", harness.BASE_IMAGE, check=False).status != 0:
        pytest.fail(f"no image {harness.BASE_IMAGE}: run `make setup`")
    return harness.BASE_IMAGE


@pytest.fixture
def container(request: pytest.FixtureRequest, podman: Podman, base_image: str) -> Iterator[ContainerFactory]:
    """Makes containers: `container("sleep", "60")`, `container.protected(...)`.  All are removed after the test."""
    factory = ContainerFactory(podman, f"avckpt-test-{os.getpid()}-{abs(hash(request.node.nodeid)) % 10**8:08d}")
    request.node.stash[CONTAINERS] = factory
    yield factory
    factory.close()


@pytest.fixture(scope="session")
def machine(podman: Podman) -> Iterator[None]:
    """This machine's hooks and sidecar are ours for the session."""
    with harness.machine_lock(timeout_s=100):
        yield


@pytest.fixture(scope="session")
def session_sidecar(machine: None, podman: Podman, base_image: str) -> Iterator[Sidecar]:
    """Started once; take the fixture `sidecar`."""
    if podman.run("image", "exists", harness.SIDECAR_IMAGE, check=False).status != 0:
        pytest.fail(f"no image {harness.SIDECAR_IMAGE}: run `make setup`")
    with harness.running_sidecar(podman) as sidecar:
        yield sidecar


@pytest.fixture
def sidecar(session_sidecar: Sidecar) -> Sidecar:
    """The sidecar container runs and the hooks are installed.  A test may kill it: the next test gets a new one."""
    if not session_sidecar.running:
        session_sidecar.restart()
    return session_sidecar


@pytest.fixture
def free_port() -> Callable[[], int]:
    """Gives a free TCP port at each call."""
    return harness.free_port


@pytest.fixture
def bus() -> Iterator[None]:
    """A CAN interface."""
    with devices.can_bus():
        yield


@pytest.fixture
def camera() -> Iterator[None]:
    """/dev/video0."""
    with devices.video_camera():
        yield
