# SPDX-License-Identifier: Apache-2.0
"""An application that writes into avckpt's memory in it: that harms nobody else."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import wait_until

SCRIBBLED_S = 3.0


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def test_what_the_application_writes_is_not_believed(tmp_path: Path) -> None:
    """The count of calls is in memory that it has, too; a guard that believes it writes behind the parasite."""
    with (
        Victim("scribble", tmp_path) as hostile,
        Victim("idle 1 1", tmp_path) as peaceful,
        GuardProcess(config(0.02), [hostile.pid, peaceful.pid]) as guard,
    ):
        guard.wait("checkpoint", cookie=2)
        wait_until(lambda: hostile.see().counter[0], 15, "the application has found the parasite")
        time.sleep(SCRIBBLED_S)
        assert guard.process.poll() is None
        guard.wait("checkpoint", cookie=2, since=guard.mark(), count=3)
        peaceful.wait_beats(3)
