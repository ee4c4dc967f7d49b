# SPDX-License-Identifier: Apache-2.0
"""SQLite in protected containers, killed under write load: what `avckpt.files` does to a database.

A bank (testkit/databases/bank.py) commits transactions in a container with a real Podman and sidecar, and reports
each to an observer outside after its COMMIT.  It is killed at random moments, in bursts of writing and in pauses
between them.  After every death the observer asks the database: PRAGMA integrity_check, every transaction that was
reported, the sum of all accounts; and the bank compares what it knows in memory with the database.

With `avckpt.files=strict` one database is kept for all kills, and Podman's restart policy starts cold what is not
restored.  With `rewind` a database that is damaged is the end of it, and the next kill has a new one.

    .venv/bin/python -m bench.sqlite [--kills 200] [--rewind-kills 40] [--cases delete,wal]

Needs root, Podman and what `make setup` builds; takes the machine's sidecar and hooks for itself, for a few
minutes at a time.  Prints a table; writes bench/results/sqlite.json.  Ends with 1 when anything was lost under strict.
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
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from testkit.databases.observer import Observer
from testkit.databases.rounds import LOAD, Bank, Round, kill_at_random
from testkit.harness import ROOT, ContainerFactory, Podman, machine_lock, running_sidecar

RESULTS = ROOT / "bench" / "results" / "sqlite.json"
BATCH_S = 200.0
"""Then sidecar and hooks are given back for a moment."""
LOCK_PATIENCE_S = 3600.0

console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)


@dataclass(frozen=True)
class Case:
    """How the bank uses its database."""

    name: str
    files: str
    arguments: tuple[str, ...]
    share: float = 1.0
    """Of the kills."""
    restart: str = "always"


CASES = [
    Case("delete", "strict", ("--journal", "delete")),
    Case("wal", "strict", ("--journal", "wal")),
    Case("truncate", "strict", ("--journal", "truncate"), 0.15, "on-failure"),
    Case("mmap", "strict", ("--mmap", "--journal", "persist"), 0.15),
    Case("reopen", "strict", ("--reopen", "--pause", "0.05"), 0.15),
    Case("delete", "rewind", ("--journal", "delete"), restart="no"),
    Case("wal", "rewind", ("--journal", "wal"), restart="no"),
]


@contextmanager
def machine() -> Iterator[ContainerFactory]:
    """The machine's sidecar and hooks, and containers that are removed."""
    podman = Podman()
    with machine_lock(LOCK_PATIENCE_S), running_sidecar(podman):
        factory = ContainerFactory(podman, f"avckpt-sqlite-{os.getpid()}")
        try:
            yield factory
        finally:
            factory.close()


def measure(case: Case, kills: int, log: Callable[[str], None]) -> list[list[Round]]:
    """So many kills of one case, by database."""
    rng = random.Random(len(case.name) * 1000 + kills)
    databases: list[list[Round]] = []
    left = kills
    while left:
        rounds: list[Round] = []
        databases.append(rounds)
        with Observer() as observer, tempfile.TemporaryDirectory(prefix="avckpt-sqlite-") as folder:
            while left and (case.files == "strict" or not any(done.damage for done in rounds)):
                batch(case, observer, Path(folder), rng, left, rounds)
                left = kills - sum(map(len, databases))
                log(f"{case.files}/{case.name}: {left} kills left; {rounds[-1]}")
    return databases


def batch(case: Case, observer: Observer, folder: Path, rng: random.Random, kills: int, rounds: list[Round]) -> None:
    """One container; at most `kills`, for some time, until a database is damaged that may be."""
    with machine() as factory:
        bank = Bank(factory, observer, folder, case.files, [*LOAD, *case.arguments], restart=case.restart)
        until = time.monotonic() + BATCH_S
        for _ in range(kills):
            done = kill_at_random(bank, rng)
            print(done, flush=True)
            if done.outcome == "ended" and rounds:
                rounds[-1] = replace(rounds[-1], said=[*rounds[-1].said, *done.said], audit=done.audit)
            else:
                rounds.append(done)
            if time.monotonic() > until or done.outcome == "ended" or (done.damage and case.files != "strict"):
                break


def summary(case: Case, databases: list[list[Round]]) -> dict[str, Any]:
    """What is written."""
    rounds = [done for of_one in databases for done in of_one]
    restored = [done for done in rounds if done.outcome == "restored"]
    refusals = Counter(reason(done.detail) for done in rounds if done.outcome == "cold")
    damage = Counter(kind for done in rounds for kind in {kind_of(text) for text in done.damage})
    return {
        "case": case.name,
        "files": case.files,
        "restart": case.restart,
        "arguments": list(case.arguments),
        "kills": len(rounds),
        "killed_while_busy": sum(done.phase == "busy" for done in rounds),
        "restored": len(restored),
        "restored_while_idle": sum(done.phase == "idle" for done in restored),
        "cold": sum(done.outcome == "cold" for done in rounds),
        "ended": sum(done.outcome == "ended" for done in rounds),
        "refused_because": dict(refusals.most_common()),
        "databases": len(databases),
        "transactions_told": sum(of_one[-1].told for of_one in databases),
        "forgotten_by_memory": sum(done.forgotten for done in restored),
        "age_median_s": round(statistics.median([done.age_s for done in restored]), 3) if restored else None,
        "damaged": sum(bool(done.damage) for done in rounds),
        "damage": dict(damage.most_common()),
        "examples": [text for done in rounds for text in done.damage][:8],
    }


def reason(detail: str) -> str:
    """Without the file's folder."""
    return detail.partition("avckpt.files=strict: ")[2].replace("/data/", "") or detail


def kind_of(damage: str) -> str:
    """A damage without its numbers."""
    if damage.startswith("disagree"):
        return "memory and database disagree"
    if damage.startswith("error"):
        return "an error of SQLite's"
    if damage.endswith("lost"):
        return "committed transactions lost"
    if damage.startswith("the accounts"):
        return "money made or lost"
    return "database corrupt"


def show(results: list[dict[str, Any]]) -> None:
    """The table."""
    table = Table(title="SQLite killed under write load", title_justify="left")
    for heading in ("avckpt.files", "case", "kills", "restored", "cold", "told", "damaged", "how"):
        table.add_column(heading, justify="left" if heading in ("avckpt.files", "case", "how") else "right")
    for row in results:
        how = ", ".join(f"{count} x {kind}" for kind, count in row["damage"].items())
        table.add_row(
            *(row["files"], row["case"], str(row["kills"]), str(row["restored"]), str(row["cold"])),
            *(str(row["transactions_told"]), str(row["damaged"]), how),
        )
    console.print(table)


def write(results: list[dict[str, Any]], path: Path) -> None:
    """In one step, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    head = {"kernel": os.uname().release, "cases": results}
    draft.write_text(json.dumps(head, indent=1) + "\n")
    draft.replace(path)


def main() -> int:
    parser = argparse.ArgumentParser(description="Kills SQLite under write load in protected containers.")
    parser.add_argument("--kills", type=int, default=200, help="of strict's two main cases (%(default)s)")
    parser.add_argument("--rewind-kills", type=int, default=40, help="of each with rewind (%(default)s)")
    parser.add_argument("--cases", default="", help="only these, e.g. strict/delete,rewind/wal")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    args = parser.parse_args()
    if os.geteuid() != 0:
        print("sqlite: it takes root: avckpt protects containers of root's Podman", file=sys.stderr)
        return 1
    wanted = args.cases.split(",") if args.cases else [f"{case.files}/{case.name}" for case in CASES]
    results: list[dict[str, Any]] = []
    for case in CASES:
        if f"{case.files}/{case.name}" not in wanted:
            continue
        kills = args.kills if case.files == "strict" else args.rewind_kills
        databases = measure(case, max(1, round(kills * case.share)), lambda line: print(line, flush=True))
        results.append(summary(case, databases))
        write(results, args.output)
    show(results)
    console.print(f"written to {args.output}")
    lost = [row for row in results if row["files"] == "strict" and row["damaged"]]
    for row in lost:
        console.print(f"[red]damaged[/]: {row['case']}: {row['examples']}")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
