# SPDX-License-Identifier: Apache-2.0
"""What checkpoints cost the voxel filter, and how their freezes look at the end of the chain.

The same pipeline without and with protection, looked at five times a second.
Checkpoints every three seconds, each kept until the next.
"""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path
from typing import Any

from bench.ros_pipeline import NODES, PERIOD_S, Pipeline
from testkit.procfs import below, figures

LOOK_EVERY_S = 0.2
SETTLE_S = 7.0
"""Before it counts: the first checkpoints bring the engine's code into the program."""
SETTINGS = {"INTERVAL": "3s", "KEEP": "1"}

Json = dict[str, Any]


def cpu_ns(pids: list[int]) -> dict[tuple[int, int], int]:
    """CPU time of each thread, by the scheduler's own account."""
    used = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{pid}/task").iterdir():
                used[pid, int(task.name)] = int((task / "schedstat").read_text().split()[0])
    return used


def memory_mb(pids: list[int]) -> float:
    """What they hold together: pages that several share count once (PSS), and page tables."""
    kb = 0
    for pid in pids:
        with contextlib.suppress(OSError):
            has = figures(pid)
            kb += has["Pss"] + has["VmPTE"]
    return kb / 1024


class Checkpoints:
    """Every checkpoint of every container, from the sidecar's event stream."""

    def __init__(self) -> None:
        self.found: list[Json] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        from avckpt.cli.client import Client
        from avckpt.errors import AvckptError
        from avckpt_hooks.shared import protocol

        with contextlib.suppress(AvckptError):
            for event in Client(Path(protocol.run_dir())).events(since=time.time(), routine=True):
                if event["kind"] == "checkpoint":
                    self.found.append(
                        {name: event.get(name) for name in ("container", "at", "freeze_s", "quiescent", "threads")}
                    )


def watch(pipeline: Pipeline, seconds: float) -> Json:
    """Samples of the voxel filter's container, and the chain's frames meanwhile."""
    main = int(pipeline.podman.inspect(NODES["voxel"])["State"]["Pid"])
    samples = []
    started = time.time()
    last, last_at = cpu_ns([main, *below(main)]), started
    while time.time() - started < seconds:
        time.sleep(LOOK_EVERY_S)
        pids = [main, *below(main)]
        now, now_at = cpu_ns(pids), time.time()
        used = sum(value - last.get(thread, 0) for thread, value in now.items())
        samples.append(
            {
                "at": now_at - started,
                "cpu_percent": used / 1e7 / (now_at - last_at),
                "memory_mb": memory_mb(pids),
            }
        )
        last, last_at = now, now_at
    time.sleep(1.0)
    frames = pipeline.log.frames(started, started + seconds)
    return {
        "started": started,
        "samples": samples,
        "frames": [[frame.stamp - started, frame.latency_s, frame.error_m] for frame in frames],
    }


def cost(seconds: float, tcp: str) -> Json:
    """Both variants."""
    found: Json = {}
    for name, protect in (("plain", False), ("protected", True)):
        with Pipeline(protect=protect, settings={**SETTINGS, "TCP": tcp}) as pipeline:
            time.sleep(SETTLE_S)
            checkpoints = Checkpoints() if protect else None
            found[name] = watch(pipeline, seconds)
            if checkpoints is not None:
                started = found[name]["started"]
                found[name]["checkpoints"] = [
                    {**one, "at": one["at"] - started} for one in checkpoints.found if one["at"] - started < seconds
                ]
    return found


def beside_checkpoints(cost_of_protected: Json) -> tuple[list[float], list[float]]:
    """Latencies, in s, of frames during which any node was frozen, and of the others."""
    at = [one["at"] for one in cost_of_protected["checkpoints"] if one["container"] in ("ros-voxel", "ros-ndt")]
    during: list[float] = []
    others: list[float] = []
    for stamp, latency, _ in cost_of_protected["frames"]:
        if latency is not None:
            hit = any(stamp - PERIOD_S / 10 <= one <= stamp + latency + PERIOD_S / 20 for one in at)
            (during if hit else others).append(latency)
    return during, others
