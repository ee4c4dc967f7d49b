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
from testkit.procfs import children_of

HOARD = ROOT / "tests/victims/build/hoard"
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine("the guard is given a time to see a new limit"),
]


def comm_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


@pytest.fixture
def group() -> Iterator[Path]:
    """Without a limit; whoever is in it has ended by the end of the test."""
    made = make_group()
    yield made
    remove_group(made)


@pytest.fixture
def local(group: Path, tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as sidecar:
        sidecar.start()
        yield sidecar


def test_a_limit_that_comes_later_holds(local: LocalSidecar, group: Path, tmp_path: Path) -> None:
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
    assert web.hook("prestart", ON_COMMAND) == ""
    local.wait_for(web, app_pid_inside=2)
    for n in (1, 2):
        take_checkpoint(local.avckpt, "web")
        os.kill(web.app_pid, signal.SIGUSR1)
        wait_until(lambda n=n: board.see().counter[0] >= 40 * n, 20, "it has written all of it again")  # type: ignore[misc]
    assert local.row(web)["generations"] == 2
    limit.write_text(str(int(int(used.read_text()) * 1.05)))
    wait_until(lambda: local.row(web)["dropped"], 10, "a generation is given up")
    assert local.row(web)["last_dropped"] == "generation 1: memory is short"
    # The other one is left to the kernel, which knows where there is room and where not.
    (newest,) = (pid for pid in children_of(web.init_pid) if comm_of(pid) == "avckpt-tmpl")
    wait_until(lambda: 300 < int(Path(f"/proc/{newest}/oom_score_adj").read_text()) < 1000, 5, "its guard knows of it")
    assert local.row(web)["generations"] == 1
    limit.write_text("-1" if first else "max")
