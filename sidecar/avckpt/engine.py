# SPDX-License-Identifier: Apache-2.0
"""The engine (`avckpt/engine.h`) for Python: the only module that touches cffi.

Thin on purpose: it starts guard processes (avckpt-guard) and converts commands and events,
and decides nothing. Every call may be made from any thread; cffi releases the GIL while it
is in C.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from avckpt_hooks.shared.tell import printable

from avckpt.artifacts import guard_binary
from avckpt.errors import AvckptError, Code, ConfigError, Denied, TargetGone, Unsupported, class_of_code
from avckpt.events.vocabulary import Kind, Reason
from avckpt.guard import FORK_REASONS, Again, Command, Event, GuardConfig, Images

try:
    from avckpt._native import ffi, lib
except ImportError as error:
    raise Unsupported(f"avckpt's native part is not there for this Python ({error}): install avckpt again") from error

_NS_PER_S = 1_000_000_000
_U64_MAX = 2**64 - 1


def version() -> str:
    """The native library's version."""
    return _text(lib.avc_version())


def probe() -> None:
    """Whether this machine can support checkpoints, and a guard that we start
    may take them.

    Raises Unsupported, Denied or KernelError with the reason.
    """
    err = ffi.new("struct avc_error *")
    if lib.avc_engine_probe(_path(guard_binary()), err) != 0:
        problem = _error(err)
        if isinstance(problem, Denied) and os.geteuid() != 0:
            raise Denied(f"this needs root: use sudo ({problem})")
        raise problem


@contextmanager
def meeting(members: int) -> Iterator[int]:
    """A descriptor of the memory where `members` guards meet, for `Guard.line()` or `Guard.recall()`. Raises
    KernelError."""
    err = ffi.new("struct avc_error *")
    fd = lib.avc_meeting_new(members, err)
    if fd < 0:
        raise _error(err)
    try:
        yield fd
    finally:
        os.close(fd)


class Guard:
    """The process that protects one container.  Made by `Engine.start_guard()`, ended by `stop()`."""

    def __init__(self, guard: Any, engine: Engine) -> None:
        self._guard = guard
        self._engine = engine
        # stop() runs in another thread than command(); the C struct is freed
        # by avc_guard_stop(), so no command may be inside it then.
        self._lock = threading.Lock()

    def command(self, command: Command, ticket: int, within_s: float = 0.0, generation: int = 0) -> None:
        """Sends a command; the answer is an event with the same `ticket` (not 0).

        One that the guard has not begun within `within_s` (0: any time) is refused.  `generation` is
        the one to restore, 0: the newest.
        Raises TargetGone when the guard has ended.
        """
        err = ffi.new("struct avc_error *")
        until_ns = time.monotonic_ns() + _ns("time", within_s) if within_s else 0
        with self._lock:
            if self._guard is None:
                raise TargetGone("its guard has ended", operation=command.name.lower())
            if lib.avc_guard_command(self._guard, int(command), ticket, generation, until_ns, err) != 0:
                raise _error(err)

    def configure(self, config: GuardConfig) -> None:
        """Changes its settings from the next checkpoint and the next death on; its generations stay.

        Raises ConfigError for invalid values, TargetGone when the guard has ended.
        """
        err = ffi.new("struct avc_error *")
        with self._lock:
            if self._guard is None:
                raise TargetGone("its guard has ended", operation="configure")
            if lib.avc_guard_configure(self._guard, _config(-1, config), err) != 0:
                raise _error(err)

    def line(self, meeting: int, line: int, ticket: int) -> None:
        """Has it take part in a line of its group; answered as a checkpoint.  Raises TargetGone, Busy."""
        self._tell("line", lambda guard, err: lib.avc_guard_line(guard, meeting, line, ticket, err))

    def recall(self, meeting: int, line: int, generation: int, ticket: int) -> None:
        """Has it go back to that generation together with its group.  Raises TargetGone, Busy."""
        self._tell("recall", lambda guard, err: lib.avc_guard_recall(guard, meeting, line, generation, ticket, err))

    def _tell(self, operation: str, tell: Callable[[Any, Any], int]) -> None:
        err = ffi.new("struct avc_error *")
        with self._lock:
            if self._guard is None:
                raise TargetGone("its guard has ended", operation=operation)
            if tell(self._guard, err) != 0:
                raise _error(err)

    @property
    def pid(self) -> int:
        """Its PID, 0 when it has exited."""
        with self._lock:
            return 0 if self._guard is None else int(lib.avc_guard_pid(self._guard))

    def check(self, patience_s: float) -> None:
        """Kills it when it has given no sign of life for this long; an event GUARD_LOST
        follows.

        It has ten times as long while it only waits for a CPU.
        """
        with self._lock:
            if self._guard is not None:
                lib.avc_guard_check(self._guard, _ns("patience", patience_s))

    def stop(self) -> None:
        """Releases the app unprotected, drops every generation and ends the process.

        Blocks for as long as a checkpoint or restore that is under way.
        A second call does nothing.
        """
        with self._lock:
            guard, self._guard = self._guard, None
        if guard is not None:
            lib.avc_guard_stop(guard)
            self._engine._forget(self)


class Engine:
    """A queue of events and the guards that fill it.  A context manager; leaving it stops every guard.

    Raises KernelError when the kernel has no descriptors left for it, ConfigError when
    the program avckpt-guard is nowhere.
    """

    def __init__(self) -> None:
        err = ffi.new("struct avc_error *")
        engine = lib.avc_engine_new(_path(guard_binary()), err)
        if engine == ffi.NULL:
            raise _error(err)
        self._engine: Any = engine
        self._guards: set[Guard] = set()
        self._event = ffi.new("struct avc_event *")

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def event_fd(self) -> int:
        """Readable (poll(2)) while events are queued.  The engine's own: do not read or close it."""
        return int(lib.avc_engine_event_fd(self._engine))

    def next_event(self) -> Event | None:
        """Takes the oldest event, None if there is none.  For one thread only."""
        if lib.avc_engine_next_event(self._engine, self._event) == 0:
            return None
        return _event(self._event)

    def start_guard(self, init_pidfd: int, config: GuardConfig, cookie: int) -> Guard:
        """Starts protecting the container of which `init_pidfd` is avckpt-init.

        `init_pidfd` stays the caller's. Returns at once; what happens comes as
        events with `cookie`. Raises ConfigError for invalid values, TargetGone,
        KernelError.
        """
        err = ffi.new("struct avc_error *")
        guard = lib.avc_guard_start(self._engine, _config(init_pidfd, config), cookie, err)
        if guard == ffi.NULL:
            raise _error(err)
        wrapped = Guard(guard, self)
        self._guards.add(wrapped)
        return wrapped

    def close(self) -> None:
        """Stops every guard and frees the engine.  A second call does nothing."""
        if self._engine is None:
            return
        for guard in list(self._guards):
            guard.stop()
        engine, self._engine = self._engine, None
        lib.avc_engine_free(engine)

    def _forget(self, guard: Guard) -> None:
        self._guards.discard(guard)


def _ns(name: str, seconds: float) -> int:
    ns = round(seconds * _NS_PER_S)
    if not 0 <= ns <= _U64_MAX:
        raise ConfigError(f"{name} of {seconds} s is out of range", operation="configure")
    return ns


def _config(init_pidfd: int, config: GuardConfig) -> Any:
    c = ffi.new("struct avc_config *")
    c.init_pidfd = init_pidfd
    c.keep = config.keep
    c.interval_ns = 0 if config.together else _ns("interval", config.interval_s)
    c.together = config.together
    c.late = config.late
    c.interval_min_ns = _ns("least interval", config.interval_min_s)
    c.apart_ns = _ns("time between generations", config.apart_s)
    c.budget_freeze_ppm = round(config.budget_freeze * 1e6)
    c.budget_cpu_ppm = round(config.budget_cpu * 1e6)
    c.freeze_deadline_ns = _ns("freeze deadline", config.freeze_deadline_s)
    c.quiesce_ns = _ns("quiesce", config.quiesce_s)
    c.restore_window_ns = _ns("restore window", config.restore_window_s)
    c.shm_bytes = config.shm_bytes
    c.memory_limit_bytes = config.memory_limit_bytes
    c.tasks_max = config.tasks_max
    c.deadline_ns = _ns("deadline", config.deadline_s)
    c.remains_ns = _ns("time for remains", config.remains_s)
    c.restore_max = config.restore_max
    c.restore_on_signal = config.restore_on_signal
    c.restore_on_exit = config.restore_on_exit
    c.files = int(config.files)
    c.tcp = int(config.tcp)
    c.images = int(config.images)
    c.again = int(config.again)
    for status in config.restore_on_statuses:
        c.restore_on_status[status] = 1
    return c


def _event(e: Any) -> Event:
    kind = Kind.of(e.kind)
    return Event(
        kind=kind,
        cookie=e.cookie,
        reason=Reason.of(e.reason) if e.reason else None,
        ticket=e.ticket,
        at_ns=e.at_ns,
        app_pid=e.app_pid,
        app_pid_inside=e.app_pid_inside,
        wait_status=e.wait_status,
        threads=e.threads,
        generation=e.generation,
        line=e.line,
        replaced=e.replaced,
        generations=e.generations,
        attempt=e.attempt,
        quiescent=bool(e.quiescent),
        restores=e.restores,
        checkpoints=e.checkpoints,
        remains_pid=e.remains_pid,
        likeness_pid=e.likeness_pid,
        interval_s=e.interval_ns / _NS_PER_S,
        freeze_max_s=e.freeze_max_ns / _NS_PER_S,
        freeze_s=e.freeze_ns / _NS_PER_S,
        stop_s=e.stop_ns / _NS_PER_S,
        clone_s=e.clone_ns / _NS_PER_S,
        wait_s=e.wait_ns / _NS_PER_S,
        images=Images(e.images).name.lower() if kind is Kind.CHECKPOINT else "",
        fork_reason=FORK_REASONS[e.fork_reason] if e.fork_reason > 1 else "",
        copied=e.copied,
        died_ns=e.died_ns,
        restore_s=e.restore_ns / _NS_PER_S,
        fork_s=e.fork_ns / _NS_PER_S,
        threads_s=e.threads_ns / _NS_PER_S,
        age_s=e.age_ns / _NS_PER_S,
        again=Again(e.again).words if e.again else "",
        input_dropped=e.dropped,
        error=_error(ffi.addressof(e, "error")) if e.error.code != Code.OK else None,
    )


def _error(err: Any) -> AvckptError:
    return class_of_code(err.code)(
        _text(err.detail),
        operation=_text(err.operation),
        syscall=_text(err.syscall),
        errno=err.errnum,
        pid=err.pid,
        undo_failures=err.undo_failures,
    )


def _path(path: Path) -> Any:
    return ffi.new("char[]", os.fsencode(path))


def _text(chars: Any) -> str:
    # ffi.string() stops at the first NUL, or at the array's end.  Names of the
    # application's files may be in it.
    return printable(ffi.string(chars).decode("utf-8", "replace"))
