# SPDX-License-Identifier: Apache-2.0
"""A limit that a container is given while it runs: a real daemon and a real control group, without Podman."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.board import Board
from testkit.harness import ROOT, take_checkpoint, wait_until
from testkit.host_pressure import make_group, remove_group
from testkit.local_sidecar import ON_COMMAND, LocalSidecar, local_sidecar
from testkit.procfs import children_of, comm_of

VICTIMS = ROOT / "tests/victims/build"
HOARD = VICTIMS / "hoard"
MB = 1 << 20
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine("the guard is given a time to see a new limit"),
]


@pytest.fixture
def group() -> Iterator[Path]:
    """A memory cgroup without a limit; its processes have ended by the end of the test."""
    made = make_group()
    yield made
    remove_group(made)


@pytest.fixture
def local(group: Path, tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as sidecar:
        sidecar.start()
        yield sidecar


def templates_of(init: int) -> list[int]:
    return [pid for pid in children_of(init) if comm_of(pid) == "avckpt-tmpl"]


@pytest.mark.parametrize("images", ["fork", "auto"])
def test_a_limit_that_comes_later_holds(local: LocalSidecar, group: Path, tmp_path: Path, images: str) -> None:
    subprocess.run(["make", "-s", "-C", str(ROOT / "tests/victims")], check=True)
    first = (group / "memory.limit_in_bytes").exists()
    limit, used = [
        group / name
        for name in (["memory.limit_in_bytes", "memory.usage_in_bytes"] if first else ["memory.max", "memory.current"])
    ]
    (group / ("memory.limit_in_bytes" if first else "memory.high")).write_text("-1" if first else "max")
    board = Board(tmp_path / "board")
    web = local.container("web", [str(HOARD), "40", "--board", str(board.path)])
    wait_until(lambda: board.see().ready, 10, "it is ready")
    for pid in (web.init_pid, web.app_pid):
        (group / "cgroup.procs").write_text(str(pid))
    assert web.hook("prestart", {**ON_COMMAND, "avckpt.images": images}) == ""
    local.wait_for(web, app_pid_inside=2)
    taken = []
    for n in (1, 2):
        taken.append(take_checkpoint(local.client, "web"))
        os.kill(web.app_pid, signal.SIGUSR1)
        wait_until(lambda n=n: board.see().counter[0] >= 40 * n, 20, "it has written all of it again")  # type: ignore[misc]
    assert local.row(web)["generations"] == 2
    limit.write_text(str(int(int(used.read_text()) * 1.05)))
    wait_until(lambda: local.row(web)["dropped"], 10, "a generation is given up")
    assert local.row(web)["last_dropped"] == f"generation {taken[0]}: memory is short"
    # The other one is left to the kernel, which knows where there is room and where not.
    wait_until(lambda: len(templates_of(web.init_pid)) == 1, 10, "its template has ended")
    (newest,) = templates_of(web.init_pid)
    wait_until(lambda: 300 < int(Path(f"/proc/{newest}/oom_score_adj").read_text()) < 1000, 5, "its guard knows of it")
    assert local.row(web)["generations"] == 1
    limit.write_text("-1" if first else "max")


@pytest.mark.skipif(os.environ.get("AVCKPT_LONG") != "1", reason="the sidecar's look once a second can be too late")
@pytest.mark.parametrize("rate", [50, 200])
def test_who_shares_memory_with_others_keeps_its_newest_generation(
    local: LocalSidecar, group: Path, tmp_path: Path, rate: int
) -> None:
    """A parent cgroup, or the host, is full before the container is: templates must not be the first victims."""
    subprocess.run(["make", "-s", "-C", str(VICTIMS.parent)], check=True)
    knob = "memory.limit_in_bytes" if (group / "memory.limit_in_bytes").exists() else "memory.max"
    if knob == "memory.max":
        (group / "memory.high").write_text("max")
        (group / "cgroup.subtree_control").write_text("+memory")
    (group / knob).write_text(str(300 * MB))
    inner = [group / name for name in ("container", "neighbour")]
    with Board(tmp_path / "neighbour") as others, Board(tmp_path / "board") as board:
        for each in inner:
            each.mkdir()
        (inner[0] / knob).write_text(str(256 * MB))

        def enter() -> None:
            (inner[1] / "cgroup.procs").write_text(str(os.getpid()))

        neighbour = subprocess.Popen([str(HOARD), "90", "--board", str(others.path)], preexec_fn=enter)
        leak = f"echo 0 > {inner[0]}/cgroup.procs && exec {VICTIMS}/leak {rate} 40 --board {board.path}"
        web = local.container("web", ["sh", "-c", leak])
        try:
            wait_until(lambda: board.see().ready and others.see().ready, 10, "both are ready")
            (inner[0] / "cgroup.procs").write_text(str(web.init_pid))
            assert web.hook("prestart", {"avckpt.enable": "true", "avckpt.interval": "500ms"}) == ""
            local.wait_for(web, app_pid_inside=2, generations=2)
            os.kill(web.app_pid, signal.SIGUSR1)
            wait_until(lambda: local.row(web, ended=True).get("restores", 0), 30, "it is restored")
            beats = board.see().beats
            wait_until(lambda: board.see().beats > beats, 10, "it goes on")
            assert neighbour.poll() is None
        finally:
            neighbour.kill()
            neighbour.wait()
            web.close()
            local.containers.remove(web)
            for each in inner:
                remove_group(each)
