# SPDX-License-Identifier: Apache-2.0
"""Freezes of applications that write all the time, by copies of written pages, beside a plain fork().

    .venv/bin/python -m bench.dirty [--cycles 40] [--restores 10] [--images auto]

A program with so much memory (tests/victims/dirt.c) writes pages at random, so many MB a second (a page counts as
4 kB, whatever is written in it).  Before each checkpoint bench/fork.c, with as much memory and one thread, times
one plain fork(), so that noise falls on both alike.  After them it is killed some times, 0.1 s after a
checkpoint and at once.  Writes bench/results/dirty.json.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

from avckpt.guard import Images
from rich.console import Console
from rich.table import Table

from bench.subjects import BenchFailed, Forker, build
from bench.trees import forks_ms
from testkit.family import kill_main
from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import ROOT

RESULTS = ROOT / "bench" / "results" / "dirty.json"
THREAD_MS = 0.03
PAUSE_S = 0.1
AGAIN = 8
WARM_UP = 6
PATIENCE_S = 60.0

console = Console(highlight=False, width=None if sys.stdout.isatty() else 132)


@dataclass(frozen=True)
class Case:
    """What is measured, and what the freeze may take: a part of a fork, and 30 us for each thread."""

    mb: int
    threads: int
    mb_per_s: float
    part: float
    processes: int = 1

    @property
    def command(self) -> str:
        if self.processes > 1:
            return f"prefork {self.processes - 1} {self.mb}"
        return f"dirt {self.mb} {self.threads} --rate {round(self.mb_per_s * 1000)}"


CASES = (
    Case(1000, 1, 4, 0.05),
    Case(1000, 20, 40, 0.10),
    Case(4000, 20, 40, 0.05),
    Case(100, 20, 40, 0.3),
    Case(200, 9, 0, 0.3, processes=9),
    Case(1000, 20, 200, 1.2),
)


@dataclass(frozen=True)
class Result:
    """Medians, in ms."""

    mb: int
    threads: int
    mb_per_s: float
    processes: int
    fork_ms: float
    freeze_ms: float
    freeze_p99_ms: float
    restore_ms: float
    restore_at_once_ms: float
    """Killed right after a checkpoint."""
    limit_ms: float
    images: dict[str, int]
    """How many were made how."""


def checkpoint(guard: GuardProcess) -> tuple[float, str]:
    """Freeze time in ms, and how it was made; tries again when one is missed."""
    for _ in range(20):
        event = guard.command("checkpoint", timeout_s=PATIENCE_S)
        if event["kind"] == "checkpoint":
            return event["freeze_s"] * 1e3, event.get("fork_reason") or event["images"]
        time.sleep(PAUSE_S)
    raise BenchFailed(f"no checkpoint: {event}")


def restore_ms(guard: GuardProcess, victim: Victim, pause_s: float) -> float:
    """From the death's report until the last thread runs again; killed so long after a checkpoint."""
    # The first ones after a restore are forks.
    for _ in range(AGAIN):
        time.sleep(PAUSE_S)
        checkpoint(guard)
    time.sleep(pause_s)
    since = guard.mark()
    kill_main(victim)
    event = guard.wait("restored", since=since, timeout_s=PATIENCE_S)
    victim.wait_beats(3, timeout_s=PATIENCE_S)
    return float(event["restore_s"]) * 1e3


def measure(case: Case, images: Images, options: argparse.Namespace, folder: Path) -> Result:
    """One program."""
    forks, freezes, made = [], [], Counter[str]()
    settings = config(images=images, freeze_deadline_s=1.0, shm_bytes=256_000_000)
    with ExitStack() as stack:
        forker = stack.enter_context(Forker(case.mb)) if case.processes == 1 else None
        victim = stack.enter_context(Victim(case.command, folder))
        guard = stack.enter_context(GuardProcess(settings, [victim.pid]))
        for cycle in range(WARM_UP + options.cycles):
            time.sleep(PAUSE_S)
            fork_ms = forker.fork_ms() if forker else 0.0
            freeze_ms, how = checkpoint(guard)
            if cycle >= WARM_UP:
                forks.append(fork_ms)
                freezes.append(freeze_ms)
                made[how] += 1
        restores = [restore_ms(guard, victim, PAUSE_S) for _ in range(options.restores)]
        at_once = [restore_ms(guard, victim, 0.0) for _ in range(options.restores)]
        victim.check()
    fork_ms = statistics.median(forks) if forker else forks_ms(case.command, folder)[0]
    freezes.sort()
    return Result(
        case.mb,
        case.threads,
        case.mb_per_s,
        case.processes,
        round(fork_ms, 2),
        round(statistics.median(freezes), 2),
        round(freezes[len(freezes) * 99 // 100], 2),
        round(statistics.median(restores), 2) if restores else 0.0,
        round(statistics.median(at_once), 2) if at_once else 0.0,
        round(case.part * fork_ms + (case.threads * THREAD_MS if case.part < 1 else 0.0), 2),
        dict(made),
    )


def show(results: list[Result]) -> None:
    """A table; what does not hold is marked."""
    table = Table(*("MB", "threads", "MB/s", "fork", "freeze", "p99", "its limit", "restore", "at once", "how"))
    for r in results:
        table.add_row(
            f"{r.processes} x {r.mb}" if r.processes > 1 else str(r.mb),
            *(str(value) for value in (r.threads, r.mb_per_s, r.fork_ms)),
            f"{'' if r.freeze_ms <= r.limit_ms else '! '}{r.freeze_ms}",
            *(str(value) for value in (r.freeze_p99_ms, r.limit_ms, r.restore_ms, r.restore_at_once_ms)),
            ", ".join(f"{count} {how}" for how, count in r.images.items()),
        )
    console.print(table)


def main() -> None:
    """Measures all of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--cycles", type=int, default=40)
    parser.add_argument("--restores", type=int, default=10)
    parser.add_argument("--images", choices=[each.name.lower() for each in Images], default="auto")
    parser.add_argument("--only", type=int, nargs="*", help="cases, from 1")
    options = parser.parse_args()
    build()
    results = []
    with tempfile.TemporaryDirectory(prefix="avckpt-bench-", dir="/dev/shm") as folder:
        for number, case in enumerate(CASES, 1):
            if options.only and number not in options.only:
                continue
            results.append(measure(case, Images[options.images.upper()], options, Path(folder)))
            show(results)
    if not options.only:
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n")


if __name__ == "__main__":
    main()
