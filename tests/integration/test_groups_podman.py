# SPDX-License-Identifier: Apache-2.0
"""Podman containers that go back together, as requested by their labels."""

from __future__ import annotations

import os
import random
import signal

import pytest

from testkit.harness import ROOT, ContainerFactory, Sidecar, wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; members wait for each other for 50 ms"
)

MEMBERS = 3


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

    wait_until(lambda: len(lines()) == 1 and min(lines()) > 0, 30, "a line of all")
    for restores in (1, 2):
        os.kill(sidecar.app_pid(ring[restores]), signal.SIGKILL)
        for member in ring:
            sidecar.wait_restores(member, restores)
    had = [len(member.logs().splitlines()) for member in ring]
    wait_until(lambda: all(len(each.logs().splitlines()) > n + 5 for each, n in zip(ring, had)), 10, "all go on")
    assert [line for member in ring for line in member.logs().splitlines() if "WRONG" in line] == []
