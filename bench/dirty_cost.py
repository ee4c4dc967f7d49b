# SPDX-License-Identifier: Apache-2.0
"""What ten checkpoints a second cost a server of 1 GB that writes 40 MB/s: none, by copies and by forks, in turns.

    .venv/bin/python -m bench.dirty_cost [--turns 5] [--seconds 10]

bench/server.c answers a client that asks every millisecond (latency), and then one that asks as fast as it can
(answers), while another thread writes pages.  Writes bench/results/dirty_cost.json: medians of all turns.

  cpu_ms       the server's CPU time for 1,000 answers of the second client and what it writes meanwhile
  page_us      average cost of writing a page
  first_us     how much longer the first write after a checkpoint takes: of pages with a page fault
  guard_cpu    the guard's CPU time, in parts of a core
  held_mb      memory of all templates that is not shared with the server
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil
from avckpt.events.vocabulary import Kind
from avckpt.guard import Images
from avckpt.supervision.pressure import templates_of
from rich.console import Console
from rich.table import Table

from bench.cost import Protected, Way, server_pid
from bench.scale import cpu_s
from bench.subjects import BenchFailed, build
from bench.workload import Client, boards_folder, build_workload, read_log
from testkit.harness import ROOT
from testkit.procfs import figures

RESULTS = ROOT / "bench" / "results" / "dirty_cost.json"
WAYS = ("none", "copies", "forks")
MB, RATE, INTERVAL_S = 1000, 40, 0.1
SETTLE_S = {"none": 2.0, "copies": 30.0, "forks": 4.0}
"""Copies: until each page has been written since the first fork, of which all are copies."""
AS_FAST_AS_IT_CAN_US = 15

console = Console(highlight=False, width=None if sys.stdout.isatty() else 132)


def guards() -> list[psutil.Process]:
    """Children of ours that are guards."""
    return [child for child in psutil.Process().children() if child.name().startswith("avckpt-guard")]


def held_mb(server: Protected) -> float:
    """Pages of server and templates, less the server's own."""
    for _ in range(100):
        with contextlib.suppress(OSError):  # one of them has just been dropped
            app = figures(server_pid(server))
            held = [figures(pid) for pid in templates_of(server.init_pid)]
            return (sum(each["Pss"] for each in held) + app["Pss"] - app["Rss"]) / 1024
    raise BenchFailed("templates come and go")


def measure(how: str, seconds: float, folder: Path) -> dict[str, Any]:
    """One turn."""
    kind = "none" if how == "none" else "avckpt"
    images = Images.FORK if how == "forks" else Images.AUTO
    found: dict[str, Any] = {"load": round(os.getloadavg()[0], 1)}
    log = folder / "log"
    # What it writes for each request would come on top of the rate.
    with Protected(Way(kind, INTERVAL_S, RATE, MB, touched=0), folder, images=images) as server:
        with Client(folder, server.port, log=log, seconds=SETTLE_S[how] + seconds) as client:
            client.wait_answers(100, "the client gets answers")
            server.wait(SETTLE_S[how])
            server.events.clear()
            begin, started_ns = server.board.see(), time.monotonic_ns()
            guard_s = cpu_s(guards())
            server.wait(seconds)
            end, ended_ns = server.board.see(), time.monotonic_ns()
            guard_s = cpu_s(guards()) - guard_s
            found["held_mb"] = held_mb(server) if kind == "avckpt" else 0.0
            client.wait_end()
        read = read_log(log)
        latencies = sorted(ms for sent, ms in zip(read.sent_ns, read.latency_ms) if started_ns <= sent < ended_ns)
        pages, ns, faults = (end.counter[n] - begin.counter[n] for n in (1, 2, 3))
        taken = [event for event in server.events if event.kind is Kind.CHECKPOINT]
        found |= {
            "p50_ms": latencies[len(latencies) // 2],
            "p99_9_ms": latencies[len(latencies) * 999 // 1000],
            "page_us": ns / 1e3 / max(1, pages),
            "faults_per_page": faults / max(1, pages),
            "guard_cpu": guard_s / ((ended_ns - started_ns) / 1e9),
            "checkpoints_per_s": len(taken) / ((ended_ns - started_ns) / 1e9),
            "copies": sum(event.images == "dirty" for event in taken) / max(1, len(taken)),
            "freeze_ms": statistics.median([event.freeze_s * 1e3 for event in taken] or [0.0]),
        }
        every = AS_FAST_AS_IT_CAN_US
        with Client(folder, server.port, every_us=every, log=log, seconds=1 + seconds / 2) as client:
            client.wait_answers(100, "the client gets answers")
            server.wait(0.5)
            itself = [psutil.Process(server_pid(server))]
            begin, started_s, used_s = server.board.see(), time.monotonic(), cpu_s(itself)
            server.wait(seconds / 2)
            end, took_s, used_s = server.board.see(), time.monotonic() - started_s, cpu_s(itself) - used_s
            client.wait_end()
        answers = end.counter[0] - begin.counter[0]
        return found | {"answers_per_s": answers / took_s, "cpu_ms": used_s * 1e6 / max(1, answers)}


def sum_up(turns: Sequence[dict[str, dict[str, Any]]]) -> dict[str, dict[str, float]]:
    """Medians, and what a first write takes longer than without checkpoints."""
    medians = {
        how: {key: round(statistics.median(turn[how][key] for turn in turns), 4) for key in turns[0][how]}
        for how in WAYS
    }
    for each in medians.values():
        first = (each["page_us"] - medians["none"]["page_us"]) / max(each["faults_per_page"], 1e-9)
        each["first_us"] = round(first, 3) if each["checkpoints_per_s"] else 0.0
    return medians


def main() -> None:
    """Measures all of it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    build()
    build_workload()
    turns: list[dict[str, dict[str, Any]]] = []
    with boards_folder() as folder:
        for _ in range(options.turns):
            turns.append({how: measure(how, options.seconds, folder) for how in WAYS})
            medians = sum_up(turns)
            table = Table("", *WAYS)
            for key in medians["none"]:
                table.add_row(key, *(str(medians[how][key]) for how in WAYS))
            console.print(table)
    RESULTS.write_text(json.dumps({"medians": medians, "turns": turns}, indent=1) + "\n")


if __name__ == "__main__":
    main()
