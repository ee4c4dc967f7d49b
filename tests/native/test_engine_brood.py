# SPDX-License-Identifier: Apache-2.0
"""Children of every kind, created at any moment of a checkpoint: none is left stopped, or killed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until
from testkit.init_peer import Init

pytestmark = pytest.mark.shared_machine(
    "children are made and checkpoints taken at random moments, and late ones are missed"
)

CHILDREN = 6000
STRESS = ("stress-ng", "--clone", "1", "--clone-ops", "30", "--verify")
WHEN_TOLD = ("sh", "-c", 'read line; exec "$@"', "sh")


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", ["", "--in-child"])
@pytest.mark.parametrize("late_us", [0, 300])
def test_children_of_every_kind_end(tmp_path: Path, late_us: int, where: str) -> None:
    """Most of these kinds cannot be protected, and every checkpoint tries again."""
    with (
        Victim(f"brood --late-us {late_us} {where}".strip(), tmp_path) as victim,
        GuardProcess(config(0.001), [victim.pid]) as guard,
    ):
        guard.wait("attached")
        wait_until(
            lambda: victim.see().counter[0] >= CHILDREN or victim.see().violations,
            PATIENCE_S,
            "children",
        )
        victim.check()
        assert guard.process.poll() is None


@pytest.mark.skipif(not shutil.which(STRESS[0]), reason="it makes the children; it is not installed")
def test_stress_ng_ends_well(tmp_path: Path) -> None:
    """clone(2) with random flags; bench/clones.py measures how long it takes."""
    said = tmp_path / "said"
    with (
        said.open("wb") as output,
        Init(
            [*WHEN_TOLD, *STRESS, "--temp-path", tmp_path],
            pid1=True,
            stdin=subprocess.PIPE,
            stdout=output.fileno(),
            stderr=subprocess.STDOUT,
        ) as init,
        GuardProcess(config(0.05), [init.pid]) as guard,
    ):
        guard.wait("attached")
        init.popen.communicate(b"\n", timeout=PATIENCE_S)
        assert init.popen.returncode == 0, said.read_text()
        assert guard.process.poll() is None
