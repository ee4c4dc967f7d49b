# SPDX-License-Identifier: Apache-2.0
"""Makes the kernel say that tasks wait for memory, at the cost of nobody else.

Writers in a control group of 16 MB dirty pages faster than the disk takes them,
so that they stand still for memory most of the time: /proc/pressure/memory has
"some" at about 70 %.  The rest of the machine has all the memory it had: to the
sidecar it is short of it only if told so (SHORT).
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.harness import ROOT

LIMIT_BYTES = 16 << 20
WRITERS = 2
SPAN_BYTES = 64 << 20
WRITER = f"""
import os, sys
with open(sys.argv[1], "w") as group:
    group.write(str(os.getpid()))
fd, block, at = os.open(sys.argv[2], os.O_RDWR), bytes(65536), 0
while True:
    os.pwrite(fd, block, at)
    at = (at + len(block)) % {SPAN_BYTES}
"""

SHORT = [
    *(sys.executable, "-c"),
    "from avckpt.supervision import pressure; pressure.AVAILABLE_STALLED = 1.1; import avckpt.__main__ as a; a.main()",
]
"""`avckpt`, for which a host with less than 110 % of its memory available is short of it when tasks wait."""


@contextlib.contextmanager
def pressure() -> Iterator[None]:
    """As long as the block runs.  Skips the test where no such control group can be made."""
    if not Path("/proc/pressure/memory").exists():
        pytest.skip("this kernel has no PSI")
    group = make_group()
    # Not in /tmp, which may be memory itself.
    folder = ROOT / "build"
    folder.mkdir(exist_ok=True)
    with contextlib.ExitStack() as undo:
        undo.callback(remove_group, group)
        for _ in range(WRITERS):
            file = undo.enter_context(tempfile.NamedTemporaryFile(dir=folder))
            writer = subprocess.Popen([sys.executable, "-c", WRITER, str(group / "cgroup.procs"), file.name])
            undo.callback(end, writer)
        yield


def stalled_s() -> float:
    """For how long, since the machine was started, at least one task has waited for memory."""
    return int(Path("/proc/pressure/memory").read_text().split("total=")[1].split()[0]) / 1e6


def make_group() -> Path:
    """A control group that may have next to no memory."""
    first, second = Path("/sys/fs/cgroup/memory"), Path("/sys/fs/cgroup")
    version_1 = (first / "memory.limit_in_bytes").exists()
    group = (first if version_1 else second) / f"avckpt-test-{os.getpid()}"
    try:
        group.mkdir()
    except OSError as error:
        pytest.skip(f"{group} cannot be made: {error.strerror}")
    # Version 2 lets who is above `high` wait, which is what is wanted.
    limit = group / ("memory.limit_in_bytes" if version_1 else "memory.high")
    try:
        limit.write_text(str(LIMIT_BYTES))
    except OSError as error:
        group.rmdir()
        pytest.skip(f"{limit} cannot be set: {error.strerror}")
    return group


def remove_group(group: Path) -> None:
    """Once the kernel has let go of its last process."""
    deadline = time.monotonic() + 10
    while True:
        try:
            group.rmdir()
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)
        else:
            return


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
