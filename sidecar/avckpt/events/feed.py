# SPDX-License-Identifier: Apache-2.0
"""Delivers events to followers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator

from avckpt.events.record import EventRecord

BACKLOG = 1024
"""Events a follower may be behind before it is dropped."""


class Feed:
    """Hands every event to every follower.  For one event loop."""

    def __init__(self) -> None:
        self._followers: set[asyncio.Queue[EventRecord | None]] = set()
        self._closed = False

    def publish(self, record: EventRecord) -> None:
        """Never blocks: a follower that does not keep up loses the rest."""
        for queue in list(self._followers):
            queue.put_nowait(record)
            if queue.qsize() >= BACKLOG:
                self._end(queue)

    @contextlib.contextmanager
    def follow(self) -> Iterator[asyncio.Queue[EventRecord | None]]:
        """A queue of the events from now on; None is the last."""
        queue: asyncio.Queue[EventRecord | None] = asyncio.Queue()
        self._followers.add(queue)
        if self._closed:
            self._end(queue)
        try:
            yield queue
        finally:
            self._followers.discard(queue)

    def close(self) -> None:
        """Ends every follower."""
        self._closed = True
        for queue in list(self._followers):
            self._end(queue)

    def _end(self, queue: asyncio.Queue[EventRecord | None]) -> None:
        self._followers.discard(queue)
        queue.put_nowait(None)
