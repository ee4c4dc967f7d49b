# SPDX-License-Identifier: Apache-2.0
"""`make bench-ros`: what a crash does to a ROS pipeline, with avckpt and with a cold start, in the same run.

    python -m bench.ros [--part latency,cut,cost] [--runs 20]

The pipeline is examples/ros/vehicle.yaml, every node in a container of its own.
Each part adds its results to bench/results/ros.json; plots and tables are made
from that file by bench/ros_show.py.  docs/evaluation.md says what is measured how.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.ros_cost import cost
from bench.ros_pipeline import (
    LOST_M,
    PERIOD_S,
    CommandFailed,
    Crash,
    Frame,
    Pipeline,
    PipelineFailed,
    sidecar,
)
from testkit.harness import ROOT

RESULTS = ROOT / "bench" / "results" / "ros.json"
BEFORE_S, AFTER_S = 3.0, 2.0
"""Of the latency: what is compared, before and after a crash."""
SETTLE_S = 10.0
"""How long a crash may take to be over."""
PAUSE_S = 1.0

Json = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One crash of the voxel filter, in ms; "age" counts a frame that is lost until a newer pose is there."""

    variant: str
    load: float
    inside: int
    median_before_ms: float
    max_before_ms: float
    median_after_ms: float
    max_after_ms: float
    median_age_after_ms: float
    max_age_after_ms: float
    to_next_cloud_ms: float
    """Crash to the next cloud of the filter's, whose scan was published after it."""
    to_next_pose_ms: float
    gap_ms: float
    """Longest time between two poses, around the crash."""
    gap_before_ms: float
    lost: int
    restore_ms: float | None
    """Death to the last thread running again, by avckpt's own clock."""


def median(values: Sequence[float]) -> float:
    ordered = sorted(values)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2


def ages(frames: Sequence[Frame]) -> list[float]:
    """For each frame: until a pose of it or of a later one was there."""
    found: list[float] = []
    best = float("inf")
    for frame in reversed(frames):
        if frame.pose is not None and frame.error_m < LOST_M:
            best = min(best, frame.pose)
        found.append(best - frame.stamp)
    return found[::-1]


def gaps(frames: Sequence[Frame]) -> list[float]:
    poses = sorted(frame.pose for frame in frames if frame.pose is not None)
    return [b - a for a, b in zip(poses, poses[1:])]


def judge(variant: str, frames: Sequence[Frame], at: float, inside: int, restore_s: float | None) -> Run:
    """What a crash at this time did.  Raises PipelineFailed when there is too little to tell."""
    before = [f for f in frames if at - BEFORE_S <= f.stamp < at - 2 * PERIOD_S and f.latency_s is not None]
    after = [f for f in frames if at - PERIOD_S <= f.stamp <= at + AFTER_S]
    delivered = [f.latency_s for f in after if f.latency_s is not None and f.error_m < LOST_M]
    aged = [age for frame, age in zip(frames, ages(frames)) if frame in after]
    clouds = [f.filtered for f in frames if f.filtered is not None and f.stamp > at]
    poses = [f.pose for f in frames if f.pose is not None and f.stamp > at and f.error_m < LOST_M]
    if len(before) < 10 or not delivered or not clouds or not poses:
        raise PipelineFailed("too few frames around the crash")
    latencies = [f.latency_s for f in before if f.latency_s is not None]
    return Run(
        variant=variant,
        load=os.getloadavg()[0],
        inside=inside,
        median_before_ms=1e3 * median(latencies),
        max_before_ms=1e3 * max(latencies),
        median_after_ms=1e3 * median(delivered),
        max_after_ms=1e3 * max(delivered),
        median_age_after_ms=1e3 * median(aged),
        max_age_after_ms=1e3 * max(aged),
        to_next_cloud_ms=1e3 * (min(clouds) - at),
        to_next_pose_ms=1e3 * (min(poses) - at),
        gap_ms=1e3 * max(gaps([f for f in frames if f.stamp > at - 5 * PERIOD_S])),
        gap_before_ms=1e3 * max(gaps(before)),
        lost=sum(frame.pose is None for frame in after),
        restore_ms=None if restore_s is None else 1e3 * restore_s,
    )


def events(since: float) -> list[Json]:
    """avckpt's events since a time of day."""
    from avckpt.cli.client import Client
    from avckpt_hooks.shared import protocol

    return Client(Path(protocol.run_dir())).history(since)


def latency_runs(protect: bool, runs: int, tcp: str, rng: random.Random) -> Iterator[Json]:
    """Crashes of the voxel filter at random moments."""
    variant = "avckpt" if protect else "cold start"
    with Pipeline(protect=protect, settings={"TCP": tcp}) as pipeline:
        for _ in range(runs):
            time.sleep(BEFORE_S + PAUSE_S + rng.uniform(0, 1.0))
            # Of a bad moment of the machine's nothing can be told.
            pipeline.wait_delivers(time.time() - 0.5, SETTLE_S, frames=10)
            time.sleep(rng.uniform(0, PERIOD_S))
            at, inside = pipeline.crash(["voxel"], Crash("kill"), rng)
            try:
                pipeline.wait_delivers(at + 0.001, SETTLE_S, frames=15)
            except PipelineFailed as error:
                yield {"variant": variant, "failed": str(error), "inside": inside}
                pipeline.mend(["voxel", "ndt"])
                continue
            restore_s = None
            if protect:
                found = [e for e in events(at - 0.01) if e["kind"] == "restored" and e["container"] == "ros-voxel"]
                restore_s = found[-1]["restore_s"] if found else None
            time.sleep(max(0.0, at + AFTER_S + 0.5 - time.time()))
            frames = pipeline.log.frames(at - BEFORE_S, at + 5.0)
            try:
                yield asdict(judge(variant, frames, at, inside or 0, restore_s))
            except PipelineFailed as error:
                yield {"variant": variant, "failed": str(error), "inside": inside}


def latency(results: list[Json], runs: int, tcp: str, rng: random.Random) -> None:
    """In turns, so that what else the machine does falls on both."""
    half = (runs + 1) // 2
    for protect, count in ((True, half), (False, half), (False, runs - half), (True, runs - half)):
        for run in latency_runs(protect, count, tcp, rng):
            results.append(run)
            say(f"{run['variant']}: " + (run.get("failed") or f"gap {run['gap_ms']:.0f} ms, lost {run['lost']}"))


def cut(results: list[Json], runs: int, values: Sequence[str], rng: random.Random) -> None:
    """Crashes in the middle of a message, for each value of avckpt.tcp."""
    for tcp in values:
        with Pipeline(protect=True, settings={"TCP": tcp}) as pipeline:
            for number in range(runs):
                place = "message" if number % 2 else ""
                time.sleep(rng.uniform(1.2, 1.8))
                try:
                    at, inside = pipeline.crash(["voxel"], Crash("kill", place), rng)
                except PipelineFailed as error:
                    say(f"tcp={tcp}: not crashed, {error}")
                    continue
                recovered = True
                try:
                    pipeline.wait_delivers(at + 0.001, SETTLE_S, frames=5)
                    time.sleep(0.6)
                except PipelineFailed:
                    recovered = False
                frames = pipeline.log.frames(at - 0.25, at + 8.0)
                good = [f for f in frames if f.pose is not None and f.stamp > at and f.error_m < LOST_M]
                lost = sum(f.pose is None for f in frames if f.stamp < at + 0.6)
                results.append(
                    {
                        "tcp": tcp,
                        "place": place or "anywhere",
                        "inside": inside,
                        "recovered": recovered,
                        "lost": lost,
                        "to_next_pose_ms": 1e3 * (min(f.pose for f in good if f.pose) - at) if good else None,
                    }
                )
                say(f"tcp={tcp}: {results[-1]}")
                if not recovered:
                    pipeline.mend(["voxel", "ndt"])


def say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def machine() -> Json:
    """What this was measured on."""
    cpu = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        platform.machine(),
    )
    podman = subprocess.run(["podman", "--version"], capture_output=True, text=True, check=False).stdout.strip()
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9),
        "kernel": platform.release(),
        "podman": podman,
        "at": time.strftime("%Y-%m-%d"),
    }


def add(path: Path, more: Json, append: bool) -> None:
    """In one step, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    known: Json = json.loads(path.read_text()) if path.exists() else {}
    for name, results in more.items():
        if append and isinstance(results, list):
            more[name] = known.get(name, []) + results
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps({**known, **more, "machine": machine()}, indent=1) + "\n")
    draft.replace(path)


def main() -> int:
    parser = argparse.ArgumentParser(description="Measures what a crash does to a ROS pipeline.")
    parser.add_argument("--part", default="latency,cut,cost", help="which parts (%(default)s)")
    parser.add_argument("--runs", type=int, default=20, help="crashes of each variant (%(default)s)")
    parser.add_argument("--seconds", type=float, default=40.0, help="how long costs are looked at (%(default)s)")
    parser.add_argument("--tcp", default="messages", help="avckpt.tcp for latency and cost (%(default)s)")
    parser.add_argument("--cut", default="keep,reset-moved,messages", help="values of avckpt.tcp (%(default)s)")
    parser.add_argument("--append", action="store_true", help="add runs to those that are there")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=RESULTS)
    args = parser.parse_args()
    rng = random.Random(args.seed)
    if os.geteuid() != 0:
        print("ros: it takes root: containers are killed and their connections looked at", file=sys.stderr)
        return 1
    try:
        with sidecar():
            for part in args.part.split(","):
                if part == "cost":
                    add(args.output, {"cost": cost(args.seconds, args.tcp)}, args.append)
                    continue
                runs: list[Json] = []
                try:
                    if part == "latency":
                        latency(runs, args.runs, args.tcp, rng)
                    elif part == "cut":
                        cut(runs, args.runs, args.cut.split(","), rng)
                    else:
                        parser.error(f"no such part: {part}")
                finally:
                    # Half an hour's runs are not lost with the last one.
                    add(args.output, {part: runs}, args.append)
    except (PipelineFailed, CommandFailed) as error:
        print(f"ros: {error}", file=sys.stderr)
        return 1
    from bench.ros_show import show

    show(args.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
