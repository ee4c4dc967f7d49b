# SPDX-License-Identifier: Apache-2.0
"""A ring of members that pass numbered tokens and go back together: do their ledgers agree, and at what cost?

    .venv/bin/python -m bench.groups [--members 5] [--lines 10000] [--kills 500] [--interval 25ms] [--name NAME]

Needs root and what `make setup-build` builds; no Podman.  Each member is an avckpt-init in a PID
namespace of its own with `testkit/programs/ring.py`, which prints WRONG when a token is lost, duplicated
or received without having been sent.  The kills, of random members, are spread over the lines.  Prints the
results and adds them to bench/results/groups.json; ends with 1 if the ledgers ever disagreed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client
from avckpt.errors import AvckptError

from testkit.harness import ROOT, wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

RESULTS = ROOT / "bench/results/groups.json"
BACK_S = 20.0


def main() -> int:
    """Starts, kills, counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=5)
    parser.add_argument("--lines", type=int, default=10000)
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=40, help="ends then, with as many as there are")
    parser.add_argument("--interval", default="25ms")
    parser.add_argument("--name", default="one run", help="of this run in the file of results, where others stay")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, local_sidecar(Path(directory)) as sidecar:
        sidecar.start()
        heard = Heard(asked.members)
        threading.Thread(target=heard.listen, args=(sidecar,), daemon=True).start()
        members = _start(sidecar, asked.members, asked.interval)
        began = time.monotonic()
        kills, lost = _storm(sidecar, members, heard, asked)
        rows = Client(sidecar.run_dir).containers()
        wrong = [line for each in members for line in _said(each) if "WRONG" in line or "Traceback" in line]
        restored = [event for event in heard.deaths if event["kind"] == "restored"]
        result = {
            "members": asked.members,
            "interval": asked.interval,
            "minutes": round((time.monotonic() - began) / 60, 1),
            "kills": kills,
            "not_back": lost,
            "wrong": wrong,
            "lines": len(heard.lines),
            "checkpoints": sum(row["checkpoints"] for row in rows),
            "missed": sum(row["missed"] for row in rows),
            "tokens": int(_said(members[0])[-2].split()[0]) if not wrong else 0,
            "connections_lost": sum(int(_said(each)[-2].split()[2]) for each in members) if not wrong else 0,
            "freeze_ms": _spread([line.freeze_s for line in heard.lines]),
            "freeze_beyond_longest_members_ms": _spread([line.freeze_s - line.longest_s for line in heard.lines]),
            "within_1_ms_of_longest_members": sum(line.freeze_s - line.longest_s <= 0.001 for line in heard.lines),
            "instants_apart_ms": _spread([line.apart_s for line in heard.lines]),
            "instants_apart_less_than_the_freeze": sum(line.apart_s < line.freeze_s for line in heard.lines),
            "restore_ms": _spread([event["restore_s"] for event in restored if event["reason"] != "group"]),
            "phases_median_ms": _phases(heard.deaths),
            "reset": [event["error"]["detail"] for event in restored if "ended" in str(event.get("error"))],
            "load": round(os.getloadavg()[0], 1),
        }
    print(json.dumps(result, indent=2))
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps({**known, asked.name: result}, indent=2) + "\n")
    return 1 if wrong or lost else 0


@dataclass
class Line:
    """One line of all members."""

    freeze_s: float
    """The longest time that one of them was stopped."""
    longest_s: float
    """The same, had it not waited for the others."""
    apart_s: float
    """From the instant in which the first was stopped to that of the last."""


class Heard:
    """What the sidecar reports."""

    def __init__(self, members: int) -> None:
        self._members = members
        self._parts: dict[int, list[dict[str, Any]]] = {}
        self.lines: list[Line] = []
        self.deaths: list[dict[str, Any]] = []

    def listen(self, sidecar: LocalSidecar) -> None:
        """Until the sidecar ends."""
        with contextlib.suppress(OSError, AvckptError):
            for event in Client(sidecar.run_dir).events(routine=True):
                if event["kind"] in ("died", "restored"):
                    self.deaths.append(event)
                elif event["kind"] == "checkpoint" and event.get("line"):
                    self._add(event)

    def _add(self, event: dict[str, Any]) -> None:
        parts = self._parts.setdefault(event["line"], [])
        parts.append(event)
        if len(parts) == self._members:
            instants = [part["monotonic_s"] for part in parts]
            longest, own = (max(part[name] for part in parts) for name in ("freeze_s", "freeze_own_s"))
            self.lines.append(Line(longest, own, max(instants) - min(instants)))
            self._parts.clear()


def _spread(times_s: list[float]) -> dict[str, float]:
    """Median, 99th percentile and longest, in ms."""
    ordered = sorted(times_s) or [0.0]
    found = {"median": statistics.median(ordered), "p99": ordered[len(ordered) * 99 // 100], "longest": ordered[-1]}
    return {name: round(each * 1000, 2) for name, each in found.items()}


def _start(sidecar: LocalSidecar, count: int, interval: str) -> list[Container]:
    labels = {
        "avckpt.enable": "true",
        "avckpt.interval": interval,
        "avckpt.group": "ring",
        "avckpt.group.recovery": "together",
        "avckpt.restore.max": "64/1s",
    }
    port = random.randrange(20000, 30000)
    program = [sys.executable, "-u", str(ROOT / "testkit/programs/ring.py")]
    members = [sidecar.protected(f"member{i}", [*program, str(i), str(count), str(port)], labels) for i in range(count)]
    wait_until(lambda: len(_lines(sidecar)) == 1 and 0 not in _lines(sidecar), 60, "a line of all")
    return members


def _storm(sidecar: LocalSidecar, members: list[Container], heard: Heard, asked: argparse.Namespace) -> tuple[int, int]:
    """The number of kills, and of those after which not all came back."""
    end = time.monotonic() + asked.minutes * 60
    for kill in range(1, asked.kills + 1):
        # Half a step early or late: at all ages of a line, and soon after a restore, too.
        due = (kill + random.uniform(-0.5, 0.5)) * asked.lines / asked.kills
        while len(heard.lines) < due:
            if time.monotonic() > end:
                return kill - 1, 0
            time.sleep(random.uniform(0.005, 0.05))
        os.kill(random.choice(members).app_pid, signal.SIGKILL)
        try:
            wait_until(lambda kill=kill: _restores(sidecar) == {kill}, BACK_S, f"restore {kill}")  # type: ignore[misc]
        except TimeoutError as error:
            print(error, [_said(each)[-1:] for each in members], sidecar.log[-2000:], file=sys.stderr)
            return kill, 1
        print(f"\r{kill} kills, {len(heard.lines)} lines", end="", file=sys.stderr, flush=True)
    while len(heard.lines) < asked.lines and time.monotonic() < end:
        time.sleep(0.2)
    time.sleep(1.0)
    return asked.kills, 0


def _phases(history: list[dict[str, Any]]) -> dict[str, float]:
    """Medians over all returns: from the first death to that of the next member, to that of the last, and to the
    restore of all, each at the time that its guard gave."""
    phases: dict[str, list[float]] = {"to_first_other": [], "to_last_other": [], "to_restored": []}
    deaths: list[float] = []
    for event in history:
        if event["kind"] == "died":
            deaths.append(event["monotonic_s"])
        elif event["kind"] == "restored" and deaths:
            if len(deaths) > 1:
                for name, end in zip(phases, (deaths[1], deaths[-1], event["monotonic_s"])):
                    phases[name].append(end - deaths[0])
            deaths = []
    return {name: round(statistics.median(times) * 1000, 1) for name, times in phases.items() if times}


def _lines(sidecar: LocalSidecar) -> set[int]:
    return {row["line"] for row in Client(sidecar.run_dir).containers()}


def _restores(sidecar: LocalSidecar) -> set[int]:
    rows = Client(sidecar.run_dir).containers()
    return {row["restores"] for row in rows if row["state"] == "protected"}


def _said(member: Container) -> list[str]:
    return member.output.read_text().splitlines()


if __name__ == "__main__":
    sys.exit(main())
