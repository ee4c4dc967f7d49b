# SPDX-License-Identifier: Apache-2.0
"""Real programs under load: rounds of checkpoint, random wait, SIGKILL, restore, and how many succeed.

    make test-programs [ROUNDS=200]
    .venv/bin/python -m bench.programs [--rounds 200] [--programs redis,go] [--modes keep,reset-moved]

Needs root, Podman and what `make setup` and scripts/setup-programs.sh build.
Takes the machine's sidecar and hooks for itself, a program at a time, as the
tests do.  Prints a table and writes bench/results/programs.json; programs that
were not asked for keep the results they have there.  Ends with 1 when a round
has failed.
"""

from __future__ import annotations

import argparse
import json
import signal
import statistics
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from testkit.harness import ROOT, Podman, machine_lock, running_sidecar
from testkit.programs.registry import PROGRAMS, Program, find
from testkit.programs.rounds import MODES, Outcome, run

RESULTS = ROOT / "bench" / "results" / "programs.json"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--programs", type=_programs, default=list(PROGRAMS), help="some of them, e.g. redis,go")
    parser.add_argument("--modes", type=lambda text: text.split(","), default=list(MODES), help="keep, reset-moved")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    options = parser.parse_args()
    podman = Podman()
    failed = False
    # As an impatient Ctrl-C: containers are removed.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    for program in options.programs:
        for mode in options.modes:
            # Let go in between, so that others get their turn.
            with machine_lock(timeout_s=1800), running_sidecar(podman):
                outcome = run(program, mode, options.rounds, podman, seed=options.seed, tell=_say)
            failed = failed or outcome.successes < outcome.rounds
            _say(f"{program.name} {mode}: {outcome.successes} of {outcome.rounds} in {outcome.seconds:g} s")
            write(summary(outcome), options.output)
            time.sleep(2)
    print(table(json.loads(options.output.read_text())))
    return 1 if failed else 0


def summary(outcome: Outcome) -> dict[str, Any]:
    """As it is written."""
    row = asdict(replace(outcome, seen=Counter()))  # asdict() makes a wrong copy of a Counter
    row["seen"] = dict(outcome.seen)
    for name in ("freeze_ms", "restore_ms"):
        times = row.pop(name) or [0.0]
        row[name] = {"median": round(statistics.median(times), 2), "max": max(times)}
    return row


def write(row: dict[str, Any], path: Path) -> None:
    """Puts one result in the place of its predecessor; at once, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = json.loads(path.read_text()) if path.exists() else []
    rows = [each for each in rows if (each["program"], each["mode"]) != (row["program"], row["mode"])]
    order = {(p.name, mode): n for n, (p, mode) in enumerate((p, mode) for p in PROGRAMS for mode in MODES)}
    rows = sorted([*rows, row], key=lambda each: order[each["program"], each["mode"]])
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(rows, indent=1) + "\n")
    draft.replace(path)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """For docs/fidelity.md."""
    lines = [
        "| program | threads | `avckpt.tcp` | rounds | succeeded | requests | connections closed | no answer in time "
        "| said twice, torn | freeze | restore |",
        "|---|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in rows:
        seen = row["seen"]
        cells = [
            find(row["program"]).title,
            row["threads"],
            f"`{row['mode']}`",
            row["rounds"],
            f"**{row['successes']}**",
            seen.get("answers", 0),
            seen.get("closed", 0),
            seen.get("no answer", 0),
            f"{seen.get('stale', 0)}, {seen.get('garbled', 0)}",
            *(f"{row[name]['median']:.1f} ({row[name]['max']:.1f})" for name in ("freeze_ms", "restore_ms")),
        ]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def _programs(text: str) -> list[Program]:
    try:
        return [find(name) for name in text.split(",")]
    except KeyError as error:
        raise argparse.ArgumentTypeError(
            f"{error} is none of {', '.join(program.name for program in PROGRAMS)}"
        ) from error


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
