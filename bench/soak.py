# SPDX-License-Identifier: Apache-2.0
"""Does anything leak?  Checkpoints every 100 ms, a death every few seconds, for an hour.

A sidecar daemon protects a C++ program (tests/victims/pool.cpp: thread pool, futures,
condition variables, all of it checking itself) below avckpt-init, in a PID namespace of
its own.  The program is killed at random moments; twice in a row now and then.  Every few
seconds all that can leak is counted in the program, in init, in templates and in the
sidecar (tests/census.py); whatever is more at the end than after the warm-up is a leak.

    .venv/bin/python -m bench.soak [--seconds 3600] [--again]

Needs root, and no Podman.  Prints a table; writes bench/results/soak.json and soak.png.
Ends with 1 when something leaked, the program found something wrong, or a restore failed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client
from rich.console import Console
from rich.table import Table

from testkit.board import Board
from testkit.census import Census, Growth, Row, growths
from testkit.harness import ROOT, wait_until
from testkit.local_sidecar import Container, local_sidecar

VICTIMS = ROOT / "tests" / "victims"
RESULTS = ROOT / "bench" / "results" / "soak.json"
WORKERS, MEGABYTES = 8, 16
LABELS = {"avckpt.enable": "true", "avckpt.interval": "100ms", "avckpt.restore.max": "16/1s"}
PAUSE_S = (2.0, 5.0)
AGAIN = 0.1
"""How often a death is followed by another one at once."""
WARM_UP = 1 / 2
"""Of the whole time: so long it takes until the sidecar's history is full and old events go."""
MOMENTS = 9
"""With fewer, nothing can be said of growth."""
MEMORY_ALLOWED_KB = 512.0

console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)


class Soak:
    """The program, its sidecar's API, and what was seen."""

    def __init__(self, container: Container, board: Board, client: Client, sidecar_pid: int) -> None:
        self.container = container
        self.board = board
        self.client = client
        self.census = Census(container.init_pid, sidecar_pid)
        self.rows: list[Row] = []
        self.kills = 0
        self.failure = ""
        self.rng = random.Random(1)

    def entry(self) -> dict[str, Any]:
        """What the sidecar says of it."""
        (entry,) = self.client.containers()
        return entry

    def kill(self) -> None:
        """One death, and the restore."""
        # There are fewer for a while after the host was short of memory.
        wait_until(lambda: self.entry()["generations"] == 2, 700, "two generations")
        pid = wait_until(lambda: self.container.app_pid, 10, "the program is there")
        self.kills += 1
        os.kill(pid, self.rng.choice((signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT)))
        wait_until(lambda: self.entry()["restores"] >= self.kills, 30, f"restore {self.kills}")
        beats = self.board.see().beats
        wait_until(lambda: self.board.see().beats > beats, 30, "it goes on")

    def check(self) -> None:
        """Raises RuntimeError when the program has found something wrong, or was started again."""
        seen = self.board.see()
        if seen.violations or seen.starts != 1:
            said = self.container.output.read_text(errors="replace")[-2000:]
            raise RuntimeError(f"{seen.violations} violations, {seen.starts} starts: {said}")

    def look(self, at_s: float) -> None:
        """Adds a row."""
        wait_until(lambda: self.entry()["generations"] == 2, 700, "two generations")
        row = wait_until(self.census.take, 10, "a count of everything")
        entry = self.entry()
        seen = self.board.see()
        assert row is not None
        row["at_s"] = round(at_s, 1)
        self.rows.append(row)
        self.progress = {
            "checkpoints": entry["checkpoints"],
            "missed": entry["missed"],
            "restores": entry["restores"],
            "beats": seen.beats,
            "tasks": seen.counter[0],
        }

    def run(self, seconds: float, every_s: float) -> None:
        """Kills and counts."""
        begin = time.monotonic()
        next_look = begin
        while (now := time.monotonic()) < begin + seconds:
            self.kill()
            if self.rng.random() < AGAIN:
                self.kill()
            self.check()
            pause_until = time.monotonic() + self.rng.uniform(*PAUSE_S)
            if now >= next_look:
                next_look = now + every_s
                time.sleep(1.0)  # the generations are all there again
                self.look(now - begin)
                print(json.dumps({"at_s": round(now - begin, 1), **self.progress, **self.rows[-1]}), flush=True)
            time.sleep(max(0.0, pause_until - time.monotonic()))


def soak(seconds: float, every_s: float) -> Soak:
    """All of it."""
    subprocess.run(["make", "-s", "-C", str(VICTIMS)], check=True)
    with tempfile.TemporaryDirectory(prefix="avckpt-soak-") as folder, local_sidecar(Path(folder)) as sidecar:
        sidecar.run_dir.mkdir()
        sidecar.start()
        board = Board(Path(folder) / "board")
        program = [str(VICTIMS / "build" / "pool"), str(WORKERS), str(MEGABYTES), "--board", str(board.path)]
        container = sidecar.protected("soak", program, LABELS)
        wait_until(lambda: board.see().ready == 1, 30, "the program is ready")
        client = Client(sidecar.run_dir)
        wait_until(lambda: client.containers()[0]["generations"] == 2, 30, "two generations")
        assert sidecar.process is not None
        run = Soak(container, board, client, sidecar.process.pid)
        try:
            run.run(seconds, every_s)
        except (RuntimeError, TimeoutError, ValueError) as error:
            print(sidecar.log[-4000:], file=sys.stderr)
            run.failure = str(error)
        return run


def show(moved: list[Growth], allowed_kb: float) -> None:
    """Memory: lows; the rest: the first high, the last low."""
    table = Table(title=f"first and last third after the warm-up; allowed: {allowed_kb:g} kB", title_justify="left")
    for heading in ("figure", "first", "last", ""):
        table.add_column(heading, justify="left" if heading == "figure" else "right")
    for growth in moved:
        verdict = "[red]LEAK" if growth.is_leak else ""
        table.add_row(growth.name, f"{growth.first:g}", f"{growth.last:g}", verdict)
    console.print(table)


def plot(result: dict[str, Any], path: Path) -> bool:
    """Draws memory and counts over time, if matplotlib is there."""
    try:
        import matplotlib
    except ImportError:
        return False
    matplotlib.use("Agg")
    from matplotlib import pyplot

    series = result["series"]
    minutes = [at_s / 60 for at_s in series["at_s"]]
    panels = {
        "resident memory, MB (of templates: what is theirs alone)": [
            name for name in series if name.endswith((".rss_kb", "templates.private_kb")) and name != "templates.rss_kb"
        ],
        "page tables, kB": [name for name in series if name.endswith("page_tables_kb")],
        "descriptors": [name for name in series if name.endswith(".fds")],
        "processes and threads": [
            name for name in series if name.endswith((".threads", ".pids", ".processes", ".zombies"))
        ],
    }
    figure, axes = pyplot.subplots(2, 2, figsize=(12, 8), sharex=True)
    for axis, (title, names) in zip(axes.flat, panels.items()):
        for name in names:
            scale = 1024 if "MB" in title else 1
            axis.plot(minutes, [value / scale for value in series[name]], label=name.rpartition("_kb")[0] or name, lw=1)
        axis.set_title(title)
        axis.set_ylim(bottom=0)
        axis.legend(fontsize=7, loc="lower right")
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel("minutes")
    figure.suptitle(f"{result['checkpoints']} checkpoints, {result['restores']} restores")
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    return True


def write(result: dict[str, Any], path: Path) -> None:
    """In one step, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    lines = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in result.items() if key != "series"]
    series = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in result["series"].items())
    draft.write_text("{\n" + ",\n".join(lines) + ',\n "series": {\n' + series + "\n }\n}\n")
    draft.replace(path)


def main() -> int:
    parser = argparse.ArgumentParser(description="Looks for leaks under checkpoints, deaths and restores.")
    parser.add_argument("--seconds", type=float, default=3600.0, help="how long (%(default)s)")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between two counts (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    parser.add_argument("--again", action="store_true", help="measure nothing: judge and draw what was measured")
    args = parser.parse_args()
    if args.again:
        return judge(json.loads(args.output.read_text()), args.output)
    if os.geteuid() != 0:
        print("soak: it takes root: the engine traces other processes", file=sys.stderr)
        return 1
    run = soak(args.seconds, args.every)
    result: dict[str, Any] = {
        "seconds": args.seconds,
        "interval": LABELS["avckpt.interval"],
        "kills": run.kills,
        **run.progress,
        "violations": run.board.see().violations,
        "failure": run.failure,
        "kernel": os.uname().release,
        "series": {name: [row[name] for row in run.rows] for name in run.rows[0]},
    }
    return judge(result, args.output)


def judge(result: dict[str, Any], path: Path) -> int:
    """Says what leaks, draws and writes; the exit status."""
    if result["failure"]:
        console.print(f"ended early: {result['failure']}", markup=False, style="red")
    picture = path.with_suffix(".png")
    series = result["series"]
    rows = [{name: series[name][i] for name in series} for i in range(len(series["at_s"]))]
    warm = [row for row in rows if row["at_s"] >= result["seconds"] * WARM_UP]
    moved = growths(warm, MEMORY_ALLOWED_KB) if len(warm) >= MOMENTS else []
    leaks = [growth.name for growth in moved if growth.is_leak]
    write({**result, "leaks": leaks, "moved": {growth.name: [growth.first, growth.last] for growth in moved}}, path)
    show(moved, MEMORY_ALLOWED_KB)
    console.print(f"{result['checkpoints']} checkpoints, {result['missed']} missed, {result['kills']} deaths,", end=" ")
    console.print(f"{result['restores']} restores, {result['beats']} rounds of the program")
    console.print(f"written to {path}" + (f" and {picture}" if plot(result, picture) else "; no matplotlib"))
    for name in leaks:
        console.print(f"[red]leaks[/]: {name}")
    return 1 if leaks or result["failure"] else 0


if __name__ == "__main__":
    sys.exit(main())
