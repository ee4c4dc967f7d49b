# SPDX-License-Identifier: Apache-2.0
"""Files that look like others, or answer to being opened: a guard opens only what it means, and harmlessly."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.guard import Files

from testkit.guarded import GuardProcess, Victim, config
from testkit.scenario import checkpoint, restored


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder for the board; on a disk its writable mapping would count as data."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as path:
        yield Path(path)


def test_a_mount_is_not_sought_outside_of_the_container(tmp_path: Path, memory: Path) -> None:
    """A link by the name of a mount point leads to the host: what is written there is none of its business."""
    with (
        Victim(f"baits covered {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        (tmp_path / "of the host").write_text("written")
        assert "error" not in restored(victim, guard, looks=False)
        (Path(f"/proc/{victim.app}/root{tmp_path}") / "of the container").write_text("written")
        victim.kill_app()
        assert "was written since the checkpoint" in str(guard.wait("gave_up")["error"])
