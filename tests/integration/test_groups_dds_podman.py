# SPDX-License-Identifier: Apache-2.0
"""Two DDS nodes in Podman containers that go back together: neither ignores what the other sends again."""

from __future__ import annotations

import os
import re
import signal
import struct
from itertools import pairwise
from pathlib import Path

import pytest

from testkit.harness import SLOWNESS, Container, ContainerFactory, Podman, Sidecar, wait_until

IMAGE = "localhost/avckpt-ros2:latest"
RECORD = struct.Struct("<4Q")
NODE = "/opt/ros2/build/dds_node"
RESTORES = 3

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; members wait for each other for 50 ms"
)


def heard(log: Path) -> list[int]:
    """The count of each message that was heard, also of those that the hearer has forgotten since."""
    data = log.read_bytes() if log.exists() else b""
    return [record[1] for record in RECORD.iter_unpack(data[: len(data) // RECORD.size * RECORD.size])]


def test_a_dds_pair_goes_on_where_its_line_was(
    sidecar: Sidecar, container: ContainerFactory, podman: Podman, tmp_path: Path
) -> None:
    if podman.run("image", "exists", IMAGE, check=False).status != 0:
        pytest.skip("no image with CycloneDDS here: scripts/setup-ros2.sh builds it")
    labels = {"interval": "2s", "restore.max": "60/60s", "group": f"dds-{os.getpid()}", "group.recovery": "together"}
    domain = os.getpid() % 200
    uri = f'CYCLONEDDS_URI=<CycloneDDS><Domain Id="{domain}"/></CycloneDDS>'
    options = ("--env", uri, "--volume", f"{tmp_path}:/log")
    # Slow, because ten messages are kept for a reader that gets no CPU.
    command = (NODE, "--rate", "20", "--log")
    node = container.protected(*command, "/log/node", labels=labels, options=options, image=IMAGE)
    turned = ("--in", "from_node", "--out", "to_node")
    peer = container.protected(*command, "/log/peer", *turned, labels=labels, options=options, image=IMAGE)
    logs = tmp_path / "node", tmp_path / "peer"

    def line(member: Container) -> int:
        return int((sidecar.find(member) or {}).get("line") or 0)

    def wait_heard(more: int) -> None:
        had = [len(heard(log)) for log in logs]
        wait_until(
            lambda: all(len(heard(log)) >= n + more for log, n in zip(logs, had)),
            60 * SLOWNESS,
            f"{more} more messages are heard",
        )

    def wait_line() -> None:
        before = line(node)
        wait_until(lambda: min(line(node), line(peer)) > before, 30 * SLOWNESS, "a new line of both")

    wait_heard(10)
    for restores in range(1, RESTORES + 1):
        wait_line()
        wait_heard(10)
        os.kill(sidecar.app_pid((node, peer)[restores % 2]), signal.SIGKILL)
        for member in (node, peer):
            sidecar.wait_restores(member, restores)
        wait_heard(10)
    for log in logs:
        # Another line may have been taken just before a kill.
        counts = heard(log)
        assert any(later <= earlier for earlier, later in pairwise(counts)), counts
    # What comes is the next one after the last one that each remembers.
    assert [each for member in (node, peer) for each in re.findall("after .* came .*", member.logs())] == []
