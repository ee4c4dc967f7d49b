# SPDX-License-Identifier: Apache-2.0
"""The sidecar's log, which no container can fill."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

from avckpt.bucket import Bucket

log = logging.getLogger("avckpt")

AT_ONCE = 700
"""A container, with its nodes, has so many lines at once: each of 200 crashes is told in three, and a launcher of
128 nodes can start and lose all of them, ..."""
EACH_S = 1.0
"""... and then one in this time, however often it is started again."""


@dataclass
class _Room:
    bucket: Bucket = field(default_factory=lambda: Bucket(AT_ONCE, 1 / EACH_S))
    left_out: int = 0


class Log:
    """Lines about somebody: a container, or a group.  Events are not left out anywhere else."""

    def __init__(self) -> None:
        self._rooms: dict[str, _Room] = {}

    def tell(self, whose: str, level: int, text: str) -> bool:
        """Whether there was room for it; those of level DEBUG take none."""
        if level >= logging.INFO:
            # Nodes are called CONTAINER/NODE, and may be others every second.
            room = self._rooms.setdefault(whose.partition("/")[0], _Room())
            if not room.bucket.has_one():
                room.left_out += 1
                return False
        log.log(level, "%s: %s", whose, text)
        return True

    def tell_what_is_left_out(self) -> None:
        """To be called every few seconds."""
        for whose, room in list(self._rooms.items()):
            if room.left_out:
                log.warning("%s: %d line(s) left out here; its events are in avckpt events", whose, room.left_out)
                room.left_out = 0
            elif room.bucket.is_full():
                del self._rooms[whose]
