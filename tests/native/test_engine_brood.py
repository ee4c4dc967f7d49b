# SPDX-License-Identifier: Apache-2.0
"""Children of every kind, made at any moment of a checkpoint: nobody is left stopped, or killed."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until

pytestmark = pytest.mark.shared_machine(
    "children are made and checkpoints taken at random moments, and late ones are missed"
)

CHILDREN = 6000


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", ["", "--in-child"])
@pytest.mark.parametrize("late_us", [0, 300])
def test_children_of_every_kind_end(tmp_path: Path, late_us: int, where: str) -> None:
    """Most of these kinds cannot be protected, which is tried all the same, again and again."""
    with (
        Victim(f"brood --late-us {late_us} {where}".strip(), tmp_path) as victim,
        GuardProcess(config(0.001), [victim.pid]) as guard,
    ):
        guard.wait("attached")
        wait_until(
            lambda: victim.see().counter[0] >= CHILDREN or victim.see().violations,
            4 * PATIENCE_S,
            "children",
        )
        victim.check()
        assert guard.process.poll() is None
