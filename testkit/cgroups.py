# SPDX-License-Identifier: Apache-2.0
"""Control groups in which nobody runs for as long as a test wants."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

import pytest

from testkit.harness import wait_until


class Cgroup:
    """One of a hierarchy that is there, with a knob to keep what is in it from running."""

    def __init__(self, roots: Sequence[str], knob: str, go: str, wait: str) -> None:
        found = [
            Path("/sys/fs/cgroup", root) for root in roots if Path("/sys/fs/cgroup", root, "cgroup.procs").exists()
        ]
        if not found:
            pytest.skip(f"no cgroups with {knob} here")
        self._folder = found[0] / f"avckpt-test-{os.getpid()}"
        self._knob, self._go, self._wait = knob, go, wait

    def __enter__(self) -> Cgroup:
        self._folder.mkdir()
        if not (self._folder / self._knob).exists():
            self._folder.rmdir()
            pytest.skip(f"no {self._knob} in {self._folder}")
        return self

    def __exit__(self, *_: object) -> None:
        self.go()
        wait_until(self._removed, 5, "the cgroup is empty")

    def _removed(self) -> bool:
        with contextlib.suppress(OSError):
            self._folder.rmdir()
        return not self._folder.exists()

    def take(self, pid: int) -> None:
        (self._folder / "cgroup.procs").write_text(str(pid))

    def wait(self) -> None:
        (self._folder / self._knob).write_text(self._wait)

    def go(self) -> None:
        (self._folder / self._knob).write_text(self._go)


def freezer(version: int) -> Cgroup:
    """As `podman pause` uses it: cgroups(7), freezer; or cgroup.freeze of version 2."""
    if version == 1:
        return Cgroup(["freezer"], "freezer.state", go="THAWED", wait="FROZEN")
    return Cgroup(["", "unified"], "cgroup.freeze", go="0", wait="1")


class MemoryGroup:
    """A group with a limit for memory; what is started with `preexec=group.enter` is in it.  A context manager."""

    def __init__(self, limit_bytes: int) -> None:
        roots = [Path("/sys/fs/cgroup/memory"), Path("/sys/fs/cgroup")]
        knobs = ["memory.limit_in_bytes", "memory.max"]
        self._folder = Path()
        self._limit_bytes = limit_bytes
        for root, knob in zip(roots, knobs):
            folder = root / f"avckpt-test-{os.getpid()}"
            with contextlib.suppress(OSError):
                folder.mkdir()
            if (folder / knob).exists():
                self._folder, self._knob = folder, knob
                self.limit(limit_bytes)
                return
            with contextlib.suppress(OSError):
                folder.rmdir()
        pytest.skip("no control group with a limit for memory can be made here")

    def __enter__(self) -> MemoryGroup:
        return self

    def __exit__(self, *_: object) -> None:
        wait_until(self._removed, 10, "the cgroup is empty")

    def limit(self, limit_bytes: int) -> None:
        """From now on."""
        (self._folder / self._knob).write_text(str(limit_bytes))

    def enter(self) -> None:
        """This process, from now on."""
        (self._folder / "cgroup.procs").write_text(str(os.getpid()))

    def _removed(self) -> bool:
        with contextlib.suppress(OSError):
            self._folder.rmdir()
        return not self._folder.exists()


def throttle() -> Cgroup:
    """Leaves a hundredth of a CPU, as `podman run --cpus=0.01` does."""
    if Path("/sys/fs/cgroup/cpu/cpu.cfs_quota_us").exists():
        return Cgroup(["cpu"], "cpu.cfs_quota_us", go="-1", wait="1000")
    return Cgroup([""], "cpu.max", go="max", wait="1000")
