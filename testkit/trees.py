# SPDX-License-Identifier: Apache-2.0
"""Applications of several processes in protected containers: started, killed, compared, and put under load."""

from __future__ import annotations

import contextlib
import http.client
import os
import random
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest

from testkit.family import Member, left_alone, look
from testkit.harness import SLOWNESS, Container, ContainerFactory, Podman, Sidecar, wait_until
from testkit.procfs import below

IMAGE = "localhost/avckpt-trees:latest"
LONG = os.environ.get("AVCKPT_LONG") == "1"
"""`make test-trees`."""
LABELS = {"interval": "100ms", "restore.max": "64/1s"}
RESTORE_S = 30.0 * SLOWNESS


def trees_image(podman: Podman) -> str:
    """The image of scripts/setup-trees.sh."""
    if podman.run("image", "exists", IMAGE, check=False).status != 0:
        pytest.fail(f"no image {IMAGE}: run `scripts/setup-trees.sh`")
    return IMAGE


@dataclass
class Tree:
    """A protected container with a tree of processes in it."""

    sidecar: Sidecar
    container: Container
    restores: int = 0

    @property
    def main(self) -> int:
        """The main process, on the host; waits while it is being restored."""

        def find() -> int:
            try:
                return self.sidecar.app_pid(self.container)
            except LookupError:
                return 0

        return wait_until(find, RESTORE_S, f"the application of {self.container.name} is there", every_s=0.005)

    def members(self) -> list[Member]:
        """The application's processes.

        A worker's holder is made by the worker (process_hold_stopped() in holder.c): for a moment it and the task
        that clones it are below the worker.
        """

        def seen() -> list[Member]:
            main = self.main
            found = [look(pid) for pid in (main, *below(main))]
            return [member for member in found if member is not None and not member.name.startswith("avckpt-")]

        return left_alone(seen, RESTORE_S, self.container.name)

    def places(self) -> list[tuple[int, int, int, int, str, bool]]:
        """Who is where: to be the same after a restore if processes neither come nor go."""
        return sorted(member.place for member in self.members())

    def kill(self, signum: int = signal.SIGKILL) -> dict[str, Any]:
        """Kills the main process and waits for the restore; the entry of `avckpt ps` after it."""
        self.restores += 1
        os.kill(self.main, signum)
        entry = self.sidecar.wait_restores(self.container, self.restores, RESTORE_S)
        assert entry["restores"] == self.restores, entry
        assert self.container.status == "running"
        return entry

    def next_generation(self) -> None:
        """Waits for a checkpoint that begins after now."""
        entry = self.sidecar.find(self.container)
        assert entry is not None
        self.sidecar.wait_generation(self.container, entry["generation"] + 2, RESTORE_S)


def start_tree(
    sidecar: Sidecar,
    factory: ContainerFactory,
    *command: str,
    labels: Mapping[str, str] | None = None,
    options: Sequence[str] = (),
) -> Tree:
    """Runs it protected and waits for the second generation."""
    made = factory.protected(
        *command, labels={**LABELS, **(labels or {})}, options=options, image=trees_image(factory.podman)
    )
    tree = Tree(sidecar, made)
    sidecar.wait_generation(made, 2, 2 * RESTORE_S)
    return tree


@dataclass
class Load:
    """Clients that ask a web server without a pause, on connections that they keep.

    What they get must be right; that a connection is lost or an answer does not come is what a
    crash may do to them, and is counted.  A context manager.
    """

    host: str
    port: int
    paths: Mapping[str, bytes | None]
    """What is asked for, and the body; None: any."""
    clients: int = 4
    answers: int = 0
    lost: int = 0
    wrong: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=self._ask, args=(n,), daemon=True) for n in range(self.clients)]

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        self.wait_answers(20)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def wait_answers(self, n: int, timeout_s: float = RESTORE_S) -> None:
        """For `n` more right answers."""
        wanted = self.answers + n
        wait_until(lambda: self.answers >= wanted or self.wrong, timeout_s, f"{n} answers of {self.host}:{self.port}")
        assert self.wrong == []

    def _ask(self, number: int) -> None:
        rng = random.Random(number)
        connection: http.client.HTTPConnection | None = None
        while not self._stop.is_set():
            path = rng.choice(list(self.paths))
            try:
                if connection is None:
                    connection = http.client.HTTPConnection(self.host, self.port, timeout=5 * SLOWNESS)
                connection.request("GET", path)
                response = connection.getresponse()
                body = response.read()
            except (OSError, http.client.HTTPException):
                with self._lock:
                    self.lost += 1
                if connection is not None:
                    connection.close()
                connection = None
                time.sleep(0.01)
                continue
            wanted = self.paths[path]
            with self._lock:
                if response.status != 200 or (wanted is not None and body != wanted):
                    self.wrong.append(f"{path}: {response.status}, {len(body)} bytes: {body[:80]!r}")
                else:
                    self.answers += 1
            if rng.random() < 0.02:
                connection.close()
                connection = None


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Readable for every user of a container."""
    folder.chmod(0o755)
    for name, content in files.items():
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        path.chmod(0o755)


def laps(text: str, word: str = "lap") -> list[int]:
    """The numbers of lines "lap N"."""
    found = []
    for line in text.splitlines():
        with contextlib.suppress(ValueError):
            first, number = line.split()
            if first == word:
                found.append(int(number))
    return found


def check_laps(numbers: Sequence[int], restores: int) -> None:
    """One after the other; a restore, and nothing else, goes back."""
    assert numbers.count(1) <= 1 + restores
    steps = [after - before for before, after in zip(numbers, numbers[1:])]
    assert all(step == 1 or step <= 0 for step in steps), [step for step in steps if step > 1]
    assert sum(step <= 0 for step in steps) <= restores
