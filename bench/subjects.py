# SPDX-License-Identifier: Apache-2.0
"""The measured programs: one below avckpt-init with a guard, and beside it one that just forks."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from avckpt.artifacts import init_binary
from avckpt.engine import Engine
from avckpt.events.vocabulary import Kind
from avckpt.guard import Command, Event, GuardConfig

from testkit.board import Board
from testkit.harness import ROOT, wait_until
from testkit.procfs import children_of

BUILD = ROOT / "build" / "bench"
VICTIMS = ROOT / "tests" / "victims"
PATIENCE_S = 60.0


class BenchFailed(Exception):
    """It cannot be measured; the message says why."""


def build() -> None:
    """Compiles the helper and the victims.  Raises BenchFailed."""
    BUILD.mkdir(parents=True, exist_ok=True)
    compile_fork = [os.environ.get("CC", "cc"), "-std=gnu11", "-D_GNU_SOURCE", "-O2", "-Wall", "-Wextra"]
    compile_fork += ["-o", str(BUILD / "fork"), str(ROOT / "bench" / "fork.c")]
    for command in (compile_fork, ["make", "-s", "-C", str(VICTIMS)]):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise BenchFailed(f"`{' '.join(command)}` failed: {done.stderr.strip()}")


def eventually(condition: Callable[[], bool], what: str, every_s: float = 0.01) -> None:
    """Raises BenchFailed when it is not so within PATIENCE_S."""
    try:
        wait_until(condition, PATIENCE_S, what, every_s)
    except TimeoutError as error:
        raise BenchFailed(str(error)) from error


class Forker:
    """bench/fork.c with `mb` MB of touched memory; with `thp` in transparent huge pages."""

    def __init__(self, mb: int, *, thp: bool = False) -> None:
        command = [str(BUILD / "fork"), str(mb), *(["--thp"] if thp else [])]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        if self._hear() != "ready":
            raise BenchFailed(f"bench/fork.c does not start with {mb} MB")

    def __enter__(self) -> Forker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()

    def fork_ms(self) -> float:
        """The time of one fork(2)."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        return int(self._hear()) / 1e6

    def _hear(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


class Idle:
    """tests/victims/idle.c below avckpt-init, which is PID 1 of a PID namespace of its own."""

    def __init__(
        self, mb: int, threads: int, *, beat_us: int, folder: Path, descriptors: int = 0, thp: bool = False
    ) -> None:
        self.board = Board(folder / f"idle-{mb}-{threads}-{time.monotonic_ns()}")
        command: list[str | Path] = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child=KILL", init_binary()]
        command += ["--wait-ms", "2000", "--", VICTIMS / "build" / "idle", str(mb), str(threads)]
        command += ["--beat-us", str(beat_us), "--descriptors", str(descriptors), "--board", self.board.path]
        command += ["--thp"] if thp else []
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        self.init_pid = 0

    def __enter__(self) -> Idle:
        try:
            eventually(self._has_started, "the victim has touched its memory")
            # It may have ended meanwhile, which check() tells.
            eventually(
                lambda: self._process.poll() is not None or bool(children_of(self._process.pid)), "init is there"
            )
            self.check()
            (self.init_pid,) = children_of(self._process.pid)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # unshare takes init along, and init its namespace.
        self._process.kill()
        self._process.wait()
        if self.init_pid:
            eventually(lambda: not Path(f"/proc/{self.init_pid}").exists(), "the victim's namespace has ended")
        self.board.page.close()

    def _has_started(self) -> bool:
        return self.board.see().ready == 1 or self._process.poll() is not None

    @property
    def app_pid(self) -> int:
        """In our PID namespace: init's oldest child, as long as nobody has restored it."""
        return children_of(self.init_pid)[0]

    def check(self) -> None:
        """Raises BenchFailed when it has ended or found something wrong with itself."""
        status = self._process.poll()
        if status is not None:
            raise BenchFailed(f"the victim has ended with status {status}")
        if self.board.see().violations:
            raise BenchFailed("the victim has found its memory or its waits broken")


@dataclass(frozen=True)
class Recovery:
    """One kill and what came of it, in ms."""

    reap_ms: float
    restore_ms: float
    resume_gap_ms: float
    event: Event


class Guarded:
    """A guard for an Idle that takes checkpoints and restores on command."""

    def __init__(self, idle: Idle) -> None:
        self._idle = idle
        self._engine = Engine()
        self._tickets = 0
        pidfd = os.pidfd_open(idle.init_pid)
        try:
            config = GuardConfig(
                interval_s=0.0,
                keep=2,
                restore_on_signal=True,
                restore_on_exit=True,
                restore_on_statuses=frozenset(),
                restore_max=64,
                restore_window_s=0.05,
                quiesce_s=0.0,
            )
            self._guard = self._engine.start_guard(pidfd, config, cookie=1)
        finally:
            os.close(pidfd)

    def __enter__(self) -> Guarded:
        self._wait(Kind.ATTACHED)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._engine.close()

    def checkpoint(self) -> Event:
        """Takes one; the event has its times."""
        self._tickets += 1
        self._guard.command(Command.CHECKPOINT, self._tickets)
        return self._wait(Kind.CHECKPOINT)

    def kill(self, app_pid: int) -> Recovery:
        """Kills the application, and waits until it beats again."""
        self._idle.board.forget_gap()
        killed_ns = time.monotonic_ns()
        os.kill(app_pid, signal.SIGKILL)
        event = self._wait(Kind.RESTORED)
        # The gap is measured by the victim itself, from beat to beat.
        eventually(lambda: self._beats_since(event.died_ns), "the victim beats again after a restore", 0.0005)
        return Recovery(
            reap_ms=(event.died_ns - killed_ns) / 1e6,
            restore_ms=event.restore_s * 1e3,
            resume_gap_ms=(self._idle.board.see().gap_end_ns - killed_ns) / 1e6,
            event=event,
        )

    def _beats_since(self, died_ns: int) -> bool:
        self._idle.check()
        return self._idle.board.see().gap_end_ns > died_ns

    def _wait(self, kind: Kind) -> Event:
        """The next event of this kind; DIED is passed over, anything else is a failure."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            event = self._engine.next_event()
            if event is None:
                ready, _, _ = select.select([self._engine.event_fd], [], [], max(0.0, deadline - time.monotonic()))
                if not ready:
                    raise BenchFailed(f"the engine does not answer: no {kind.name} within {PATIENCE_S:g} s")
            elif event.kind is kind:
                return event
            elif event.kind is not Kind.DIED:
                raise BenchFailed(f"{event.kind.name} instead of {kind.name}: {event.error}")
