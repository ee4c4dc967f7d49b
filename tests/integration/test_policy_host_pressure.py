# SPDX-License-Identifier: Apache-2.0
"""A host that is short of memory costs the container whose generations hold most its oldest one.

The kernel's trigger is real, but for CPU pressure: a machine that is short of
memory in earnest would make everybody on it suffer.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import local_sidecar as local_module
import pytest
from harness import ROOT, wait_until
from local_sidecar import ON_COMMAND, LocalSidecar, local_sidecar
from native.board import Board

VICTIMS = ROOT / "tests/victims/build"
BY_CPU = """
import sys
from pathlib import Path
import avckpt.pressure
avckpt.pressure.PSI = Path("/proc/pressure/cpu")
from avckpt.cli import main
main()
"""
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.skipif(not Path("/proc/pressure/cpu").exists(), reason="this kernel has no PSI"),
]


def test_the_one_that_holds_most_gives_its_oldest_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    subprocess.run(["make", "-s", "-C", str(ROOT / "tests/victims")], check=True)
    with local_sidecar(tmp_path) as sidecar, monkeypatch.context() as patch:
        patch.setattr(local_module, "avckpt_command", lambda: [sys.executable, "-c", BY_CPU])
        sidecar.start()
        patch.undo()
        little = sidecar.protected("little", [str(VICTIMS / "idle"), "1", "1"], ON_COMMAND)
        checkpoint(sidecar, "little")
        board = Board(tmp_path / "board")
        much = sidecar.protected("much", [str(VICTIMS / "hoard"), "40", "--board", str(board.path)], ON_COMMAND)
        wait_until(lambda: board.see().ready, 10, "it is ready")
        checkpoint(sidecar, "much")
        os.kill(much.app_pid, signal.SIGUSR1)
        # Others on this machine may have pressed already; then it is done.
        press(sidecar)
        assert "the host is short of memory: much gives up a generation" in sidecar.log
        assert "much: generation 1 is given up: memory is short" in sidecar.log
        assert sidecar.row(little)["dropped"] == 0  # which would free nothing
        back = sidecar.wait_for(much, generations=1, timeout_s=60)
        assert back["state"] == "protected"


def checkpoint(sidecar: LocalSidecar, name: str) -> None:
    """A busy machine may be too slow for the freeze deadline."""
    wait_until(lambda: sidecar.avckpt("checkpoint", name, check=False).status == 0, 20, "a checkpoint", every_s=0.2)


def press(sidecar: LocalSidecar) -> None:
    """Makes processes wait for a CPU until the sidecar has heard of it."""
    load = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1) + 1)]

    def dropped() -> bool:
        return any(row["dropped"] for row in json.loads(sidecar.avckpt("ps", "--json").stdout))

    try:
        wait_until(dropped, 30, "a generation is given up")
    finally:
        for process in load:
            process.kill()
            process.wait()
