# SPDX-License-Identifier: Apache-2.0
"""Notifies containers of recoveries, as their labels avckpt.notify and avckpt.notify.self
request.

No restore and no other receiver waits for a delivery: each receiver has its own short
queue and task, and each delivery has a deadline.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from avckpt_hooks.shared.labels import Notify
from avckpt_hooks.shared.tell import printable

from avckpt.containers.looks import look
from avckpt.containers.process import has_ended, open_app, pid_of
from avckpt.containers.process import status as status_of
from avckpt.containers.protected import Protected
from avckpt.errors import AvckptError, Busy, TargetGone, of_any
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import EXPECTED, Kind, signal_name
from avckpt.supervision.inside import run_inside

EXEC_TIMEOUT_S = 5.0
"""A command that runs for longer is killed."""
APP_TIMEOUT_S = 5.0
"""How long to wait for a receiver that is being restored itself."""
SHOWN = 160
"""Characters of a program's name, and of its output."""
BACKLOG = 16
"""Notifications that may wait for one receiver; further ones are dropped, which is reported."""


class Watched(Protocol):
    """The part of the daemon's Watch that is needed of a receiver."""

    container: Protected
    pidfd: int

    @property
    def notify(self) -> Notify | None: ...

    @property
    def notify_self(self) -> Notify | None: ...


Tell = Callable[[Protected, Kind, str], None]
"""Reports a notification as delivered, or not, in a clause for users."""


@dataclass
class _Receiver:
    pidfd: int
    """Our duplicate of its init's pidfd."""
    container: Protected
    waiting: deque[tuple[Notify, EventRecord]] = field(default_factory=deque)
    task: asyncio.Task[None] | None = None


class Notifier:
    """Delivers notifications.  For one event loop."""

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._receivers: dict[int, _Receiver] = {}

    def take(self, record: EventRecord, subject: Protected, watches: Iterable[Watched]) -> None:
        """Queues `record`, which is about `subject`, for all containers that asked for it. Never blocks."""
        if record.kind is Kind.GAVE_UP:
            if record.outcome in EXPECTED:
                return
        elif record.kind is not Kind.RESTORED:
            return
        for watch in list(watches):
            if watch.container is subject:
                # After gave_up there is no application left to notify.
                if watch.notify_self is not None and record.kind is Kind.RESTORED:
                    self._enqueue(watch, watch.notify_self, record)
            elif watch.notify is not None and subject.group and watch.container.group == subject.group:
                self._enqueue(watch, watch.notify, record)

    async def close(self) -> None:
        """Drops undelivered notifications; running commands are killed."""
        tasks = [receiver.task for receiver in self._receivers.values() if receiver.task is not None]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def _enqueue(self, watch: Watched, how: Notify, record: EventRecord) -> None:
        cookie = watch.container.cookie
        receiver = self._receivers.get(cookie)
        if receiver is None:
            try:
                pidfd = os.dup(watch.pidfd)
            except OSError as error:
                self._failed(watch.container, record, of_any(error))
                return
            receiver = self._receivers[cookie] = _Receiver(pidfd, watch.container)
            receiver.task = asyncio.get_running_loop().create_task(self._deliver_all(cookie, receiver))
        if len(receiver.waiting) >= BACKLOG:
            self._failed(watch.container, record, Busy(f"{BACKLOG} notifications are waiting for it already"))
            return
        receiver.waiting.append((how, record))

    async def _deliver_all(self, cookie: int, receiver: _Receiver) -> None:
        """Delivers in order until nothing is left."""
        try:
            while receiver.waiting:
                how, record = receiver.waiting.popleft()
                try:
                    done = await _deliver(receiver, how, record)
                except Exception as error:  # noqa: BLE001 - whatever stops this one, the next may be delivered
                    if has_ended(receiver.pidfd):
                        return
                    self._failed(receiver.container, record, of_any(error))
                else:
                    self._tell(receiver.container, Kind.NOTIFIED, f"notified of {record.container} {done}")
        finally:
            del self._receivers[cookie]
            os.close(receiver.pidfd)

    def _failed(self, receiver: Protected, record: EventRecord, why: AvckptError) -> None:
        self._tell(receiver, Kind.NOTIFY_FAILED, f"{record.container} {record.kind.value}: {why}")


async def _deliver(receiver: _Receiver, how: Notify, record: EventRecord) -> str:
    """Raises AvckptError with the reason when it could not be done."""
    if how.signal:
        app = await _app_of(receiver)
        try:
            await _send(app, how.signal)
        finally:
            os.close(app)
        return f"by {signal_name(how.signal)}"
    done = await run_inside(
        receiver.pidfd,
        how.command,
        timeout_s=EXEC_TIMEOUT_S,
        stdin=json.dumps(record.to_json()).encode() + b"\n",
        env=environment_of(record),
    )
    # Not its arguments: readers of the log may not be allowed to read the label.
    program = printable(how.command[0])[:SHOWN]
    said = _one_line(done.output)
    if done.timed_out:
        raise AvckptError(f"{program}: killed after {EXEC_TIMEOUT_S:g} s{said}")
    if done.status:
        raise AvckptError(f"{program}: exited with status {done.status}{said}")
    return f"by {program}"


def environment_of(record: EventRecord) -> Mapping[str, str]:
    """The environment of a command: AVCKPT_EVENT, and AVCKPT_<FIELD> for every other plain field."""
    variables = {}
    for name, value in record.to_json().items():
        if name == "kind":
            variables["AVCKPT_EVENT"] = str(value)
        elif isinstance(value, (str, int, float)):
            variables[f"AVCKPT_{name.upper()}"] = str(value)
    return variables


async def _app_of(receiver: _Receiver) -> int:
    """A pidfd of the receiver's application, which may be absent during a restore.

    Raises TargetGone when there is none in time.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + APP_TIMEOUT_S
    while True:
        try:
            return open_app(receiver.container.app_pid, receiver.container.init_pid, receiver.pidfd)
        except TargetGone:
            if loop.time() > deadline or has_ended(receiver.pidfd):
                raise
        await asyncio.sleep(0.02)


async def _send(app: int, number: int) -> None:
    """Sends a signal unless it would kill the application, which must have a handler for it."""
    pid = pid_of(app)
    if not await look("threads", pid, lambda: _is_ready(pid, number)):
        raise AvckptError(f"its application does not handle {signal_name(number)}, which would end it: it was not sent")
    try:
        signal.pidfd_send_signal(app, number)
    except ProcessLookupError as error:
        raise TargetGone("its application has just ended") from error


def _is_ready(pid: int, number: int) -> bool:
    """Waits until it has settled; whether a signal would not kill it. Runs in a separate thread."""
    _settle(pid)
    for _ in range(_TRIES):
        if _is_prepared(pid, number):
            return True
        # It may just have been on its way into or out of sigwait(3).
        time.sleep(0.05)
    return False


def _settle(pid: int) -> None:
    """Waits, 100 ms at most, until the application's main thread is in a system call.

    A restored thread restarts the call it was in. A signal that arrives just before
    that runs its handler, but does not interrupt the call, as it would have a moment
    later: a program that relies on the interruption would keep sleeping.
    """
    for _ in range(10):
        with suppress(OSError):
            if not Path(f"/proc/{pid}/syscall").read_text().startswith("running"):
                return
        time.sleep(0.01)


_HARMLESS = frozenset({signal.SIGCHLD, signal.SIGURG, signal.SIGWINCH, signal.SIGCONT})
"""Their default action: none."""

_RT_SIGTIMEDWAIT = {"x86_64": "128", "aarch64": "137"}

_TRIES = 3
_LOOKS = 4
_BETWEEN_LOOKS_S = 0.003


def _is_prepared(pid: int, number: int) -> bool:
    """Whether a signal is caught or ignored, or blocked or waited for by every thread."""
    if number in _HARMLESS:
        return True
    bit = 1 << (number - 1)
    status = _status(pid)
    if (int(status.get("SigCgt", "0"), 16) | int(status.get("SigIgn", "0"), 16)) & bit:
        return True
    try:
        threads = os.listdir(f"/proc/{pid}/task")
    except OSError:
        return False
    # A thread that the guard has stopped, or that was just restored, briefly has every signal blocked; one
    # that blocks it itself does so at every check.
    for again in range(_LOOKS):
        if again:
            time.sleep(_BETWEEN_LOOKS_S)
        if not all(_is_blocked(tid, bit) or _waits_for(tid, bit) for tid in threads):
            return False
    return True


def _is_blocked(tid: str, bit: int) -> bool:
    """Whether an untraced thread has the signal blocked."""
    status = _status(int(tid))
    return status.get("TracerPid", "0").strip() == "0" and bool(int(status.get("SigBlk", "0"), 16) & bit)


def _waits_for(tid: str, bit: int) -> bool:
    """Whether a thread is in sigwait(3) or the like for a signal, which meanwhile is not blocked."""
    try:
        words = Path(f"/proc/{tid}/syscall").read_text().split()
        if words[0] != _RT_SIGTIMEDWAIT.get(os.uname().machine):
            return False
        with open(f"/proc/{tid}/mem", "rb", buffering=0) as memory:
            memory.seek(int(words[1], 16))
            return bool(int.from_bytes(memory.read(8), "little") & bit)
    except (OSError, ValueError, IndexError):
        return False


def _status(pid: int) -> dict[str, str]:
    """/proc/PID/status, proc(5); only a name when there is no such process."""
    try:
        return status_of(pid)
    except OSError:
        return {"Name": ""}


def _one_line(output: str) -> str:
    """The end of a command's output, as an addition to a message."""
    last = output.strip().rpartition("\n")[2]
    shown = printable(last)[:SHOWN]
    return f": {shown}" if shown else ""
