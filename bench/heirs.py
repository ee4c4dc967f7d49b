# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of many processes that have their descriptors from their parent.

    .venv/bin/python -m bench.heirs [--sizes 20/400,60/400,100/400] [--checkpoints 20]

tests/victims/heirs.c: so many children, and so many socket pairs, which all of them have.  Prints
what it takes from the guard's start to the first checkpoint, how long those that follow stop the
application (median and longest), and what each takes altogether, most of it while that runs.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from bench.subjects import build
from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import wait_until


def measure(size: str, checkpoints: int, folder: Path) -> tuple[float, list[float], list[float]]:
    """Until the first (s); stops (ms) and durations (s) of the others."""
    freezes: list[float] = []
    takes: list[float] = []
    with Victim(f"heirs {size} {folder}", folder) as victim:
        since = time.monotonic()
        with GuardProcess(config(), [victim.pid]) as guard:
            wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 60, "a checkpoint", 0.001)
            first = time.monotonic() - since
            while len(freezes) < checkpoints:
                since = time.monotonic()
                answer = guard.command("checkpoint")
                if answer["kind"] == "checkpoint":
                    takes.append(time.monotonic() - since)
                    freezes.append(1000 * answer["freeze_s"])
    return first, freezes, takes


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", default="20/400,60/400,100/400", help="%(default)s")
    parser.add_argument("--checkpoints", type=int, default=20, help="%(default)s")
    asked = parser.parse_args()
    build()
    print("children/pairs  first s  freeze ms: median  longest  each s")
    for size in asked.sizes.split(","):
        with tempfile.TemporaryDirectory() as folder:
            first, freezes, takes = measure(size, asked.checkpoints, Path(folder))
        print(
            f"{size:14}  {first:7.2f}  {statistics.median(freezes):17.1f}  {max(freezes):7.1f}"
            f"  {statistics.median(takes):6.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
