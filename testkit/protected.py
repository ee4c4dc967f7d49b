# SPDX-License-Identifier: Apache-2.0
"""A victim in a protected container of a real Podman, with its board."""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from testkit.board import Board, Seen
from testkit.harness import ROOT, Container, ContainerFactory, Sidecar, take_checkpoint, wait_until

QUICK = {"interval": "100ms", "restore.max": "60/60s"}


@dataclass
class ProtectedVictim:
    """What a test on a protected container needs at hand."""

    sidecar: Sidecar
    container: Container
    board: Board

    def see(self) -> Seen:
        return self.board.see()

    @property
    def app(self) -> int:
        """The victim's PID on the host; waits while it is being restored."""

        def look() -> int:
            try:
                return self.sidecar.app_pid(self.container)
            except LookupError:
                return 0

        return wait_until(look, 10, "the application is there")

    def wait_beats(self, n: int = 20, timeout_s: float = 10.0) -> None:
        """Waits for beats, and for nothing to be wrong."""
        wanted = self.see().beats + n
        wait_until(lambda: self.see().beats >= wanted, timeout_s, f"{n} beats of {self.container.name}")
        assert self.see().violations == 0, self.container.logs()

    def events(self, *kinds: str) -> list[dict[str, Any]]:
        """What `avckpt events` tells of it, of these kinds."""
        return [
            event
            for event in self.sidecar.client.history()
            if event["id"] == self.container.id and event["kind"] in kinds
        ]

    def checkpoint(self) -> int:
        """Takes one, and waits for it; returns its generation."""
        return take_checkpoint(self.sidecar.client, self.container.name)

    def kill(self, signum: int) -> dict[str, Any]:
        """Kills the victim as it is now, and waits for the restore; the entry of `avckpt ps` after it."""
        entry = self.sidecar.find(self.container)
        assert entry is not None
        os.kill(self.app, signum)
        after = self.sidecar.wait_restores(self.container, entry["restores"] + 1)
        self.wait_beats()
        return after


@functools.cache
def build_victims() -> None:
    """tests/victims/build, brought up to date once."""
    subprocess.run(["make", "-s", "-C", str(ROOT / "tests/victims")], check=True)


def start_victim(
    sidecar: Sidecar,
    factory: ContainerFactory,
    folder: Path,
    command: str,
    *,
    labels: Mapping[str, str] = QUICK,
    options: Sequence[str] = (),
    generation: int = 2,
) -> ProtectedVictim:
    """Starts `command` (a victim and its arguments) and waits for that generation (0: does not wait)."""
    build_victims()
    folder.chmod(0o755)
    board = Board(folder / "board")
    program, *args = command.split()
    container = factory.protected(
        f"/victims/{program}",
        *args,
        *("--board", "/board/board"),
        labels=labels,
        options=[
            *("--volume", f"{ROOT}/tests/victims/build:/victims:ro", "--volume", f"{folder}:/board", *options),
        ],
    )
    victim = ProtectedVictim(sidecar, container, board)
    wait_until(lambda: victim.see().ready == 1, 10, f"{command} is ready")
    if generation:
        sidecar.wait_generation(container, generation)
    return victim


def ours(container: Container, name: str = "avckpt-") -> list[int]:
    """Templates ("avckpt-tmpl"), spare ("avckpt-spare") and holder ("avckpt-hold") in a container; PIDs on the host."""
    init = container.pid
    found = []
    for pid in Path(f"/proc/{init}/task/{init}/children").read_text().split():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # an old one, just ending
            if Path(f"/proc/{pid}/comm").read_text().startswith(name):
                found.append(int(pid))
    return found


def start_hoard(
    sidecar: Sidecar, factory: ContainerFactory, folder: Path, mb: int, limit_mb: int, images: str = "fork"
) -> ProtectedVictim:
    """Starts the victim `hoard` with so much memory, in a container with that limit (0: none)."""
    return start_victim(
        sidecar,
        factory,
        folder,
        f"hoard {mb}",
        labels={"interval": "1h", "images": images},
        options=["--memory", f"{limit_mb}m", "--memory-swap", f"{limit_mb}m"] if limit_mb else [],
        generation=0,
    )


def write_hoard(victim: ProtectedVictim, signum: int, mb: int) -> None:
    """Has the victim `hoard` write all its memory again, and waits until it has."""
    wanted = victim.see().counter[0] + mb
    os.kill(victim.app, signum)
    wait_until(lambda: victim.see().counter[0] >= wanted, 20, f"{mb} MB written")


def ended(sidecar: Sidecar, container: Container) -> str:
    """Why a container was not restored, as `avckpt ps -a` has it."""

    def look() -> str:
        found = [entry for entry in sidecar.ps(ended=True) if entry["id"] == container.id and entry["state"] == "ended"]
        return str(found[-1]["reason"]) if found else ""

    return wait_until(look, 10, f"avckpt ps -a tells how {container.name} ended")


def told(sidecar: Sidecar, container: Container, kind: str) -> list[dict[str, Any]]:
    """What `avckpt events` tells of a container, of that kind."""
    return [event for event in sidecar.client.history() if event["id"] == container.id and event["kind"] == kind]
