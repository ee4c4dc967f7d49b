# SPDX-License-Identifier: Apache-2.0
"""`make bench-trees`: freeze and restore of process trees beside plain forks of as much memory.

    .venv/bin/python -m bench.trees [--cycles 20] [--only freeze,restore,workers,exec,commands]

Five questions, each with the limit that the project has set itself:

- freeze:   a tree, against 1.5 times the sum of the forks of its processes plus 30 us per thread;
- restore:  a tree, against twice the sum of the forks of its processes plus 0.3 ms for each of them;
- workers:  restore of a main process with 8 prefork workers that share 200 MB, against 3 times the restore of
            one process of 200 MB; with small pages and with transparent huge pages;
- exec:     what a child of 100 MB private memory that has executed a program adds to a restore, against the
            time of copying 100 MB plus 5 ms;
- commands: 1,000 short commands in a loop under 100 ms checkpoints, against the same loop unprotected plus 10 %.

Writes bench/results/trees.json.  A limit that is exceeded is reported, but is no failure: times on a
shared machine are no test.  Ends with 1 when something could not be measured.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest import mock

from rich.console import Console
from rich.table import Table

from bench.subjects import BenchFailed, build
from testkit.family import kill_main, members
from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import ROOT

RESULTS = ROOT / "bench" / "results" / "trees.json"
WARM_UP_CYCLES = 2
AHEAD_S = 0.1
"""From a checkpoint to a kill: what a restore is spared of is done then."""
COMMANDS = 1000
TREES = ("tree 8", "tree 24 --threads 4", "prefork 8 200", "prefork 8 200 --thp", "prefork 2 20 --private 100")
RESTORED = ("tree 8", "tree 24 --threads 4", "prefork 8 20", "prefork 30 5")
PATIENCE_S = 60.0

console = Console(highlight=False, width=None if sys.stdout.isatty() else 132)


@dataclass(frozen=True)
class Figure:
    """One comparison, in ms."""

    what: str
    measured_ms: float
    limit_ms: float
    how: str
    """What the limit is made of, and what else there is to know."""

    @property
    def holds(self) -> bool:
        return self.measured_ms <= self.limit_ms


def living(victim: Victim) -> list[int]:
    """Its processes, zombies left out."""
    return [member.pid for member in members(victim) if not member.is_zombie]


class Subject:
    """A victim of several processes with a guard that takes checkpoints on command."""

    def __init__(self, command: str, folder: Path) -> None:
        self.command = command
        self.victim = Victim(command, folder)

    def __enter__(self) -> Subject:
        self.victim.__enter__()
        self.guard = GuardProcess(config(shm_bytes=64_000_000, freeze_deadline_s=1.0), [self.victim.pid])
        return self

    def __exit__(self, *_: object) -> None:
        self.guard.__exit__(None, None, None)
        self.victim.__exit__(None, None, None)

    def checkpoint_ms(self) -> float:
        """Freeze time of one checkpoint.  Tries again when one is missed."""
        for _ in range(20):
            event = self.guard.command("checkpoint")
            if event["kind"] == "checkpoint":
                return float(event["freeze_s"]) * 1e3
            time.sleep(0.05)
        raise BenchFailed(f"no checkpoint of `{self.command}`: {event}")

    def restore_ms(self) -> float:
        """From the death's report until the last thread runs again."""
        since = self.guard.mark()
        kill_main(self.victim)
        event = self.guard.wait("restored", since=since, timeout_s=PATIENCE_S)
        self.victim.wait_beats(3)
        return float(event["restore_s"]) * 1e3

    def pids(self) -> list[int]:
        return living(self.victim)

    def threads(self) -> int:
        return sum(len(os.listdir(f"/proc/{pid}/task")) for pid in self.pids())


def cycles_of(subject: Subject, cycles: int, take: Callable[[], float]) -> float:
    """Median of `cycles`, after a few that do not count."""
    rng = random.Random(subject.command)
    taken = []
    for cycle in range(WARM_UP_CYCLES + cycles):
        time.sleep(rng.uniform(0.005, 0.03))
        value = take()
        if cycle >= WARM_UP_CYCLES:
            taken.append(value)
    return statistics.median(taken)


def forks_ms(command: str, folder: Path) -> tuple[float, int]:
    """What plain forks of all its processes take, one after the other, each by itself; and how many there are."""
    with mock.patch.dict(os.environ, VICTIM_TIME_FORKS="1"), Victim(command, folder) as victim:
        give_up = time.monotonic() + PATIENCE_S
        while victim.see().counter[3] < (processes := len(living(victim))):
            if victim.see().violations or time.monotonic() > give_up:
                raise BenchFailed(f"the forks of `{command}` could not be measured: {victim.said}")
            time.sleep(0.01)
        return victim.see().counter[2] / 1e6, processes


def measure_freeze(cycles: int, folder: Path) -> list[Figure]:
    found = []
    for command in TREES:
        forks, processes = forks_ms(command, folder)
        with Subject(command, folder) as subject:
            threads = subject.threads()
            took = cycles_of(subject, cycles, subject.checkpoint_ms)
        how = f"1.5 x {forks:.2f} (plain forks of its {processes} processes) + 0.03 x {threads} threads"
        found.append(Figure(f"freeze of `{command}`", took, 1.5 * forks + 0.03 * threads, how))
    return found


def measure_restore(command: str, cycles: int, folder: Path) -> float:
    with Subject(command, folder) as subject:

        def take() -> float:
            subject.checkpoint_ms()
            time.sleep(AHEAD_S)
            return subject.restore_ms()

        return cycles_of(subject, cycles, take)


def measure_trees(cycles: int, folder: Path) -> list[Figure]:
    found = []
    for command in RESTORED:
        forks, processes = forks_ms(command, folder)
        took = measure_restore(command, cycles, folder)
        how = f"2 x {forks:.2f} (plain forks of its {processes} processes) + 0.3 x {processes}"
        found.append(Figure(f"restore of `{command}`", took, 2 * forks + 0.3 * processes, how))
    return found


def measure_workers(cycles: int, folder: Path) -> list[Figure]:
    found = []
    for pages, option in (("", ""), (" of huge pages", " --thp")):
        alone = measure_restore(f"prefork 0 200{option}", cycles, folder)
        took = measure_restore(f"prefork 8 200{option}", cycles, folder)
        how = f"3 x {alone:.2f} (one process of 200 MB)"
        found.append(Figure(f"restore of 8 workers sharing 200 MB{pages}", took, 3 * alone, how))
    return found


def copy_ms(mb: int, cycles: int) -> float:
    """Copying so much into fresh memory."""
    source = bytearray(os.urandom(1 << 20) * mb)
    taken = []
    for _ in range(cycles):
        started = time.perf_counter()
        copy = bytes(source)
        taken.append((time.perf_counter() - started) * 1e3)
        del copy
    return statistics.median(taken)


def measure_exec(cycles: int, folder: Path) -> list[Figure]:
    without = measure_restore("prefork 1 10 --private 1", cycles, folder)
    took = measure_restore("prefork 1 10 --private 100", cycles, folder)
    copying = copy_ms(99, cycles)
    how = f"{copying:.2f} (copying 99 MB) + 5; the restore takes {took:.2f}, with 1 MB in the child {without:.2f}"
    return [Figure("what 100 MB in an exec'ed child add", took - without, copying + 5, how)]


def commands_ms(victim: Victim, n: int) -> float:
    """The time of the next `n` commands."""
    started, first = time.monotonic(), victim.see().counter[0]
    while victim.see().counter[0] < first + n:
        if victim.see().violations or time.monotonic() - started > PATIENCE_S:
            raise BenchFailed(f"the commands do not go on: {victim.said}")
        time.sleep(0.0005)
    return (time.monotonic() - started) * 1e3


def measure_commands(cycles: int, folder: Path) -> list[Figure]:
    """Protected and unprotected take turns, so that what else the machine does falls on both alike."""
    free, checked = [], []
    rounds = max(3, cycles // 4)
    with Victim("commands", folder) as victim:
        commands_ms(victim, 50)
        for _ in range(rounds):
            free.append(commands_ms(victim, COMMANDS))
            with GuardProcess(config(0.1), [victim.pid]) as guard:
                guard.wait("checkpoint", count=2)
                checked.append(commands_ms(victim, COMMANDS))
                guard.stop()
    alone, took = statistics.median(free), statistics.median(checked)
    how = f"1.1 x {alone:.0f} (unprotected); {rounds} rounds each"
    return [Figure(f"{COMMANDS} commands under 100 ms checkpoints", took, 1.1 * alone, how)]


MEASURES: dict[str, Callable[[int, Path], list[Figure]]] = {
    "freeze": measure_freeze,
    "restore": measure_trees,
    "workers": measure_workers,
    "exec": measure_exec,
    "commands": measure_commands,
}


def show(figures: list[Figure]) -> None:
    table = Table(title="medians in ms, beside their limits", title_justify="left")
    table.add_column("what")
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("limit", justify="right", no_wrap=True)
    table.add_column("the limit's parts")
    for figure in figures:
        colour = "green" if figure.holds else "red"
        table.add_row(figure.what, f"[{colour}]{figure.measured_ms:.2f}[/]", f"{figure.limit_ms:.2f}", figure.how)
    console.print(table)
    for figure in figures:
        if not figure.holds:
            console.print(f"[red]does not hold[/]: {figure.what}: {figure.measured_ms:.2f} > {figure.limit_ms:.2f} ms")


def main() -> int:
    parser = argparse.ArgumentParser(description="Measures freeze and restore of process trees.")
    parser.add_argument("--cycles", type=int, default=20, help="this many of each (%(default)s)")
    parser.add_argument("--only", default=",".join(MEASURES), help="some of %(default)s")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    args = parser.parse_args()
    if os.geteuid() != 0:
        print("bench: it takes root: the engine traces other processes", file=sys.stderr)
        return 1
    figures: list[Figure] = []
    failures = []
    build()
    subprocess.run(["make", "-s", "-C", str(ROOT / "native"), "build/avckpt-init"], check=True)
    with tempfile.TemporaryDirectory(prefix="avckpt-bench-") as folder:
        for name in args.only.split(","):
            console.print(f"{name}, {args.cycles} cycles (load {os.getloadavg()[0]:.1f}) ...", style="dim")
            try:
                figures += MEASURES[name](args.cycles, Path(folder))
            except (BenchFailed, AssertionError, TimeoutError) as error:
                failures.append(f"{name}: {error}"[:1000])
    show(figures)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps([asdict(figure) for figure in figures], indent=1) + "\n")
    console.print(f"written to {args.output}")
    for failure in failures:
        print(f"bench: could not be measured: {failure}", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
