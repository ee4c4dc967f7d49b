# SPDX-License-Identifier: Apache-2.0
"""avckpt.group.recovery=together: containers with one recovery line.

A line is a checkpoint of every member at one instant: the guards coordinate that among
themselves (native/engine/guard/guard_group.c), and are only told here when, with whom, and
which line to restore. A problem with a member costs a line or leaves the member out, and is
reported; members are rolled back together or not at all.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections import Counter
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from avckpt_hooks.shared.labels import KEEP_MAX

from avckpt.containers import cgroup
from avckpt.engine import Guard, meeting
from avckpt.errors import AvckptError, Busy, NothingToRestore, TargetGone
from avckpt.events.log import Log
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind
from avckpt.guard import Command, Event
from avckpt.orders import Orders, check

if TYPE_CHECKING:
    from avckpt.daemon import Watch

FIRST_S = 0.3
"""Longest time from a member's start to a line with it: others may be starting, too."""
SOON_S, LONG_S = 0.1, 60.0
"""Shortest and longest pause after a line that was missed while none is held."""
PATIENCE = 2
"""Number of lines in a row that a member that cannot be protected may break, before some are taken without
it."""
SKIPPED = 10
"""The number of lines taken without it."""
TRIES = 2
"""Attempts to go back to one line: a member may only have been late."""

Answer = tuple[Event, EventRecord]


@dataclass
class Line:
    """The lines that all its members hold."""

    number: int
    generations: dict[int, int]
    """By cookie."""


@dataclass
class Group:
    """Members are containers with a guard."""

    name: str
    members: dict[int, Watch] = field(default_factory=dict)
    cgroups: dict[int, cgroup.Groups] = field(default_factory=dict)
    """By cookie: of avckpt-init.  To find them takes milliseconds, ten times a second."""
    lines: list[Line] = field(default_factory=list)
    """Oldest first."""
    number: int = 0
    """Of the last line."""
    dead: dict[int, int] = field(default_factory=dict)
    """By cookie: the newest generation allowed for a dead member that waits for the group."""
    broken: dict[int, int] = field(default_factory=dict)
    """By cookie: lines in a row that this member broke; above PATIENCE: counts those taken without it."""
    without: float | None = None
    """Since when lines have been missed while none is held; of the loop's time."""
    coming: asyncio.Event = field(default_factory=asyncio.Event)
    busy: asyncio.Lock = field(default_factory=asyncio.Lock)
    tasks: set[asyncio.Task[None]] = field(default_factory=set)

    @property
    def interval_s(self) -> float:
        """The shortest of its members'."""
        return min((each.settings.config.interval_s for each in self.members.values()), default=1.0)


def pause_s(interval_s: float, without_s: float | None) -> float:
    """From one line to the next.  `without_s`: none is held, and they have been missed for so long.

    Then after as long again, as one guard tries (policy_without() in policy.c).
    """
    if without_s is None:
        return interval_s
    return min(interval_s, max(SOON_S, min(without_s, LONG_S)))


def end_haste() -> None:
    """A guard whose application waits for its group gives this process real-time priority (guard_group.c)."""
    if os.sched_getscheduler(0) == os.SCHED_RR | os.SCHED_RESET_ON_FORK:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


class Groups:
    """All groups with a common recovery. For one event loop."""

    def __init__(self, orders: Orders, log: Log) -> None:
        self._orders = orders
        self._log = log
        self._groups: dict[str, Group] = {}

    def join(self, watch: Watch) -> None:
        """A guard for it has started."""
        policy = watch.settings.policy
        if not policy.together or watch.guard is None:
            return
        group = self._groups.setdefault(policy.group, Group(policy.group))
        group.members[watch.container.cookie] = watch
        if not group.tasks:
            self._begin(group, self._take_lines(group))

    def leave(self, watch: Watch) -> None:
        """Its guard is gone, or it leaves the group: lines with it are void."""
        cookie = watch.container.cookie
        group = self._group_of(watch)
        if group is None:
            return
        del group.members[cookie]
        for known in (group.dead, group.broken, group.cgroups):
            known.pop(cookie, None)
        group.lines = [line for line in group.lines if cookie not in line.generations]
        if not group.members:
            del self._groups[group.name]
            for task in group.tasks:
                task.cancel()

    def hear(self, watch: Watch, event: Event) -> None:
        """An event of a guard."""
        group = self._group_of(watch)
        if group is None:
            if event.kind is Kind.WAITS:
                end_haste()
            return
        cookie = watch.container.cookie
        if event.kind is Kind.ATTACHED:
            group.coming.set()
        elif event.kind in (Kind.CHECKPOINT, Kind.DROPPED):
            gone = event.replaced if event.kind is Kind.CHECKPOINT else event.generation
            group.lines = [line for line in group.lines if line.generations.get(cookie) != gone]
        elif event.kind is Kind.UNPROTECTED:
            group.lines = [line for line in group.lines if cookie not in line.generations]
        elif event.kind is Kind.WAITS:
            if not group.dead:
                self._begin(group, self._go_back(group))
            group.dead[cookie] = event.generation
        elif event.kind in (Kind.RESTORED, Kind.GAVE_UP):
            group.dead.pop(cookie, None)

    async def command(self, watch: Watch, command: Command, generation: int = 0) -> EventRecord:
        """A checkpoint or rollback of one is that of all; returns the event of this
        one.

        Raises Busy, NothingToRestore, or what went wrong.
        """
        group = self._group_of(watch)
        if group is None:
            raise Busy(f"{watch.container.label} is in no group at this moment")
        async with group.busy:
            if command is Command.CHECKPOINT:
                answers = await self._take_line(group)
            else:
                cookie = watch.container.cookie
                lines = [line for line in self._lines_of_all(group) if generation in (0, line.generations.get(cookie))]
                if not lines:
                    raise NothingToRestore(f"group {group.name} holds no such line to go back to")
                answers = await self._recall(group, lines[-1])
        answer = answers.get(watch.container.cookie)
        if answer is None:
            raise Busy(f"{watch.container.label}: the line was taken without it")
        if isinstance(answer, AvckptError):
            raise answer
        check(watch.container.label, answer[0])
        return answer[1]

    async def close(self) -> None:
        """Stops taking lines and common rollbacks."""
        tasks = [task for group in self._groups.values() for task in group.tasks]
        self._groups.clear()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _tell(self, group: Group, level: int, text: str) -> None:
        self._log.tell(f"group {group.name}", level, text)

    def _group_of(self, watch: Watch) -> Group | None:
        cookie = watch.container.cookie
        return next((group for group in self._groups.values() if cookie in group.members), None)

    def _begin(self, group: Group, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        group.tasks.add(task)
        task.add_done_callback(group.tasks.discard)

    # Lines

    async def _take_lines(self, group: Group) -> None:
        while True:
            due_s = self._pause_s(group)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(group.coming.wait(), due_s)
                group.coming.clear()
                await asyncio.sleep(min(FIRST_S, group.interval_s))
            async with group.busy:
                try:
                    if not group.dead:
                        await self._take_line(group)
                except (AvckptError, OSError) as error:
                    self._tell(group, logging.ERROR, f"a line could not be taken: {error}")

    def _pause_s(self, group: Group) -> float:
        without_s = None if group.without is None else asyncio.get_running_loop().time() - group.without
        return pause_s(group.interval_s, without_s)

    async def _take_line(self, group: Group) -> dict[int, Answer | AvckptError]:
        members = {cookie: guard for cookie, guard in self._able(group).items() if not self._is_skipped(group, cookie)}
        if not members:
            return {}
        group.number += 1
        number = group.number
        with meeting(len(members)) as fd:
            answers = await self._ask(group, members, lambda cookie, guard, ticket: guard.line(fd, number, ticket))
        taken = {
            cookie: answer[0].generation
            for cookie, answer in answers.items()
            if isinstance(answer, tuple) and answer[0].kind is Kind.CHECKPOINT
        }
        # If one has it, all have: the others may only have ended since.
        if taken:
            group.without = None
            group.broken = {cookie: n for cookie, n in group.broken.items() if cookie not in members}
            # A line from before a member started: what it has sent since would have no sender after a
            # rollback.
            older = [line for line in group.lines if taken.keys() <= line.generations.keys()]
            group.lines = [*older[1 - KEEP_MAX :], Line(number, taken)]
            return answers
        breakers = self._breakers(answers)
        for cookie in breakers:
            group.broken[cookie] = group.broken.get(cookie, 0) + 1
        # One that cannot be protected may be when the next line is due.
        if group.lines or breakers:
            group.without = None
        elif group.without is None:
            group.without = asyncio.get_running_loop().time()
        return answers

    def _able(self, group: Group) -> dict[int, Guard]:
        """Those that can be frozen at all."""
        return {
            cookie: watch.guard
            for cookie, watch in group.members.items()
            if watch.guard is not None and watch.container.app_pid and not self._is_paused(group, watch)
        }

    def _is_paused(self, group: Group, watch: Watch) -> bool:
        cookie = watch.container.cookie
        if cookie not in group.cgroups:
            try:
                group.cgroups[cookie] = cgroup.groups_of(watch.container.init_pid)
            except OSError:
                return False  # it has ended
        return group.cgroups[cookie].is_frozen()

    def _is_skipped(self, group: Group, cookie: int) -> bool:
        """One that cannot be protected is left out of some, and then retried."""
        if group.broken.get(cookie, 0) < PATIENCE:
            return False
        group.broken[cookie] += 1
        if group.broken[cookie] > PATIENCE + SKIPPED:
            group.broken[cookie] = PATIENCE - 1
        elif group.broken[cookie] == PATIENCE + 1:
            label = group.members[cookie].container.label
            self._tell(group, logging.WARNING, f"the next {SKIPPED} lines are taken without {label}")
        return True

    def _breakers(self, answers: dict[int, Answer | AvckptError]) -> list[int]:
        """Members that cannot be protected. One that was only too late is not left out: it would not be
        rolled back with the others."""
        return [
            cookie
            for cookie, answer in answers.items()
            if isinstance(answer, tuple) and answer[0].kind is Kind.UNPROTECTED
        ]

    async def _ask(
        self, group: Group, members: dict[int, Guard], tell: Callable[[int, Guard, int], None]
    ) -> dict[int, Answer | AvckptError]:
        """Sends all of them the same command, and waits for all answers."""

        async def ask(cookie: int, guard: Guard) -> Answer | AvckptError:
            try:
                watch = group.members[cookie]
                return await self._orders.ask(watch.container, lambda ticket: tell(cookie, guard, ticket))
            except AvckptError as error:
                return error

        answers = await asyncio.gather(*(ask(cookie, guard) for cookie, guard in members.items()))
        return dict(zip(members, answers))

    # Returns

    async def _go_back(self, group: Group) -> None:
        """A member has died: back to the newest line that all members have."""
        try:
            await self._bring_back(group)
        finally:
            end_haste()

    async def _bring_back(self, group: Group) -> None:
        async with group.busy:
            tried: Counter[int] = Counter()
            while group.dead:
                line = self._line_for(group, tried)
                if line is None:
                    break
                tried[line.number] += 1
                try:
                    await self._recall(group, line)
                except (AvckptError, OSError) as error:
                    self._tell(group, logging.ERROR, f"it cannot go back to line {line.number}: {error}")
                    break
            for cookie in list(group.dead):
                watch = group.members[cookie]
                self._tell(group, logging.ERROR, f"there is no line to go back to with {watch.container.label}")
                with contextlib.suppress(TargetGone, Busy):
                    if watch.guard is not None:
                        watch.guard.command(Command.ABANDON, 0)
            group.dead.clear()

    def _line_for(self, group: Group, tried: Counter[int]) -> Line | None:
        """The newest line allowed for the dead, and all members that hold it."""
        for line in reversed(self._lines_of_all(group)):
            if tried[line.number] < TRIES and all(
                line.generations.get(cookie, newest + 1) <= newest for cookie, newest in group.dead.items()
            ):
                return line
        return None

    def _lines_of_all(self, group: Group) -> list[Line]:
        """Without lines that lack a running, protected member: one that was paused then, for example."""
        holders = {cookie for cookie in self._able(group) if group.members[cookie].container.generations}
        return [line for line in group.lines if holders <= line.generations.keys()]

    async def _recall(self, group: Group, line: Line) -> dict[int, Answer | AvckptError]:
        able = self._able(group)
        members = {cookie: able[cookie] for cookie in line.generations if cookie in able}
        for cookie in line.generations.keys() - members.keys():
            label = group.members[cookie].container.label
            self._tell(group, logging.WARNING, f"{label} is paused, and is not rolled back")
        # Whatever the outcome, newer ones are useless.
        group.lines = group.lines[: group.lines.index(line) + 1]
        with meeting(len(members)) as fd:
            answers = await self._ask(
                group,
                members,
                lambda cookie, guard, ticket: guard.recall(fd, line.number, line.generations[cookie], ticket),
            )
        if all(isinstance(answer, tuple) and answer[0].kind is Kind.RESTORED for answer in answers.values()):
            self._tell(group, logging.WARNING, f"went back to line {line.number} together ({len(members)} members)")
        return answers
