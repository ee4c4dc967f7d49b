# SPDX-License-Identifier: Apache-2.0
"""Commands to guards, and their answers."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

from avckpt.containers.protected import Protected
from avckpt.engine import Guard
from avckpt.errors import AvckptError, DeadlineMissed, TargetGone, Unprotected
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind, why_not_restored
from avckpt.guard import Command, Event

TIMEOUT_S = 30.0
"""Seconds that a command waits for the guard's answer."""


@dataclass
class _Order:
    cookie: int
    done: asyncio.Future[None]
    events: list[Event] = field(default_factory=list)
    record: EventRecord | None = None


class Orders:
    """The commands that wait for an answer.  For one event loop."""

    def __init__(self) -> None:
        self._tickets = itertools.count(1)
        self._open: dict[int, _Order] = {}

    async def give(self, guard: Guard, container: Protected, command: Command, generation: int = 0) -> EventRecord:
        """Carries out a command; returns the resulting event.

        Raises DeadlineMissed, TargetGone, or the guard's error.
        """
        order = await self._carry_out(container, _of_command(guard, command, generation))
        check(container.label, order.events[-1])
        assert order.record is not None
        return order.record

    async def ask(self, container: Protected, tell: Callable[[int], None]) -> tuple[Event, EventRecord]:
        """Calls `tell` with a new ticket; returns the answer, whatever it is.

        Raises DeadlineMissed, TargetGone, or what `tell` raises.
        """
        order = await self._carry_out(container, tell)
        assert order.record is not None
        return order.events[-1], order.record

    async def held(self, guard: Guard, container: Protected) -> list[Event]:
        """The generations that are held, oldest first.  Raises as `give()`."""
        order = await self._carry_out(container, _of_command(guard, Command.LIST))
        if order.events[-1].kind is not Kind.HELD:
            check(container.label, order.events[-1])
        return [event for event in order.events if event.generation]

    def answer(self, event: Event, record: EventRecord | None) -> None:
        """Takes an event of a guard; `record` is its distributed form."""
        order = self._open.get(event.ticket)
        if order is None or order.done.done():
            return
        order.events.append(event)
        order.record = record
        if event.kind is not Kind.HELD or len(order.events) >= event.generations:
            order.done.set_result(None)

    def fail(self, container: Protected, why: str) -> None:
        """Answers all pending commands of a container: no other answer will come."""
        for order in self._open.values():
            if order.cookie == container.cookie and not order.done.done():
                order.done.set_exception(TargetGone(f"{container.label}: {why}"))

    async def _carry_out(self, container: Protected, tell: Callable[[int], None]) -> _Order:
        ticket = next(self._tickets)
        order = self._open[ticket] = _Order(container.cookie, asyncio.get_running_loop().create_future())
        try:
            tell(ticket)
            await asyncio.wait_for(order.done, TIMEOUT_S)
        except asyncio.TimeoutError as error:
            raise DeadlineMissed(f"{container.label}: no answer within {TIMEOUT_S:g} s") from error
        finally:
            del self._open[ticket]
        return order


def _of_command(guard: Guard, command: Command, generation: int = 0) -> Callable[[int], None]:
    return lambda ticket: guard.command(command, ticket, TIMEOUT_S, generation)


def check(label: str, event: Event) -> None:
    """Raises the error in the answer to a command, with the container's name."""
    if event.kind in (Kind.CHECKPOINT, Kind.RESTORED):
        return
    if event.kind is Kind.GAVE_UP:
        raise AvckptError(f"{label} was not restored and ended: {why_not_restored(event.reason, event.error)}")
    if event.kind is Kind.UNPROTECTED:
        raise Unprotected(f"{label} runs unprotected: {event.error}")
    if event.error is None:
        raise AvckptError(f"{label}: answered with {event.kind.name.lower()}")
    error = event.error
    raise type(error)(
        error.detail,
        container=label,
        operation=error.operation,
        syscall=error.syscall,
        errno=error.errno,
        pid=error.pid,
        undo_failures=error.undo_failures,
    )
