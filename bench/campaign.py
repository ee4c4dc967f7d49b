# SPDX-License-Identifier: Apache-2.0
"""Injects faults into protected programs, and counts what follows.

    python -m bench.campaign --runs 50 --seconds 60        into bench/results/campaign.json

Each run is a program of bench/faults in a PID namespace of its own, protected by a real sidecar as
a container is.  It computes a known series and sends each term; an oracle compares.  A signal
triggers the fault; what happens within `--seconds` of the first death (or of the signal,
where there is none) decides.  Every run is counted, once:

    wrong      a wrong term was sent
    cold       the container ended: all its state is lost
    recrashed  it died more than once, and continues correctly
    recovered  it died once, and continues correctly
    stuck      it lives, and sends nothing
    unharmed   it did not die, and continues correctly
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import hashlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client

from testkit.harness import ROOT, wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

RESULTS = ROOT / "bench" / "results" / "campaign.json"
FAULTS = ROOT / "bench" / "faults"
OUTCOMES = ("recovered", "recrashed", "wrong", "cold", "stuck", "unharmed")
LABELS = {"avckpt.enable": "true", "avckpt.interval": "200ms"}
POISON_EVERY_S = 1.0
"""Poison comes back: whoever sent it has had no answer."""
SILENT_S = 2.0

EVERYWHERE = (
    *("null pointer", "index out of range", "uncaught exception", "stack overflow", "exit with a status"),
    *("descriptor leak", "killed from outside", "fault in another thread", "poison input"),
    *("poison input, one in four", "corruption before the checkpoint", "wrong value, no crash"),
    *("deadlock", "livelock", "lost wake-up"),
)
NOT_GO = (
    *("double free", "assertion", "truncated mapped file", "memory leak to a limit", "death of a child"),
    *("deadlock, own watchdog", "livelock, own watchdog", "lost wake-up, own watchdog"),
)
LANGUAGES = {
    "C++": (
        *EVERYWHERE,
        *NOT_GO,
        *("wild pointer", "write to constant", "call through null", "use after free", "heap corruption found later"),
        *("stack smashed", "division by zero", "illegal instruction", "race", "hang in a callback"),
        *("hang in a callback, own watchdog", "the only thread ends"),
    ),
    "Python": (*EVERYWHERE, *NOT_GO, "abort"),
    "Go": (*EVERYWHERE, "division by zero", "race"),
}


class Oracle:
    """Knows the series, and hears what one program sends."""

    _terms = [0]  # noqa: RUF012 - one series for all of them
    _lock = threading.Lock()

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.2)
        self.port: int = self._socket.getsockname()[1]
        self.heard = self.wrong = 0
        self.last_s = 0.0
        self._over = False
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hears no more."""
        self._over = True
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        while not self._over:
            try:
                number, value = map(int, self._socket.recv(200).split())
            except socket.timeout:
                continue
            self.heard += 1
            self.last_s = time.monotonic()
            self.wrong += value != self._term(number)

    @classmethod
    def _term(cls, number: int) -> int:
        with cls._lock:
            while len(cls._terms) <= number < 10**8:
                cls._terms.append((cls._terms[-1] * 6364136223846793005 + 1442695040888963407) % 2**64)
            return cls._terms[number] if number < len(cls._terms) else -1


@dataclass
class Cell:
    """One fault in one language."""

    fault: str
    language: str
    command: list[str]
    counted: dict[str, int] = field(default_factory=lambda: dict.fromkeys(OUTCOMES, 0))
    detected_s: list[float] = field(default_factory=list)
    restored_s: list[float] = field(default_factory=list)
    failed: int = 0
    """Runs that could not be made: the program was not protected in time."""

    def to_json(self) -> dict[str, object]:
        """As in the results."""
        return {
            "fault": self.fault,
            "language": self.language,
            "runs": sum(self.counted.values()),
            **self.counted,
            "not_made": self.failed,
            "detected_max_s": max(self.detected_s, default=None),
            "restored_max_s": max(self.restored_s, default=None),
        }


class Run:
    """One of them."""

    def __init__(self, sidecar: LocalSidecar, cell: Cell, name: str, seconds: float) -> None:
        self._sidecar = sidecar
        self._client = Client(sidecar.run_dir)
        self._cell = cell
        self._seconds = seconds
        self.name = name
        self._oracle = Oracle()
        self._container: Container | None = None

    def outcome(self) -> str:
        """Makes it.  Raises TimeoutError, AssertionError or OSError when the program could not be protected."""
        try:
            command = [*self._cell.command, self._cell.fault, str(self._oracle.port)]
            # Not the place in a list from which others are taken away at the same time.
            identity = hashlib.sha256(self.name.encode()).hexdigest()
            self._container = self._sidecar.container(self.name, command, identity)
            said = self._container.hook("prestart", LABELS)
            if said:
                raise OSError(said.strip())
            wait_until(lambda: self._row()["generations"] >= 2, 30, "it is protected", every_s=0.1)
            wait_until(lambda: self._oracle.heard > 20, 30, "it computes", every_s=0.1)
            self._bring_out()
            return self._judge()
        finally:
            self._oracle.close()
            if self._container is not None:
                self._container.close()
                self._sidecar.containers.remove(self._container)

    def _bring_out(self) -> None:
        pid = int(self._row()["app_pid"])
        os.kill(pid, signal.SIGUSR1)

    def _judge(self) -> str:
        end = time.monotonic() + self._seconds
        poisoned = time.monotonic()
        died = False
        while time.monotonic() < end:
            time.sleep(0.05)
            row = self._row()
            if row["state"] == "ended":
                return "wrong" if self._oracle.wrong else "cold"
            if row["restores"] and not died:
                died = True
                end = time.monotonic() + self._seconds
            if "poison" in self._cell.fault and time.monotonic() - poisoned > POISON_EVERY_S:
                poisoned = time.monotonic()
                if row["state"] == "protected":
                    with contextlib.suppress(ProcessLookupError):  # it is dying at this moment
                        self._bring_out()
        if self._oracle.wrong:
            return "wrong"
        if time.monotonic() - self._oracle.last_s > SILENT_S:
            return "stuck"
        return "unharmed" if not row["restores"] else "recovered" if row["restores"] == 1 else "recrashed"

    def _row(self) -> dict[str, Any]:
        assert self._container is not None
        rows = self._client.containers(ended=True, memory=False)
        return next(row for row in reversed(rows) if row["name"] == self.name)


def cells(build: Path, wanted: set[str]) -> list[Cell]:
    """All that this machine can make, its programs compiled into `build`."""
    made = []
    commands = {"Python": [sys.executable, str(FAULTS / "faults.py")]}
    if "C++" in wanted:
        options = ["-O1", "-g", "-w", "-pthread", "-fstack-protector-all"]  # -w: compilers see some of the faults
        subprocess.run(["g++", *options, "-o", str(build / "cpp"), str(FAULTS / "faults.cpp")], check=True)
        commands["C++"] = [str(build / "cpp")]
    if "Go" in wanted and shutil.which("go"):
        env = {**os.environ, "GOCACHE": str(build / "cache"), "GO111MODULE": "off"}
        subprocess.run(["go", "build", "-o", str(build / "go"), str(FAULTS / "faults.go")], check=True, env=env)
        commands["Go"] = [str(build / "go")]
    for language, faults in LANGUAGES.items():
        if language in commands and language in wanted:
            made += [Cell(fault, language, commands[language]) for fault in faults]
    return made


def times(sidecar: LocalSidecar, names: dict[str, Cell]) -> None:
    """How long detection and restore took, as the sidecar has told."""
    for event in Client(sidecar.run_dir).history():
        cell = names.get(event["container"])
        if cell is not None and event["kind"] == "crash":
            cell.restored_s += [event["restore_s"]] if "restore_s" in event else []
            cell.detected_s += [event["detected_s"]] if "detected_s" in event else []


def one_round(made: list[Cell], number: int, parallel: int, seconds: float) -> None:
    """Each of them once, under a sidecar of its own."""
    names: dict[str, Cell] = {}
    with tempfile.TemporaryDirectory() as folder, local_sidecar(Path(folder)) as sidecar:
        sidecar.start()
        with concurrent.futures.ThreadPoolExecutor(parallel) as pool:
            runs: dict[concurrent.futures.Future[str], Cell] = {}
            for i, cell in enumerate(made):
                name = f"run-{number}-{i}"
                names[name] = cell
                runs[pool.submit(lambda c=cell, n=name: Run(sidecar, c, n, seconds).outcome())] = cell  # type: ignore[misc]
            for done in concurrent.futures.as_completed(runs):
                cell = runs[done]
                try:
                    cell.counted[done.result()] += 1
                except (TimeoutError, AssertionError, OSError, StopIteration, subprocess.SubprocessError) as error:
                    cell.failed += 1
                    print(f"{cell.language}, {cell.fault}: not made: {str(error)[:200]}", file=sys.stderr)
        times(sidecar, names)


def main() -> None:
    """Makes the campaign."""
    parser = argparse.ArgumentParser(description="inject faults into protected programs")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--parallel", type=int, default=4)
    parser.add_argument("--language", action="append", choices=sorted(LANGUAGES))
    parser.add_argument("--fault", action="append")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as build:
        made = cells(Path(build), set(options.language or LANGUAGES))
        made = [cell for cell in made if not options.fault or cell.fault in options.fault]
        for number in range(options.runs):
            one_round(made, number, options.parallel, options.seconds)
            write(options.output, made, options.seconds)
            print(f"round {number + 1} of {options.runs}, {time.monotonic() - begun:.0f} s", file=sys.stderr)


def write(path: Path, made: list[Cell], seconds: float) -> None:
    """The results so far."""
    path.write_text(json.dumps([{**cell.to_json(), "seconds": seconds} for cell in made], indent=1) + "\n")


if __name__ == "__main__":
    main()
