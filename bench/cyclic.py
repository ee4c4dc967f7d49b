# SPDX-License-Identifier: Apache-2.0
"""What checkpoints add to the wake-ups of a real-time program: cyclictest, SCHED_FIFO, 1 kHz.

    .venv/bin/python -m bench.cyclic [--rounds 6] [--seconds 10] [--intervals none,3s,auto]

Unprotected and at each interval in turns. Of each run: cyclictest's histogram, the longest freeze that the guard has
reported, and by how much the latest wake-up was later than that.

Needs root, cyclictest (Debian: rt-tests) and what `make setup-build` builds. Prints a table and writes
bench/results/cyclic.json.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from testkit.guarded import GuardProcess, config
from testkit.harness import ROOT
from testkit.init_peer import Init

RESULTS = ROOT / "bench" / "results" / "cyclic.json"
MOST_US = 100_000
CONFIGS = {"3s": config(3.0), "100ms": config(0.1), "auto": config(3.0, interval_min_s=0.02, keep=3)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--seconds", type=int, default=10)
    parser.add_argument("--intervals", default="none,3s,auto")
    options = parser.parse_args()
    runs: dict[str, list[dict[str, Any]]] = {interval: [] for interval in options.intervals.split(",")}
    for _ in range(options.rounds):
        for interval, found in runs.items():
            found.append(measure(interval, options.seconds))
    rows = [row(interval, found) for interval, found in runs.items()]
    for each in rows:
        print(each)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


def measure(interval: str, seconds: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "histogram"
        command = ["cyclictest", "-t1", "-p80", "-i1000", "-m", "-q", f"-D{seconds}", f"-h{MOST_US}"]
        with contextlib.ExitStack() as stack:
            init = stack.enter_context(Init([*command, f"--histfile={path}"], pid1=True))
            guard = None
            if interval in CONFIGS:
                guard = stack.enter_context(GuardProcess(CONFIGS[interval], [init.pid]))
            time.sleep(seconds + 0.5)
            while not path.exists() or "# Max" not in path.read_text():
                if init.popen.poll() is not None:
                    raise SystemExit(f"cyclictest ended with {init.popen.returncode}; is rt-tests installed?")
                time.sleep(0.2)
            events = guard.events if guard is not None else []
        taken = [event for event in events if event.get("kind") == "checkpoint"]
        missed = [event for event in events if event.get("kind") == "missed"]
        freezes_s = [event["freeze_max_s"] for event in taken] + [event["freeze_s"] for event in missed]
        return {
            "histogram": histogram(path.read_text()),
            "freeze_max_us": max(freezes_s, default=0.0) * 1e6,
            "checkpoints": sum(event["checkpoints"] for event in taken),
            "missed": [f"{event['error']}" for event in missed],
        }


def histogram(text: str) -> Counter[int]:
    """Microseconds, and how many wake-ups were so late."""
    found: Counter[int] = Counter()
    for line in text.splitlines():
        if line and line[0].isdigit():
            late, count = line.split()[:2]
            found[int(late)] += int(count)
    overflow = next((line for line in text.splitlines() if line.startswith("# Histogram Overflows")), ": 0")
    found[MOST_US] += int(overflow.split(":")[1])
    return +found


def quantile(found: Counter[int], share: float) -> int:
    left = share * found.total()
    for late in sorted(found):
        left -= found[late]
        if left <= 0:
            return late
    return max(found)


def row(interval: str, runs: list[dict[str, Any]]) -> dict[str, Any]:
    together: Counter[int] = sum((run["histogram"] for run in runs), Counter())
    return {
        "interval": interval,
        "wakeups": together.total(),
        "checkpoints": sum(run["checkpoints"] for run in runs),
        "missed": [why for run in runs for why in run["missed"]],
        "p50_us": quantile(together, 0.5),
        "p999_us": quantile(together, 0.999),
        "max_us": max(together),
        "freeze_max_us": [round(run["freeze_max_us"]) for run in runs],
        "run_max_us": [max(run["histogram"]) for run in runs],
        "load": round(os.getloadavg()[0], 1),
    }


if __name__ == "__main__":
    main()
