# SPDX-License-Identifier: Apache-2.0
"""`make bench-peers`: avckpt beside CRIU, cold start and a plain fork(), on the same workloads.

A server (bench/server.c) with so much touched memory and so many threads answers a
client (bench/client.c) that asks every millisecond over one TCP connection.  Again
and again a checkpoint is taken, and some moments later the server is killed with
SIGKILL.  Server and client measure, in the same way for all subjects:

  freeze   longest time between two beats of the server (one every 0.1 ms) around the checkpoint
  outage   longest time without an answer around the kill

and what is still there afterwards: PID, memory, TCP connection, the container's run.

Results go into bench/results/peers.json (rows of subjects and sizes that were not
measured this time stay), plots and a table beside it.  Ends with 1 when something
could not be measured at all; what a peer cannot do is a result, with its error message.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import random
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from avckpt.errors import AvckptError
from rich.console import Console

from bench import peers_show
from bench.cpu_group import first_in_line, join
from bench.peers_subjects import (
    AvckptEngine,
    AvckptPodman,
    ColdCommand,
    ColdStart,
    CriuBare,
    CriuFailed,
    CriuPodman,
    CriuPodmanRunc,
    InWorld,
    Subject,
)
from bench.peers_world import World
from bench.subjects import BenchFailed, Forker, build, eventually
from bench.workload import Client, boards_folder, build_workload
from testkit.harness import ROOT, SIDECAR_NAME, CommandFailed, Podman, Sidecar, machine_lock, running_sidecar

RESULTS = ROOT / "bench" / "results" / "peers.json"
MEGABYTES = (10, 100, 1000)
THREADS = (1, 20, 100)
LOCK_PATIENCE_S = 900.0
QUICK_CYCLES = 2
STOPS = 3
"""How often CRIU also stops the server and brings it back, which is what it is made for."""
FORK = "fork"

SUBJECTS: dict[str, type[Subject]] = {
    "engine": AvckptEngine,
    "avckpt": AvckptPodman,
    "criu": CriuBare,
    "crun": CriuPodman,
    "runc": CriuPodmanRunc,
    "policy": ColdStart,
    "start": ColdCommand,
}

console = Console(highlight=False)


@dataclass
class Row:
    """One subject with one workload; the entries of peers.json.  Times in ms, one entry per cycle."""

    subject: str
    mb: int
    threads: int
    cycles: int = 0
    freeze_ms: list[float] = field(default_factory=list)
    tool_freeze_ms: list[float] = field(default_factory=list)
    checkpoint_ms: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    outage_ms: list[float] = field(default_factory=list)
    tool_restore_ms: list[float] = field(default_factory=list)
    unanswered: list[int] = field(default_factory=list)
    same_pid: int = 0
    same_memory: int = 0
    same_connection: int = 0
    same_run: int | None = None
    """How often Podman had not noticed anything; None: no container."""
    stop_outage_ms: list[float] = field(default_factory=list)
    stop_same_connection: int = 0
    stops: int = 0
    refused: int = 0
    """Checkpoints and restores that had to be tried again."""
    failures: list[str] = field(default_factory=list)
    load: float = 0.0


def fork_row(mb: int, threads: int, cycles: int) -> Row:
    """The limit: fork(2) of as much memory by a process with one thread; what it holds are page tables."""
    row = Row(FORK, mb, threads, load=os.getloadavg()[0])
    with Forker(mb) as forker:
        for _ in range(cycles):
            # Not one upon the other: the tables would be in the CPU's caches still.
            time.sleep(0.02)
            ms = forker.fork_ms()
            row.freeze_ms.append(ms)
            row.outage_ms.append(ms)
        row.cycles = cycles
    row.memory_mb = [round(mb / 512, 3)]
    return row


def _ns_to_ms(ns: int) -> float:
    return round(ns / 1e6, 3)


def _answers_again(client: Client, before: int, since_ns: int) -> None:
    """Waits for a gap that ended after `since_ns`, and then for some answers more."""

    def again() -> bool:
        seen = client.board.see()
        return seen.counter[0] > before and seen.beat_ns > since_ns

    eventually(again, "the client gets answers again", 0.001)
    client.wait_answers(20, "the client goes on getting answers")


def cycle(subject: Subject, client: Client, row: Row, rng: random.Random) -> None:
    """One checkpoint and one kill.  Raises BenchFailed, CommandFailed, AvckptError, TimeoutError."""
    subject.board.forget_gap()
    taken = subject.checkpoint()
    if taken is not None:
        time.sleep(0.02)
        row.freeze_ms.append(_ns_to_ms(subject.board.see().gap_ns))
        row.checkpoint_ms.append(round(taken.took_ms, 3))
        row.memory_mb.append(round(taken.memory_mb, 3))
        if taken.tool_freeze_ms is not None:
            row.tool_freeze_ms.append(round(taken.tool_freeze_ms, 3))
    time.sleep(rng.uniform(0.05, 0.15))
    before, conmon = client.identity(), subject.conmon()
    answers, unanswered = client.answers, client.sent - client.answers
    client.board.forget_gap()
    recovered = subject.crash()
    _answers_again(client, answers, time.monotonic_ns())
    after = client.identity()
    row.outage_ms.append(_ns_to_ms(client.board.see().gap_ns))
    row.unanswered.append(client.sent - client.answers - unanswered)
    if recovered.tool_restore_ms is not None:
        row.tool_restore_ms.append(round(recovered.tool_restore_ms, 3))
    row.same_pid += after.pid == before.pid
    row.same_memory += after.token == before.token
    row.same_connection += after.connections == before.connections
    if conmon is not None:
        # One whose container has ended takes its time to go.
        time.sleep(1.0)
        row.same_run = (row.same_run or 0) + (subject.conmon() == conmon)
    row.cycles += 1


def stop_and_restore(subject: InWorld, client: Client, row: Row) -> None:
    """What CRIU is made for: the server is ended by the dump itself, and its connections are kept from ending."""
    before = client.identity()
    answers = client.answers
    client.board.forget_gap()
    subject.stop_and_restore()
    _answers_again(client, answers, time.monotonic_ns())
    row.stop_outage_ms.append(_ns_to_ms(client.board.see().gap_ns))
    row.stop_same_connection += client.identity().connections == before.connections
    row.stops += 1


def measure(subject: Subject, row: Row, cycles: int) -> None:
    """Fills the row; what a peer cannot do becomes a failure in it."""
    rng = random.Random(row.mb * 1000 + row.threads)
    row.load = round(os.getloadavg()[0], 1)
    try:
        with subject, subject.client() as client:
            client.wait_answers(100, "the client gets answers")
            # Not counted: avckpt's first checkpoint brings its code into the process.
            subject.checkpoint()
            for _ in range(cycles):
                cycle(subject, client, row, rng)
            if isinstance(subject, InWorld):
                for _ in range(min(STOPS, cycles)):
                    stop_and_restore(subject, client, row)
    except CriuFailed as error:
        row.failures.append(str(error))
    row.refused = len(subject.refused)
    row.failures += sorted(set(subject.refused))


class Bench:
    """Makes subjects, and what they need, once and only when it is needed."""

    def __init__(self, folder: Path, *, first: bool) -> None:
        self._folder = folder
        self._first = first
        self._container_options: list[str] = []
        self._undo = contextlib.ExitStack()
        self._world: World | None = None
        self._sidecar: Sidecar | None = None
        self._locked = False
        self.versions: dict[str, str] = {}

    def __enter__(self) -> Bench:
        if self._first:
            self._container_options = self._undo.enter_context(first_in_line())
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def subject(self, name: str, mb: int, threads: int) -> Subject:
        """Raises BenchFailed, CommandFailed, TimeoutError."""
        made = self._make(name, mb, threads)
        made.container_options = self._container_options
        return made

    def _make(self, name: str, mb: int, threads: int) -> Subject:
        kind = SUBJECTS[name]
        if issubclass(kind, InWorld):
            return kind(mb, threads, self._folder, self._the_world())
        if kind is AvckptPodman:
            return AvckptPodman(mb, threads, self._folder, self._the_sidecar())
        if issubclass(kind, ColdStart):
            return kind(mb, threads, self._folder, Podman())
        return kind(mb, threads, self._folder)

    def _the_world(self) -> World:
        if self._world is None:
            self._world = self._undo.enter_context(World(self._folder))
            self.versions.update(self._world.versions())
        return self._world

    def _the_sidecar(self) -> Sidecar:
        if self._sidecar is None:
            self._undo.enter_context(machine_lock(LOCK_PATIENCE_S))
            self._sidecar = self._undo.enter_context(running_sidecar(Podman()))
            if self._first:
                join(Podman().inspect(SIDECAR_NAME)["State"]["Pid"])
        return self._sidecar


def machine() -> dict[str, str]:
    """Where it was measured."""
    cpu = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        "?",
    )
    return {
        "kernel": platform.release(),
        "cpu": f"{os.cpu_count()} x {cpu}",
        "podman (avckpt, cold start)": Podman().run("--version").stdout.split()[-1],
    }


def load(path: Path) -> dict[str, Any]:
    """What is there; empty if nothing is."""
    if not path.exists():
        return {"machine": {}, "rows": []}
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def merge(path: Path, rows: Sequence[Row], versions: dict[str, str]) -> dict[str, Any]:
    """Puts new rows in the place of old ones of the same subject and workload; writes in one step."""
    results = load(path)
    key: Callable[[dict[str, Any]], tuple[Any, ...]] = lambda row: (row["subject"], row["mb"], row["threads"])  # noqa: E731
    merged = {key(row): row for row in results["rows"]}
    merged.update({key(row): row for row in map(asdict, rows)})
    order = [FORK, *(kind.name for kind in SUBJECTS.values())]
    results["rows"] = sorted(merged.values(), key=lambda row: (row["mb"], row["threads"], order.index(row["subject"])))
    results["machine"] = {**results["machine"], **machine(), **versions}
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(results, indent=1) + "\n")
    draft.replace(path)
    return results


def workloads(mb: Sequence[int], threads: Sequence[int]) -> Iterator[tuple[int, int]]:
    for size in mb:
        for number in threads:
            yield size, number


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def _names(text: str) -> list[str]:
    names = text.split(",")
    unknown = [name for name in names if name not in (FORK, *SUBJECTS)]
    if unknown:
        raise argparse.ArgumentTypeError(f"{', '.join(unknown)}: not one of {FORK}, {', '.join(SUBJECTS)}")
    return names


def main() -> int:
    parser = argparse.ArgumentParser(description="avckpt beside CRIU, cold start and a plain fork().")
    parser.add_argument("--subjects", type=_names, default=[FORK, *SUBJECTS], help="some of fork,engine,avckpt,...")
    parser.add_argument("--mb", type=_numbers, default=MEGABYTES, help="sizes, e.g. 10,100")
    parser.add_argument("--threads", type=_numbers, default=THREADS, help="numbers of threads, e.g. 1,20")
    parser.add_argument("--cycles", type=int, help="this many for everybody")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK_CYCLES} cycles each")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    parser.add_argument("--first", action="store_true", help="on a machine that others use: take the CPU first")
    parser.add_argument("--show", action="store_true", help="measure nothing, make table and plots of what is there")
    args = parser.parse_args()
    if args.show:
        peers_show.show(load(args.output), args.output)
        return 0
    if os.geteuid() != 0:
        print("bench: it takes root: other processes are traced, and containers are root's", file=sys.stderr)
        return 1
    rows: list[Row] = []
    status = 0
    try:
        build()
        build_workload()
        with boards_folder() as folder, Bench(folder, first=args.first) as bench:
            for name in args.subjects:
                for mb, threads in workloads(args.mb, args.threads):
                    console.print(f"{name}: {mb} MB, {threads} threads (load {os.getloadavg()[0]:.1f})", style="dim")
                    cycles = args.cycles or (QUICK_CYCLES if args.quick else 0)
                    if name == FORK:
                        rows.append(fork_row(mb, threads, cycles or 40))
                        continue
                    subject = bench.subject(name, mb, threads)
                    row = Row(subject.name, mb, threads)
                    try:
                        measure(subject, row, cycles or subject.cycles)
                    except (BenchFailed, AvckptError, CommandFailed, TimeoutError) as error:
                        # The others can be measured all the same.
                        print(f"bench: {error}", file=sys.stderr)
                        status = 1
                        continue
                    rows.append(row)
                    for failure in row.failures:
                        console.print(f"  {failure}", style="yellow")
            versions = bench.versions
    except (BenchFailed, AvckptError, CommandFailed, TimeoutError) as error:
        print(f"bench: {error}", file=sys.stderr)
        status = 1
        versions = {}
    peers_show.show(merge(args.output, rows, versions), args.output)
    return status


if __name__ == "__main__":
    sys.exit(main())
