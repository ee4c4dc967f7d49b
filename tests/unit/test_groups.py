# SPDX-License-Identifier: Apache-2.0
"""Groups that go back together (avckpt.supervision.groups): when their lines are taken."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from typing import Any

import pytest
from avckpt.events.log import Log
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind
from avckpt.guard import Event
from avckpt.orders import Orders
from avckpt.supervision import groups
from avckpt.supervision.groups import Group, Groups, pause_s

COOKIE = 1
HOUR_S = 3600.0


def test_as_long_again_while_no_line_is_held() -> None:
    assert pause_s(3600, None) == 3600
    assert [pause_s(3600, since) for since in (0, 0.05, 0.2, 7, 61, 5000)] == [0.1, 0.1, 0.2, 7, 60, 60]
    assert [pause_s(0.05, since) for since in (0, 7)] == [0.05, 0.05]  # never later than it is due


class Scripted(Groups):
    """A group of one member, whose lines come out as a test says."""

    def __init__(self, outcomes: list[Kind]) -> None:
        super().__init__(Orders(), Log())
        self.outcomes = outcomes
        self.pauses: list[float] = []

    def _able(self, group: Group) -> dict[int, Any]:
        return {COOKIE: None}

    async def _ask(self, group: Group, members: dict[int, Any], tell: object) -> dict[int, Any]:
        kind = self.outcomes.pop(0)
        return {COOKIE: (Event(kind=kind, cookie=COOKIE, generation=1), EventRecord(kind))}

    def _pause_s(self, group: Group) -> float:
        if not self.outcomes:
            raise Over
        self.pauses.append(super()._pause_s(group))
        return 0.0  # which nobody has to wait for

    async def take_lines(self) -> list[float]:
        """The pauses before them."""
        with contextlib.suppress(Over):
            await self._take_lines(Group("chain"))
        return self.pauses


class Over(Exception):
    pass


@pytest.fixture(autouse=True)
def an_hour_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextlib.contextmanager
    def none(_: int) -> Iterator[int]:
        yield -1

    monkeypatch.setattr(groups, "meeting", none)
    monkeypatch.setattr(groups, "FIRST_S", 0.0)
    monkeypatch.setattr(Group, "interval_s", HOUR_S)


def test_a_first_line_that_is_missed_is_tried_soon() -> None:
    """Not so one after a line, nor one that a member has broken which cannot be protected."""
    outcomes = [Kind.MISSED, Kind.MISSED, Kind.CHECKPOINT, Kind.MISSED, Kind.CHECKPOINT]
    pauses = asyncio.run(Scripted(outcomes).take_lines())
    assert pauses[0] == pauses[3] == pauses[4] == HOUR_S
    assert max(pauses[1:3]) < HOUR_S
    assert asyncio.run(Scripted([Kind.UNPROTECTED] * 2).take_lines()) == [HOUR_S, HOUR_S]
