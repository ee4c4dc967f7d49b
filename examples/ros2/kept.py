# SPDX-License-Identifier: Apache-2.0
"""A count that a restore does not take back; kept.h has the same in C, and says why."""

from __future__ import annotations

import mmap
import os
import struct


class Kept:
    """How many messages this process has sent, also those that it does not remember."""

    def __init__(self) -> None:
        fd = os.memfd_create("avckpt-kept")
        os.ftruncate(fd, mmap.PAGESIZE)
        self._page = mmap.mmap(fd, mmap.PAGESIZE)  # by its name: a restore leaves it alone
        os.close(fd)
        self._remembered = 0

    def forgotten(self) -> int:
        """How many were sent that this process does not remember; 0: there was no restore."""
        return max(0, self._sent() - self._remembered)

    def count(self) -> None:
        """Before a message is given to the middleware: one filler too many is harmless, one too few is not."""
        self._remembered += 1
        if self._sent() < self._remembered:
            struct.pack_into("Q", self._page, 0, self._remembered)

    def _sent(self) -> int:
        sent: int = struct.unpack_from("Q", self._page)[0]
        return sent
