# SPDX-License-Identifier: Apache-2.0
"""Injects faults into programs in protected containers, and counts what follows.

    python -m bench.campaign --runs 50 --seconds 60        into bench/results/campaign.json

Hours: with `--go-on`, what --output has of the same seconds and labels counts, so that it can be made in parts.

Each run is a program of bench/faults in a container of Podman's, with hooks and sidecar of this
checkout: its own, so that the machine's are left alone.  It computes a known series and sends each
term; an oracle compares.  A node of ROS publishes the terms instead, and another node, which is not
protected, sends on what it hears.  A signal triggers the fault; what happens within `--seconds` of
the first death (or of the signal, where there is none) decides.  Every run is counted, once:

    wrong      a wrong term was sent
    cold       the container ended: all its state is lost
    recrashed  it died more than once, and continues correctly
    recovered  it died once, and continues correctly
    stuck      it lives, and sends nothing
    unharmed   it did not die, and continues correctly

`--label avckpt.keep=4` and so on change what the containers are protected with.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import itertools
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client
from avckpt.errors import AvckptError

from testkit.harness import BASE_IMAGE, ROOT, CommandFailed, Podman, wait_until
from testkit.local_sidecar import LocalSidecar, hooked_podman, local_sidecar
from testkit.procfs import state_of

RESULTS = ROOT / "bench" / "results" / "campaign.json"
FAULTS = ROOT / "bench" / "faults"
ROS_IMAGE = "localhost/avckpt-ros:latest"
ROS_BUILD_IMAGE = "localhost/avckpt-ros-build"
OUTCOMES = ("recovered", "recrashed", "wrong", "cold", "stuck", "unharmed")
LABELS = {"avckpt.enable": "true", "avckpt.interval": "200ms"}
MOMENT_S = 1.0
"""So long after the program is protected, at most, comes the signal: at no particular time since a checkpoint."""
POISON_EVERY_S = 1.0
"""Poison comes back: whoever sent it has had no answer."""
SILENT_S = 10.0
"""So long at the end: where more runs than CPUs wait, one may be silent for seconds."""
TOLD = 100
"""After so many runs a line says how far it is."""
LOOK_S = 0.2
"""Between two looks at a run."""
ROWS_S = 0.25
"""So old may be what the sidecar has said of all runs: each asking for itself would keep it busy."""
OUT_OF_MEMORY = "memory leak to the OOM killer"
MEMORY = "150m"
"""Of a container that leaks."""
SPINNING_CPUS = "0.08"
"""Of a container with a livelock."""
COMPILE = ("g++", "-O1", "-g", "-w", "-pthread", "-fstack-protector-all")
"""-w: compilers see some of the faults."""

EVERYWHERE = (
    *("null pointer", "index out of range", "uncaught exception", "stack overflow", "exit with a status"),
    *("descriptor leak", "killed from outside", "fault in another thread", "poison input"),
    *("poison input, one in four", "corruption before the checkpoint", "wrong value, no crash"),
    *("deadlock", "livelock", "lost wake-up", "disk full", OUT_OF_MEMORY),
)
NOT_ROS = ("death of a thread",)
NOT_GO = (
    *("double free", "assertion", "truncated mapped file", "memory leak to a limit", "death of a child"),
    *("burst of bad messages", "bad job in a queue"),
    *("deadlock, own watchdog", "livelock, own watchdog", "lost wake-up, own watchdog", "timer without a handler"),
)
ONLY_CPP = (
    *("wild pointer", "write to constant", "call through null", "use after free", "heap corruption found later"),
    *("stack smashed", "division by zero", "illegal instruction", "race", "hang in a callback", "broken pipe"),
    "threads that meet",
    *("hang in a callback, own watchdog", "the only thread ends", "pure virtual call", "huge allocation"),
)
WATCHED_THREAD = "death of a thread, own watchdog"
LANGUAGES = {
    "C++": (*EVERYWHERE, *NOT_ROS, *NOT_GO, *ONLY_CPP, WATCHED_THREAD),
    "Python": (*EVERYWHERE, *NOT_ROS, *NOT_GO, "abort", WATCHED_THREAD),
    "Go": (*EVERYWHERE, *NOT_ROS, "division by zero", "race"),
    "ROS": (*EVERYWHERE, *NOT_GO, *(fault for fault in ONLY_CPP if fault != "the only thread ends")),
}


class Rows:
    """What the sidecar says of its containers, for all runs together."""

    def __init__(self, run_dir: Path) -> None:
        self._client = Client(run_dir)
        self._lock = threading.Lock()
        self._rows: dict[str, dict[str, Any]] = {}
        self._at_s = 0.0

    def of(self, name: str) -> dict[str, Any]:
        """Of the newest container of that name; empty: it knows none.  Raises AvckptError, OSError."""
        with self._lock:
            if time.monotonic() - self._at_s > ROWS_S:
                self._rows = {row["name"]: row for row in self._client.containers(ended=True, memory=False)}
                self._at_s = time.monotonic()
            return self._rows.get(name, {})


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
    image: str
    command: list[str]
    counted: dict[str, int] = field(default_factory=lambda: dict.fromkeys(OUTCOMES, 0))
    detected_s: list[float] = field(default_factory=list)
    restored_s: list[float] = field(default_factory=list)
    failed: int = 0
    """Runs that could not be made: the program was not protected in time."""

    @property
    def runs(self) -> int:
        """That were counted."""
        return sum(self.counted.values())

    def missing(self, wanted: int) -> int:
        """Runs; one that could not be made is tried again, but not for ever."""
        return wanted - self.runs if self.failed < wanted else 0

    def to_json(self) -> dict[str, object]:
        """As in the results."""
        return {
            "fault": self.fault,
            "language": self.language,
            "runs": self.runs,
            **self.counted,
            "not_made": self.failed,
            "detected_max_s": max(self.detected_s, default=None),
            "restored_max_s": max(self.restored_s, default=None),
        }


@dataclass(frozen=True)
class World:
    """Where containers run: a Podman whose hooks, and whose sidecar, are this checkout's and ours alone."""

    podman: Podman
    sidecar: LocalSidecar
    rows: Rows
    programs: Path
    labels: dict[str, str]
    options: list[str]
    core: str
    """The container of ROS's master; empty: there is none."""
    core_port: int
    core_pid: str = ""

    def relay(self, program: str, port: int) -> subprocess.Popen[bytes]:
        """A node that is not protected, and sends to `port` what it hears, in the master's container."""
        command = ("nsenter", "--mount", "--target", self.core_pid, program, "relay", str(port))
        return subprocess.Popen(command, env={**os.environ, **self._ros()}, stdout=subprocess.DEVNULL)

    def _ros(self) -> dict[str, str]:
        return {"ROS_MASTER_URI": f"http://127.0.0.1:{self.core_port}", "ROS_IP": "127.0.0.1"}

    def start(self, name: str, image: str, command: Sequence[str], options: Sequence[str], *, protect: bool) -> str:
        """A container; its id.  Raises CommandFailed."""
        labels = {key: value for key, value in self.labels.items() if protect}
        words = [word for key, value in labels.items() for word in ("--label", f"{key}={value}")]
        env = [word for key, value in self._ros().items() for word in ("--env", f"{key}={value}")]
        return self.podman.run(
            *("run", "--detach", "--rm", "--pull=never", "--network=host", "--volume", f"{self.programs}:/faults:ro"),
            *("--name", name, *words, *env, *self.options, *options, image, *command),
        ).stdout.strip()

    def remove(self, name: str) -> None:
        """Ends one; Podman removes it then.  Where nobody knows its first process that takes a command, and on a
        busy machine more than one attempt."""
        with contextlib.suppress(AvckptError, OSError):
            row = self.rows.of(name)
            if row and row["state"] != "ended":
                os.kill(row["init_pid"], signal.SIGKILL)
            if row:
                return
        for _ in range(3):
            with contextlib.suppress(CommandFailed, subprocess.TimeoutExpired):
                self.podman.remove(name)
                return


@contextlib.contextmanager
def world(programs: Path, labels: dict[str, str], options: list[str], *, ros: bool) -> Iterator[World]:
    """One, for some runs."""
    with tempfile.TemporaryDirectory() as folder, local_sidecar(Path(folder)) as sidecar:
        sidecar.start()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port: int = probe.getsockname()[1]
        core = f"avckpt-campaign-{os.getpid()}-core" if ros else ""
        made = World(hooked_podman(sidecar), sidecar, Rows(sidecar.run_dir), programs, labels, options, core, port)
        try:
            if ros:
                made.start(core, ROS_IMAGE, ["rosmaster", "--core", "-p", str(port)], [], protect=False)
                pid = made.podman.run("inspect", "--format", "{{.State.Pid}}", core).stdout.strip()
                made = replace(made, core_pid=pid)
            yield made
        finally:
            if ros:
                made.remove(core)


class Run:
    """One of them, which begins now."""

    def __init__(self, world: World, cell: Cell, name: str, seconds: float) -> None:
        self._world = world
        self._cell = cell
        self._seconds = seconds
        self._begun = time.time()
        self.name = name
        self._oracle = Oracle()

    def outcome(self) -> str:
        """Makes it.  Raises TimeoutError, OSError or CommandFailed when the program could not be protected."""
        cell, port, relay = self._cell, self._oracle.port, None
        try:
            if cell.language == "ROS":
                relay = self._world.relay(cell.command[0], port)
            command = [*cell.command, cell.fault, str(port)]
            self._world.start(self.name, cell.image, command, options_for(cell.fault), protect=True)
            wait_until(lambda: self._row().get("generations", 0) >= 2, 30, "it is protected", every_s=0.1)
            wait_until(lambda: self._oracle.heard > 20, 30, "it computes", every_s=0.1)
            time.sleep(random.uniform(0, MOMENT_S))
            self._bring_out()
            outcome = self._judge()
            self._note_times()
            return outcome
        finally:
            self._oracle.close()
            self._world.remove(self.name)
            if relay is not None:
                relay.kill()
                relay.wait()

    def _bring_out(self) -> None:
        pid = int(self._row()["app_pid"])
        os.kill(pid, signal.SIGUSR1)

    def _judge(self) -> str:
        end = time.monotonic() + self._seconds
        poisoned = time.monotonic()
        died = False
        while time.monotonic() < end:
            time.sleep(LOOK_S)
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
        if time.monotonic() - self._oracle.last_s > min(SILENT_S, self._seconds / 2):
            if row["restores"]:
                print(f"{self._cell.language}, {self._cell.fault}: stuck: {tasks(row['app_pid'])}", file=sys.stderr)
            return "stuck"
        return "unharmed" if not row["restores"] else "recovered" if row["restores"] == 1 else "recrashed"

    def _note_times(self) -> None:
        """How long detection and restore took, as the sidecar has told.  Now: it forgets the oldest events."""
        for event in Client(self._world.sidecar.run_dir).history(self._begun):
            if event["container"] == self.name and event["kind"] == "crash":
                self._cell.restored_s += [event["restore_s"]] if "restore_s" in event else []
                self._cell.detected_s += [event["detected_s"]] if "detected_s" in event else []

    def _row(self) -> dict[str, Any]:
        return self._world.rows.of(self.name)


def outcome(world: World, cell: Cell, name: str, seconds: float) -> str:
    """Of a run that begins when it is its turn."""
    return Run(world, cell, name, seconds).outcome()


def tasks(pid: int) -> str:
    """What each thread of a process waits for: one that was restored and is stuck is a defect of ours."""
    found = []
    for task in sorted(Path(f"/proc/{pid}/task").glob("*")):
        with contextlib.suppress(OSError):
            texts = [(task / name).read_text().strip() for name in ("comm", "wchan", "syscall")]
            found.append(f"{task.name} {state_of(int(task.name))} {' '.join(texts)}")
    return "; ".join(found)


def options_for(fault: str) -> tuple[str, ...]:
    """Of podman run: for faults that need a limit, and those that would take the CPUs of all others."""
    if fault == OUT_OF_MEMORY:
        return "--memory", MEMORY, "--memory-swap", MEMORY
    return ("--cpus", SPINNING_CPUS) if "livelock" in fault else ()


def cells(build: Path, wanted: set[str]) -> list[Cell]:
    """All that this machine can make, its programs put into `build`."""
    shutil.copy(FAULTS / "faults.py", build)
    made = []
    commands = {"Python": (BASE_IMAGE, ["python3", "/faults/faults.py"])}
    if "C++" in wanted:
        subprocess.run([*COMPILE, "-o", str(build / "cpp"), str(FAULTS / "faults.cpp")], check=True)
        commands["C++"] = (BASE_IMAGE, ["/faults/cpp"])
    if "Go" in wanted and shutil.which("go"):
        env = {**os.environ, "GOCACHE": str(build / "cache"), "GO111MODULE": "off", "CGO_ENABLED": "0"}
        subprocess.run(["go", "build", "-o", str(build / "go"), str(FAULTS / "faults.go")], check=True, env=env)
        commands["Go"] = (BASE_IMAGE, ["/faults/go"])
    if "ROS" in wanted and compile_ros(build):
        commands["ROS"] = (ROS_IMAGE, ["/faults/ros"])
    for language, faults in LANGUAGES.items():
        if language in commands and language in wanted:
            made += [Cell(fault, language, *commands[language]) for fault in faults]
    return made


def compile_ros(build: Path) -> bool:
    """With Debian's ROS 1, in a container (scripts/setup-ros.sh); whether there is one."""
    podman = Podman()
    images = podman.run("images", "--format", "{{.Repository}}:{{.Tag}}", ROS_BUILD_IMAGE).stdout.split()
    if not images or podman.run("image", "exists", ROS_IMAGE, check=False).status != 0:
        return False
    compiler = " ".join((*COMPILE, "-DROS", "-o", "/out/ros", "/src/faults.cpp"))
    libraries = "$(pkg-config --cflags --libs roscpp std_msgs) -lboost_system -lboost_thread"
    podman.run(
        *("run", "--rm", "--pull=never", "--network=none", "--volume", f"{FAULTS}:/src:ro"),
        *("--volume", f"{build}:/out", images[0], "sh", "-c", f"{compiler} {libraries}"),
        timeout_s=600,
    )
    return True


def make(cells: list[Cell], number: int, options: argparse.Namespace, programs: Path) -> None:
    """What is missing, those with the fewest runs first, some side by side, all under one sidecar of their own."""
    labels = {**LABELS, **dict(pair.split("=", 1) for pair in options.label)}
    missing = [(cell.runs + i, random.random(), cell) for cell in cells for i in range(cell.missing(options.runs))]
    missing.sort(key=lambda each: each[:2])
    ros = any(cell.language == "ROS" for cell in cells)
    begun = time.monotonic()
    pool = concurrent.futures.ThreadPoolExecutor(options.parallel)
    with world(programs, labels, options.podman, ros=ros) as here, pool:
        made: dict[concurrent.futures.Future[str], Cell] = {}
        for i, (_, _, cell) in enumerate(missing):
            name = f"avckpt-campaign-{os.getpid()}-{number}-{i}"
            made[pool.submit(outcome, here, cell, name, options.seconds)] = cell
        for i, done in enumerate(concurrent.futures.as_completed(made), 1):
            cell = made[done]
            try:
                cell.counted[done.result()] += 1
            except (OSError, CommandFailed, AvckptError, KeyError, subprocess.SubprocessError) as error:
                cell.failed += 1
                print(f"{cell.language}, {cell.fault}: not made: {str(error)[-300:]}", file=sys.stderr)
            write(options.output, cells, options)
            if i % TOLD == 0:
                print(f"{i} of {len(missing)} runs, {time.monotonic() - begun:.0f} s", file=sys.stderr)


def main() -> None:
    """Makes the campaign."""
    parser = argparse.ArgumentParser(description="inject faults into programs in protected containers")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--parallel", type=int, default=4)
    parser.add_argument("--go-on", action="store_true", help="what --output has of --seconds and --label counts")
    parser.add_argument("--language", action="append", choices=sorted(LANGUAGES))
    parser.add_argument("--fault", action="append")
    parser.add_argument("--label", action="append", default=[], metavar="NAME=VALUE", help="another label of theirs")
    parser.add_argument(
        "--podman", action="append", default=[], metavar="OPTION", help="of podman run, for all of them"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as build:
        Path(build).chmod(0o755)
        made = cells(Path(build), set(options.language or LANGUAGES))
        made = [cell for cell in made if not options.fault or cell.fault in options.fault]
        if options.go_on:
            take_up(made, options)
        for number in itertools.count():
            if not any(cell.missing(options.runs) for cell in made):
                break
            make(made, number, options, Path(build))


def take_up(made: list[Cell], options: argparse.Namespace) -> None:
    """What was counted before, under the same conditions."""
    of = {(cell.fault, cell.language): cell for cell in made}
    for found in json.loads(options.output.read_text()) if options.output.exists() else []:
        cell = of.get((found["fault"], found["language"]))
        if cell is not None and (found["seconds"], found["labels"]) == (options.seconds, options.label):
            cell.counted = {outcome: found[outcome] for outcome in OUTCOMES}
            cell.failed = found["not_made"]
            cell.detected_s = [found["detected_max_s"]] if found["detected_max_s"] is not None else []
            cell.restored_s = [found["restored_max_s"]] if found["restored_max_s"] is not None else []


def write(path: Path, made: list[Cell], options: argparse.Namespace) -> None:
    """The results so far; the file is whole at every instant."""
    found = [{**cell.to_json(), "seconds": options.seconds, "labels": options.label} for cell in made]
    new = path.with_suffix(".new")
    new.write_text(json.dumps(found, indent=1) + "\n")
    new.replace(path)


if __name__ == "__main__":
    main()
