# SPDX-License-Identifier: Apache-2.0
"""`python -m bench.cores`: what `avckpt.core=on` costs restores.

Two processes with --mb of memory are killed in turns, one with a core file and one without, each after a checkpoint
for which it has a spare, and when no core is being written.  Under a sidecar of this checkout, without Podman.
Needs root; takes some minutes.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path

from testkit.harness import wait_until
from testkit.local_sidecar import QUICK, Container, LocalSidecar, local_sidecar

VICTIM = """
import sys, time
memory = bytearray(bytes(range(256)) * (int(sys.argv[1]) * 3907))
while True:
    memory[::1_000_000] = bytes(len(memory[::1_000_000]))
    time.sleep(0.01)
"""
PATIENCE_S = 60.0
SPARE_S = 0.7
"""After a checkpoint there is a spare."""


def kill(sidecar: LocalSidecar, victim: Container, with_core: bool) -> tuple[float, float]:
    """Its restore and, 0 without one, its core; s."""
    restored, cores = (len(sidecar.events(victim.name, kind)) for kind in ("restored", "core"))
    checkpoints = sidecar.row(victim)["checkpoints"]
    wait_until(lambda: sidecar.row(victim)["checkpoints"] > checkpoints, PATIENCE_S, "a checkpoint", every_s=0.1)
    time.sleep(SPARE_S)
    os.kill(victim.app_pid, signal.SIGKILL)
    wait_until(lambda: len(sidecar.events(victim.name, "restored")) > restored, PATIENCE_S, "restored", every_s=0.2)
    if with_core:
        wait_until(lambda: len(sidecar.events(victim.name, "core")) > cores, PATIENCE_S, "a core", every_s=0.2)
        event = sidecar.events(victim.name, "core")[-1]
        if "core" not in event:
            raise RuntimeError(event["detail"])
        Path(event["core"]).unlink()
    restore_s: float = sidecar.events(victim.name, "restored")[-1]["restore_s"]
    return restore_s, float(event["detail"].partition("after ")[2].partition(" s")[0]) if with_core else 0.0


def main() -> None:
    """Measures, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mb", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, local_sidecar(Path(folder)) as sidecar:
        sidecar.start()
        command = [sys.executable, "-c", VICTIM, str(options.mb)]
        labels = {**QUICK, "avckpt.interval": "3s", "avckpt.restore.max": "64/1s"}
        modes = ("off", "on")
        victims = {each: sidecar.protected(each, command, {**labels, "avckpt.core": each}) for each in modes}
        for victim in victims.values():
            sidecar.wait_for(victim, timeout_s=PATIENCE_S, state="protected", generations=2)
        restores: dict[str, list[float]] = {each: [] for each in modes}
        cores = []
        for run in range(options.runs):
            for mode in modes if run % 2 else modes[::-1]:
                restore_s, core_s = kill(sidecar, victims[mode], mode == "on")
                restores[mode].append(restore_s * 1000)
                cores += [core_s] if mode == "on" else []
    print(f"restores of {options.mb} MB, ms, {options.runs} each; load {os.getloadavg()[0]:.1f}")
    for mode, times in restores.items():
        low, median, high = min(times), statistics.median(times), max(times)
        print(f"avckpt.core={mode:3}  median {median:.2f}  from {low:.2f} to {high:.2f}")
    print(f"a core is written after {statistics.median(cores):.2f} s (median)")


if __name__ == "__main__":
    main()
