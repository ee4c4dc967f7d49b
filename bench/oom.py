# SPDX-License-Identifier: Apache-2.0
"""Containers that leak until the OOM killer takes their application: how many are restored?

    .venv/bin/python -m bench.oom [--containers 20] [--at-once 5] [--rates 10,50,200] [--memory 256m]

Each container has `--memory` and no label but avckpt.enable: a program in C or in Python that has
40 MB, and leaks so many MB per second, all of them written to, from the moment when it has all its
generations.  One that "came back" was killed by the OOM killer, and restored.  One whose
checkpoint is from after the beginning of its leak leaks on, and is killed again.

Needs root, Podman and what `make setup` builds.  Takes the machine's sidecar and hooks for itself,
as the tests do, and removes every container it starts.  Prints a table and writes
bench/results/oom.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.scale import VICTIMS
from testkit.board import Board
from testkit.harness import ROOT, Container, ContainerFactory, Podman, Sidecar, machine_lock, running_sidecar

RESULTS = ROOT / "bench/results/oom.json"
BASE_MB = 40
PATIENCE_S = 60.0

PYTHON = f"""
import mmap, signal, struct, sys, time
rate = float(sys.argv[1])
board = mmap.mmap(open(sys.argv[2], "r+b").fileno(), 4096)
beats, leaking = 0, False
def leak(*_):
    global leaking
    leaking = True
signal.signal(signal.SIGUSR1, leak)
held = [b"x" * (1 << 20) for _ in range({BASE_MB})]
last = time.monotonic()
owed = 0.0
while True:
    time.sleep(0.001)
    now = time.monotonic()
    if leaking and now - last < 0.1:
        owed += (now - last) * rate * (1 << 20)
        held.append(b"x" * int(owed))
        owed -= int(owed)
    last = now
    beats += 1
    struct.pack_into("<Q", board, 3 * 8, beats)
"""
"""Beats on the board as the victims do."""


@dataclass
class Result:
    """Some containers of one kind."""

    language: str
    mb_per_s: int
    memory: str
    containers: int
    killed: int
    """By the OOM killer, once at least."""
    came_back: int
    restores: int
    """Of all of them together, when somebody looked last."""
    not_back: list[str]
    """What the sidecar says of those."""
    load: float


def start(factory: ContainerFactory, folder: Path, language: str, rate: int, n: int, memory: str) -> Container:
    """One that does not leak yet."""
    board = f"/bench/{n}.board"
    program = {
        "C": ["/victims/leak", str(rate), str(BASE_MB), "--board", board],
        "Python": ["python3", "-c", PYTHON, str(rate), board],
    }[language]
    return factory.protected(
        *program,
        options=[
            *("--memory", memory, "--network", "none"),
            *("--volume", f"{VICTIMS}:/victims:ro", "--volume", f"{folder}:/bench"),
        ],
    )


def wait_rows(sidecar: Sidecar, containers: list[Container], timeout_s: float) -> None:
    """Until each has all its generations."""
    ids = {container.id for container in containers}
    deadline = time.monotonic() + timeout_s
    while sum(row["generations"] == row["keep"] for row in sidecar.ps() if row["id"] in ids) < len(ids):
        if time.monotonic() > deadline:
            raise TimeoutError(f"not all of {len(ids)} containers hold their generations: {sidecar.ps()}")
        time.sleep(0.5)


def watch(sidecar: Sidecar, containers: list[Container], rate: int) -> tuple[int, int, int, list[str]]:
    """Killed, came back, restores, and what is said of the others."""
    for container in containers:
        container.signal("USR1")
    until = time.monotonic() + 300 / rate + PATIENCE_S
    last: dict[str, dict[str, Any]] = {}
    back: dict[str, int] = {}
    ended: set[str] = set()
    while time.monotonic() < until and len(back.keys() | ended) < len(containers):
        for row in sidecar.ps(ended=True):
            last[row["id"]] = row
            if row["state"] == "ended":
                ended.add(row["id"])
            if row["restores"]:
                back[row["id"]] = row["restores"]
        time.sleep(0.5)
    said = [f"{c.name}: {json.dumps(last.get(c.id))}" for c in containers if c.id not in back]
    return len({c.id for c in containers} & (back.keys() | ended)), len(back), sum(back.values()), said


def measure(sidecar: Sidecar, factory: ContainerFactory, language: str, rate: int, options: Any) -> Result:
    """So many of one kind, some at once."""
    result = Result(language, rate, options.memory, options.containers, 0, 0, 0, [], 0.0)
    while (left := options.containers - result.came_back - len(result.not_back)) > 0:
        with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
            folder = Path(name)
            folder.chmod(0o777)
            numbers = range(min(left, options.at_once))
            for n in numbers:
                stack.enter_context(Board(folder / f"{n}.board"))
            containers = [start(factory, folder, language, rate, n, options.memory) for n in numbers]
            try:
                wait_rows(sidecar, containers, 120)
                killed, back, restores, said = watch(sidecar, containers, rate)
            finally:
                factory.close()
        result.killed += killed
        result.came_back += back
        result.restores += restores
        result.not_back += said
        for line in said:
            print(line)
        print(f"\r{language} {rate} MB/s: {result.came_back} of {result.came_back + len(result.not_back)}", flush=True)
    result.load = round(os.getloadavg()[0], 1)
    return result


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--containers", type=int, default=20)
    parser.add_argument("--at-once", type=int, default=5)
    parser.add_argument("--rates", default="10,50,200")
    parser.add_argument("--languages", default="C,Python")
    parser.add_argument("--memory", default="256m")
    options = parser.parse_args()
    subprocess.run(["make", "-s", "-C", str(VICTIMS.parent), "STATIC=1"], check=True)
    podman = Podman()
    factory = ContainerFactory(podman, f"avckpt-oom-{os.getpid()}")
    results = []
    with machine_lock(timeout_s=600), running_sidecar(podman) as sidecar:
        try:
            for language in options.languages.split(","):
                for rate in map(int, options.rates.split(",")):
                    results.append(measure(sidecar, factory, language, rate, options))
                    RESULTS.write_text(json.dumps([asdict(result) for result in results], indent=1) + "\n")
        finally:
            factory.close()
    for result in results:
        print(
            f"{result.language:8} {result.mb_per_s:4} MB/s: {result.came_back} of {result.containers} came back, "
            f"{result.restores} restores, load {result.load}"
        )
        for line in result.not_back:
            print(f"    {line}")


if __name__ == "__main__":
    main()
