# SPDX-License-Identifier: Apache-2.0
"""Measuring on a machine that others use: a CPU control group with priority.

Niceness is not enough: it only counts within a session (autogroups) or a control
group.  Works where Podman manages cgroups v1; elsewhere measure on a quiet
machine.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

from bench.subjects import BenchFailed

CONTROLLERS = Path("/sys/fs/cgroup")
NAME = "avckpt-bench"
SHARES = 262144
"""The most there is; every other group has 1024."""
RT_RUNTIME_US = 940_000
"""avckpt's guard is a real-time thread while something is stopped.  A new group has none of it."""


REAL_TIME = ("chrt", "--fifo", "1")
"""In front of a program of which the slowest thousandth counts: that is more than a share can give it."""


def join(pid: int) -> None:
    """Moves a process with all its threads into the group.  Raises OSError."""
    (CONTROLLERS / "cpu" / NAME / "cgroup.procs").write_text(str(pid))


@contextlib.contextmanager
def first_in_line() -> Iterator[list[str]]:
    """This process and all it starts, in the group; yields the options that put a container there.

    Raises BenchFailed.
    """
    cpu = CONTROLLERS / "cpu"
    if not (cpu / "cpu.shares").exists():
        raise BenchFailed(f"--first needs cgroup v1's cpu controller in {cpu}")
    (cpu / NAME).mkdir(exist_ok=True)
    (cpu / NAME / "cpu.shares").write_text(str(SHARES))
    if (cpu / NAME / "cpu.rt_runtime_us").exists():
        (cpu / NAME / "cpu.rt_runtime_us").write_text(str(RT_RUNTIME_US))
    join(os.getpid())
    try:
        yield [f"--cgroup-parent={NAME}"]
    finally:
        (cpu / "cgroup.procs").write_text(str(os.getpid()))
        _remove()


def _remove() -> None:
    """Podman has made the group in every controller."""
    # What was killed last may not be gone yet.
    time.sleep(0.5)
    for group in CONTROLLERS.glob(f"*/{NAME}"):
        for below in sorted(group.glob("**/"), reverse=True):
            with contextlib.suppress(OSError):
                below.rmdir()
