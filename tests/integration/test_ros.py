# SPDX-License-Identifier: Apache-2.0
"""A real ROS 1 pipeline, one node a container: the whole chain continues after each crash.

Runs where `make bench-ros` (or scripts/setup-ros.sh) has made the image and the drive.
"""

from __future__ import annotations

import os
import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.ros_pipeline import Crash, Pipeline
from testkit.harness import Podman, Sidecar, wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "a pipeline of ROS nodes is given a time to deliver again"
)

IMAGE = "localhost/avckpt-ros:latest"
DRIVE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "avckpt" / "ros-drive" / "drive.bag"
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def pipeline(podman: Podman, session_sidecar: Sidecar, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pipeline]:
    if podman.run("image", "exists", IMAGE, check=False).status != 0 or not DRIVE.exists():
        pytest.skip(f"no {IMAGE} or no {DRIVE}: scripts/setup-ros.sh makes them")
    with Pipeline(protect=True, settings={"TCP": "messages"}, results=tmp_path_factory.mktemp("ros")) as up:
        yield up


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("nodes", "crash"),
    [
        (["voxel"], Crash("kill")),
        (["voxel"], Crash("kill", "message")),
        (["voxel", "ndt"], Crash("segv")),
        (["ndt"], Crash("throw", "middle")),
    ],
    ids=lambda value: value.kind + value.place if isinstance(value, Crash) else "+".join(value),
)
def test_the_whole_chain_delivers_again(pipeline: Pipeline, nodes: list[str], crash: Crash) -> None:
    started = {name: pipeline.podman.inspect(f"ros-{name}")["State"]["StartedAt"] for name in ("voxel", "ndt")}
    time.sleep(1.0)
    at, _ = pipeline.crash(nodes, crash, random.Random(1))
    pipeline.wait_delivers(at + 0.001, PATIENCE_S, frames=5)
    # Restored, not started anew.
    assert started == {name: pipeline.podman.inspect(f"ros-{name}")["State"]["StartedAt"] for name in started}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_rospy_node_goes_on(pipeline: Pipeline) -> None:
    at, _ = pipeline.crash(["watch"], Crash("kill"), random.Random(1))
    wait_until(lambda: pipeline.log.watched(at + 0.5) >= 3, PATIENCE_S, "the rospy node tells of new scans")
