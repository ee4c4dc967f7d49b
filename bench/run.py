# SPDX-License-Identifier: Apache-2.0
"""`make bench`: freeze, reap and restore, beside a plain fork() of as much memory.

For every size and number of threads one victim (tests/victims/idle.c) is
checkpointed and killed again and again.  Each cycle times one fork(2) of
bench/fork.c first, so that other load of the machine affects both alike.

Writes medians to bench/results/engine.json and prints them with the limits that
the project has set itself.  Ends with 1 when something could not be measured; a
limit that is exceeded is reported, but is no failure: times on a shared machine
are no test.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from avckpt.errors import AvckptError
from rich.console import Console
from rich.table import Table

from bench.subjects import BenchFailed, Forker, Guarded, Idle, build
from testkit.harness import ROOT

RESULTS = ROOT / "bench" / "results" / "engine.json"
MEGABYTES = (10, 100, 1000)
THREADS = (1, 20, 100)
DESCRIPTORS = (100, 50, 100)
"""MB, threads and descriptors of one more victim: the others have next to no descriptors."""
CYCLES = 40
QUICK_CYCLES = 5
WARM_UP_CYCLES = 2
"""Not counted: the first checkpoint brings the engine's code into the process."""
PAUSE_S = (0.1, 0.15)
"""Between fork, checkpoint and kill: the spare of 1 GB is there then, and its making disturbs nothing."""
BEAT_US = 100

# The table is wider than the 80 columns that rich takes a pipe for.
console = Console(highlight=False, width=None if sys.stdout.isatty() else 132)


@dataclass(frozen=True)
class Row:
    """Medians of one victim, in ms; the keys of engine.json."""

    mb: int
    threads: int
    descriptors: int
    thp: bool
    fork_ms: float
    freeze_ms: float
    reap_ms: float
    restore_ms: float
    resume_gap_ms: float

    @property
    def freeze_limit_ms(self) -> float:
        return 1.5 * self.fork_ms + 0.030 * self.threads

    @property
    def restore_limit_ms(self) -> float:
        return 1.5 * self.fork_ms + 0.060 * self.threads + 1.0

    @property
    def reap_limit_ms(self) -> float | None:
        """Set for the big process only."""
        return 1.0 if self.mb >= 1000 else None

    @property
    def failures(self) -> list[str]:
        """Limits that do not hold."""
        found = []
        if self.freeze_ms > self.freeze_limit_ms:
            found.append(f"freeze {self.freeze_ms:.2f} > {self.freeze_limit_ms:.2f} ms")
        if self.restore_ms > self.restore_limit_ms:
            found.append(f"restore {self.restore_ms:.2f} > {self.restore_limit_ms:.2f} ms")
        if self.reap_limit_ms is not None and self.reap_ms >= self.reap_limit_ms:
            found.append(f"reap {self.reap_ms:.2f} >= {self.reap_limit_ms:.2f} ms")
        return found


@dataclass(frozen=True)
class Parts:
    """Where the time goes, medians in ms (--parts)."""

    stop_ms: float
    clone_ms: float
    freeze_rest_ms: float
    restore_fork_ms: float
    restore_threads_ms: float
    restore_rest_ms: float


def measure(
    mb: int, threads: int, descriptors: int, folder: Path, *, thp: bool, cycles: int, soon: bool
) -> tuple[Row, Parts]:
    """One victim, `cycles` times; `soon`: killed before there is a spare.  Raises BenchFailed, AvckptError."""
    rng = random.Random(mb * 1000 + threads)
    forks, checkpoints, recoveries = [], [], []
    with (
        Forker(mb, thp=thp) as forker,
        Idle(mb, threads, beat_us=BEAT_US, folder=folder, descriptors=descriptors, thp=thp) as idle,
        Guarded(idle) as guarded,
    ):
        app_pid = idle.app_pid
        for cycle in range(WARM_UP_CYCLES + cycles):
            fork_ms = forker.fork_ms()
            time.sleep(rng.uniform(*PAUSE_S))
            checkpoint = guarded.checkpoint()
            if not soon:
                time.sleep(rng.uniform(*PAUSE_S))
            recovery = guarded.kill(app_pid)
            app_pid = recovery.event.app_pid
            time.sleep(rng.uniform(*PAUSE_S))
            idle.check()
            if cycle >= WARM_UP_CYCLES:
                forks.append(fork_ms)
                checkpoints.append(checkpoint)
                recoveries.append(recovery)
    median = statistics.median
    row = Row(
        mb=mb,
        threads=threads,
        descriptors=descriptors,
        thp=thp,
        fork_ms=round(median(forks), 4),
        freeze_ms=round(median(c.freeze_s * 1e3 for c in checkpoints), 4),
        reap_ms=round(median(r.reap_ms for r in recoveries), 4),
        restore_ms=round(median(r.restore_ms for r in recoveries), 4),
        resume_gap_ms=round(median(r.resume_gap_ms for r in recoveries), 4),
    )
    parts = Parts(
        stop_ms=1e3 * median(c.stop_s for c in checkpoints),
        clone_ms=1e3 * median(c.clone_s for c in checkpoints),
        freeze_rest_ms=1e3 * median(c.freeze_s - c.stop_s - c.clone_s for c in checkpoints),
        restore_fork_ms=1e3 * median(r.event.fork_s for r in recoveries),
        restore_threads_ms=1e3 * median(r.event.threads_s for r in recoveries),
        restore_rest_ms=median(r.restore_ms - 1e3 * (r.event.fork_s + r.event.threads_s) for r in recoveries),
    )
    return row, parts


def _against(value: float, limit: float | None, fork_ms: float) -> str:
    text = f"{value:.2f} ({value / fork_ms:.1f}x)" if fork_ms else f"{value:.2f}"
    if limit is None:
        return text
    holds = value <= limit
    return f"{text} [{'green' if holds else 'red'}]{'<=' if holds else '>'} {limit:.2f}[/]"


def show(rows: Sequence[Row]) -> None:
    """The table: beside each figure its ratio to fork, and its limit."""
    table = Table(title="medians in ms (times a plain fork), beside their limits", title_justify="left")
    for heading in ("MB", "threads", "fds", "fork", "freeze", "reap", "restore", "resume gap"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            str(row.mb),
            str(row.threads),
            str(row.descriptors),
            f"{row.fork_ms:.2f}",
            _against(row.freeze_ms, row.freeze_limit_ms, row.fork_ms),
            _against(row.reap_ms, row.reap_limit_ms, 0.0),
            _against(row.restore_ms, row.restore_limit_ms, row.fork_ms),
            f"{row.resume_gap_ms:.2f}",
        )
    console.print(table)
    console.print(
        "limits: freeze <= 1.5 fork + 0.03/thread; restore <= 1.5 fork + 0.06/thread + 1; reap < 1 at 1000 MB"
    )
    for row in rows:
        for failure in row.failures:
            what = f"{row.mb} MB, {row.threads} threads, {row.descriptors} descriptors"
            console.print(f"[red]does not hold[/]: {what}: {failure}")
    if not any(row.failures for row in rows):
        console.print("[green]every limit holds[/]")


def show_parts(rows: Sequence[Row], parts: Sequence[Parts]) -> None:
    """Where the time goes."""
    table = Table(title="parts, medians in ms", title_justify="left")
    names = list(asdict(parts[0]))
    for heading in ("MB", "threads", "fds", *(name.removesuffix("_ms").replace("_", " ") for name in names)):
        table.add_column(heading, justify="right")
    for row, part in zip(rows, parts):
        figures = (row.mb, row.threads, row.descriptors)
        table.add_row(*map(str, figures), *(f"{value:.3f}" for value in asdict(part).values()))
    console.print(table)


def write(rows: Sequence[Row], path: Path) -> None:
    """In one step, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    draft.replace(path)


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def main() -> int:
    parser = argparse.ArgumentParser(description="Measures freeze, reap and restore beside a plain fork().")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_CYCLES} cycles each instead of {CYCLES}")
    parser.add_argument("--cycles", type=int, help="this many cycles each")
    parser.add_argument("--json", action="store_true", help="print the results as JSON, and no table")
    parser.add_argument("--parts", action="store_true", help="also show where the time goes")
    parser.add_argument("--mb", type=_numbers, default=MEGABYTES, help="sizes, e.g. 10,100")
    parser.add_argument("--threads", type=_numbers, default=THREADS, help="numbers of threads, e.g. 1,20")
    parser.add_argument("--descriptors", type=int, default=0, help="open so many more (%(default)s)")
    parser.add_argument("--thp", action="store_true", help="memory in transparent huge pages")
    parser.add_argument("--soon", action="store_true", help="kill right after the checkpoint, before there is a spare")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    args = parser.parse_args()
    cycles = args.cycles or (QUICK_CYCLES if args.quick else CYCLES)
    if os.geteuid() != 0:
        print("bench: it takes root: the engine traces other processes", file=sys.stderr)
        return 1
    rows: list[Row] = []
    parts: list[Parts] = []
    try:
        build()
        with tempfile.TemporaryDirectory(prefix="avckpt-bench-") as folder:
            cases = [(mb, threads, args.descriptors) for mb in args.mb for threads in args.threads]
            if (args.mb, args.threads, args.descriptors) == (MEGABYTES, THREADS, 0):
                cases.append(DESCRIPTORS)
            for mb, threads, descriptors in cases:
                if not args.json:
                    what = f"{mb} MB, {threads} threads, {descriptors} descriptors, {cycles} cycles"
                    console.print(f"{what} (load {os.getloadavg()[0]:.1f}) ...", style="dim")
                row, part = measure(mb, threads, descriptors, Path(folder), thp=args.thp, cycles=cycles, soon=args.soon)
                rows.append(row)
                parts.append(part)
    except (BenchFailed, AvckptError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return 1
    write(rows, args.output)
    if args.json:
        print(json.dumps([asdict(row) for row in rows], indent=1))
        return 0
    show(rows)
    if args.parts:
        show_parts(rows, parts)
    console.print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
