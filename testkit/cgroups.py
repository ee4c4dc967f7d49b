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
