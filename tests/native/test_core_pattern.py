# SPDX-License-Identifier: Apache-2.0
"""The kernel writes its own core of a dying application into a pipe: nothing of it is lost."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until

PATTERN = Path("/proc/sys/kernel/core_pattern")
COLLECTOR = """#!/bin/sh
[ "$1" = crash ] || exec cat > /dev/null
touch {0}/begun
until [ -e {0}/go ]; do sleep 0.01; done
wc -c > {0}/.size
mv {0}/.size {0}/size
"""
MISSED = 5
"""So many checkpoints are due while it is being written."""

pytestmark = [
    pytest.mark.alone("the kernel gives all cores of this machine to the test's collector"),
    pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long"),
]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.fixture
def collector(tmp_path: Path) -> Iterator[Path]:
    """The folder of a collector that begins to read when `go` is there."""
    program = tmp_path / "collector"
    program.write_text(COLLECTOR.format(tmp_path))
    program.chmod(0o755)
    before = PATTERN.read_text()
    PATTERN.write_text(f"|{program} %e")
    try:
        yield tmp_path
    finally:
        (tmp_path / "go").touch()
        PATTERN.write_text(before)


PIPE_BYTES = 65536
"""A pipe holds so much of a core, whatever becomes of the rest."""


def size_of_core(victim: Victim, folder: Path, wait_s: float) -> int:
    """Kills it; how much the collector got, of which it reads the most after that time."""
    victim.kill_app(signal.SIGSEGV)
    wait_until((folder / "begun").exists, PATIENCE_S, "the core is begun")
    time.sleep(wait_s)
    (folder / "go").touch()
    wait_until((folder / "size").exists, PATIENCE_S, "the core is whole")
    return int((folder / "size").read_text())


def test_checkpoints_leave_it_whole(tmp_path: Path, collector: Path) -> None:
    interval_s = 0.05
    with Victim("crash", tmp_path) as victim, GuardProcess(config(interval_s), [victim.pid]) as guard:
        guard.wait("checkpoint", count=2)
        assert size_of_core(victim, collector, MISSED * interval_s) > PIPE_BYTES
        assert guard.wait("restored")["wait_status"] & 0x7F == signal.SIGSEGV
        victim.wait_beats(3)


def test_the_first_checkpoint_leaves_it_whole(tmp_path: Path, collector: Path) -> None:
    interval_s = 0.3
    with Victim("crash", tmp_path) as victim, GuardProcess(config(interval_s), [victim.pid]) as guard:
        guard.wait("attached")
        assert size_of_core(victim, collector, MISSED * interval_s) > PIPE_BYTES


def test_a_child_writes_it_without_the_priority_of_its_guard(tmp_path: Path, collector: Path) -> None:
    """Real-time tasks that copy gigabytes would leave no CPU to anybody else."""
    with Victim("crash --in-child", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        child = victim.player
        os.kill(child, signal.SIGSEGV)
        wait_until((collector / "begun").exists, PATIENCE_S, "the core is begun")
        for _ in range(3):
            assert guard.command("checkpoint")["kind"] == "missed"
            assert os.sched_getscheduler(child) == os.SCHED_OTHER
