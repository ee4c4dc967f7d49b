# SPDX-License-Identifier: Apache-2.0
"""How long a ROS 2 node's peer receives nothing when the node is restored: CycloneDDS and zenoh.

    make bench-ros2
    .venv/bin/python -m bench.ros2 --only cyclonedds --remedies none,skip --rates 100 --intervals auto,1

Real protected containers on Podman's bridge network: a node and, unprotected, its peer; both send to each other at a
fixed rate.  The node's application is killed with SIGKILL at random moments.  Two gaps are measured, each from the last
message before the death to the first after it: `out`, as the peer hears the node, and `in`, as the node hears the peer
(it tells in each message what it has heard).  `together` protects the peer, too, in a group with the node that goes
back to one instant.  ddsperf tells no more than how many pongs came: what is missing, divided
by the rate, is the outage there.

Needs root and what `make setup` and scripts/setup-ros2.sh build.  Takes the machine's sidecar and hooks for itself.
Results of earlier runs stay in bench/results/ros2.json unless they are measured again.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import random
import re
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench import ros2_show
from testkit.harness import (
    ROOT,
    Container,
    ContainerFactory,
    Podman,
    Sidecar,
    avckpt_command,
    machine_lock,
    running_sidecar,
    wait_until,
)

IMAGE = "localhost/avckpt-ros2:latest"
RESULTS = ROOT / "bench/results/ros2.json"
RECORD = struct.Struct("<4Q")
NS_PER_MS = 1e6
PATIENCE_S = 30.0
SETTLE_S = 0.5
STEADY_S = 0.4
AUTO_S = 3.0
"""The longest interval of `auto`."""
GAP = re.compile(r"^\w+: after (\d+) came (\d+)$", re.MULTILINE)
NODE = "/opt/ros2/build/dds_node"
ZENOH = "python3 /opt/ros2/zenoh_node.py"
PEER_TOPICS = "--in from_node --out to_node --log /log/heard"


@dataclass(frozen=True)
class Case:
    """A middleware and what is done about its numbers."""

    subject: str
    remedy: str
    node: str
    peer: str
    labels: tuple[tuple[str, str], ...] = ()
    together: bool = False

    @property
    def name(self) -> str:
        return f"{self.subject}/{self.remedy}"


HEAR = (("notify.self", "signal:USR1"),)
KEEP = (("tcp", "keep"),)
RESET = (("tcp", "reset"),)
CASES = (
    Case("ddsperf", "none", "ddsperf -i {domain} pong", "ddsperf -i {domain} ping {rate}Hz"),
    Case("cyclonedds", "none", f"{NODE} --rate {{rate}}", f"{NODE} --rate {{rate}} {PEER_TOPICS}"),
    Case(
        "cyclonedds",
        "best-effort",
        f"{NODE} --rate {{rate}} --best-effort",
        f"{NODE} --rate {{rate}} --best-effort {PEER_TOPICS}",
    ),
    Case("cyclonedds", "skip", f"{NODE} --rate {{rate}} --after-restore skip", f"{NODE} --rate {{rate}} {PEER_TOPICS}"),
    Case(
        "cyclonedds",
        "endpoints",
        f"{NODE} --rate {{rate}} --after-restore endpoints",
        f"{NODE} --rate {{rate}} {PEER_TOPICS}",
        HEAR,
    ),
    Case(
        "cyclonedds",
        "participant",
        f"{NODE} --rate {{rate}} --after-restore participant",
        f"{NODE} --rate {{rate}} {PEER_TOPICS}",
        HEAR,
    ),
    Case(
        "cyclonedds",
        "together",
        f"{NODE} --rate {{rate}}",
        f"{NODE} --rate {{rate}} {PEER_TOPICS}",
        together=True,
    ),
    Case(
        "zenoh",
        "default",
        f"{ZENOH} --rate {{rate}} --listen tcp/0.0.0.0:7447",
        f"{ZENOH} --rate {{rate}} --connect tcp/{{address}}:7447 {PEER_TOPICS}",
    ),
    Case(
        "zenoh",
        "together",
        f"{ZENOH} --rate {{rate}} --listen tcp/0.0.0.0:7447",
        f"{ZENOH} --rate {{rate}} --connect tcp/{{address}}:7447 {PEER_TOPICS}",
        together=True,
    ),
    Case(
        "zenoh",
        "none",
        f"{ZENOH} --rate {{rate}} --listen tcp/0.0.0.0:7447",
        f"{ZENOH} --rate {{rate}} --connect tcp/{{address}}:7447 {PEER_TOPICS}",
        KEEP,
    ),
    Case(
        "zenoh",
        "skip",
        f"{ZENOH} --rate {{rate}} --listen tcp/0.0.0.0:7447 --after-restore skip",
        f"{ZENOH} --rate {{rate}} --connect tcp/{{address}}:7447 {PEER_TOPICS}",
        KEEP,
    ),
    Case(
        "zenoh",
        "reset",
        f"{ZENOH} --rate {{rate}} --listen tcp/0.0.0.0:7447",
        f"{ZENOH} --rate {{rate}} --connect tcp/{{address}}:7447 {PEER_TOPICS}",
        RESET,
    ),
    Case(
        "zenoh",
        "reset-retry",
        f"{ZENOH} --rate {{rate}} --listen tcp/0.0.0.0:7447",
        f"{ZENOH} --rate {{rate}} --connect tcp/{{address}}:7447 --retry-ms 20 {PEER_TOPICS}",
        RESET,
    ),
)


@dataclass
class Trial:
    """One kill and what followed; a gap of None: not within PATIENCE_S."""

    subject: str
    remedy: str
    rate_hz: int
    interval_s: float | None
    """None: no label, which is `auto`."""
    age_s: float
    restore_ms: float
    freeze_ms: float
    """Median of all checkpoints of this container."""
    out_ms: float | None
    in_ms: float | None
    """None with ddsperf, which does not tell."""
    steady_ms: float
    """Largest gap that the peer saw in the time before the kill, STEADY_S; 0 with ddsperf."""
    lost: int | None = None
    """Messages of the node that nobody gets, at its rate; with `together`, numbers that are missing in what both
    remember."""


class Events:
    """`avckpt events --follow --all`, as long as the block lasts."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [*avckpt_command(), "events", "--follow", "--all", "--json"], stdout=subprocess.PIPE, text=True
        )
        self._seen: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> Events:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait()
        self._thread.join()

    def of(self, container: Container, kind: str) -> list[dict[str, Any]]:
        """So far, in their order."""
        return [event for event in list(self._seen) if event["id"] == container.id and event["kind"] == kind]

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._seen.append(json.loads(line))


class HeardLog:
    """What a peer (dds_node, zenoh_node) has heard: arrays of (now, count, sent, heard), in ns."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, last_bytes: int = 0) -> list[tuple[int, ...]]:
        """All of it, or about the end of it."""
        if not self._path.exists():
            return []
        with self._path.open("rb") as file:
            size = file.seek(0, os.SEEK_END) // RECORD.size * RECORD.size
            file.seek(max(0, size - last_bytes // RECORD.size * RECORD.size) if last_bytes else 0)
            data = file.read()
        return list(RECORD.iter_unpack(data[: len(data) // RECORD.size * RECORD.size]))

    def heard_since(self, at_ns: int) -> bool:
        """Do both directions work again: has the node heard what was sent after `at_ns`, and said so?"""
        newest = self.read(RECORD.size)
        return bool(newest) and newest[0][3] > at_ns

    def gaps(self, killed_ns: int) -> tuple[float | None, float | None, float]:
        """out, in, and the largest one of the time before; ms."""
        before = [r for r in self.read() if r[0] <= killed_ns]
        # One that goes back, too, may have been about to write down a message that it heard before the line.
        last_out, last_in = max(r[0] for r in before[-100:]), max(r[3] for r in before[-100:])
        out = heard = None
        for now, _, sent, heard_ns in self.read():
            if out is None and sent > killed_ns:
                out = (now - last_out) / NS_PER_MS
            if heard is None and heard_ns > killed_ns:
                heard = (heard_ns - last_in) / NS_PER_MS
        steady = [r[0] for r in before if r[0] > killed_ns - STEADY_S * 1e9]
        return out, heard, max((b - a for a, b in zip(steady, steady[1:])), default=0) / NS_PER_MS


class PongCounts:
    """ddsperf ping's own report: a line about once a second, with the number of pongs since the last one."""

    LINE = re.compile(r"^\[\d+\] +(\d+\.\d+) .* mean .* cnt (\d+)$", re.MULTILINE)

    def __init__(self, path: Path, rate_hz: int) -> None:
        self._path = path
        self._rate_hz = rate_hz

    def lines(self) -> list[tuple[float, int]]:
        """(seconds since its start, pongs)"""
        if not self._path.exists():
            return []
        return [(float(at), int(count)) for at, count in self.LINE.findall(self._path.read_text())]

    def wait_whole_second(self, after: int) -> int:
        """Waits for the second line after the first `after` ones that lacks little; how many there are."""

        def whole() -> int:
            lines = self.lines()
            good = [count >= 0.8 * self._rate_hz for _, count in lines[after:]]
            return len(lines) if good[1:].count(True) >= 1 else 0

        return wait_until(whole, PATIENCE_S, "ddsperf's pongs come again", every_s=0.1)

    def missing_ms(self, first: int, last: int) -> float:
        """Of the pongs between the ends of two lines, by their numbers."""
        lines = self.lines()
        expected = (lines[last - 1][0] - lines[first - 1][0]) * self._rate_hz
        return 1000 * max(0.0, expected - sum(count for _, count in lines[first:last])) / self._rate_hz


def measure(case: Case, rate_hz: int, interval_s: float | None, restores: int, world: World) -> list[Trial]:
    """Starts a pair, kills its node `restores` times."""
    with world.pair(case, rate_hz, interval_s) as (node, peer, folder):
        kill = kill_ddsperf if case.subject == "ddsperf" else kill_node
        gaps = []
        missing = [missing_numbers(node, peer)]
        for number in range(restores):
            # One checkpoint at least after the restore before; then any moment between two.
            time.sleep(SETTLE_S + (interval_s or AUTO_S) * (1 + random.random()))
            gaps.append(kill(world.sidecar, node, folder, rate_hz))
            missing.append(missing_numbers(node, peer) if case.together else 0)
            outage = "never" if gaps[-1][0] is None else f"{gaps[-1][0]:.0f} ms"
            print(
                f"{case.name} {rate_hz} Hz, every {interval_name(interval_s)}: {number + 1} of {restores}, {outage}",
                flush=True,
            )
        wait_until(
            lambda: len(world.events.of(node, "restored")) >= restores, PATIENCE_S, f"{restores} restores are told"
        )
        freezes = sorted(event["freeze_s"] for event in world.events.of(node, "checkpoint"))
        return [
            Trial(
                subject=case.subject,
                remedy=case.remedy,
                rate_hz=rate_hz,
                interval_s=interval_s,
                age_s=round(event["age_s"], 4),
                restore_ms=round(1e3 * event["restore_s"], 3),
                freeze_ms=round(1e3 * freezes[len(freezes) // 2], 3),
                out_ms=out and round(out, 1),
                in_ms=heard and round(heard, 1),
                steady_ms=round(steady, 1),
                lost=after - before if case.together else missed(out, rate_hz),
            )
            for event, (out, heard, steady), before, after in zip(
                world.events.of(node, "restored"), gaps, missing, missing[1:]
            )
        ]


def missed(out_ms: float | None, rate_hz: int) -> int | None:
    """How many messages would have been sent in an outage."""
    return None if out_ms is None else max(0, round(out_ms * rate_hz / 1000) - 1)


def missing_numbers(node: Container, peer: Container) -> int:
    """Of messages, in what the two remember: they tell each that is not the next one."""
    return sum(abs(int(came) - int(last) - 1) for each in (node, peer) for last, came in GAP.findall(each.logs()))


def interval_name(interval_s: float | None) -> str:
    return "auto" if interval_s is None else f"{interval_s:g} s"


Gaps = tuple["float | None", "float | None", float]


def kill_node(sidecar: Sidecar, node: Container, folder: Path, rate_hz: int) -> Gaps:
    """One of ours; the peer has written down every message."""
    heard = HeardLog(folder / "heard")
    pid = sidecar.app_pid(node)
    os.kill(pid, signal.SIGKILL)
    # It may send for some more microseconds; what is sent later is sent by the restored one.
    killed_ns = time.monotonic_ns() + 200_000
    with contextlib.suppress(TimeoutError):
        wait_until(lambda: heard.heard_since(killed_ns), PATIENCE_S, "both hear each other again")
    return heard.gaps(killed_ns)


def kill_ddsperf(sidecar: Sidecar, node: Container, folder: Path, rate_hz: int) -> Gaps:
    """ddsperf's pong."""
    counts = PongCounts(folder / "ping", rate_hz)
    first = len(counts.lines())
    os.kill(sidecar.app_pid(node), signal.SIGKILL)
    try:
        last = counts.wait_whole_second(first)
    except TimeoutError:
        return None, None, 0.0
    return counts.missing_ms(first, last), None, 0.0


@dataclass
class World:
    """What all pairs share."""

    sidecar: Sidecar
    factory: ContainerFactory
    events: Events
    folder: Path
    domains: Iterator[int]

    @contextlib.contextmanager
    def pair(self, case: Case, rate_hz: int, interval_s: float | None) -> Iterator[tuple[Container, Container, Path]]:
        """A protected node and its peer, in a DDS domain of their own, that hear each other; and the peer's folder."""
        domain = next(self.domains)
        folder = self.folder / str(domain)
        folder.mkdir()
        words = {"rate": rate_hz, "domain": domain, "address": ""}
        env = ["--env", f'CYCLONEDDS_URI=<CycloneDDS><Domain Id="{domain}"/></CycloneDDS>']
        if case.subject == "ddsperf":  # it has an option for that, and does not want both
            env = []
        labels = {"restore.max": "60/60s", **dict(case.labels)}
        if interval_s is not None:
            labels["interval"] = f"{round(1000 * interval_s)}ms"
        if case.together:
            labels |= {"group": f"pair-{os.getpid()}-{domain}", "group.recovery": "together"}
        node = self.factory.protected(
            *case.node.format(**words).split(),
            labels=labels,
            options=env,
            image=IMAGE,
        )
        words["address"] = node.ip
        command = case.peer.format(**words).split()
        if case.subject == "ddsperf":
            command = ["sh", "-c", f"exec {' '.join(command)} >/log/ping"]
        start = functools.partial(self.factory.protected, labels=labels) if case.together else self.factory
        peer = start(*command, options=(*env, "--volume", f"{folder}:/log"), image=IMAGE)
        try:
            started = time.monotonic_ns()
            if case.subject == "ddsperf":
                counts = PongCounts(folder / "ping", rate_hz)
                counts.wait_whole_second(0)
            else:
                heard = HeardLog(folder / "heard")
                wait_until(lambda: heard.heard_since(started), PATIENCE_S, f"the pair of {case.name} hears each other")
            self.sidecar.wait_generation(node)
            if case.together:
                # Of both, and not of before they heard each other.
                line = (self.sidecar.find(node) or {}).get("line", 0)
                for each in (node, peer):
                    self.sidecar.wait_for(each, lambda entry: entry["line"] > line + 1, "a line")
            yield node, peer, folder
        finally:
            node.remove()
            peer.remove()


def run(options: argparse.Namespace) -> list[Trial]:
    """Everything that was asked for; pairs run `--parallel` at a time."""
    podman = Podman()
    factory = ContainerFactory(podman, f"avckpt-ros2-{os.getpid()}")
    wanted = [
        (case, rate, interval)
        for case in CASES
        if case.subject in options.only and (not options.remedies or case.remedy in options.remedies)
        for rate in options.rates
        for interval in options.intervals
        if not (case.together and interval is None)  # it is refused
    ]
    with (
        machine_lock(timeout_s=options.wait),
        running_sidecar(podman) as sidecar,
        Events() as events,
        tempfile.TemporaryDirectory() as folder,
    ):
        world = World(sidecar, factory, events, Path(folder), iter(range(1, 200)))
        try:
            with ThreadPoolExecutor(options.parallel) as pool:
                done = [
                    pool.submit(measure, case, rate, interval, options.restores, world)
                    for case, rate, interval in wanted
                ]
                return [trial for future in done for trial in future.result()]
        finally:
            factory.close()


def merge(trials: list[Trial], path: Path) -> list[Trial]:
    """What was measured now replaces what was measured before, case by case."""
    now = {(t.subject, t.remedy, t.rate_hz, t.interval_s) for t in trials}
    before = [Trial(**entry) for entry in json.loads(path.read_text())["trials"]] if path.exists() else []
    return [t for t in before if (t.subject, t.remedy, t.rate_hz, t.interval_s) not in now] + trials


def write(trials: list[Trial], path: Path) -> None:
    """In one step, so that no reader ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = {(case.subject, case.remedy): number for number, case in enumerate(CASES)}
    trials.sort(key=lambda t: (order.get((t.subject, t.remedy), 99), t.rate_hz, t.interval_s or 0))
    draft = path.with_suffix(".tmp")
    entries = [{key: value for key, value in asdict(t).items() if (key, value) != ("lost", None)} for t in trials]
    draft.write_text('{"trials": [\n' + ",\n".join(map(json.dumps, entries)) + "\n]}\n")
    draft.replace(path)


def main() -> int:
    subjects = sorted({case.subject for case in CASES})
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--restores", type=int, default=10, help="kills per point")
    parser.add_argument("--rates", type=lambda text: [int(part) for part in text.split(",")], default=[100, 1000])
    parser.add_argument(
        "--intervals",
        type=lambda text: [None if part == "auto" else float(part) for part in text.split(",")],
        default=[None, 0.1, 0.5, 1.0, 3.0],
    )
    parser.add_argument("--only", type=lambda text: text.split(","), default=subjects, help=",".join(subjects))
    parser.add_argument("--remedies", type=lambda text: text.split(","), help="e.g. none,skip")
    parser.add_argument("--parallel", type=int, default=2, help="pairs at a time")
    parser.add_argument("--wait", type=float, default=600, help="seconds to wait for the machine")
    parser.add_argument("--show", action="store_true", help="measure nothing: table and plots of what is there")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    if options.show:
        trials = merge([], options.output)
    else:
        trials = merge(run(options), options.output)
        write(trials, options.output)
    print(ros2_show.table(trials))
    ros2_show.draw(trials, options.output.with_suffix(""))
    return 0


if __name__ == "__main__":
    sys.exit(main())
