# SPDX-License-Identifier: Apache-2.0
"""Devices of a vehicle after a restore: a CAN bus, a camera, an input device.

make test-kernels KERNELS=trixie KERNEL_TESTS=tests/native/test_fidelity_devices.py
"""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.devices import load_driver
from testkit.guarded import WHERE, GuardProcess, Victim, config
from testkit.scenario import checkpoint, disturb, disturb_and_restore, restored

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; a bus and a camera go on meanwhile"
)


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["can", "buses"])
@pytest.mark.usefixtures("bus")
def test_a_bus(scenario: str, where: str, tmp_path: Path) -> None:
    """CAN sockets receive what they had subscribed to, closed ones included; cyclic messages go on."""
    with (
        Victim(f"devices {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


@pytest.mark.usefixtures("bus")
def test_what_was_said_in_a_cycle_is_lost_with_its_socket(tmp_path: Path) -> None:
    with Victim(f"devices cycle {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        assert "cannot be made again" in restored(victim, guard)["error"]["detail"]


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["camera", "holding", "stopped", "unused", "again"])
@pytest.mark.usefixtures("camera")
def test_a_camera(scenario: str, where: str, tmp_path: Path) -> None:
    """It keeps filming into all of its buffers, also when it dies while it holds one."""
    with (
        Victim(f"devices {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(("scenario", "what"), [("changed", "its buffers have changed"), ("left", "opened anew")])
@pytest.mark.usefixtures("camera")
def test_a_camera_that_is_not_as_it_was_is_told(scenario: str, what: str, where: str, tmp_path: Path) -> None:
    """This is reported, and its mapped buffers can still be read."""
    with (
        Victim(f"devices {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        disturb(victim)
        assert what in restored(victim, guard)["error"]["detail"]


@pytest.mark.usefixtures("camera")
def test_a_camera_that_fills_the_programs_memory_is_refused(tmp_path: Path) -> None:
    """A restored program's memory is not the memory that the driver fills."""
    with (
        Victim(f"devices own {tmp_path}", tmp_path) as victim,
        GuardProcess(config(0.02), [victim.pid]) as guard,
    ):
        told = guard.wait("unprotected")
        assert told["error"]["kind"] == "unsupported"
        assert "V4L2_MEMORY_USERPTR" in told["error"]["message"]
        victim.wait_beats(20)


@pytest.mark.parametrize("where", WHERE)
def test_an_input_device(where: str, tmp_path: Path) -> None:
    load_driver("uinput")
    with (
        Victim(f"devices input {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)
