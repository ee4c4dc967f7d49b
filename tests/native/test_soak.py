# SPDX-License-Identifier: Apache-2.0
"""Nothing leaks, over half a minute of checkpoints and restores; `make soak` looks for an hour."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from pathlib import Path

import pytest

from testkit.board import Board
from testkit.census import Census, Row, growths
from testkit.guarded import BUILD
from testkit.harness import wait_until
from testkit.local_sidecar import local_sidecar

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "what has not been reaped yet looks like a leak"
)

LABELS = {"avckpt.enable": "true", "avckpt.interval": "50ms", "avckpt.restore.max": "16/1s"}
LOOKS, WARM_UP_LOOKS, KILLS_PER_LOOK = 9, 3, 2
MEMORY_ALLOWED_KB = 2048.0
"""In this short time the sidecar's history still fills, and so do the arenas of the application's allocator."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.timeout(400)
def test_nothing_is_left_of_checkpoints_and_restores(tmp_path: Path) -> None:
    """Compares memory, page tables, descriptors, threads, processes and zombies of application, init and sidecar."""
    if not (BUILD / "pool").exists():
        pytest.skip(f"no C++ compiler: {shutil.which('c++')}")
    rng = random.Random(1)
    with local_sidecar(tmp_path) as sidecar, Board(tmp_path / "board") as board:
        sidecar.run_dir.mkdir()
        sidecar.start()
        container = sidecar.protected("pool", [str(BUILD / "pool"), "4", "8", "--board", str(board.path)], LABELS)
        wait_until(lambda: board.see().ready == 1, 30, "the program is ready")
        assert sidecar.process is not None
        census = Census(container.init_pid, sidecar.process.pid)
        rows: list[Row] = []
        restores = 0
        for _ in range(LOOKS + WARM_UP_LOOKS):
            for _ in range(KILLS_PER_LOOK):
                sidecar.wait_for(container, 60, generations=2)
                time.sleep(rng.uniform(0.0, 0.2))
                os.kill(wait_until(lambda: container.app_pid, 10, "the program is there"), signal.SIGKILL)
                restores += 1
                sidecar.wait_for(container, 60, restores=restores)
            sidecar.wait_for(container, 60, generations=2)
            row = wait_until(census.take, 10, "a count of everything")
            assert row is not None
            rows.append(row)
        seen = board.see()
        assert (seen.violations, seen.starts) == (0, 1), container.output.read_text()
        leaks = [growth for growth in growths(rows[WARM_UP_LOOKS:], MEMORY_ALLOWED_KB) if growth.is_leak]
        assert leaks == []
