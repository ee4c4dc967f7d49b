# SPDX-License-Identifier: Apache-2.0
"""memory.oom.group=1 (cgroup v2): the kernel would kill the container as a whole, avckpt-init as well."""

from __future__ import annotations

from pathlib import Path

import pytest
from avckpt.containers.cgroup import groups_of

from testkit.harness import SLOWNESS, Container, ContainerFactory, Sidecar, wait_until

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
ONE_OF_TWO_LEAKS = f"""
import os, time
if os.fork() == 0:
    exec({LEAK!r})
while True:
    time.sleep(0.05)
"""
OPTIONS = ("--memory=120m", "--memory-swap=120m", "--network=none")
GROUP = "--cgroup-conf=memory.oom.group=1"


def group_of(container: Container) -> str:
    """What the kernel goes by now."""
    memory = groups_of(container.pid).memory
    assert memory is not None
    return (memory / "memory.oom.group").read_text().strip()


@pytest.mark.parametrize("options", [OPTIONS, (*OPTIONS, GROUP)], ids=["0", "1"])
def test_one_that_leaks_is_restored(options: tuple[str, ...], sidecar: Sidecar, container: ContainerFactory) -> None:
    """It leaks on, and is restored as often as it may be."""
    one = container.protected("python3", "-uc", LEAK, labels={"interval": "200ms"}, options=options)
    sidecar.wait_restores(one, 1, 60 * SLOWNESS)


def test_all_go_back_when_one_was_killed(sidecar: Sidecar, container: ContainerFactory) -> None:
    """The one that was not, too."""
    one = container.protected(
        "python3", "-uc", ONE_OF_TWO_LEAKS, labels={"interval": "200ms"}, options=(*OPTIONS, GROUP)
    )
    sidecar.wait_restores(one, 1, 60 * SLOWNESS)


def test_without_a_sidecar_it_is_as_before(sidecar: Sidecar, container: ContainerFactory) -> None:
    """One that was killed leaves a note for the next one."""
    one = container.protected("sleep", "infinity", options=(*OPTIONS, GROUP))
    sidecar.wait_generation(one, 1, 60 * SLOWNESS)
    assert group_of(one) == "0"
    sidecar.kill()
    sidecar.stop()
    sidecar.start()
    sidecar.wait_generation(one, 1, 60 * SLOWNESS)
    assert group_of(one) == "0"
    sidecar.stop()
    wait_until(lambda: group_of(one) == "1", 20 * SLOWNESS, "memory.oom.group is 1 again")
