# SPDX-License-Identifier: Apache-2.0
"""The ROS node beside CRIU: the pipeline of examples/ros in the peers' world, its voxel filter brought back by Podman,
or, as a process without a container, by CRIU itself.

    .venv/bin/python -m bench.ros_peers [--runs 2] [--ways bare,crun,runc]

Each run takes one checkpoint of the filter, kills it three seconds later with SIGKILL, and calls `podman container
restore`, or `criu restore`, in that moment.  What a crash does to the chain is measured as in bench/ros.py, whose
results for avckpt and for a cold start stand beside it.  Writes bench/results/ros_peers.json and .md.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, Protocol

import yaml

from bench.peers_subjects import CLOSED, IN_FLIGHT, CriuContainer, CriuFailed, CriuImages, Taken
from bench.peers_world import BOARDS_INSIDE, World
from bench.ros import BEFORE_S, SETTLE_S, machine, say
from bench.ros_pipeline import LOST_M, MANIFEST, PERIOD_S, START_S, Log, PipelineFailed
from bench.ros_show import spread
from bench.subjects import BenchFailed
from testkit.harness import ROOT, CommandFailed

RESULTS = ROOT / "bench" / "results" / "ros_peers.json"
BESIDE = ROOT / "bench" / "results" / "ros.json"
IMAGE = "localhost/avckpt-ros:latest"
NODE = "voxel"
BARE = "bare"
ENVIRONMENT = ("ROS_MASTER_URI=http://127.0.0.1:11311", "ROS_IP=127.0.0.1")
SERVICES = ("roscore", "monitor", "ndt", NODE, "player")
RESTORE_S = 65.0
"""How long a restore is tried: longer than a port stays taken by connections that have ended (TIME_WAIT)."""
CHAIN_S = 30.0
"""How long the chain is then waited for."""
AROUND_S = 0.3
"""Scans published so shortly before and after a checkpoint count as its own."""

Json = dict[str, Any]


def commands() -> dict[str, list[str]]:
    """Of the manifest's services, with its defaults."""
    text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", MANIFEST.read_text())
    services = yaml.safe_load(text)["services"]
    return {name: services[name]["command"] for name in SERVICES}


class Service(Protocol):
    """A node of the pipeline, with CRIU's commands for it.  Those raise CriuFailed."""

    refused: list[str]

    def start(self, command: Sequence[str]) -> None: ...
    def remove(self) -> None: ...
    def pid(self) -> int:
        """In the peers' world."""

    def checkpoint(self) -> Taken: ...
    def restore(self) -> float:
        """What the command took, ms."""


class Contained(Service):
    """In a container, by Podman."""

    def __init__(self, container: CriuContainer, options: Sequence[str]) -> None:
        self._container = container
        self._options = options
        self.refused = container.refused

    def start(self, command: Sequence[str]) -> None:
        environment = [option for value in ENVIRONMENT for option in ("--env", value)]
        self._container.run(*environment, *self._options, IMAGE, *command)

    def remove(self) -> None:
        self._container.remove()

    def pid(self) -> int:
        return int(self._container.inspect("{{.State.Pid}}"))

    def checkpoint(self) -> Taken:
        return self._container.checkpoint("--leave-running", told=(IN_FLIGHT, CLOSED))

    def restore(self) -> float:
        self._container.tell_criu(CLOSED)
        return self._container.restore(RESTORE_S)


class Bare(Service):
    """A process without a container, by CRIU itself: with the image's files as its root, in a mount namespace."""

    _root = "/ros"
    _pid_file = "/tmp/node.pid"

    def __init__(self, world: World) -> None:
        self._world = world
        self._criu = CriuImages(world)
        self.refused = self._criu.refused
        script = f"mkdir {self._root} && podman create --name unpack {IMAGE} && "
        script += f"podman export unpack | tar -C {self._root} -x && podman rm unpack && "
        script += f"mount --bind {self._root} {self._root}"
        world.run("sh", "-c", script)

    def start(self, command: Sequence[str]) -> None:
        # The image has no umount(8): the old root's, with the libraries that it needs.
        umount = "mnt/lib64/ld-linux-x86-64.so.2 --library-path mnt/lib/x86_64-linux-gnu mnt/usr/bin/umount -l mnt"
        script = f"echo $$ >{self._pid_file} && mount --bind {self._root} {self._root} && cd {self._root} && "
        script += f"mount -t proc proc proc && pivot_root . mnt && {umount} && "
        script += 'export PATH="/opt/ros/avckpt_ros:$PATH" && exec env "$@" </dev/null >/dev/null 2>&1'
        self._world.start(
            "unshare", "--mount", "--propagation", "private", "sh", "-c", script, "sh", *ENVIRONMENT, *command
        )

    def remove(self) -> None:
        self._world.run("sh", "-c", f"[ ! -e {self._pid_file} ] || kill -KILL $(cat {self._pid_file})", check=False)

    def pid(self) -> int:
        return int(self._world.run("cat", self._pid_file).stdout)

    def checkpoint(self) -> Taken:
        return self._criu.dump(self.pid(), "--leave-running")

    def restore(self) -> float:
        return self._criu.restore(CLOSED, RESTORE_S, "--root", self._root)


class Chain:
    """The pipeline's containers in a world of their own; `way`: what brings the filter back."""

    def __init__(self, world: World, way: str, results: Path) -> None:
        self._results = results
        self._world = world
        self.log = Log(results / "monitor.log")
        runtime = "crun" if way == BARE else way
        options = ["--volume", "/cache/ros-drive:/drive:ro", "--volume", f"{BOARDS_INSIDE}/{results.name}:/results"]
        self.services: dict[str, Service] = {
            name: Contained(CriuContainer(world, runtime, f"ros-{name}"), options) for name in SERVICES
        }
        if way == BARE:
            self.services[NODE] = Bare(world)
        self.node = self.services[NODE]
        self._commands = commands()

    def __enter__(self) -> Chain:
        (self._results / "faults").mkdir(parents=True)
        for name in SERVICES:
            self._start(name)
        self.log.wait_delivers(time.time(), START_S, frames=20)
        return self

    def __exit__(self, *_: object) -> None:
        for service in reversed(self.services.values()):
            service.remove()

    def _start(self, name: str) -> None:
        self.services[name].start(self._commands[name])

    def start_node_anew(self) -> None:
        self.node.remove()
        self._start(NODE)
        self.log.wait_delivers(time.time(), START_S, frames=20)

    def kill_node(self) -> float:
        """When."""
        pidfd = os.pidfd_open(self._world.outside(self.node.pid()))
        try:
            at = time.time()
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            return at
        finally:
            os.close(pidfd)


def one_run(chain: Chain, variant: str, rng: random.Random) -> Json:
    """A checkpoint, a crash, a restore.  Raises CriuFailed, PipelineFailed when there is no checkpoint."""
    time.sleep(BEFORE_S + rng.uniform(0, 1.0))
    chain.log.wait_delivers(time.time() - 0.5, SETTLE_S, frames=10)
    began = time.time()
    taken = chain.node.checkpoint()
    ended = time.time()
    time.sleep(BEFORE_S + rng.uniform(0, 0.1))
    around = chain.log.frames(began - AROUND_S, ended + AROUND_S)
    run = {
        "variant": variant,
        "checkpoint_ms": taken.took_ms,
        "freeze_ms": taken.tool_freeze_ms,
        "checkpoint_mb": taken.memory_mb,
        "lost_at_checkpoint": sum(frame.pose is None for frame in around),
    }
    at = chain.kill_node()
    try:
        run["command_ms"] = chain.node.restore()
        chain.log.wait_delivers(at + 0.001, CHAIN_S, frames=15)
    except (CriuFailed, PipelineFailed) as error:
        return run | {"failed": str(error)}
    frames = chain.log.frames(at - PERIOD_S)
    clouds = [frame.filtered for frame in frames if frame.filtered is not None and frame.stamp > at]
    poses = [frame.pose for frame in frames if frame.pose is not None and frame.stamp > at and frame.error_m < LOST_M]
    return run | {
        "to_next_cloud_ms": 1e3 * (min(clouds) - at),
        "to_next_pose_ms": 1e3 * (min(poses) - at),
        "lost": sum(frame.pose is None for frame in frames if frame.stamp < min(poses)),
    }


def runs_of(way: str, runs: int, rng: random.Random) -> Generator[Json, None, None]:
    variant = "CRIU" if way == BARE else f"CRIU, Podman, {way}"
    with tempfile.TemporaryDirectory(prefix="avckpt-ros-", dir="/dev/shm") as folder, World(Path(folder)) as world:
        archive = Path(folder) / "ros.tar"
        subprocess.run(["podman", "save", "--quiet", "--output", str(archive), IMAGE], check=True)
        world.load_image(BOARDS_INSIDE / archive.name)
        archive.unlink()
        with Chain(world, way, Path(folder) / "results") as chain:
            for _ in range(runs):
                before = len(chain.node.refused)
                run = one_run(chain, variant, rng)
                yield run | {"refused": len(chain.node.refused) - before}
                if "failed" in run:
                    chain.start_node_anew()


def row(name: str, key: str, digits: int, columns: Sequence[Sequence[Json]]) -> str:
    cells = [spread([run[key] for run in column if run.get(key) is not None], digits) for column in columns]
    return f"| {name} | " + " | ".join(cells) + " |"


def table(runs: Sequence[Json]) -> str:
    """Mean and standard deviation; avckpt and cold start as bench/ros.py has measured them."""
    beside = json.loads(BESIDE.read_text())["latency"] if BESIDE.exists() else []
    every = [*beside, *runs]
    variants = list(dict.fromkeys(run["variant"] for run in every))
    columns = [[run for run in every if run["variant"] == variant] for variant in variants]
    failed = [sum(run["variant"] == variant and "failed" in run for run in every) for variant in variants]
    lines = ["| | " + " | ".join(variants) + " |", "|---|" + "---:|" * len(variants)]
    lines.append("| runs | " + " | ".join(str(len(column)) for column in columns) + " |")
    lines.append("| of these did not recover | " + " | ".join(map(str, failed)) + " |")
    for name, key, digits in (
        ("freeze by a checkpoint, by the tool's own account, ms", "freeze_ms", 0),
        ("scans lost at a checkpoint", "lost_at_checkpoint", 2),
        ("a checkpoint holds, MB", "checkpoint_mb", 0),
        ("crash to next filtered cloud, ms", "to_next_cloud_ms", 0),
        ("crash to next pose, ms", "to_next_pose_ms", 0),
        ("scans lost", "lost", 2),
    ):
        lines.append(row(name, key, digits, columns))
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description="The ROS node beside CRIU, through Podman and without.")
    parser.add_argument("--runs", type=int, default=2, help="of each way (%(default)s)")
    parser.add_argument("--ways", default=f"{BARE},crun,runc", help="CRIU itself, Podman's runtimes (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    parser.add_argument("--show", action="store_true", help="measure nothing, make the table of what is there")
    args = parser.parse_args()
    runs: list[Json] = json.loads(args.output.read_text())["runs"] if args.show else []
    if os.geteuid() != 0:
        print("ros_peers: it takes root: CRIU restores other processes", file=sys.stderr)
        return 1
    try:
        for way in [] if args.show else args.ways.split(","):
            with contextlib.closing(runs_of(way, args.runs, random.Random(way))) as found:
                for run in found:
                    runs.append(run)
                    told = run.get("failed") or f"next pose after {run['to_next_pose_ms']:.0f} ms"
                    say(f"{run['variant']}: {told}")
    except (BenchFailed, CommandFailed, PipelineFailed, subprocess.CalledProcessError) as error:
        print(f"ros_peers: {error}", file=sys.stderr)
        return 1
    if not args.show:
        args.output.write_text(json.dumps({"runs": runs, "machine": machine()}, indent=1) + "\n")
    text = table(runs)
    args.output.with_suffix(".md").write_text(text + "\n")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
