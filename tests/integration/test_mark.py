# SPDX-License-Identifier: Apache-2.0
"""A line about each restore in the container's own log, where it does no harm (avckpt.mark)."""

from __future__ import annotations

import fcntl
import os
import re
import signal
from collections.abc import Iterator

import pytest

from testkit.harness import ContainerFactory, Podman, take_checkpoint, wait_until
from testkit.local_sidecar import QUICK, Container, LocalSidecar, hooked_podman

pytestmark = pytest.mark.shared_machine("a sidecar, its guards and containers have to get CPU time within seconds")

MARKED = {**QUICK, "avckpt.mark": "on"}
LINE = r"avckpt: .*SIGSEGV.*, restored in [\d.]+ ms from generation \d+ \([\d.]+ s old\), .*\n"
SLEEP = ["sleep", "1000"]


@pytest.fixture
def log() -> Iterator[tuple[int, int]]:
    """A pipe, as who collects a container's log has it: the end to read (at once, or not at all), and the other."""
    read, write = os.pipe()
    os.set_blocking(read, False)
    yield read, write
    for fd in (read, write):
        os.close(fd)


def said(fd: int) -> bytes:
    """What lies in a pipe."""
    try:
        return os.read(fd, 1 << 20)
    except BlockingIOError:
        return b""


def crash(local: LocalSidecar, victim: Container, times: int = 1) -> None:
    """Has it die, and waits until its sidecar knows of the restore."""
    take_checkpoint(local.client, victim.name)  # a new one: what dies again right after a restore is given up
    os.kill(victim.app_pid, signal.SIGSEGV)
    wait_until(lambda: len(local.events(victim.name, "restored")) == times, 10, "it is restored", every_s=0.05)


def test_a_restore_adds_a_line(local: LocalSidecar, log: tuple[int, int]) -> None:
    """Wherever the application sends its own output."""
    read, write = log
    victim = local.protected("victim", ["sh", "-c", "exec sleep 1000 2>/dev/null"], MARKED, stderr=write)
    for time in range(1, 4):
        crash(local, victim, time)
        line = wait_until(lambda: said(read), 5, "there is a line").decode()
        assert re.fullmatch(LINE, line)
        assert line[len("avckpt: ") : -1] == local.events("victim", "restored")[-1]["message"]


def test_without_the_label_there_is_none(local: LocalSidecar, log: tuple[int, int]) -> None:
    read, write = log
    victim = local.protected("victim", SLEEP, stderr=write)
    crash(local, victim)
    marked = local.protected("marked", SLEEP, MARKED, stderr=write)
    crash(local, marked)
    line = wait_until(lambda: said(read), 5, "there is a line of the other").decode()
    assert re.fullmatch(LINE, line)


def test_a_full_pipe_gets_no_line_and_nobody_waits(local: LocalSidecar, log: tuple[int, int]) -> None:
    read, write = log
    os.set_blocking(write, False)
    size = fcntl.fcntl(write, 1032)  # F_GETPIPE_SZ
    assert os.write(write, b"x" * size) == size
    os.set_blocking(write, True)
    victim = local.protected("victim", SLEEP, MARKED, stderr=write)
    crash(local, victim)
    take_checkpoint(local.client, "victim")
    assert said(read) == b"x" * size
    assert os.get_blocking(write)
    crash(local, victim, 2)
    assert re.fullmatch(LINE, wait_until(lambda: said(read), 5, "there is a line").decode())


def test_nobody_reads_and_what_is_no_pipe(local: LocalSidecar) -> None:
    read, write = os.pipe()
    unread = local.protected("unread", SLEEP, MARKED, stderr=write)
    os.close(read)
    os.close(write)
    filed = local.protected("filed", SLEEP, MARKED)
    for victim in (unread, filed):
        crash(local, victim)
        crash(local, victim, 2)
        assert local.row(victim)["state"] == "protected"
    assert filed.output.read_bytes() == b""


def test_podman_logs_has_it(podman: Podman, base_image: str, local: LocalSidecar) -> None:
    factory = ContainerFactory(hooked_podman(local), f"avckpt-mark-{os.getpid()}")
    try:
        made = factory.protected("sh", "-c", "echo begun; exec sleep 1000", labels=MARKED)
        wait_until(lambda: local.events(made.name, "checkpoint"), 20, "it is protected", every_s=0.1)
        os.kill(next(row["app_pid"] for row in local.ps() if row["name"] == made.name), signal.SIGSEGV)
        logs = made.wait_for_log("restored")
        assert re.fullmatch("begun\n" + LINE, logs)
    finally:
        factory.close()
