# SPDX-License-Identifier: Apache-2.0
"""`avckpt.interval=auto` in many busy containers: what their guards take of the CPUs, alone and together.

    .venv/bin/python -m bench.shares [--counts 1,5,20] [--seconds 20] [--totals 25%,9999%]

Each is a program that computes for a tenth of a millisecond and sends a message, 50 times a second, under an
avckpt-init of its own and a sidecar daemon without Podman. Needs root and what `make setup-build` builds.
Prints a table and writes bench/results/shares.json. With `--idle` each is one that wakes up ten times a second and
does nothing, and the table is only printed, at avckpt.interval=auto and 3s in turns.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

from bench.scale import cpu_s
from testkit.harness import ROOT, wait_until
from testkit.local_sidecar import local_sidecar

RESULTS = ROOT / "bench" / "results" / "shares.json"
SETTLE_S = 8.0
SENDER = """
import socket, time
to = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
to.bind(("127.0.0.1", 0))
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
while True:
    until = time.monotonic() + 1e-4
    while time.monotonic() < until:
        pass
    out.sendto(b"x", to.getsockname())
    to.recv(64)
    time.sleep(0.02)
"""

BUSY = (sys.executable, "-S", "-c", SENDER)
IDLE = (sys.executable, "-S", "-c", "import time\nwhile True: time.sleep(0.1)")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--counts", default="1,5,20")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--totals", default="25%,9999%")
    parser.add_argument("--idle", action="store_true")
    options = parser.parse_args()
    counts = [int(count) for count in options.counts.split(",")]
    if options.idle:
        for count in counts:
            for interval in ("auto", "3s", "auto", "3s"):
                measure(count, "25%", options.seconds, interval, IDLE)
        return
    rows = [measure(count, total, options.seconds) for count in counts for total in options.totals.split(",")]
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


def measure(
    count: int, total: str, seconds: float, interval: str = "auto", command: Sequence[str] = BUSY
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as directory, local_sidecar(Path(directory)) as sidecar:
        sidecar.config.write_text(f"sidecar: {{budget.cpu: {total}}}\n")
        sidecar.start()
        labels = {"avckpt.enable": "true", "avckpt.interval": interval}
        for n in range(count):
            sidecar.protected(f"c{n}", command, labels)
        wait_until(lambda: all(row["state"] == "protected" for row in sidecar.ps()), 60, "all are protected")
        time.sleep(SETTLE_S)
        before, began = sidecar.ps(), time.monotonic()
        guards = [psutil.Process(row["guard_pid"]) for row in before]
        cpu = cpu_s(guards)
        time.sleep(seconds)
        took = time.monotonic() - began
        used = cpu_s(guards) - cpu
        after = sidecar.ps()
        taken = sum(row["checkpoints"] for row in after) - sum(row["checkpoints"] for row in before)
        row = {
            "containers": count,
            "interval": interval,
            "total": total,
            "guards_cpu_percent": round(100 * used / took, 1),
            "checkpoints_per_s": round(taken / took, 1),
            "interval_ms": round(1000 * statistics.median(each["interval_s"] for each in after)),
            "load": round(os.getloadavg()[0], 1),
        }
        print(row, flush=True)
        return row


if __name__ == "__main__":
    main()
