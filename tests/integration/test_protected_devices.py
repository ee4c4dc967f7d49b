# SPDX-License-Identifier: Apache-2.0
"""Protected containers with devices of a vehicle: a CAN bus, a camera.

make test-kernels KERNELS=trixie KERNEL_TESTS=tests/integration/test_protected_devices.py
"""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from testkit.harness import ContainerFactory, Sidecar, take_checkpoint
from testkit.protected import QUICK, ProtectedVictim, start_victim
from testkit.scenario import disturb_app

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; a bus and a camera go on meanwhile"
)

KILLS = 6


def crash_while_in_use(sidecar: Sidecar, victim: ProtectedVictim) -> None:
    """After each restore the program checks its device, and no loss is reported."""
    take_checkpoint(sidecar.client, victim.container.name)
    for n in range(1, KILLS + 1):
        disturb_app(victim.app, victim.see)
        entry = victim.kill(signal.SIGKILL)
        assert (entry["state"], entry["restores"]) == ("protected", n)
    assert [event.get("error") for event in victim.events("restored")] == [None] * KILLS


ON_COMMAND = {**QUICK, "interval": "1h"}


@pytest.mark.usefixtures("camera")
def test_a_camera(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    options = ["--device=/dev/video0", "--cap-drop=all"]
    victim = start_victim(
        sidecar, container, tmp_path, "devices camera /board", labels=ON_COMMAND, options=options, generation=0
    )
    crash_while_in_use(sidecar, victim)


@pytest.mark.parametrize("scenario", ["can", "buses"])
@pytest.mark.usefixtures("bus")
def test_a_bus(scenario: str, sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    options = ["--network=host", "--cap-drop=all"]
    victim = start_victim(
        sidecar, container, tmp_path, f"devices {scenario} /board", labels=ON_COMMAND, options=options, generation=0
    )
    crash_while_in_use(sidecar, victim)
