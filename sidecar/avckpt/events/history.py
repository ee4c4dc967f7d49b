# SPDX-License-Identifier: Apache-2.0
"""The last events, numbered, in a file that outlives the sidecar.

One JSON object per line, appended by one write(2) each, so that a sidecar that
is killed at any instant leaves at most one torn line, which the next one drops.
The file grows to twice `limit` lines and is then replaced by its newer half.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import stat
import time
from collections import Counter, deque
from pathlib import Path
from typing import TYPE_CHECKING

from avckpt.events.record import EventRecord

if TYPE_CHECKING:
    from avckpt.events.archive import Archive

log = logging.getLogger("avckpt")

LIMIT = 1000
"""Events kept."""
FILE_BYTES = 16 << 20
"""Several times what so many events take: of a longer file only the end is read."""
AGAIN_S = 10.0
"""A failed write is retried with the first event after this time: a full disk may not stay full."""


class History:
    """The last events of a machine: since it started, or with an `archive` from before; at most `limit`.

    At most half of it is of one container, whose events may come as often as it likes.
    For one thread.  What cannot be written is kept in memory until it can, and the log says so once.
    A `durable` one waits for its disk before it replaces the file.
    """

    def __init__(
        self, path: Path, limit: int = LIMIT, *, archive: Archive | None = None, durable: bool = False
    ) -> None:
        self._path = path
        self._limit = limit
        self._archive = archive
        self._durable = durable
        self._kept: deque[EventRecord] = deque()
        self._shares: Counter[str] = Counter()
        """How many are kept of each container, its nodes' included."""
        self._lines = 0
        self._fd = -1
        self._closed = False
        self._failed_s: float | None = None
        """When a write failed (CLOCK_MONOTONIC); None: none has."""
        whole = self._load()
        if archive is not None and self._join(archive):
            whole = False
        # The time of day as the first number: numbers given out before a
        # history was lost are smaller, so that a client that resumes after one
        # of them misses nothing.
        self._next = self._kept[-1].seq + 1 if self._kept else int(time.time())
        if not whole or self._lines >= 2 * limit:
            self._compact()

    def add(self, record: EventRecord) -> EventRecord:
        """Numbers an event and keeps it; returns it with its number."""
        record = dataclasses.replace(record, seq=self._next)
        self.keep(record)
        if self._archive is not None:
            self._archive.add(record)
        return record

    def keep(self, record: EventRecord) -> None:
        """Keeps an event that has its number."""
        self._next = record.seq + 1
        self._hold(record)
        if self._failed_s is None and self._lines < 2 * self._limit:
            self._append(record)
        elif self._failed_s is None or time.monotonic() - self._failed_s >= AGAIN_S:
            self._compact()

    def after(self, seq: int | None = None, since: float | None = None) -> list[EventRecord]:
        """The stored events, oldest first: later than number `seq`, and not before the time of day
        `since`."""
        if seq is not None and seq >= self._next:
            seq = None  # of another history: this one was lost, or the clock was set back
        return [
            record
            for record in self._kept
            if (seq is None or record.seq > seq) and (since is None or record.at >= since)
        ]

    def write_again(self) -> None:
        """Writes the file again: it was removed."""
        self._compact()

    def sync(self) -> None:
        """Has the disk write what was kept.  Blocks."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):  # the next write says so
                os.fdatasync(self._fd)

    def close(self) -> None:
        """Closes the file; what is added from now on is not written."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1
        self._closed = True
        if self._archive is not None:
            self._archive.close()

    def _join(self, archive: Archive) -> bool:
        """Completes each by what only the other has; whether it had something for this one."""
        here = {record.seq: record for record in self._kept}
        there = {record.seq: record for record in archive.load()}
        for seq in sorted(here.keys() - there.keys()):
            archive.add(here[seq])
        both = {**there, **here}
        self._kept.clear()
        self._shares.clear()
        for seq in sorted(both):
            self._hold(both[seq])
        return bool(there.keys() - here.keys())

    def _load(self) -> bool:
        """Reads the file; False when it must be rewritten before events are appended."""
        try:
            content, whole = self._content()
        except FileNotFoundError:
            return True
        except OSError as error:
            self._complain(error)
            return True
        lines = content.splitlines()
        newest = lines[-2 * self._limit - 1 :]
        whole &= len(newest) == len(lines) and (content.endswith(b"\n") or not content)
        last = 0
        for line in newest:
            self._lines += 1
            try:
                record = EventRecord.from_json(json.loads(line))
            except (ValueError, AttributeError, RecursionError):
                whole = False
                continue
            if record.seq > last:
                self._hold(record)
                last = record.seq
        return whole

    def _content(self) -> tuple[bytes, bool]:
        """The end of the file, and whether that is all of it and a file.

        What else may be in its place must not hold the start up. Nobody waits for a `durable` one.
        """
        with open(self._path, "rb", opener=self._open_at_once) as file:
            is_file = stat.S_ISREG(os.fstat(file.fileno()).st_mode)
            size = file.seek(0, os.SEEK_END) if is_file else 0
            if is_file:
                file.seek(max(size - FILE_BYTES, 0))
            elif not self._durable:
                return b"", False
            return file.read(FILE_BYTES), is_file and size <= FILE_BYTES

    def _open_at_once(self, name: str, flags: int) -> int:
        return os.open(name, flags | (0 if self._durable else os.O_NONBLOCK))

    def _hold(self, record: EventRecord) -> None:
        whose = _whose(record)
        self._kept.append(record)
        self._shares[whose] += 1
        if len(self._kept) <= self._limit:
            return
        if self._shares[whose] <= self._limit // 2:
            whose = _whose(self._kept[0])
        del self._kept[next(i for i, each in enumerate(self._kept) if _whose(each) == whose)]
        self._shares[whose] -= 1
        if not self._shares[whose]:
            del self._shares[whose]

    def _append(self, record: EventRecord) -> None:
        if self._closed:
            return
        line = _line(record)
        try:
            if self._fd < 0:
                flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
                self._fd = os.open(self._path, flags, 0o600)
                os.fchmod(self._fd, 0o600)
            written = os.write(self._fd, line)
        except OSError as error:
            self._complain(error)
            return
        self._lines += 1
        if written != len(line):
            self._compact()

    def _compact(self) -> None:
        """Replaces the file by the stored events, atomically."""
        if self._closed:
            return
        aside = self._path.with_name(f"{self._path.name}.new")
        try:
            with contextlib.suppress(FileNotFoundError):
                aside.unlink()
            fd = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(fd, "wb") as file:
                file.writelines(map(_line, self._kept))
                if self._durable:
                    file.flush()
                    os.fdatasync(fd)
            aside.replace(self._path)
        except OSError as error:
            self._complain(error)
            return
        self._lines = len(self._kept)
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        if self._failed_s is not None:
            self._failed_s = None
            log.info("%s is written again", self._path)

    def _complain(self, error: OSError) -> None:
        if self._failed_s is None:
            log.error("%s cannot be used (%s): events are kept in memory only", self._path, error.strerror)
        self._failed_s = time.monotonic()


def _whose(record: EventRecord) -> str:
    """Nodes are called CONTAINER/NODE, and may be others every second."""
    return record.container.partition("/")[0]


def _line(record: EventRecord) -> bytes:
    return json.dumps(record.to_json(), separators=(",", ":")).encode() + b"\n"
