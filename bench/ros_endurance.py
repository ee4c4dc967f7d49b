# SPDX-License-Identifier: Apache-2.0
"""`make bench-ros-long`: crashes one of the ROS chain's nodes, or both, every one or two seconds, again and again.

    python -m bench.ros_endurance --crashes 1000 [--tcp messages] [--together nodes] [--output FILE]

A crash counts as survived when poses of three later scans come out within five
seconds, each less than a metre from the truth.  With --together the nodes, or all containers, the
player and the monitor included, are one group that goes back together.  One line of JSON is appended
for each crash, so a run can be stopped and continued.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bench.ros_pipeline import CommandFailed, Crash, Pipeline, PipelineFailed, sidecar
from testkit.harness import ROOT

OUTPUT = ROOT / "bench" / "results" / "ros_endurance.jsonl"
WITHIN_S = 5.0
AFTER_S = 0.7
"""So long is looked for frames that were missed."""

GROUPS = {
    "nodes": {"RECOVERY": "together", "OUTSIDE": "outside"},
    "all": {"RECOVERY": "together", "OUTSIDE_RECOVERY": "together"},
}
"""Settings of examples/ros/vehicle.yaml for each."""

TARGETS = (["voxel"], ["ndt"], ["voxel", "ndt"])
CRASHES = (
    Crash("kill"),
    Crash("segv"),
    Crash("abort"),
    Crash("kill", "message"),
    Crash("segv", "message"),
    Crash("segv", "begin"),
    Crash("segv", "middle"),
    Crash("abort", "middle"),
    Crash("throw", "middle"),
    Crash("throw", "end"),
    Crash("exit", "middle"),
)


def one(pipeline: Pipeline, nodes: list[str], crash: Crash, rng: random.Random) -> dict[str, Any]:
    """One crash, and what came of it."""
    if crash.place == "message" and "voxel" not in nodes:
        crash = Crash(crash.kind)
    at, inside = pipeline.crash(nodes, crash, rng)
    survived = True
    try:
        pipeline.wait_delivers(at + 0.001, WITHIN_S, frames=3)
        time.sleep(max(0.0, at + AFTER_S + 0.4 - time.time()))
    except PipelineFailed:
        survived = False
    frames = pipeline.log.frames(at - 0.5, at + AFTER_S)
    lost = [round(frame.stamp - at, 4) for frame in frames if frame.pose is None]
    wrong = [round(frame.stamp - at, 4) for frame in frames if frame.pose is not None and frame.error_m > 1.0]
    poses = sorted(frame.pose for frame in pipeline.log.frames(at - 1.0, at + 2.0) if frame.pose is not None)
    return {
        "at": round(at, 6),
        "nodes": nodes,
        "kind": crash.kind,
        "place": crash.place,
        "inside": inside,
        "survived": survived,
        "lost": lost,
        "wrong": wrong,
        "gap_s": round(max((b - a for a, b in zip(poses, poses[1:])), default=0.0), 4),
        "load": os.getloadavg()[0],
    }


def crashes(pipeline: Pipeline, count: int, rng: random.Random) -> Iterator[dict[str, Any]]:
    """So many of them; mends the chain after one that was not survived."""
    done = 0
    while done < count:
        time.sleep(rng.uniform(0.3, 0.8))
        nodes = rng.choice(TARGETS)
        try:
            result = one(pipeline, list(nodes), rng.choice(CRASHES), rng)
        except (LookupError, OSError, TimeoutError, PipelineFailed) as error:
            # The crash itself could not be brought about: that says nothing of avckpt, unless it stays so.
            print(f"not crashed: {error!r}", file=sys.stderr)
            if not pipeline.log.delivers(time.time() - 2.0):
                pipeline.mend(["voxel", "ndt"])
            continue
        done += 1
        yield result
        if not result["survived"]:
            pipeline.mend(["voxel", "ndt"])


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Counts over all lines."""
    by_place: Counter[str] = Counter()
    survived_by_place: Counter[str] = Counter()
    more_lost = 0
    for result in results:
        place = result["place"] or "anywhere"
        by_place[place] += 1
        survived_by_place[place] += result["survived"]
        more_lost += len(result["lost"]) > 1
    return {
        "crashes": len(results),
        "survived": sum(result["survived"] for result in results),
        "by_place": {place: [survived_by_place[place], by_place[place]] for place in sorted(by_place)},
        "no_frame_lost": sum(not result["lost"] for result in results),
        "one_frame_lost": sum(len(result["lost"]) == 1 for result in results),
        "more_lost": more_lost,
        "wrong_poses": sum(bool(result["wrong"]) for result in results),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="Crashes the nodes of the ROS chain again and again.")
    parser.add_argument("--crashes", type=int, default=1000, help="how many (%(default)s)")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so many")
    parser.add_argument("--tcp", help="avckpt.tcp (messages; of a group: reset-moved)")
    parser.add_argument("--together", choices=GROUPS, help="who goes back together (nobody)")
    parser.add_argument("--interval", default="500ms", help="avckpt.interval (%(default)s)")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--output", type=Path, default=OUTPUT)
    args = parser.parse_args()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + args.minutes * 60
    tcp = args.tcp or ("reset-moved" if args.together else "messages")
    settings = {"TCP": tcp, "INTERVAL": args.interval, **(GROUPS[args.together] if args.together else {})}
    results = []
    try:
        with (
            sidecar(),
            Pipeline(protect=True, settings=settings) as pipeline,
            args.output.open("a") as output,
        ):
            for result in crashes(pipeline, args.crashes, random.Random(args.seed)):
                results.append(result)
                output.write(json.dumps({"tcp": tcp, "together": args.together or "", **result}) + "\n")
                output.flush()
                if time.monotonic() > end:
                    break
    except (PipelineFailed, CommandFailed) as error:
        print(f"ros: {error}", file=sys.stderr)
        return 1
    finally:
        print(json.dumps(summary(results), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
