# SPDX-License-Identifier: Apache-2.0
"""Whose death at the hands of the OOM killer takes an application as a whole along."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.containers.cgroup import Groups
from avckpt.containers.process import has_ended
from avckpt.containers.protected import Protected
from avckpt.policy import settings_of
from avckpt.supervision.oom_group import NOTE, OomGroup, oom_group_of

from testkit.harness import wait_until

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="trusted attributes are root's")


@pytest.fixture
def app() -> Iterator[int]:
    """A pidfd."""
    with subprocess.Popen(["sleep", "infinity"]) as process:
        pidfd = os.pidfd_open(process.pid)
        yield pidfd
        os.close(pidfd)
        process.kill()


def write(folder: Path, group: str, kills: int) -> None:
    (folder / "memory.oom.group").write_text(group)
    (folder / "memory.events").write_text(f"low 0\noom 7\noom_kill {kills}\noom_group_kill 0\n")


def begin(folder: Path, pidfd: int) -> tuple[OomGroup, Protected]:
    container = Protected("c" * 64, "c", 1, os.getpid(), settings_of({}).config, 0.0, app_pid=os.getpid())
    write(folder, "1", 3)
    group = oom_group_of(Groups((), folder, ()), container, pidfd)
    assert group is not None
    return group, container


def test_one_that_nobody_explains_takes_all(tmp_path: Path, app: int) -> None:
    group, container = begin(tmp_path, app)
    assert (tmp_path / "memory.oom.group").read_text() == "0"
    group.look(container, app)
    write(tmp_path, "0", 4)
    group.look(container, app)
    assert not has_ended(app)
    group.look(container, app)
    wait_until(lambda: has_ended(app), 10, "it is killed")


@pytest.mark.parametrize("told", ["last_death_ns", "dropped"])
def test_a_death_that_the_guard_tells_does_not(tmp_path: Path, app: int, told: str) -> None:
    group, container = begin(tmp_path, app)
    write(tmp_path, "0", 4)
    group.look(container, app)
    setattr(container, told, 1)
    for _ in range(3):
        group.look(container, app)
    assert not has_ended(app)


def test_it_is_given_back_and_taken_from_one_that_died(tmp_path: Path, app: int) -> None:
    _, container = begin(tmp_path, app)
    later = oom_group_of(Groups((), tmp_path, ()), container, app)
    assert later is not None
    later.give_back()
    assert (tmp_path / "memory.oom.group").read_text() == "1"
    assert NOTE not in os.listxattr(tmp_path)
    write(tmp_path, "0", 3)
    assert oom_group_of(Groups((), tmp_path, ()), container, app) is None
