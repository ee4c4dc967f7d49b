# SPDX-License-Identifier: Apache-2.0
"""Follows each death: collects what the kernel reported, the memory shows, and the outcome, and makes one
event of it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Collection, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from avckpt.containers.looks import look
from avckpt.containers.protected import Protected
from avckpt.engine import Guard
from avckpt.errors import AvckptError, Busy, TargetGone
from avckpt.events.history import History
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import EXPECTED, Kind, Reason
from avckpt.evidence.collector import Case, Collector
from avckpt.evidence.cores import Cores
from avckpt.evidence.crash import Crash
from avckpt.evidence.remains import command_of
from avckpt.guard import Command, Event
from avckpt.policy import Settings

log = logging.getLogger("avckpt")

OUTCOME_S = 15.0
"""How long the end of a restore is waited for."""


class Watched(Protocol):
    """What is needed of the daemon's side of a container."""

    container: Protected
    guard: Guard | None
    settings: Settings


W = TypeVar("W", bound=Watched)


class Inquests(Generic[W]):
    """One for each death, beside whatever the daemon does.  For one event loop; `start()` it there."""

    def __init__(
        self,
        tell: Callable[[W, EventRecord], EventRecord],
        history: History,
        cores: Path,
        protected: Callable[[], Collection[int]],
    ) -> None:
        self._tell = tell
        self._history = history
        self._collector = Collector(protected)
        self._cores = Cores(cores)
        self._tasks: set[asyncio.Task[None]] = set()
        self._open: dict[int, asyncio.Future[EventRecord]] = {}
        """By the container's cookie: what follows the death that is looked into."""

    def start(self) -> None:
        """Begins to hear of deaths."""
        self._collector.start()

    async def close(self) -> None:
        """Gives up what is not finished."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._collector.close()

    def take(self, watch: W, event: Event, record: EventRecord) -> None:
        """Hears what a guard has told: of a death, or what followed."""
        cookie = watch.container.cookie
        if event.kind is Kind.DIED:
            case = self._collector.open_case(event, watch.container.init_pid, watch.container.command)
            outcome = self._open[cookie] = asyncio.get_running_loop().create_future()
            self._begin(self._look_into(watch, case, outcome))
        elif event.kind in (Kind.RESTORED, Kind.GAVE_UP):
            waiting = self._open.pop(cookie, None)
            if waiting is not None and not waiting.done():
                waiting.set_result(record)
        elif event.kind is Kind.ATTACHED or (event.kind is Kind.CHECKPOINT and record.seq):
            # The first checkpoint: also of what an entry point has executed since.
            self._begin(self._look_at_command(watch.container))

    def crashes_of(self, container: Protected) -> list[EventRecord]:
        """Those in the history, oldest first, also of earlier runs of the same name."""
        return [each for each in self._history.after() if each.kind is Kind.CRASH and _is_of(each, container)]

    def _begin(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    @staticmethod
    async def _look_at_command(container: Protected) -> None:
        """For a death after which nothing is left to look at."""
        pid, init_pid = container.app_pid, container.init_pid
        with contextlib.suppress(AvckptError, OSError):
            container.command = await look("command", pid, lambda: command_of(pid, init_pid)) or container.command

    async def _look_into(self, watch: W, case: Case, outcome: asyncio.Future[EventRecord]) -> None:
        try:
            crash = await self._collector.examine(case)
            watch.container.command = crash.command or watch.container.command
            self._command(watch, Command.SEEN, case.remains_pid or case.likeness_pid)
            try:
                followed = await asyncio.wait_for(outcome, OUTCOME_S)
            except asyncio.TimeoutError:
                followed = EventRecord(Kind.GAVE_UP, reason=Reason.SIGNAL, wait_status=case.wait_status)
            if followed.reason in (Reason.COMMAND, Reason.GROUP) or followed.outcome in EXPECTED:
                return  # somebody wanted it
            record = self._tell(watch, self._record(watch.container, crash, followed, case.detected_s))
            self._judge(watch, record)
            mode = watch.settings.policy.core
            if mode != "off" and followed.outcome is Reason.RESTORED:
                path, size, what = await self._cores.make(watch.container, case, crash, mode)
                core = EventRecord(Kind.CORE, core=path or None, core_bytes=size or None, detail=what)
                self._tell(watch, replace(core, crash_seq=record.seq))
        finally:
            self._command(watch, Command.RELEASE, case.remains_pid)

    def _record(
        self, container: Protected, crash: Crash, followed: EventRecord, detected_s: float | None
    ) -> EventRecord:
        before = [
            each for each in self.crashes_of(container) if each.crash and each.crash.fingerprint == crash.fingerprint
        ]
        left = container.config.restore_max - followed.attempt if followed.attempt is not None else None
        return EventRecord(
            Kind.CRASH,
            reason=followed.reason,
            outcome=followed.outcome,
            wait_status=followed.wait_status,
            generation=followed.generation,
            age_s=followed.age_s,
            lost_s=followed.lost_s,
            restore_s=followed.restore_s,
            detected_s=detected_s,
            recovered_s=None if followed.restore_s is None else followed.restore_s + (detected_s or 0.0),
            attempt=followed.attempt,
            left=max(left, 0) if left is not None else None,
            crash=replace(crash, count=len(before) + 1),
        )

    def _judge(self, watch: W, record: EventRecord) -> None:
        deadline_s = watch.settings.policy.deadline_s
        if deadline_s and record.recovered_s is not None and record.recovered_s > deadline_s:
            detail = f"it was back later than avckpt.deadline={deadline_s * 1000:g}ms"
            self._tell(
                watch, EventRecord(Kind.LATE, detail=detail, recovered_s=record.recovered_s, crash_seq=record.seq)
            )

    @staticmethod
    def _command(watch: W, command: Command, pid: int) -> None:
        if pid and watch.guard is not None:
            # One that has just ended has released them.
            with contextlib.suppress(TargetGone, Busy):
                watch.guard.command(command, pid)


def _is_of(record: EventRecord, container: Protected) -> bool:
    return record.id == container.id or (bool(container.name) and record.container == container.name)
