# SPDX-License-Identifier: Apache-2.0
"""The subjects compared: each starts bench/server.c, checkpoints it, kills it and restores it.

Every subject gets the best conditions: CRIU's images are in memory, and it is called
as soon as the process is dead, as by an ideal supervisor.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from avckpt.artifacts import init_binary
from avckpt.cli.client import Client as Api
from avckpt.errors import AvckptError
from avckpt.guard import Command
from avckpt.supervision.pressure import held_bytes, templates_of

from bench.peers_world import BOARDS_INSIDE, IMAGE, PROGRAMS_INSIDE, World
from bench.subjects import BenchFailed, Guarded, Idle, eventually
from bench.workload import PROGRAMS, Client, find_server
from testkit.board import Board
from testkit.harness import (
    RUN_DIR,
    CommandFailed,
    Completed,
    Container,
    ContainerFactory,
    Podman,
    Sidecar,
    free_port,
)
from testkit.procfs import figures

BEAT_US = 100
PORT_INSIDE = 5555
"""In the peers' world, whose network nobody else uses."""
PATIENCE_S = 30.0
"""With restores that are refused."""
ESTABLISHED = "--tcp-established"
CLOSED = "--tcp-close"
"""After a crash CRIU gets no connection back: the dead process' sockets have said goodbye to their peers, and
linger in the way of new ones (with --tcp-established: "Can't connect inet socket back: Cannot assign requested
address").  So they are restored as closed ones."""
IN_FLIGHT = "--skip-in-flight"
"""A connection that nobody has accepted yet does not keep CRIU from dumping."""
NO_CHECKPOINTS = "24h"
"""An interval that does not come up: checkpoints are taken by command."""


@dataclass(frozen=True)
class Taken:
    """One checkpoint."""

    took_ms: float
    """The whole command or call."""
    tool_freeze_ms: float | None
    """How long everything stood still, by the tool's own account."""
    memory_mb: float
    """What it holds right after it was taken."""


@dataclass(frozen=True)
class Recovered:
    """One recovery."""

    tool_restore_ms: float | None
    """By the tool's own account, from the death it saw (avckpt) or from its own start."""


def is_alive(pid: int) -> bool:
    """A zombie is not: there may be nobody who reaps it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def wait_gone(pidfd: int) -> None:
    """Waits until the process is dead and reaped or a zombie.  Raises BenchFailed."""
    ready, _, _ = select.select([pidfd], [], [], 60.0)
    if not ready:
        raise BenchFailed("a killed process does not end within 60 s")


class Subject(ABC):
    """A context manager around one running server."""

    name: str
    cycles: int = 10

    def __init__(self, mb: int, threads: int, folder: Path) -> None:
        self.folder = folder
        self.board = Board(folder / f"server-{uuid.uuid4().hex[:12]}")
        self.arguments = [str(mb), str(threads)]
        self.options = ["--beat-us", str(BEAT_US)]
        self.port = 0
        self.container_options: list[str] = []
        self._conmon: int | None = None
        self.refused: list[str] = []
        """Checkpoints and restores that did not work at the first try, in the tool's own words."""
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> Subject:
        try:
            self._undo.callback(self._forget_board)
            self.start()
            eventually(lambda: self.board.see().ready == 1, f"{self.name}: the server has touched its memory")
        except BaseException:
            self._undo.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._undo.close()

    def _forget_board(self) -> None:
        self.board.page.close()
        self.board.path.unlink(missing_ok=True)

    def command(self, programs: Path, boards: Path) -> list[str]:
        """The server, by the paths that it has where it runs."""
        port = str(self.port or PORT_INSIDE)
        return [
            f"{programs}/server",
            *self.arguments,
            port,
            *self.options,
            "--board",
            f"{boards}/{self.board.path.name}",
        ]

    def client(self) -> Client:
        """One that can reach it."""
        return Client(self.folder, self.port)

    def app_pid(self) -> int:
        """The server's process, in our PID namespace."""
        return find_server(self.board.path)

    def kill(self) -> None:
        """SIGKILL; returns when the process is dead."""
        pidfd = os.pidfd_open(self.app_pid())
        try:
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            wait_gone(pidfd)
        finally:
            os.close(pidfd)

    @abstractmethod
    def start(self) -> None:
        """Starts the server; undone by callbacks on `_undo`."""

    @abstractmethod
    def checkpoint(self) -> Taken | None:
        """None: this subject takes none."""

    @abstractmethod
    def crash(self) -> Recovered:
        """Kills the server and sees to it that it comes back."""

    def conmon(self) -> int | None:
        """The container's conmon, which lives as long as Podman sees it running; None: no container."""
        if self._conmon is None or not is_alive(self._conmon):
            self._conmon = self._ask_conmon()
        return self._conmon

    def _ask_conmon(self) -> int | None:
        return None


class Below(Idle):
    """The server below avckpt-init in a PID namespace of its own, to be used with Guarded."""

    def __init__(self, board: Board, command: Sequence[str]) -> None:
        self.board = board
        unshare = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child=KILL", str(init_binary())]
        self._process = subprocess.Popen(
            [*unshare, "--wait-ms", "2000", "--", *command], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        self.init_pid = 0

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        if self.init_pid:
            eventually(lambda: not Path(f"/proc/{self.init_pid}").exists(), "the server's namespace has ended")


def templates_mb(init_pid: int, app_pid: int) -> float:
    """What the templates below avckpt-init hold: pages that the app does not have, and page tables."""
    templates = templates_of(init_pid)
    tables_kb = 0
    for template in templates:
        with contextlib.suppress(OSError):
            tables_kb += figures(template)["VmPTE"]
    return held_bytes(app_pid, templates) / 2**20 + tables_kb / 1024


class AvckptEngine(Subject):
    """avckpt without Podman: the engine in this process."""

    name = "avckpt engine"
    cycles = 20

    def start(self) -> None:
        self.port = free_port()
        self._below = self._undo.enter_context(Below(self.board, self.command(PROGRAMS, self.folder)))
        self._guarded = self._undo.enter_context(Guarded(self._below))

    def checkpoint(self) -> Taken:
        started = time.monotonic()
        while True:
            try:
                event = self._guarded.checkpoint()
                break
            except BenchFailed as error:
                # On a machine with much to do, a thread may not stop in time.
                if "MISSED" not in str(error) or time.monotonic() - started > PATIENCE_S:
                    raise
                self.refused.append(str(error))
        took_ms = (time.monotonic() - started) * 1e3
        held = templates_mb(self._below.init_pid, self.app_pid())
        return Taken(took_ms, event.freeze_s * 1e3, held / max(1, event.generations))

    def crash(self) -> Recovered:
        return Recovered(self._guarded.kill(self.app_pid()).restore_ms)


class InContainer(Subject):
    """What containers of the host's Podman have in common.  The host's network: 127.0.0.1."""

    def __init__(self, mb: int, threads: int, folder: Path, podman: Podman) -> None:
        super().__init__(mb, threads, folder)
        self._podman = podman
        self._factory = ContainerFactory(podman, f"avckpt-bench-{os.getpid()}")
        self._undo.callback(self._factory.close)
        self.container: Container | None = None

    def _options(self) -> list[str]:
        return [
            *self.container_options,
            "--network=host",
            "-v",
            f"{PROGRAMS}:{PROGRAMS_INSIDE}:ro",
            "-v",
            f"{self.folder}:{BOARDS_INSIDE}",
        ]

    def _ask_conmon(self) -> int:
        assert self.container is not None
        pid: int = self.container.inspect()["State"]["ConmonPid"]
        return pid


class AvckptPodman(InContainer):
    """avckpt as it is used: a labelled container and the sidecar."""

    name = "avckpt"
    cycles = 20

    def __init__(self, mb: int, threads: int, folder: Path, sidecar: Sidecar) -> None:
        super().__init__(mb, threads, folder, sidecar.podman)
        self._sidecar = sidecar
        self._api = Api(RUN_DIR)

    def start(self) -> None:
        self.port = free_port()
        self.container = self._factory.protected(
            *self.command(PROGRAMS_INSIDE, BOARDS_INSIDE),
            options=self._options(),
            # Its client has numbers in its requests, and asks without waiting for answers.
            labels={"interval": NO_CHECKPOINTS, "restore.max": "64/1s", "tcp": "keep"},
        )
        # The first one also comes after an interval, so by command.
        self._sidecar.wait_for(self.container, lambda entry: entry["app_pid"] > 0, "its application", 60.0)
        self._command()

    def _entry(self) -> dict[str, Any]:
        assert self.container is not None
        return next(entry for entry in self._api.containers() if entry["id"] == self.container.id)

    def _command(self) -> dict[str, Any]:
        assert self.container is not None
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                event: dict[str, Any] = self._api.command(self.container.name, Command.CHECKPOINT)["event"]
                return event
            except AvckptError as error:
                # As with the engine: a thread may not stop in time.
                if time.monotonic() > until:
                    raise
                self.refused.append(str(error))

    def checkpoint(self) -> Taken:
        assert self.container is not None
        started = time.monotonic()
        event = self._command()
        took_ms = (time.monotonic() - started) * 1e3
        entry = self._entry()
        held = templates_mb(entry["init_pid"], entry["app_pid"]) / max(1, entry["generations"])
        return Taken(took_ms, event["freeze_s"] * 1e3, held)

    def crash(self) -> Recovered:
        assert self.container is not None
        before = self._entry()["restores"]
        self.kill()
        eventually(lambda: self._entry()["restores"] > before, "avckpt restores the server", 0.02)
        restore_s = self._entry()["last_restore_s"]
        return Recovered(None if restore_s is None else restore_s * 1e3)


class ColdStart(InContainer):
    """No checkpoint: Podman starts the container again, by its restart policy."""

    name = "restart policy"
    cycles = 6
    policy = "always"

    def start(self) -> None:
        self.port = free_port()
        self.container = self._factory(
            *self.command(PROGRAMS_INSIDE, BOARDS_INSIDE), options=[*self._options(), f"--restart={self.policy}"]
        )

    def checkpoint(self) -> None:
        return None

    def crash(self) -> Recovered:
        self.kill()
        return Recovered(None)


class ColdCommand(ColdStart):
    """The same by `podman start`, called in the moment of death."""

    name = "podman start"
    policy = "no"

    def crash(self) -> Recovered:
        assert self.container is not None
        self.kill()
        started = time.monotonic()
        # Until conmon has told it, Podman takes the container for running, and does nothing.
        while True:
            done = self._podman.run("start", self.container.name, check=False)
            with contextlib.suppress(LookupError):
                self.app_pid()
                break
            if time.monotonic() - started > 60:
                raise BenchFailed(f"podman start does not start it: {done}")
        return Recovered(done.took_s * 1e3)


def stats(data: bytes) -> dict[int, dict[int, int]]:
    """CRIU's stats-dump or stats-restore: {1: dump, 2: restore}, each {number of the field: value}.

    Two magic numbers, a length, and a protobuf message of messages of integers (CRIU's images/stats.proto).
    """

    def varint(at: int) -> tuple[int, int]:
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if not byte & 0x80:
                return value, at

    found: dict[int, dict[int, int]] = {}
    at = 12
    while at < len(data):
        key, at = varint(at)
        length, at = varint(at)
        end = at + length
        fields = found.setdefault(key >> 3, {})
        while at < end:
            field, at = varint(at)
            fields[field >> 3], at = varint(at)
    return found


class CriuFailed(BenchFailed):
    """CRIU could not do it; the message has its own words."""


def _criu_failed(what: str, done: Completed, log: str) -> CriuFailed:
    errors = [line.strip() for line in log.splitlines() if "Error (" in line]
    # Without the time in front, and without the one that is there in every run as soon as
    # CAP_SYS_RESOURCE is missing, and harms nothing.
    said = [re.sub(r"^\d+: ", "", line.split(") ", 1)[-1].strip()) for line in errors if "RLIMIT_NOFILE" not in line]
    return CriuFailed(f"{what} ended with {done.status}: {' | '.join(said) or done.stderr.strip()[-600:]}")


class InWorld(Subject):
    """What CRIU's two ways have in common: they run in the peers' world."""

    cycles = 6

    def __init__(self, mb: int, threads: int, folder: Path, world: World) -> None:
        super().__init__(mb, threads, folder)
        self._world = world

    def client(self) -> Client:
        return Client(
            self.folder,
            PORT_INSIDE,
            enter=self._world.enter,
            program=PROGRAMS_INSIDE / "client",
            inside=BOARDS_INSIDE,
        )

    @abstractmethod
    def stop_and_restore(self) -> None:
        """What CRIU is made for: the process is dumped and ended, and comes back from the images."""

    def _kill_left(self) -> None:
        with contextlib.suppress(LookupError):
            self.kill()


class CriuImages:
    """CRIU's own command line in the peers' world, with images on its tmpfs."""

    _folder = "/tmp/images"

    def __init__(self, world: World) -> None:
        self.refused: list[str] = []
        """Restores that did not work at the first try, in CRIU's own words."""
        self._world = world

    def dump(self, pid: int, *more: str) -> Taken:
        """`pid`: as it is numbered inside.  Raises CriuFailed."""
        self._world.run("rm", "-rf", self._folder)
        self._world.run("mkdir", self._folder)
        # -v1: the log costs time.
        command = ["criu", "dump", "-t", str(pid), "-D", self._folder, ESTABLISHED, IN_FLIGHT, "-o", "dump.log", "-v1"]
        done = self._world.run(*command, *more, check=False)
        if done.status != 0:
            raise _criu_failed("criu dump", done, self._log("dump.log"))
        told = stats(self._bytes("stats-dump"))[1]
        size = self._world.run("du", "-sk", self._folder).stdout.split()[0]
        # Fields 1 and 2: time to stop everything, and time it stood still then, us.
        return Taken(done.took_s * 1e3, (told[1] + told[2]) / 1e3, int(size) / 1024)

    def restore(self, connections: str, patience_s: float = PATIENCE_S, *more: str) -> float:
        """What the command took that did it, ms.  Raises CriuFailed.

        As a supervisor would: what the dead process' connections left in the kernel can be in the way.
        """
        until = time.monotonic() + patience_s
        while True:
            command = ["criu", "restore", "-d", "-D", self._folder, connections, "-o", "restore.log", "-v1"]
            done = self._world.run(*command, *more, check=False)
            if done.status == 0:
                return done.took_s * 1e3
            error = _criu_failed("criu restore", done, self._log("restore.log"))
            if time.monotonic() > until:
                raise error
            self.refused.append(str(error))

    def _log(self, name: str) -> str:
        return self._world.run("cat", f"{self._folder}/{name}", check=False).stdout

    def _bytes(self, name: str) -> bytes:
        command = [*self._world.enter, "cat", f"{self._folder}/{name}"]
        return subprocess.run(command, capture_output=True, check=True, timeout=30).stdout


class CriuBare(InWorld):
    """CRIU's own command line on a process without a container."""

    name = "CRIU"

    def start(self) -> None:
        self._undo.callback(self._kill_left)
        self._criu = CriuImages(self._world)
        self.refused = self._criu.refused
        self._world.start(*self.command(PROGRAMS_INSIDE, BOARDS_INSIDE))

    def _pid_inside(self) -> int:
        return int(Path(f"/proc/{self.app_pid()}/status").read_text().split("NSpid:")[1].split("\n")[0].split()[-1])

    def checkpoint(self) -> Taken:
        return self._criu.dump(self._pid_inside(), "--leave-running")

    def crash(self) -> Recovered:
        self.kill()
        return Recovered(self._criu.restore(CLOSED))

    def stop_and_restore(self) -> None:
        self._criu.dump(self._pid_inside())
        self._criu.restore(ESTABLISHED)


class CriuContainer:
    """A container in the peers' world, for `podman container checkpoint` and `restore`."""

    def __init__(self, world: World, runtime: str, name: str) -> None:
        self.name = name
        self.refused: list[str] = []
        """Restores that did not work at the first try, in CRIU's own words."""
        self._world = world
        self._runtime = runtime
        self._static_dir = ""

    def podman(self, *args: str, check: bool = True) -> Completed:
        return self._world.run("podman", "--runtime", self._runtime, *args, check=check)

    def run(self, *args: str) -> None:
        """On the world's own network.  `args`: options, image, command."""
        self.podman("run", "--detach", "--pull=never", "--name", self.name, "--network=host", *args)
        self._static_dir = self.inspect("{{.StaticDir}}")

    def inspect(self, format: str) -> str:
        return self.podman("inspect", "--format", format, self.name).stdout.strip()

    def remove(self) -> None:
        self.podman("rm", "--force", "--ignore", "--time", "0", self.name)
        self.tell_criu()

    def tell_criu(self, *options: str) -> None:
        """What Podman has no options for: CRIU reads this file, whoever calls it (criu(8), configuration files)."""
        script = 'mkdir -p /etc/criu && printf "%s\\n" "$@" >/etc/criu/default.conf'
        self._world.run("sh", "-c", script, "sh", *(option.removeprefix("--") for option in options))

    def checkpoint(self, *more: str, told: Sequence[str] = (IN_FLIGHT,)) -> Taken:
        """Raises CriuFailed."""
        self.tell_criu(*told)
        done = self.podman(
            *("container", "checkpoint", "--keep", ESTABLISHED, "--print-stats", *more, self.name), check=False
        )
        if done.status != 0:
            log = self._world.run("cat", f"{self._static_dir}/dump.log", check=False).stdout
            raise _criu_failed("podman container checkpoint", done, log)
        try:
            stats: dict[str, int] = json.loads(done.stdout)["container_statistics"][0]["criu_statistics"]
        except (ValueError, KeyError, IndexError, TypeError):
            stats = {}
        size = self._world.run("du", "-sk", f"{self._static_dir}/checkpoint").stdout.split()[0]
        freeze = (stats["freezing_time"] + stats["frozen_time"]) / 1e3 if stats else None
        return Taken(done.took_s * 1e3, freeze, int(size) / 1024)

    def restore(self, patience_s: float = PATIENCE_S) -> float:
        """What the command took that did it, ms.  Raises CriuFailed."""
        until = time.monotonic() + patience_s
        # Podman hears of the death from conmon; until then it does not restore ("is running or paused").
        while True:
            done = self.podman("container", "restore", "--keep", ESTABLISHED, self.name, check=False)
            if done.status == 0:
                return done.took_s * 1e3
            if "is running or paused" in done.stderr and time.monotonic() < until:
                continue
            log = self._world.run("cat", f"{self._static_dir}/restore.log", check=False).stdout
            error = _criu_failed("podman container restore", done, log)
            if time.monotonic() > until:
                raise error
            self.refused.append(str(error))


class CriuPodman(InWorld):
    """CRIU through Podman: `podman container checkpoint` and `restore`."""

    runtime = "crun"
    name = "CRIU, Podman, crun"

    def start(self) -> None:
        self._world.import_image()
        self._container = CriuContainer(self._world, self.runtime, f"server-{uuid.uuid4().hex[:8]}")
        self._container.refused = self.refused
        self._undo.callback(self._container.remove)
        mounts = ["-v", f"{PROGRAMS_INSIDE}:{PROGRAMS_INSIDE}:ro", "-v", f"{BOARDS_INSIDE}:{BOARDS_INSIDE}"]
        self._container.run(*self.container_options, *mounts, IMAGE, *self.command(PROGRAMS_INSIDE, BOARDS_INSIDE))

    def checkpoint(self) -> Taken:
        return self._container.checkpoint("--leave-running")

    def crash(self) -> Recovered:
        self._container.tell_criu(CLOSED)
        self.kill()
        return Recovered(self._container.restore())

    def stop_and_restore(self) -> None:
        self._container.checkpoint()
        self._container.restore()

    def _ask_conmon(self) -> int:
        # The world has PIDs of its own, which all of its processes see in NSpid.
        return self._world.outside(int(self._container.inspect("{{.State.ConmonPid}}")))


class CriuPodmanRunc(CriuPodman):
    """The same with runc."""

    runtime = "runc"
    name = "CRIU, Podman, runc"


__all__ = [
    "CLOSED",
    "AvckptEngine",
    "AvckptPodman",
    "Below",
    "ColdCommand",
    "ColdStart",
    "CommandFailed",
    "CriuBare",
    "CriuContainer",
    "CriuFailed",
    "CriuPodman",
    "CriuPodmanRunc",
    "InWorld",
    "Recovered",
    "Subject",
    "Taken",
]
