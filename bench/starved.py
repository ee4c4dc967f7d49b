# SPDX-License-Identifier: Apache-2.0
"""Restores beside containers that take every CPU: what the CPU shares of the sidecar's container change.

    python -m bench.starved [--busy 20] [--shares 1024,4096,10240] [--rounds 1]

Sidecar and guards are in one control group, as in a container, with these shares; a protected program and each of
those that are busy in another, with 1024.  Needs root and version 1 of the controller cpu.  Prints a table.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from bench.cpu_group import CONTROLLERS, first_in_line
from testkit.harness import wait_until
from testkit.local_sidecar import local_sidecar

CPU = CONTROLLERS / "cpu"
SHARES = 1024
LABELS = {"avckpt.enable": "true", "avckpt.interval": "200ms", "avckpt.restore.max": "64/10s"}
PROGRAM = "import time\nwhile True: time.sleep(0.01); sum(range(2000))"
KILLS = 15
ALIVE_S = 0.6


@contextlib.contextmanager
def group(name: str, shares: int, *pids: int) -> Iterator[None]:
    """With these processes; what is left in it then goes back to the root."""
    folder = CPU / f"avckpt-starved-{name}"
    folder.mkdir()
    try:
        (folder / "cpu.shares").write_text(str(shares))
        for pid in pids:
            (folder / "cgroup.procs").write_text(str(pid))
        yield
    finally:
        for left in (folder / "cgroup.procs").read_text().split():
            with contextlib.suppress(OSError):
                (CPU / "cgroup.procs").write_text(left)
        wait_until(lambda: not (folder / "cgroup.procs").read_text(), 10, "all have left")
        folder.rmdir()


def measure(shares: int) -> str:
    """A row of the table."""
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        sidecar = stack.enter_context(local_sidecar(Path(folder)))
        sidecar.start()
        assert sidecar.process is not None
        stack.enter_context(group("sidecar", shares, sidecar.process.pid))
        program = sidecar.protected("program", [sys.executable, "-c", PROGRAM], LABELS)
        stack.enter_context(group("program", SHARES, program.init_pid, program.app_pid))
        sidecar.wait_for(program, 60, generations=2)
        for number in range(KILLS):
            time.sleep(ALIVE_S)
            os.kill(program.app_pid, signal.SIGKILL)
            wait_until(lambda: len(sidecar.events("program", "restored")) > number, 30, "it is restored")  # noqa: B023
        restored = sidecar.events("program", "restored")
    columns = [sorted(event[key] * 1000 for event in restored) for key in ("restore_s", "freeze_s")]
    figures = " | ".join(f"{statistics.median(each):.1f} | {each[-1]:.1f}" for each in columns)
    return f"| {shares} | {figures} |"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description="restores beside containers that take every CPU")
    parser.add_argument("--busy", type=int, default=20)
    parser.add_argument("--shares", default="1024,4096,10240")
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    print("| shares | restore, ms | longest | freeze, ms | longest |\n|---:|---:|---:|---:|---:|")
    with contextlib.ExitStack() as stack:
        stack.enter_context(first_in_line())  # this program only watches
        for number in range(options.busy):
            busy = stack.enter_context(subprocess.Popen(["sh", "-c", "while :; do :; done"], start_new_session=True))
            stack.enter_context(group(f"busy{number}", SHARES, busy.pid))
            stack.callback(busy.kill)
        for _ in range(options.rounds):
            for shares in options.shares.split(","):
                print(measure(int(shares)), flush=True)


if __name__ == "__main__":
    main()
