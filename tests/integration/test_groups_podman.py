# SPDX-License-Identifier: Apache-2.0
"""Podman containers that go back together, as requested by their labels."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from testkit.harness import ROOT, SLOWNESS, ContainerFactory, Sidecar, wait_until
from testkit.local_sidecar import LocalSidecar, hooked_podman
from testkit.nodes import app_pid, nodes_of

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; members wait for each other for 50 ms"
)

MEMBERS = 3
PATIENCE_S = 30.0 * SLOWNESS


def test_a_ring_of_containers_goes_back_together(sidecar: Sidecar, container: ContainerFactory) -> None:
    labels = {
        "interval": "200ms",
        "group": f"ring-{os.getpid()}",
        "group.recovery": "together",
    }
    port = str(random.randrange(20000, 30000))
    program = (ROOT / "testkit/programs/ring.py").read_text()
    ring = [
        container.protected(
            "python3", "-uc", program, str(index), str(MEMBERS), port, labels=labels, options=["--network=host"]
        )
        for index in range(MEMBERS)
    ]

    def lines() -> set[int]:
        ids = {member.id for member in ring}
        return {row["line"] for row in sidecar.ps() if row["id"] in ids}

    wait_until(lambda: len(lines()) == 1 and min(lines()) > 0, PATIENCE_S, "a line of all")
    for restores in (1, 2):
        os.kill(sidecar.app_pid(ring[restores]), signal.SIGKILL)
        for member in ring:
            sidecar.wait_restores(member, restores)
    had = [len(member.logs().splitlines()) for member in ring]
    wait_until(
        lambda: all(len(each.logs().splitlines()) > n + 5 for each, n in zip(ring, had)), PATIENCE_S, "all go on"
    )
    assert [line for member in ring for line in member.logs().splitlines() if "WRONG" in line] == []


LAUNCHER = """
for i in {numbers}; do $AVCKPT_INIT --name n$i -- python3 -uc "$RING" $i {members} {port} & done
while wait -n; s=$?; [ $s != 127 ]; do echo ended $s; done
"""


@pytest.fixture
def hooked(local: LocalSidecar, base_image: str) -> Iterator[ContainerFactory]:
    """Containers of a sidecar of our own."""
    factory = ContainerFactory(hooked_podman(local), f"avckpt-groups-{os.getpid()}")
    yield factory
    factory.close()


def test_nodes_of_two_containers_go_back_together(local: LocalSidecar, hooked: ContainerFactory) -> None:
    labels = {"scope": "nodes", "interval": "200ms", "group": f"nodes-{os.getpid()}", "group.recovery": "together"}
    port = random.randrange(20000, 30000)
    ring = (ROOT / "testkit/programs/ring.py").read_text()
    cars = [
        hooked.protected(
            *("bash", "-c", LAUNCHER.format(numbers=numbers, members=4, port=port)),
            labels=labels,
            options=["--network=host", "--env", f"RING={ring}"],
        )
        for numbers in ("0 1", "2 3")
    ]

    def rows() -> list[dict[str, Any]]:
        found = [nodes_of(local, car) for car in cars]
        return [row for nodes in found for _, row in sorted(nodes.items())]

    def have_line() -> bool:
        lines = {row["line"] for row in rows()}
        return len(rows()) == 4 and len(lines) == 1 and min(lines) > 0

    wait_until(have_line, PATIENCE_S, "a line of all four")
    for restores in range(1, 4):
        os.kill(app_pid(rows()[restores]), signal.SIGKILL)
        wait_until(
            lambda: [(row["restores"], row["state"]) for row in rows()] == [(restores, "protected")] * 4,  # noqa: B023
            PATIENCE_S,
            f"all are back: {rows()}",
        )
        wait_until(have_line, PATIENCE_S, "a new line of all four")
    had = [len(car.logs().splitlines()) for car in cars]
    wait_until(lambda: all(len(car.logs().splitlines()) > n + 10 for car, n in zip(cars, had)), PATIENCE_S, "all go on")
    said = [line for car in cars for line in car.logs().splitlines()]
    assert [line for line in said if "WRONG" in line or "ended" in line or "Traceback" in line] == []
    restored = [event for event in local.client.history() if event["kind"] == "restored"]
    assert len(restored) == 4 * 3
    assert [event for event in restored if "of its connections" in str(event.get("error"))] == []
