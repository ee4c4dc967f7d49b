# SPDX-License-Identifier: Apache-2.0
"""An application that reads its own /proc, and all its state in the kernel, notices no checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit.guarded import WHERE, GuardProcess, Victim, config

pytestmark = pytest.mark.shared_machine("a thousand checkpoints have to be taken in time")


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize(
    ("command", "images", "checkpoints"),
    [("mirror", Images.FORK, 1000), ("mirror --in-child", Images.FORK, 200), ("mirror", Images.DIRTY, 200)],
)
def test_it_sees_itself_as_it_was(command: str, images: Images, checkpoints: int, tmp_path: Path) -> None:
    """Mappings, VmFlags, masks, timers, descriptors, limits, options: everything a process can read of itself."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(images=images), [victim.pid]) as guard:
        said = guard.burst(checkpoints)
        assert said["taken"] > 0, said["reasons"]
        victim.wait_beats(3)
        guard.stop()
        # And when it is protected no more.
        victim.wait_beats(3)


@pytest.mark.parametrize("where", WHERE)
def test_nor_does_it_notice_who_looks_for_what_dead_guards_have_left(where: str, tmp_path: Path) -> None:
    """Its stacks are searched for that: memory above them that was never touched is not read, which would show."""
    with Victim(f"mirror {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(3):
            for _ in range(3):
                assert guard.checkpoint()["kind"] == "checkpoint"
            victim.wait_beats(3)
            guard.start_another(victim.pid)
