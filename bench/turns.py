# SPDX-License-Identifier: Apache-2.0
"""`python -m bench.turns DIR`: freeze and restore of this checkout beside those of another one.

DIR is built (`make setup-build`), a worktree of the commit before a change, say.  Both run the same
measurements in turns, so that other load of the machine affects both alike, and take turns in
going first.  A measurement that fails (on a busy machine a checkpoint may be missed) does not
count.  Prints the median over the turns of each figure, and its ratio.  Ends with 1 when nothing
could be measured, and with 2 when a figure is larger by more than --limit per cent.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

from rich.console import Console
from rich.table import Table

from testkit.harness import ROOT

Figures = dict[str, float]
"""By what was measured, in ms."""

console = Console(highlight=False, width=None if sys.stdout.isatty() else 132)


def engine(checkout: Path, output: Path, options: argparse.Namespace) -> Figures:
    """bench.run: processes."""
    _run(checkout, "bench.run", output, "--mb", options.mb, "--threads", options.threads, options=options)
    return {
        f"{name} of {row['mb']} MB, {row['threads']} threads": row[f"{name}_ms"]
        for row in json.loads(output.read_text())
        for name in ("fork", "freeze", "restore")
    }


def trees(checkout: Path, output: Path, options: argparse.Namespace) -> Figures:
    """bench.trees: process trees."""
    _run(checkout, "bench.trees", output, "--only", options.trees, options=options)
    return {figure["what"]: figure["measured_ms"] for figure in json.loads(output.read_text())}


def _run(checkout: Path, module: str, output: Path, *arguments: str, options: argparse.Namespace) -> None:
    """Raises CalledProcessError."""
    command = [str(checkout / ".venv/bin/python"), "-m", module, *arguments]
    subprocess.run(
        [*command, "--cycles", str(options.cycles), "--output", str(output)],
        cwd=checkout,
        check=True,
        stdout=subprocess.DEVNULL,
    )


def show(figures: dict[str, tuple[list[float], list[float]]], limit: float) -> int:
    """The table; how many figures are above the limit."""
    table = Table(title="medians in ms", title_justify="left")
    table.add_column("what")
    for heading in ("there", "here", "ratio"):
        table.add_column(heading, justify="right", no_wrap=True)
    above = 0
    for what, values in figures.items():
        if not all(values):
            continue
        there, here = map(statistics.median, values)
        # That of fork(2) tells how well the turns were shared.
        bad = not what.startswith("fork ") and here > there * (1 + limit / 100)
        above += bad
        table.add_row(what, f"{there:.3f}", f"{here:.3f}", f"[{'red' if bad else 'green'}]{here / there:.3f}[/]")
    console.print(table)
    return above


def main() -> int:
    parser = argparse.ArgumentParser(description="Measures this checkout beside another one, in turns.")
    parser.add_argument("checkout", type=Path, help="the other one, built")
    parser.add_argument("--turns", type=int, default=6, help="so often each (%(default)s)")
    parser.add_argument("--cycles", type=int, default=10, help="in each turn (%(default)s)")
    parser.add_argument("--mb", default="100,1000", help="sizes of the process (%(default)s)")
    parser.add_argument("--threads", default="1,20", help="its numbers of threads (%(default)s)")
    parser.add_argument("--only", default="engine,trees", help="some of %(default)s")
    parser.add_argument(
        "--trees", default="freeze,restore,workers", help="what of trees, if both know it (%(default)s)"
    )
    parser.add_argument("--limit", type=float, default=5.0, help="per cent (%(default)s)")
    options = parser.parse_args()
    measures = [{"engine": engine, "trees": trees}[name] for name in options.only.split(",")]
    figures: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    with tempfile.TemporaryDirectory(prefix="avckpt-bench-") as folder:
        for turn in range(options.turns):
            console.print(f"turn {turn + 1} of {options.turns} (load {os.getloadavg()[0]:.1f}) ...", style="dim")
            for side in (0, 1) if turn % 2 else (1, 0):
                for measure in measures:
                    try:
                        found = measure((options.checkout.resolve(), ROOT)[side], Path(folder) / "found", options)
                    except subprocess.CalledProcessError as error:
                        print(f"bench: {' '.join(error.cmd)} failed; does not count", file=sys.stderr)
                        continue
                    for what, value in found.items():
                        figures[what][side].append(value)
    if not any(all(values) for values in figures.values()):
        return 1
    return 2 if show(figures, options.limit) else 0


if __name__ == "__main__":
    sys.exit(main())
