# SPDX-License-Identifier: Apache-2.0
"""Which events are logged, and at which level. One line per event."""

from __future__ import annotations

import logging

from avckpt.bucket import Bucket
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import EXPECTED, Kind, Reason

SELDOM_S = 60.0
"""Failures that may recur at every interval (a checkpoint, a health check) are logged at most this often per
container."""

OFTEN_AT_ONCE = 30
OFTEN_S = 10.0
"""What an application can bring about as often as it likes (it executes programs, it cannot be protected for
changing reasons) is logged so many times at once, and then once in this time."""

LEVELS = {
    Kind.REGISTERED: logging.INFO,
    Kind.ATTACHED: logging.DEBUG,
    Kind.GUARD_LOST: logging.WARNING,
    Kind.DIED: logging.INFO,
    Kind.CRASH: logging.INFO,
    Kind.CORE: logging.INFO,
    Kind.LATE: logging.WARNING,
    Kind.WAITS: logging.DEBUG,
    Kind.RESTORED: logging.WARNING,
    Kind.GAVE_UP: logging.ERROR,
    Kind.DROPPED: logging.WARNING,
    Kind.HEALTH: logging.WARNING,
    Kind.CONFIGURED: logging.INFO,
    Kind.REFUSED: logging.WARNING,
    Kind.ENDED: logging.INFO,
    Kind.NOTIFIED: logging.DEBUG,
    Kind.HELD: logging.DEBUG,
    Kind.NOTIFY_FAILED: logging.WARNING,
    Kind.SIDECAR_STARTED: logging.INFO,
    Kind.SIDECAR_STOPPED: logging.INFO,
}
"""Levels of the kinds that are always logged. Those below INFO are routine, and not stored in the history."""


class _Seldom:
    """Limits lines to one per `SELDOM_S`; the others are counted."""

    def __init__(self) -> None:
        self._told_s = 0.0
        self._untold = 0

    def line(self, record: EventRecord) -> tuple[int, str] | None:
        if self._told_s and record.monotonic_s - self._told_s < SELDOM_S:
            self._untold += 1
            return None
        more = f" (and {self._untold} more since this was last said)" if self._untold else ""
        self._told_s, self._untold = record.monotonic_s, 0
        return logging.WARNING, f"{record.message}{more}"


class _Often:
    """Lets so many lines through at once, and then one per `OFTEN_S`; the others are counted."""

    def __init__(self) -> None:
        self._bucket = Bucket(OFTEN_AT_ONCE, 1 / OFTEN_S, at_s=0.0)
        self._untold = 0

    def line(self, at_s: float, line: tuple[int, str]) -> tuple[int, str] | None:
        if not self._bucket.has_one(at_s):
            self._untold += 1
            return None
        more = f" (and {self._untold} more lines of that kind before)" if self._untold else ""
        self._untold = 0
        return line[0], line[1] + more


class Journal:
    """Makes the log lines of one container. Remembers what it has logged, so that nothing is repeated at
    every interval."""

    def __init__(self) -> None:
        self._held = False
        self._unprotected = ""
        self._lacking = ""
        self._missed = _Seldom()
        self._unhealthy = _Seldom()
        self._often = _Often()

    def line(self, record: EventRecord) -> tuple[int, str] | None:
        """A logging level and the text (without the container's name), or None for silence."""
        line = self._line(record)
        often = record.kind in (Kind.CHECKPOINT, Kind.UNPROTECTED, Kind.MISSED) or (
            record.kind is Kind.DROPPED and record.reason not in (Reason.CRASHED, Reason.UNHEALTHY)
        )
        if line is None or not often or line[0] < logging.INFO:
            return line
        return self._often.line(record.monotonic_s, line)

    def _line(self, record: EventRecord) -> tuple[int, str] | None:
        kind = record.kind
        if kind is Kind.CHECKPOINT:
            return self._checkpoint(record)
        was_held = self._held
        if record.generations == 0 or kind is Kind.GUARD_LOST:
            self._held = False
        if kind is Kind.MISSED:
            # One that lost the generations is always logged.
            return (logging.WARNING, record.message) if was_held and not self._held else self._missed.line(record)
        if kind is Kind.HEALTH and record.error is not None:
            return self._unhealthy.line(record)
        if kind is Kind.UNPROTECTED:
            return self._lost(record)
        if kind is Kind.DROPPED and record.reason is Reason.EXECUTED:
            return logging.INFO, record.message  # as the entry points of many images do
        if kind is Kind.GUARD_LOST and record.reason is Reason.FILTER:
            return logging.INFO, record.message
        if kind is Kind.GAVE_UP and record.outcome in EXPECTED:
            return logging.INFO, record.message
        if kind is Kind.CONFIGURED and record.error is not None:
            return logging.WARNING, record.message
        return LEVELS[kind], record.message

    def _checkpoint(self, record: EventRecord) -> tuple[int, str]:
        self._unprotected = ""
        lacking = str(record.error) if record.error is not None else ""
        new, self._lacking = lacking != self._lacking, lacking
        if lacking and new:
            self._held = True
            return logging.WARNING, f"protected, but {lacking}"
        if not self._held:
            self._held = True
            return logging.INFO, f"protected: first {record.message.replace(':', ',', 1)}"
        return logging.DEBUG, record.message

    def _lost(self, record: EventRecord) -> tuple[int, str] | None:
        # The guard retries every interval: log it once per reason.
        self._held = False
        if record.message == self._unprotected:
            return None
        self._unprotected = record.message
        return logging.WARNING, record.message
