# SPDX-License-Identifier: Apache-2.0
"""Nodes below a launcher: kills random ones of many in one container, again and again.

    python -m bench.nodes [--launcher shell|supervisord|roslaunch|ros2] [--nodes 20] [--kills 1000] [--idle SECONDS]

Every node (tests/victims/crash.c) beats a thousand times a second.  It is killed by a signal from
outside, or faults, aborts or exits by itself.  What counts is the gap between two beats of the one
that was killed, and of its siblings; theirs is compared with as many windows without a kill, in
which the sidecar is asked as often.  Of each longest gap it is told for how long that node was
runnable and got no CPU in the whole window (schedstat).  With --idle nothing is killed, and nodes
sleep: what protecting them costs is measured for that time.

Needs root, Podman and what `make setup` builds; roslaunch needs scripts/setup-ros.sh, supervisord
PyPI's supervisor; ros2, which neither Debian nor PyPI has, a virtual environment with `ros2 launch`
in it (--ros2 FOLDER).  Sidecar and hooks are its own, beside those of the machine.  Prints a table and
writes bench/results/nodes.json.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import random
import signal
import statistics
import subprocess
import tempfile
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avckpt.supervision.pressure import held_bytes, templates_of
from rich.console import Console

from bench.scale import VICTIMS, cpu_s, processes, pss_mb
from testkit.board import Board
from testkit.harness import (
    BASE_IMAGE,
    ROOT,
    Container,
    ContainerFactory,
    Podman,
    wait_until,
)
from testkit.local_sidecar import LocalSidecar, hooked_podman, local_sidecar
from testkit.nodes import SUPERVISORD, SUPERVISORD_CONF, app_pid, supervisor_options

RESULTS = ROOT / "bench/results/nodes.json"
WITHIN_MS = 20.0
HOPELESS_S = 10.0
SETTLE_S = 10.0
"""Before costs are measured: avckpt.interval=auto finds its pace."""
PAUSE_S = (0.1, 0.3)
"""Between two kills: there is a checkpoint of every node in it."""

SIGNALS = (
    *("SIGKILL", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGABRT", "SIGTRAP", "SIGSYS"),
    *("SIGUSR1", "SIGUSR2", "SIGHUP"),  # by itself: a fault, abort(), exit(3)
)
NODE = "#!/bin/sh\nexec /victims/crash --board /bench/$NODE.board\n"
IDLE = "#!/bin/sh\nexec sleep infinity\n"
SHELL = """
for i in {numbers}; do NODE=$i $AVCKPT_INIT --name n$i -- /bench/nodes/node & done
while wait -n; s=$?; [ $s != 127 ]; do echo ended $s; done
"""
PROGRAM = """
[program:n{n}]
command=%(ENV_AVCKPT_INIT)s --name n{n} -- /bench/nodes/node
environment=NODE="{n}"
"""
PACKAGE = "<package><name>nodes</name><version>1.0.0</version><description>n</description></package>\n"
LAUNCH_NODE = """ <node pkg="nodes" type="node" name="n{n}" output="screen"
  launch-prefix="$(env AVCKPT_INIT) --name n{n} --"><env name="NODE" value="{n}"/></node>
"""
LAUNCH_PY = """
import os
from launch import LaunchDescription
from launch.actions import ExecuteProcess
def node(n):
    prefix = os.environ["AVCKPT_INIT"] + f" --name n{{n}} --"
    return ExecuteProcess(cmd=["/bench/nodes/node"], prefix=prefix, additional_env={{"NODE": str(n)}}, output="screen")
def generate_launch_description():
    return LaunchDescription([node(n + 1) for n in range({nodes})])
"""

console = Console(highlight=False)


@dataclass
class Result:
    """One run; gaps in ms."""

    launcher: str
    nodes: int
    kills: int
    restored: int
    within_20_ms: int
    gap_median_ms: float
    gap_p99_ms: float
    gap_max_ms: float
    siblings_gap_ms: float
    """The longest gap of a node that was not killed."""
    siblings_delay_ms: float
    """How long it was runnable without a CPU, in the window of its longest gap."""
    quiet_gap_ms: float
    """The longest gap of any node in as many windows without kills."""
    quiet_delay_ms: float
    not_back: list[str]
    """Who did not come back, from what."""
    launcher_said: list[str]
    """Lines of the launcher that tell of the end of a node."""
    load: float


@dataclass
class Idle:
    """What protecting them costs while nothing happens; CPU in per cent of one core."""

    nodes: int
    seconds: float
    interval_s: float
    guards_cpu_percent: float
    sidecar_cpu_percent: float
    guards_pss_mb: float
    generations_mb: float
    load: float


class Nodes:
    """The container, and a board for each node."""

    def __init__(self, sidecar: LocalSidecar, container: Container, boards: dict[str, Board]) -> None:
        self.sidecar, self.container, self.boards = sidecar, container, boards

    def rows(self) -> dict[str, dict[str, Any]]:
        """By name.  Asked directly: the command line takes seconds on a busy machine."""
        rows = self.sidecar.client.containers(memory=False)
        return {row["name"].partition("/")[2]: row for row in rows if row["node_of"] == self.container.id}

    def wait_protected(self, *, fully: bool = True) -> dict[str, dict[str, Any]]:
        """Fully: with all generations that they keep."""

        def found() -> dict[str, dict[str, Any]]:
            rows = self.rows()
            ready = [
                row
                for row in rows.values()
                if row["state"] == "protected" and (row["generations"] == row["keep"] or not fully)
            ]
            return rows if len(ready) == len(self.boards) else {}

        return wait_until(found, 120, f"{len(self.boards)} nodes are protected", every_s=0.5)


@dataclass(frozen=True, order=True)
class Gap:
    """The longest of some nodes, and for how long that node was runnable without a CPU; ms."""

    gap_ms: float = 0.0
    delay_ms: float = 0.0


def run_delay_ms(pid: int) -> float:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e6


def start(sidecar: LocalSidecar, folder: Path, stack: ExitStack, options: argparse.Namespace) -> Nodes:
    factory = ContainerFactory(hooked_podman(sidecar), f"avckpt-nodes-{os.getpid()}")
    stack.callback(factory.close)
    numbers = range(1, options.nodes + 1)
    boards = {f"n{n}": stack.enter_context(Board(folder / f"{n}.board")) for n in numbers}
    package = folder / "nodes"
    package.mkdir()
    (package / "node").write_text(IDLE if options.idle else NODE)
    (package / "node").chmod(0o755)
    (package / "package.xml").write_text(PACKAGE)
    (package / "all.launch").write_text(
        "<launch>\n" + "".join(LAUNCH_NODE.format(n=n) for n in numbers) + "</launch>\n"
    )
    command, image = ["bash", "-c", SHELL.format(numbers=" ".join(map(str, numbers)))], BASE_IMAGE
    volumes, others = ["-v", f"{folder}:/bench", "-v", f"{VICTIMS}:/victims:ro"], []
    if options.launcher == "supervisord":
        (folder / "supervisord.conf").write_text(SUPERVISORD_CONF + "".join(PROGRAM.format(n=n) for n in numbers))
        command, others = [*SUPERVISORD, "/bench/supervisord.conf"], supervisor_options()
        if not others:
            raise SystemExit("error: there is no supervisord: .venv/bin/pip install supervisor")
    elif options.launcher == "roslaunch":
        command, image = ["roslaunch", "nodes", "all.launch"], ros_image(factory.podman)
        others = ["-e", "ROS_PACKAGE_PATH=/bench:/usr/share", "-e", "ROS_MASTER_URI=http://localhost:11311"]
    elif options.launcher == "ros2":
        (folder / "all.launch.py").write_text(LAUNCH_PY.format(nodes=options.nodes))
        command = ["python3", f"{options.ros2}/bin/ros2", "launch", "/bench/all.launch.py"]
        libraries = ":".join(map(str, options.ros2.glob("lib/python3*/site-packages")))
        others = ["-v", f"{options.ros2}:{options.ros2}:ro", "-e", f"PYTHONPATH={libraries}"]
        others += ["-e", f"AMENT_PREFIX_PATH={options.ros2}"]
    labels = {"scope": "nodes", "restore.max": "64/1s", "restore.on": "signal,exit", "files": "rewind"}
    if options.interval:
        labels["interval"] = options.interval
    container = factory.protected(*command, labels=labels, image=image, options=[*volumes, *others])
    return Nodes(sidecar, container, boards)


def ros_image(podman: Podman) -> str:
    names = podman.run("images", "--format", "{{.Repository}}:{{.Tag}}").stdout.split()
    found = [name for name in names if name.startswith("localhost/avckpt-ros-run:")]
    if not found:
        raise SystemExit("error: there is no image of ROS: run scripts/setup-ros.sh")
    return found[0]


def found_pid(row: dict[str, Any]) -> int:
    """app_pid(), again where a template that it looks at has just been replaced."""

    def look() -> int:
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            return app_pid(row)
        return 0

    return wait_until(look, HOPELESS_S, f"{row['name']} runs", every_s=0.001)


def kill_one(nodes: Nodes, name: str, signum: signal.Signals | None) -> tuple[float, Gap]:
    """The gap of the one in ms (infinite: it did not come back) and of all others.  None: the same without a kill."""
    rows = nodes.rows()
    row = rows[name]
    siblings = {key: found_pid(other) for key, other in rows.items() if key != name}
    before = {key: run_delay_ms(pid) for key, pid in siblings.items()}
    for board in nodes.boards.values():
        board.forget_gap()
    pid = found_pid(row)
    if signum is not None:
        os.kill(pid, signum)
    # Without a kill the second look is enough, as it nearly always is with one.
    looks = itertools.count()
    try:
        wait_until(
            lambda: nodes.rows().get(name, row)["restores"] > row["restores"] or (signum is None and next(looks) > 0),
            HOPELESS_S,
            "it is restored",
        )
        beats = nodes.boards[name].see().beats
        wait_until(lambda: nodes.boards[name].see().beats > beats, HOPELESS_S, "it goes on")
    except TimeoutError:
        return float("inf"), Gap()
    gaps = {key: board.see().gap_ns / 1e6 for key, board in nodes.boards.items()}
    own = gaps.pop(name)
    return own, max((Gap(gaps[key], run_delay_ms(pid) - before[key]) for key, pid in siblings.items()), default=Gap())


def run(nodes: Nodes, options: argparse.Namespace) -> Result:
    dice = random.Random(options.seed)
    nodes.wait_protected()
    gaps, siblings, not_back = [], [], []
    for n in range(options.kills):
        name, signum = dice.choice(list(nodes.boards)), dice.choice(SIGNALS)
        gap, others = kill_one(nodes, name, signal.Signals[signum])
        gaps.append(gap)
        if gap == float("inf"):
            row = nodes.rows().get(name, {})
            not_back.append(f"{name}, {signum}: {row.get('state')}, last death {row.get('last_death')}")
        siblings.append(others)
        time.sleep(dice.uniform(*PAUSE_S))
        print(f"\r{n + 1} of {options.kills} killed", end="", flush=True)
    quiet = Gap()
    for _ in range(options.kills):
        quiet = max(quiet, kill_one(nodes, dice.choice(list(nodes.boards)), None)[1])
        time.sleep(dice.uniform(*PAUSE_S))
    back = sorted(gap for gap in gaps if gap != float("inf"))
    words = ("ended", "process has died", "process has finished", "exited:")
    return Result(
        launcher=options.launcher,
        nodes=options.nodes,
        kills=options.kills,
        restored=len(back),
        within_20_ms=sum(gap <= WITHIN_MS for gap in back),
        gap_median_ms=round(statistics.median(back), 2),
        gap_p99_ms=round(back[int(0.99 * (len(back) - 1))], 2),
        gap_max_ms=round(back[-1], 2),
        siblings_gap_ms=round(max(siblings).gap_ms, 2),
        siblings_delay_ms=round(max(siblings).delay_ms, 2),
        quiet_gap_ms=round(quiet.gap_ms, 2),
        quiet_delay_ms=round(quiet.delay_ms, 2),
        not_back=not_back,
        launcher_said=[line for line in nodes.container.logs().splitlines() if any(word in line for word in words)],
        load=round(os.getloadavg()[0], 1),
    )


def idle(nodes: Nodes, options: argparse.Namespace) -> Idle:
    rows = nodes.wait_protected(fully=False).values()
    time.sleep(SETTLE_S)
    assert nodes.sidecar.process is not None
    own, guards = processes(nodes.sidecar.process.pid)
    before, guards_before, began = cpu_s(own), cpu_s(guards), time.monotonic()
    time.sleep(options.idle)
    took = time.monotonic() - began
    return Idle(
        nodes=options.nodes,
        seconds=round(took, 1),
        interval_s=round(statistics.median(row["interval_s"] for row in nodes.rows().values()), 3),
        guards_cpu_percent=round(100 * (cpu_s(guards) - guards_before) / took, 2),
        sidecar_cpu_percent=round(100 * (cpu_s(own) - before) / took, 2),
        guards_pss_mb=pss_mb(guards),
        generations_mb=round(sum(held_bytes(app_pid(row), templates_of(row["init_pid"])) for row in rows) / 1e6, 1),
        load=round(os.getloadavg()[0], 1),
    )


def main() -> None:
    """Starts, kills or waits, removes; results of other launchers stay in the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--launcher", choices=("shell", "supervisord", "roslaunch", "ros2"), default="shell")
    parser.add_argument("--ros2", type=Path, help="where `ros2 launch` is installed")
    parser.add_argument("--nodes", type=int, default=20)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--interval", default="", help="avckpt.interval of all nodes (that of the release)")
    parser.add_argument("--idle", type=float, default=0.0, help="measure costs for so many seconds; kill nobody")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    subprocess.run(["make", "-s", "-C", str(VICTIMS.parent), "STATIC=1"], check=True)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="avckpt-nodes-")))
        folder.chmod(0o777)
        sidecar = stack.enter_context(local_sidecar(folder))
        sidecar.start()
        nodes = start(sidecar, folder, stack, options)
        result = idle(nodes, options) if options.idle else run(nodes, options)
    console.print()
    for key, value in asdict(result).items():
        console.print(f"{key.replace('_', ' '):<22} {value}")
    key = f"idle {options.nodes}" if options.idle else options.launcher
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps({**known, key: asdict(result)}, indent=1) + "\n")


if __name__ == "__main__":
    main()
