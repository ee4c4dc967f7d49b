# SPDX-License-Identifier: Apache-2.0
"""An application that leaks until the kernel kills it comes back; and nobody is killed for our copies of him."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.cgroups import MemoryGroup
from testkit.guarded import GuardProcess, Victim, config

LIMIT_BYTES = 256 << 20
BASE_MB = 40
TRIALS = int(os.environ.get("AVCKPT_OOM_TRIALS", "1"))


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.fixture
def group() -> Iterator[MemoryGroup]:
    """256 MB for all that is started in it."""
    with MemoryGroup(LIMIT_BYTES) as made:
        yield made


@pytest.mark.parametrize("trial", range(TRIALS))
@pytest.mark.parametrize("rate", [10, 50, 200])
def test_a_leak_is_restored(rate: int, trial: int, group: MemoryGroup, tmp_path: Path) -> None:
    with (
        Victim(f"leak {rate} {BASE_MB}", tmp_path, preexec=group.enter) as victim,
        GuardProcess(config(0.5, memory_limit_bytes=LIMIT_BYTES), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        os.kill(victim.app, signal.SIGUSR1)
        died = guard.wait("died", timeout_s=60)
        assert died["wait_status"] == signal.SIGKILL
        assert guard.wait("restored", timeout_s=20)["reason"] == "signal"
        victim.wait_beats(5)
