# SPDX-License-Identifier: Apache-2.0
"""memory.oom.group=1 (cgroup v2): the kernel kills the container as a whole, avckpt-init as well."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.harness import SLOWNESS, ContainerFactory, Sidecar, wait_until

pytestmark = [
    pytest.mark.skipif(not Path("/sys/fs/cgroup/cgroup.controllers").exists(), reason="no cgroup v2 here"),
    pytest.mark.shared_machine("the OOM killer needs a CPU"),
]

LEAK = """
import time
kept = []
while True:
    kept.append(bytearray(4 << 20))
    time.sleep(0.05)
"""


@pytest.mark.parametrize("group", [0, 1])
def test_who_dies(group: int, sidecar: Sidecar, container: ContainerFactory) -> None:
    """Of a process that leaks: restored with 0; with 1 the container ends, and nothing hangs."""
    options = ("--memory=120m", "--memory-swap=120m", f"--cgroup-conf=memory.oom.group={group}", "--network=none")
    one = container.protected("python3", "-uc", LEAK, labels={"interval": "200ms"}, options=options)
    if group:
        wait_until(lambda: one.status == "exited", 60 * SLOWNESS, "the container ends", every_s=0.5)
        assert one.exit_code == 137
        assert one.inspect()["State"]["OOMKilled"]
    else:
        # It leaks on, and is restored as often as it may be.
        sidecar.wait_restores(one, 1, 60 * SLOWNESS)
