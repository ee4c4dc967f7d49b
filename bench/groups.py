# SPDX-License-Identifier: Apache-2.0
"""A ring of members that pass numbered tokens and go back together: do their ledgers agree, and at what cost?

    .venv/bin/python -m bench.groups [--members 5] [--kills 500] [--interval 100ms] [--between 2] [--name NAME]

Needs root and what `make setup-build` builds; no Podman.  Each member is an avckpt-init in a PID
namespace of its own with `testkit/programs/ring.py`, which prints WRONG when a token is lost, duplicated
or received without having been sent.  A random member is killed every `--between` seconds.  Prints the results
and adds them to bench/results/groups.json; ends with 1 if the ledgers ever disagreed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client

from testkit.harness import ROOT, wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

RESULTS = ROOT / "bench/results/groups.json"
BACK_S = 20.0


def main() -> int:
    """Starts, kills, counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=5)
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--interval", default="100ms")
    parser.add_argument("--between", type=float, default=2.0, metavar="S")
    parser.add_argument("--name", default="one run", help="of this run in the file of results, where others stay")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory, local_sidecar(Path(directory)) as sidecar:
        sidecar.start()
        members = _start(sidecar, asked.members, asked.interval)
        freezes, kills, lost = _storm(sidecar, members, asked.kills, asked.between)
        rows = Client(sidecar.run_dir).containers()
        wrong = [line for each in members for line in _said(each) if "WRONG" in line or "Traceback" in line]
        history = Client(sidecar.run_dir).history()
        restored = [event for event in history if event["kind"] == "restored"]
        died = [event["restore_s"] for event in restored if event["reason"] != "group"]
        result = {
            "members": asked.members,
            "interval": asked.interval,
            "kills": kills,
            "not_back": lost,
            "wrong": wrong,
            "lines": min(row["checkpoints"] for row in rows),
            "checkpoints": sum(row["checkpoints"] for row in rows),
            "missed": sum(row["missed"] for row in rows),
            "tokens": int(_said(members[0])[-2].split()[0]) if not wrong else 0,
            "connections_lost": sum(int(_said(each)[-2].split()[2]) for each in members) if not wrong else 0,
            "freeze_median_ms": round(statistics.median(freezes) * 1000, 2),
            "freeze_p99_ms": round(sorted(freezes)[len(freezes) * 99 // 100] * 1000, 2),
            "restore_median_ms": round(statistics.median(died) * 1000, 1) if died else 0,
            "restore_p99_ms": round(sorted(died)[len(died) * 99 // 100] * 1000, 1) if died else 0,
            "phases_median_ms": _phases(history),
            "reset": [event["error"]["detail"] for event in restored if "ended" in str(event.get("error"))],
            "load": round(os.getloadavg()[0], 1),
        }
    print(json.dumps(result, indent=2))
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    RESULTS.write_text(json.dumps({**known, asked.name: result}, indent=2) + "\n")
    return 1 if wrong or lost else 0


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


def _storm(
    sidecar: LocalSidecar, members: list[Container], kills: int, between_s: float
) -> tuple[list[float], int, int]:
    """Freezes of single checkpoints in seconds, kills, and those after which not all came back."""
    freezes: list[float] = []
    for kill in range(1, kills + 1):
        end = time.monotonic() + random.uniform(0.5, 1.5) * between_s
        while time.monotonic() < end:
            freezes += [row["last_freeze_s"] for row in Client(sidecar.run_dir).containers() if row["last_freeze_s"]]
            time.sleep(0.1)
        os.kill(random.choice(members).app_pid, signal.SIGKILL)
        try:
            wait_until(lambda kill=kill: _restores(sidecar) == {kill}, BACK_S, f"restore {kill}")  # type: ignore[misc]
        except TimeoutError as error:
            print(error, [_said(each)[-1:] for each in members], sidecar.log[-2000:], file=sys.stderr)
            return freezes, kill, 1
    time.sleep(1.0)
    return freezes, kills, 0


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
