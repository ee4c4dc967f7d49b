# SPDX-License-Identifier: Apache-2.0
"""Devices as a vehicle has them, made of drivers that need no hardware."""

from __future__ import annotations

import contextlib
import fcntl
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

LOCK = Path("/run/lock/avckpt-test-devices.lock")


def load_driver(name: str, *options: str) -> None:
    """Skips the test where there is none: kernels of servers and clouds have few; that of Debian 13 has them all."""
    if not shutil.which("modprobe") or subprocess.run(["modprobe", name, *options], check=False).returncode:
        pytest.skip(f"this kernel has no driver {name}")


@contextlib.contextmanager
def device_lock() -> Iterator[None]:
    """The machine has one of each, and another run of pytest may have it for a moment."""
    with LOCK.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextlib.contextmanager
def can_bus() -> Iterator[None]:
    """An interface that loops back, for CAN and CAN FD."""
    load_driver("vcan")
    load_driver("can-isotp")
    with device_lock():
        subprocess.run(["ip", "link", "add", "avckpt-can", "type", "vcan"], check=True)
        try:
            subprocess.run(["ip", "link", "set", "avckpt-can", "mtu", "72", "up"], check=True)
            yield
        finally:
            subprocess.run(["ip", "link", "del", "avckpt-can"], check=True)


@contextlib.contextmanager
def video_camera() -> Iterator[None]:
    """/dev/video0, which films a test pattern."""
    with device_lock():
        load_driver("vivid", "n_devs=1", "node_types=0x1")
        subprocess.run(["udevadm", "settle"], check=False)
        yield
        subprocess.run(["modprobe", "-r", "vivid"], check=True)
