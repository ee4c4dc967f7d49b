# SPDX-License-Identifier: Apache-2.0
"""How long stress-ng's `clone` takes with checkpoints every 50 ms, and without.

    .venv/bin/python -m bench.clones [--ops 300] [--turns 5]

In turns.  Prints medians in s, and their ratios: of the time that stress-ng tells, and of the CPU
time of all processes of the container, templates and what ends them included, which other load
hardly changes.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import resource
import statistics
import subprocess
import tempfile
from pathlib import Path

from bench.subjects import BenchFailed
from testkit.guarded import GuardProcess, config
from testkit.init_peer import Init

PATIENCE_S = 300


def cpu_s() -> float:
    """Of all children that have been waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_s(ops: int, guarded: bool, folder: Path) -> tuple[float, float]:
    """One run: its duration, and the CPU time."""
    said = folder / "said"
    command = ["stress-ng", "--clone", "1", "--clone-ops", str(ops), "--verify", "--temp-path", str(folder)]
    with contextlib.ExitStack() as stack:
        output = stack.enter_context(said.open("wb"))
        init = stack.enter_context(Init(command, pid1=True, stdout=output.fileno(), stderr=subprocess.STDOUT))
        if guarded:
            stack.enter_context(GuardProcess(config(0.05), [init.pid]))
        before = cpu_s()
        status = init.popen.wait(timeout=PATIENCE_S)
        used = cpu_s() - before
    took = re.search(r"completed in ([0-9.]+)(?:s| secs)", said.read_text())
    if status or not took:
        raise BenchFailed(f"stress-ng ended with {status}: {said.read_text()}")
    return float(took[1]), used


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ops", type=int, default=300, help="%(default)s")
    parser.add_argument("--turns", type=int, default=5, help="%(default)s")
    asked = parser.parse_args()
    runs: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(asked.turns):
            for guarded in (False, True):
                runs[guarded].append(run_s(asked.ops, guarded, Path(folder)))
    for i, what in enumerate(("duration", "CPU time")):
        plain, protected = (statistics.median(run[i] for run in runs[guarded]) for guarded in (False, True))
        print(f"{what}: without {plain:.2f} s, with {protected:.2f} s: {protected / plain:.2f}")
    print(runs)


if __name__ == "__main__":
    main()
