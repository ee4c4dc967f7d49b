# SPDX-License-Identifier: Apache-2.0
"""The board of a victim (tests/victims/victim.h), read from outside."""

from __future__ import annotations

import mmap
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

MAGIC = 0x31445242544356
LAYOUT = struct.Struct("<9Q64Q")
GAP_OFFSET = 5 * 8
COUNTERS_OFFSET = 9 * 8
VIOLATION_STATUS = 99
UNAVAILABLE_STATUS = 77


@dataclass(frozen=True)
class Seen:
    """struct board: what a victim has shown up to now. Times are CLOCK_MONOTONIC ns."""

    magic: int
    starts: int
    pid: int
    beats: int
    beat_ns: int
    gap_ns: int
    gap_end_ns: int
    violations: int
    ready: int
    counter: tuple[int, ...]


class Board:
    """Maps the file that a victim was given by --board; makes it if need be."""

    def __init__(self, path: Path) -> None:
        self.path = path
        fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            os.fchmod(fd, 0o666)  # the victim may be another user
            os.ftruncate(fd, 4096)
            self.page = mmap.mmap(fd, 4096)
        finally:
            os.close(fd)

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.page.close()

    def see(self) -> Seen:
        fields = LAYOUT.unpack_from(self.page)
        magic, starts, pid, beats, beat_ns, gap_ns, gap_end_ns, violations, ready = fields[:9]
        return Seen(magic, starts, pid, beats, beat_ns, gap_ns, gap_end_ns, violations, ready, fields[9:])

    def forget_gap(self) -> None:
        """From now on gap_ns is the longest gap between beats since now."""
        struct.pack_into("<Q", self.page, GAP_OFFSET, 0)

    def set_counter(self, which: int, value: int) -> None:
        """For a victim that waits for it."""
        struct.pack_into("<Q", self.page, COUNTERS_OFFSET + 8 * which, value)
