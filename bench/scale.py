# SPDX-License-Identifier: Apache-2.0
"""What many small protected containers cost: CPU and memory of sidecar and guards, missed checkpoints.

    .venv/bin/python -m bench.scale [--containers 100] [--seconds 60] [--interval 3s]

Needs root, Podman and what `make setup` builds.  Takes the machine's sidecar
and hooks for itself, as the tests do, and removes every container it starts.
Prints a table and writes bench/results/scale.json.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil
from avckpt.supervision.pressure import held_bytes, templates_of

from testkit.harness import ROOT, SIDECAR_NAME, ContainerFactory, Podman, Sidecar, machine_lock, running_sidecar

VICTIMS = ROOT / "tests/victims/build-static"
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass
class Result:
    """One measurement; CPU in per cent of one core."""

    containers: int
    interval: str
    seconds: float
    sidecar_cpu_percent: float
    guards_cpu_percent: float
    """Of all guard processes together, kernel's work for them included."""
    machine_cpu_percent: float
    """Of all cores, everything on the machine included."""
    idle_machine_cpu_percent: float
    """The same just before, with the same containers and no sidecar: what the containers themselves cost."""
    sidecar_pss_mb: float
    guards_pss_mb: float
    generations_mb: float
    """Held by all templates and not used by the applications."""
    checkpoints: int
    missed: int
    late: int
    """Containers whose last checkpoint was older than an interval and a half."""
    freeze_median_ms: float
    freeze_max_ms: float
    start_median_s: float


def main() -> None:
    """Starts, waits, measures, removes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--containers", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--interval", default="3s")
    options = parser.parse_args()
    subprocess.run(["make", "-s", "-C", str(VICTIMS.parent), "STATIC=1"], check=True)
    podman = Podman()
    factory = ContainerFactory(podman, f"avckpt-scale-{os.getpid()}")
    with machine_lock(timeout_s=600), running_sidecar(podman) as sidecar:
        try:
            result = measure(sidecar, factory, options)
        finally:
            factory.close()
    show(result)
    path = ROOT / "bench/results/scale.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(asdict(result), indent=1) + "\n")


def measure(sidecar: Sidecar, factory: ContainerFactory, options: argparse.Namespace) -> Result:
    took_s = []
    for n in range(options.containers):
        before = time.monotonic()
        factory.protected(
            *("/victims/idle", "1", "1", "--beat-us", "100000"),
            labels={"interval": options.interval},
            options=["--network", "host", "--volume", f"{VICTIMS}:/victims:ro"],
        )
        took_s.append(time.monotonic() - before)
        print(f"\r{n + 1} of {options.containers} containers started", end="", flush=True)
    print(f"; measuring for {2 * options.seconds:g} s")
    sidecar.stop()
    time.sleep(2)
    busy = machine_cpu_s()
    time.sleep(options.seconds)
    idle_percent = 100 * (machine_cpu_s() - busy) / options.seconds / (os.cpu_count() or 1)
    sidecar.start()
    wait_protected(sidecar, options.containers)
    pid = int(factory.podman.inspect(SIDECAR_NAME)["State"]["Pid"])
    rows = sidecar.ps()
    sidecar_processes, guards = processes(pid)
    cpu, guards_cpu, busy, started = cpu_s(sidecar_processes), cpu_s(guards), machine_cpu_s(), time.monotonic()
    time.sleep(options.seconds)
    took = time.monotonic() - started
    cpu, guards_cpu, busy = cpu_s(sidecar_processes) - cpu, cpu_s(guards) - guards_cpu, machine_cpu_s() - busy
    after, now = sidecar.ps(), time.time()
    freezes = [row["last_freeze_s"] * 1000 for row in after]
    return Result(
        containers=len(after),
        interval=options.interval,
        seconds=round(took, 1),
        sidecar_cpu_percent=round(100 * cpu / took, 2),
        guards_cpu_percent=round(100 * guards_cpu / took, 2),
        machine_cpu_percent=round(100 * busy / took / (os.cpu_count() or 1), 1),
        idle_machine_cpu_percent=round(idle_percent, 1),
        sidecar_pss_mb=pss_mb(sidecar_processes),
        guards_pss_mb=pss_mb(guards),
        generations_mb=round(sum(held_bytes(r["app_pid"], templates_of(r["init_pid"])) for r in after) / 1e6, 1),
        checkpoints=total(after, "checkpoints") - total(rows, "checkpoints"),
        missed=total(after, "missed") - total(rows, "missed"),
        late=sum(now - row["last_checkpoint_at"] > 1.5 * row["interval_s"] for row in after),
        freeze_median_ms=round(statistics.median(freezes), 3),
        freeze_max_ms=round(max(freezes), 3),
        start_median_s=round(statistics.median(took_s), 2),
    )


def wait_protected(sidecar: Sidecar, count: int, timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while sum(row["generations"] == row["keep"] for row in sidecar.ps()) < count:
        if time.monotonic() > deadline:
            raise TimeoutError(f"not all of {count} containers hold their generations after {timeout_s:g} s")
        time.sleep(0.5)


def total(rows: list[dict[str, Any]], key: str) -> int:
    return sum(row[key] for row in rows)


def processes(main_pid: int) -> tuple[list[psutil.Process], list[psutil.Process]]:
    """The sidecar's own processes, and its guards."""
    main = psutil.Process(main_pid)
    below = main.children(recursive=True)
    guards = [process for process in below if process.name() == "avckpt-guard"]
    return [main, *(process for process in below if process not in guards)], guards


def cpu_s(of: list[psutil.Process]) -> float:
    """CPU time of all their threads."""
    return sum(times.user + times.system for times in (process.cpu_times() for process in of))


def pss_mb(of: list[psutil.Process]) -> float:
    """What they share with others is counted in proportion."""
    return round(sum(process.memory_full_info().pss for process in of) / 1e6, 1)


def machine_cpu_s() -> float:
    """CPU time of everything but idling, all cores."""
    user, nice, system, _, _, irq, softirq, *_ = map(int, Path("/proc/stat").read_text().split("\n")[0].split()[1:])
    return (user + nice + system + irq + softirq) / TICKS_PER_S


def show(result: Result) -> None:
    for key, value in asdict(result).items():
        print(f"{key.replace('_', ' '):<28} {value}")


if __name__ == "__main__":
    main()
