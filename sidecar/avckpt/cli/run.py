# SPDX-License-Identifier: Apache-2.0
"""`avckpt run`: protects a plain program, with no Podman and no sidecar.

    avckpt run            guard (engine), messages; outside the new PID namespace
      avckpt-init         PID 1 of a PID namespace with a /proc of its own
        PROGRAM

The program has our standard descriptors and, if we had it, the foreground of
our terminal.  ^Z stops the program, and us with our group, as a job; the shell
that continues us has the program continued.

When `avckpt run` itself is killed with SIGKILL, init and program are killed,
too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import selectors
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import TypeVar

from avckpt.artifacts import init_binary
from avckpt.cli.namespace import spawn_pid1
from avckpt.containers.cgroup import groups_of
from avckpt.containers.process import stat_fields
from avckpt.engine import Engine, probe
from avckpt.errors import AvckptError, LabelsWrong
from avckpt.events.journal import Journal
from avckpt.events.record import of_guard
from avckpt.events.vocabulary import Kind, signal_name
from avckpt.guard import GuardConfig
from avckpt.messages import Messages
from avckpt.policy import Settings, settings_of

NOT_FORWARDED = frozenset(
    {
        # Not to be caught.
        signal.SIGKILL,
        signal.SIGSTOP,
        # Ours: children, and writing to terminals and pipes.
        signal.SIGCHLD,
        signal.SIGPIPE,
        signal.SIGTTOU,
        signal.SIGTTIN,
        signal.SIGTSTP,
        # Our own crash.
        signal.SIGSEGV,
        signal.SIGBUS,
        signal.SIGFPE,
        signal.SIGILL,
        signal.SIGTRAP,
        signal.SIGABRT,
        signal.SIGSYS,
    }
)


S = TypeVar("S", bound="Supervisor")


def settings_of_run(labels: Mapping[str, str]) -> Settings:
    """What `--label` says; `avckpt.enable` is implied.  Raises LabelsWrong."""
    for key in labels:
        if not key.startswith("avckpt."):
            raise LabelsWrong(f"label {key}: avckpt run knows only avckpt.* labels")
        if key.startswith(("avckpt.group", "avckpt.notify")):
            raise LabelsWrong(f"label {key}: it takes containers and the sidecar, leave it out")
    settings = settings_of({"avckpt.enable": "true", **labels})
    if settings.policy.core != "off":
        raise LabelsWrong("label avckpt.core: it takes the sidecar, which writes the files, leave it out")
    if settings.policy.restore_on.unhealthy:
        raise LabelsWrong("label avckpt.restore.on: unhealthy takes a container's health check, leave it out")
    if labels.get("avckpt.enable", "true").strip().lower() in ("false", "0", "no", "off"):
        raise LabelsWrong("label avckpt.enable=false: then run the program without avckpt run")
    return settings


def run(settings: Settings, argv: list[str], *, verbose: bool) -> int:
    """Runs `argv` to its end and returns its exit status, 128+N when signal N killed it.

    Raises AvckptError when it cannot be started.
    """
    io_uring = settings.policy.io_uring
    if settings.policy.scope == "nodes":
        from avckpt.cli.run_nodes import NodesSupervisor, socket_for_nodes

        with socket_for_nodes(init_binary()) as listening:
            return _run(
                argv, NodesSupervisor, lambda _, nodes: nodes.watch_nodes(listening, settings.said), verbose, io_uring
            )

    def watch(pid: int, supervisor: Supervisor) -> None:
        supervisor.watch(limited(replace(settings.config, remains_s=0.0), pid))

    return _run(argv, Supervisor, watch, verbose, io_uring)


def _run(argv: list[str], kind: type[S], watch: Callable[[int, S], None], verbose: bool, io_uring: bool) -> int:
    """Raises AvckptError when it cannot be started."""
    probe()
    init = init_binary()
    with _signals() as signals_fd, _terminal() as terminal:
        command = [init.name, "--wait-ms", "2000", "--stop-signal", "15", "--", *argv]
        pid = spawn_pid1(str(init), command, tty=terminal, io_uring=io_uring)
        if terminal is not None:
            # We are in the background now, and say things all the same.
            signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        pidfd = os.pidfd_open(pid)
        try:
            job = Job(terminal, pid) if terminal is not None else None
            watch(pid, kind(argv[0], pidfd, signals_fd, verbose, job))
            _, status = os.waitpid(pid, 0)
        finally:
            os.close(pidfd)
            if terminal is not None:
                _take_back(terminal, pid)
    return os.WEXITSTATUS(status) if os.WIFEXITED(status) else 128 + os.WTERMSIG(status)


def limited(config: GuardConfig, pid: int) -> GuardConfig:
    """With the limits of its control groups."""
    try:
        groups = groups_of(pid)
    except OSError:  # it has just ended
        return config
    return replace(config, memory_limit_bytes=groups.memory_and_swap_bytes() or 0, tasks_max=groups.tasks_max() or 0)


class Supervisor:
    """Forwards signals and tells events until init has ended."""

    def __init__(self, name: str, init_pidfd: int, signals_fd: int, verbose: bool, job: Job | None) -> None:
        self._name = name
        self._job = job
        self._pidfd = init_pidfd
        self._signals_fd = signals_fd
        self._verbose = verbose
        self._journal = Journal()
        # The kernel drops what is sent to a PID 1 that is not ready for it, so
        # signals wait for the guard's first word of init.
        self._ready = False
        self._waiting: list[int] = []

    def watch(self, config: GuardConfig) -> None:
        """Returns when init has ended."""
        with Engine() as engine, selectors.DefaultSelector() as selector:
            try:
                guard = engine.start_guard(self._pidfd, config, cookie=1)
            except AvckptError as error:
                say(f"{self._name}: runs unprotected: {error}")
                guard = None
                self._ready = True
            selector.register(self._pidfd, selectors.EVENT_READ)
            selector.register(engine.event_fd, selectors.EVENT_READ)
            selector.register(self._signals_fd, selectors.EVENT_READ)
            ended = False
            while not ended:
                for key, _ in selector.select(None if self._job is None else Job.LOOK_EVERY_S):
                    if key.fd == self._pidfd:
                        ended = True
                    elif key.fd == self._signals_fd:
                        self._take_signals()
                self._take_events(engine)
                if self._job is not None:
                    self._job.look()
            if guard is not None:
                guard.stop()
            self._take_events(engine)

    def _take_events(self, engine: Engine) -> None:
        while (event := engine.next_event()) is not None:
            self._become_ready()
            line = self._journal.line(of_guard(event))
            if line is None:
                continue
            level, text = line
            quiet = level < logging.WARNING or event.kind is Kind.MISSED
            if self._verbose or not quiet:
                say(f"{self._name}: {text}")

    def _become_ready(self) -> None:
        waiting, self._waiting, self._ready = self._waiting, [], True
        for signum in waiting:
            self._forward(signum)

    def _take_signals(self) -> None:
        try:
            numbers = os.read(self._signals_fd, 4096)
        except BlockingIOError:
            return
        for signum in numbers:
            if signum == signal.SIGCONT and self._job is not None:
                self._job.go_on()
            if self._ready:
                self._forward(signum)
            else:
                self._waiting.append(signum)

    def _forward(self, signum: int) -> None:
        try:
            signal.pidfd_send_signal(self._pidfd, signum)
        except ProcessLookupError:
            return  # it has ended meanwhile
        if self._verbose:
            say(f"{self._name}: {signal_name(signum)} passed on")


class Job:
    """The program in the foreground of our terminal, as part of the job that the shell knows us as.

    Only its parent, init, hears when it stops, and cannot be stopped itself; so it is looked at.
    """

    LOOK_EVERY_S = 0.1

    def __init__(self, terminal: int, init_pid: int) -> None:
        self._terminal = terminal
        self._init_pid = init_pid
        self._group = 0
        """The program's own, when it was seen last."""

    def look(self) -> None:
        """Stops with it if it was stopped (^Z), until somebody continues us."""
        try:
            group = os.tcgetpgrp(self._terminal)
            if group == os.getpgrp():
                self.go_on()  # a shell has brought us back to the foreground
                return
            state, parent = stat_fields(group)[:2]
        except OSError:
            return
        if int(parent) != self._init_pid:
            return  # ours, a shell's, or that of a program which sees to its own jobs
        self._group = group
        if state == "T":
            # With nobody to continue us (a script without job control) this is ignored, and it goes on at once.
            os.killpg(os.getpgrp(), signal.SIGTSTP)
            time.sleep(0.01)  # another thread may be the one that stops us
            self.go_on()

    def go_on(self) -> None:
        """Continues it, and where the shell has given us the terminal, gives it on."""
        if not self._group:
            return
        with contextlib.suppress(OSError):
            if os.tcgetpgrp(self._terminal) == os.getpgrp():
                os.tcsetpgrp(self._terminal, self._group)
            os.killpg(self._group, signal.SIGCONT)


_messages = Messages(2)


def say(text: str) -> None:
    """Writes one message. A reader that is gone must not end the program, and one that hangs not hold it up."""
    _messages.write(f"avckpt: {text}\n")


@contextmanager
def _signals() -> Iterator[int]:
    """Catches every signal that is to be forwarded; a descriptor that yields their numbers, a byte each.

    Those that we were started to ignore (nohup) stay ignored, and the program inherits that.
    """
    read_fd, write_fd = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(write_fd, warn_on_full_buffer=False)
    caught = [n for n in signal.valid_signals() - NOT_FORWARDED if signal.getsignal(n) is not signal.SIG_IGN]
    for signum in caught:
        signal.signal(signum, _caught)
    try:
        yield read_fd
    finally:
        signal.set_wakeup_fd(-1)
        for signum in caught:
            signal.signal(signum, signal.SIG_DFL)
        os.close(read_fd)
        os.close(write_fd)


def _caught(signum: int, frame: FrameType | None) -> None:
    """Nothing: the wakeup descriptor has it."""


@contextmanager
def _terminal() -> Iterator[int | None]:
    """A descriptor of the controlling terminal while we are in its foreground, else None."""
    try:
        fd = os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError:
        yield None
        return
    try:
        yield fd if os.tcgetpgrp(fd) == os.getpgrp() else None
    finally:
        os.close(fd)


def _take_back(terminal: int, init_pid: int) -> None:
    """Makes us the foreground again: our own caller may be a script that goes on reading the terminal."""
    try:
        foreground = os.tcgetpgrp(terminal)
        if foreground != init_pid and _group_exists(foreground):
            return  # a shell has taken the terminal meanwhile
        os.tcsetpgrp(terminal, os.getpgrp())
    except OSError:
        return  # the terminal is gone


def _group_exists(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
