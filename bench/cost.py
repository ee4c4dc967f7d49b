# SPDX-License-Identifier: Apache-2.0
"""`make bench-cost`: what checkpoints cost a running server, by interval and by how much it writes.

bench/server.c answers a client that asks every millisecond, while another of its
threads writes whole pages, one after the other through all of its memory, at a
given rate.  Every request changes a word in 8 pages, so that it meets page faults
as well.  The engine takes checkpoints with the default settings of a container.

  latency   of each request, from its sending to its answer; the client does not wait
            for answers before it asks again, so that a stopped server is noticed
  fault     how much longer the first write to a page takes after a checkpoint:
            the kernel copies it (copy-on-write)
  memory    what 1 to 5 generations hold: all pages of server and templates, less the
            server's own (proportional set sizes, and page tables)

`fork` is the limit: the server makes plain fork(2)s of itself at the same intervals.

Results go into bench/results/cost.json (cells that were not measured this time stay);
tables and plots beside it.  Ends with 1 when something could not be measured.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avckpt.engine import Engine
from avckpt.errors import AvckptError
from avckpt.events.vocabulary import Kind
from avckpt.guard import Event, GuardConfig, Images
from avckpt.supervision.pressure import templates_of
from rich.console import Console

from bench import cost_show
from bench.cpu_group import REAL_TIME, first_in_line
from bench.peers_subjects import Below
from bench.subjects import BenchFailed, build, eventually
from bench.workload import PROGRAMS, Client, boards_folder, build_workload, read_log
from testkit.board import Board, Seen
from testkit.harness import ROOT, free_port
from testkit.procfs import children_of, figures

RESULTS = ROOT / "bench" / "results" / "cost.json"
MB = 256
RATES = (1, 10, 100, 500)
INTERVALS = (3.0, 1.0, 0.5, 0.1)
KEEPS = (1, 2, 3, 4, 5)
SIZES = (10, 100, 1000)
TOUCHED = 8
"""Pages that a request changes a word in."""
QUIESCE_S = 0.02
KEEP = 2
"""These two are a container's defaults."""
SECONDS = 20.0
SETTLE_S = 2.0
QUANTILES = (0.5, 0.9, 0.95, 0.99, 0.995, 0.999, 0.9995)

console = Console(highlight=False)


@dataclass(frozen=True)
class Way:
    """How checkpoints are taken, of what."""

    kind: str
    """"none", "avckpt" or "fork"."""
    interval_s: float
    rate_mb_s: int
    mb: int = MB
    keep: int = KEEP
    touched: int = TOUCHED


@dataclass(frozen=True)
class Cell:
    """What was measured for one way; the entries of cost.json.  Latencies in us."""

    kind: str
    interval_s: float
    rate_mb_s: int
    mb: int
    keep: int
    requests: int
    quantiles_us: dict[str, float]
    worst_us: float
    checkpoints: int
    missed: int
    quiescent: int
    freeze_ms: float
    freeze_worst_ms: float
    written_mb_s: float
    page_us: float
    """Time to write a page, on average."""
    faults_per_s: float
    faults_per_page: float
    load: float


@dataclass(frozen=True)
class Held:
    """Memory of so many generations; MB."""

    interval_s: float
    rate_mb_s: int
    mb: int
    keep: int
    pages_mb: float
    tables_mb: float


class Protected:
    """The server below avckpt-init; with `way.kind` "avckpt" also an engine that takes checkpoints of it."""

    def __init__(self, way: Way, folder: Path, before: Sequence[str] = (), *, images: Images = Images.FORK) -> None:
        self.way = way
        self.images = images
        self.port = free_port()
        self.board = Board(folder / f"server-{self.port}")
        self.events: list[Event] = []
        command = [*before, str(PROGRAMS / "server"), str(way.mb), "1", str(self.port), "--touch", str(way.touched)]
        command += ["--write-mb-s", str(way.rate_mb_s), "--board", str(self.board.path)]
        if way.kind == "fork":
            command += ["--fork-ms", str(round(way.interval_s * 1e3)), "--keep", str(way.keep)]
        self._below = Below(self.board, command)
        self._undo = contextlib.ExitStack()
        self._engine: Engine | None = None

    def __enter__(self) -> Protected:
        self._undo.callback(self.board.page.close)
        self._undo.enter_context(self._below)
        if self.way.kind == "avckpt":
            self._engine = self._undo.enter_context(Engine())
            config = GuardConfig(
                interval_s=self.way.interval_s,
                keep=self.way.keep,
                restore_on_signal=True,
                restore_on_exit=True,
                restore_on_statuses=frozenset(),
                restore_max=5,
                restore_window_s=60.0,
                quiesce_s=QUIESCE_S,
                images=self.images,
            )
            pidfd = os.pidfd_open(self.init_pid)
            try:
                self._engine.start_guard(pidfd, config, cookie=1)
            finally:
                os.close(pidfd)
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    @property
    def init_pid(self) -> int:
        return self._below.init_pid

    def take_events(self) -> None:
        """To be called now and then.  Raises BenchFailed when the server is not protected any more."""
        while self._engine is not None and (event := self._engine.next_event()) is not None:
            if event.kind not in (Kind.ATTACHED, Kind.CHECKPOINT, Kind.MISSED):
                raise BenchFailed(f"{event.kind.name}: {event.error}")
            self.events.append(event)

    def wait(self, seconds: float) -> None:
        """Lets it run."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            time.sleep(min(0.2, left))
            self.take_events()
            self._below.check()

    def templates(self) -> list[int]:
        """Their PIDs."""
        found = []
        for child in children_of(self.init_pid):
            with contextlib.suppress(OSError):
                if Path(f"/proc/{child}/comm").read_text().strip() == "avckpt-tmpl":
                    found.append(child)
        return found


def measure(way: Way, seconds: float, folder: Path, before: Sequence[str] = ()) -> Cell:
    """`before`: words in front of both programs.  Raises BenchFailed, AvckptError."""
    load = os.getloadavg()[0]
    log = folder / "log"
    with (
        Protected(way, folder, before) as server,
        Client(folder, server.port, enter=before, log=log, seconds=SETTLE_S + seconds) as client,
    ):
        client.wait_answers(100, "the client gets answers")
        # The first checkpoint brings the engine's code into the server.
        server.wait(SETTLE_S)
        server.events.clear()
        begin, started_ns = server.board.see(), time.monotonic_ns()
        server.wait(seconds)
        end, ended_ns = server.board.see(), time.monotonic_ns()
        client.wait_end()
    logged = read_log(log)
    latencies = sorted(ms * 1e3 for sent, ms in zip(logged.sent_ns, logged.latency_ms) if started_ns <= sent < ended_ns)
    if len(latencies) < 1000:
        raise BenchFailed(f"only {len(latencies)} requests were answered")
    return _cell(way, latencies, (begin, end), server.events, (ended_ns - started_ns) / 1e9, load)


def _cell(
    way: Way, latencies: Sequence[float], seen: tuple[Seen, Seen], events: Sequence[Event], took_s: float, load: float
) -> Cell:
    before, after = seen
    pages, ns, faults = (after.counter[n] - before.counter[n] for n in (1, 2, 3))
    taken = [event for event in events if event.kind is Kind.CHECKPOINT]
    freezes = [event.freeze_s * 1e3 for event in taken]
    if way.kind == "fork":
        # The server's own account: its longest fork(2), no median.
        freezes = [after.counter[4] / 1e6]
    return Cell(
        kind=way.kind,
        interval_s=way.interval_s,
        rate_mb_s=way.rate_mb_s,
        mb=way.mb,
        keep=way.keep,
        requests=len(latencies),
        quantiles_us={str(q): round(latencies[int(q * len(latencies))], 1) for q in QUANTILES},
        worst_us=round(latencies[-1], 1),
        checkpoints=after.counter[5] - before.counter[5] if way.kind == "fork" else len(taken),
        missed=sum(event.kind is Kind.MISSED for event in events),
        quiescent=sum(event.quiescent for event in taken),
        freeze_ms=round(statistics.median(freezes), 3) if freezes else 0.0,
        freeze_worst_ms=round(max(freezes), 3) if freezes else 0.0,
        written_mb_s=round(pages / 256 / took_s, 2),
        page_us=round(ns / 1e3 / max(1, pages), 3),
        faults_per_s=round(faults / took_s, 1),
        faults_per_page=round(faults / max(1, pages), 4),
        load=round(load, 1),
    )


def hold(way: Way, folder: Path, before: Sequence[str] = ()) -> Held:
    """What the generations hold when all of them are there and the newest is as old as it gets.

    Raises BenchFailed, AvckptError.
    """
    with Protected(way, folder, before) as server:
        eventually(lambda: server.board.see().ready == 1, "the server has touched its memory")
        highest, tables = 0.0, 0.0
        # Until all are there, and then over some more intervals: what is held grows from one checkpoint
        # to the next, and is least just after one.
        server.wait(way.interval_s)
        eventually(lambda: len(server.templates()) == way.keep, f"there are {way.keep} generations")
        until = time.monotonic() + 3 * way.interval_s
        while time.monotonic() < until:
            server.wait(way.interval_s / 10)
            if len(server.templates()) != way.keep:
                continue
            with contextlib.suppress(OSError):
                held = [figures(pid) for pid in templates_of(server.init_pid)]
                app = figures(server_pid(server))
                pages = sum(each["Pss"] for each in held) + app["Pss"] - app["Rss"]
                if pages / 1024 > highest:
                    highest = pages / 1024
                    tables = sum(each["VmPTE"] for each in held) / 1024
        if not tables:
            raise BenchFailed(f"{way.keep} generations were never seen")
    return Held(way.interval_s, way.rate_mb_s, way.mb, way.keep, round(highest, 2), round(tables, 2))


def server_pid(server: Protected) -> int:
    """The server itself."""
    for child in children_of(server.init_pid):
        with contextlib.suppress(OSError):
            if Path(f"/proc/{child}/comm").read_text().strip() == "server":
                return child
    raise BenchFailed("the server is not there any more")


def ways(rates: Sequence[int], intervals: Sequence[float], kinds: Sequence[str]) -> Iterator[Way]:
    """By rate; what is compared is measured one after the other."""
    for rate in rates:
        if "none" in kinds:
            yield Way("none", 0.0, rate)
        for interval in intervals:
            for kind in ("avckpt", "fork"):
                if kind in kinds:
                    yield Way(kind, interval, rate)


def load_results(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {"cells": [], "memory": []}
    found: dict[str, Any] = json.loads(path.read_text())
    return found


def merge(path: Path, cells: Sequence[Cell], memory: Sequence[Held]) -> dict[str, Any]:
    """Puts new entries in the place of old ones for the same way; writes in one step."""
    results = load_results(path)
    for name, new in (("cells", cells), ("memory", memory)):
        merged = {_key(each): each for each in [*results[name], *map(asdict, new)]}
        results[name] = [merged[key] for key in sorted(merged)]
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    draft.write_text(json.dumps(results, indent=1) + "\n")
    draft.replace(path)
    return results


def _key(entry: dict[str, Any]) -> tuple[Any, ...]:
    kind = ("none", "avckpt", "fork").index(entry.get("kind", "avckpt"))
    return entry["mb"], entry["rate_mb_s"], kind, -entry["interval_s"], entry["keep"]


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")] if text else []


def _seconds(text: str) -> list[float]:
    return [float(part) for part in text.split(",")] if text else []


def main() -> int:
    parser = argparse.ArgumentParser(description="What checkpoints cost a request/reply server over time.")
    parser.add_argument("--rates", type=_numbers, default=RATES, help="MB/s written, e.g. 1,100")
    parser.add_argument("--intervals", type=_seconds, default=INTERVALS, help="seconds, e.g. 3,0.1")
    parser.add_argument("--kinds", default="none,avckpt,fork", help="some of %(default)s")
    parser.add_argument("--sizes", type=_numbers, default=SIZES, help="MB, with 10 MB/s at 1 s; empty: none")
    parser.add_argument("--keeps", type=_numbers, default=KEEPS, help="generations held for memory; empty: none")
    parser.add_argument("--memory-rates", type=_numbers, default=(1, 10, 100, 500), help="MB/s for that")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="for each cell (%(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS, help="where the results go (%(default)s)")
    parser.add_argument("--first", action="store_true", help="on a machine that others use: take the CPU first")
    parser.add_argument("--show", action="store_true", help="measure nothing, make tables and plots of what is there")
    args = parser.parse_args()
    if args.show:
        cost_show.show(load_results(args.output), args.output)
        return 0
    if os.geteuid() != 0:
        print("bench: it takes root: the engine traces other processes", file=sys.stderr)
        return 1
    cells: list[Cell] = []
    memory: list[Held] = []
    status = 0
    try:
        build()
        build_workload()
        with boards_folder() as folder, first_in_line() if args.first else contextlib.nullcontext():
            for way in ways(args.rates, args.intervals, args.kinds.split(",")):
                console.print(f"{way} (load {os.getloadavg()[0]:.1f})", style="dim")
                cells.append(measure(way, args.seconds, folder, REAL_TIME if args.first else ()))
            for mb in args.sizes:
                for kind in ("none", "avckpt"):
                    way = Way(kind, 1.0 if kind == "avckpt" else 0.0, 10, mb)
                    console.print(f"{way} (load {os.getloadavg()[0]:.1f})", style="dim")
                    cells.append(measure(way, args.seconds, folder, REAL_TIME if args.first else ()))
            for rate in args.memory_rates:
                for keep in args.keeps:
                    way = Way("avckpt", 1.0, rate, keep=keep)
                    console.print(f"memory: {way}", style="dim")
                    memory.append(hold(way, folder, REAL_TIME if args.first else ()))
    except (BenchFailed, AvckptError) as error:
        print(f"bench: {error}", file=sys.stderr)
        status = 1
    finally:
        # What was measured is not lost with what could not be.
        results = merge(args.output, cells, memory)
    cost_show.show(results, args.output)
    return status


if __name__ == "__main__":
    sys.exit(main())
