# SPDX-License-Identifier: Apache-2.0
"""Processes with descriptors inherited from their parent."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config, kill_at_random
from testkit.harness import SLOWNESS, wait_until
from testkit.scenario import disturb, restored


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("size", ["3/20", "44/400"])
def test_what_children_have_from_their_parents(size: str, tmp_path: Path) -> None:
    """The same open files under the same numbers, except for their own; more than a guard may have open."""
    with (
        Victim(f"heirs {size} {tmp_path}", tmp_path) as victim,
        GuardProcess(config(freeze_deadline_s=1.0 * SLOWNESS), [victim.pid]) as guard,
    ):
        for _ in range(2):
            guard.wait("attached")
            # New threads of so many processes may be slow to come home from their parasites.
            wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 60 * SLOWNESS, "a checkpoint")
            for _kill in range(2):
                disturb(victim)
                event = restored(victim, guard)
                assert "error" not in event, event


@pytest.mark.parametrize("kind", ["kept", "twins", "saved", "for-good"])
def test_others_in_their_places(kind: str, tmp_path: Path) -> None:
    """A child replaces a file and the parent puts it back, also between the stages of a checkpoint."""
    with Victim(f"redirect {kind}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 12, (0.01, 0.12))
