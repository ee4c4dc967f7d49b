# SPDX-License-Identifier: Apache-2.0
"""When the host is short of memory, the container whose generations hold most loses its oldest one: only then."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import pytest

from testkit.board import Board
from testkit.harness import ROOT, SIDECAR_NAME, ContainerFactory, Sidecar, take_checkpoint, wait_until
from testkit.host_pressure import SHORT, pressure, stalled_s
from testkit.local_sidecar import ON_COMMAND, local_sidecar
from testkit.procfs import below
from testkit.protected import start_hoard, write_hoard

VICTIMS = ROOT / "tests/victims/build"
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.alone("the host becomes short of memory, and every sidecar on it gives generations up"),
    pytest.mark.shared_machine("how short of memory the host is depends on what else runs there"),
]


def test_the_one_that_holds_most_gives_its_oldest_up(tmp_path: Path) -> None:
    subprocess.run(["make", "-s", "-C", str(ROOT / "tests/victims")], check=True)
    with local_sidecar(tmp_path) as sidecar:
        sidecar.command = SHORT
        sidecar.start()
        little = sidecar.protected("little", [str(VICTIMS / "idle"), "1", "1"], ON_COMMAND)
        take_checkpoint(sidecar.client, "little")
        board = Board(tmp_path / "board")
        much = sidecar.protected("much", [str(VICTIMS / "hoard"), "40", "--board", str(board.path)], ON_COMMAND)
        wait_until(lambda: board.see().ready, 10, "it is ready")
        oldest = take_checkpoint(sidecar.client, "much")
        app = much.app_pid
        os.kill(app, signal.SIGUSR1)
        with pressure():
            wait_until(lambda: sidecar.row(much)["dropped"], 30, "a generation is given up")
        assert "the host is short of memory: much gives up a generation" in sidecar.log
        assert f"much: generation {oldest} is given up: memory is short" in sidecar.log
        assert sidecar.row(little)["dropped"] == 0  # which would free nothing
        back = sidecar.wait_for(much, generations=1, timeout_s=60)
        assert (back["state"], back["restores"]) == ("protected", 0)
        assert much.app_pid == app


def test_a_container_at_its_own_limit_costs_others_nothing(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """The kernel says "pressure" of the whole host then, but nobody is short of what others hold."""
    victim = start_hoard(sidecar, container, tmp_path, 60, 0)
    for _ in range(2):
        victim.checkpoint()
        write_hoard(victim, signal.SIGUSR1, 60)
    init = sidecar.podman.inspect(SIDECAR_NAME)["State"]["Pid"]
    opened = [os.path.realpath(fd) for pid in below(init) for fd in Path(f"/proc/{pid}/fd").iterdir()]
    assert "/proc/pressure/memory" in opened, "the sidecar hears of it"
    with pressure():
        before = stalled_s()
        wait_until(lambda: stalled_s() > before + 4, 60, "tasks have waited for memory")
    entry = sidecar.find(victim.container)
    assert entry is not None
    assert (entry["dropped"], entry["generations"]) == (0, 2)
    victim.kill(signal.SIGKILL)
