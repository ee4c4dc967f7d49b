# SPDX-License-Identifier: Apache-2.0
"""Which events are worth a line, and how it reads.  One line per event of interest."""

from __future__ import annotations

import logging

from avckpt.event_record import EXPECTED, EventRecord, Kind

MISSED_EVERY_S = 60.0
"""Missed checkpoints of one container are told at most this often."""

LEVELS = {
    Kind.REGISTERED: logging.INFO,
    Kind.ATTACHED: logging.DEBUG,
    Kind.DIED: logging.INFO,
    Kind.RESTORED: logging.WARNING,
    Kind.GAVE_UP: logging.ERROR,
    Kind.DROPPED: logging.WARNING,
    Kind.HEALTH: logging.WARNING,
    Kind.CONFIGURED: logging.INFO,
    Kind.REFUSED: logging.WARNING,
    Kind.ENDED: logging.INFO,
    Kind.NOTIFIED: logging.DEBUG,
    Kind.NOTIFY_FAILED: logging.WARNING,
}
"""Levels of the kinds that are always told.  What is below INFO is routine: it is not kept in the history."""


class Journal:
    """Makes the lines of one container.  Remembers what it has said, so that nothing is said every interval."""

    def __init__(self) -> None:
        self._held = False
        self._unprotected = ""
        self._lacking = ""
        self._missed_told_s = 0.0
        self._missed_untold = 0

    def line(self, record: EventRecord) -> tuple[int, str] | None:
        """A logging level and the text (without the container's name), or None for silence."""
        kind = record.kind
        if kind is Kind.CHECKPOINT:
            return self._checkpoint(record)
        if kind is Kind.MISSED:
            return self._missed(record)
        if kind is Kind.UNPROTECTED:
            return self._lost(record)
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

    def _missed(self, record: EventRecord) -> tuple[int, str] | None:
        since_s = record.monotonic_s - self._missed_told_s
        if self._missed_told_s and since_s < MISSED_EVERY_S:
            self._missed_untold += 1
            return None
        more = f" (and {self._missed_untold} more since this was last said)" if self._missed_untold else ""
        self._missed_told_s = record.monotonic_s
        self._missed_untold = 0
        return logging.WARNING, f"{record.message}{more}"

    def _lost(self, record: EventRecord) -> tuple[int, str] | None:
        # The guard looks again every interval: say it once per reason.
        self._held = False
        if record.message == self._unprotected:
            return None
        self._unprotected = record.message
        return logging.WARNING, record.message
