# SPDX-License-Identifier: Apache-2.0
"""Our own messages, which nobody has to read: a journal may hang, a terminal be stopped, a pipe be full."""

from __future__ import annotations

import os
import select

from avckpt_hooks.shared.tell import WAIT_MS, has_room


class Messages:
    """A text stream over a descriptor that waits a moment for a reader once, and then for none until one reads.

    What could not be written is left out, and counted in front of the next message.  Raises nothing.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._left_out = 0

    def write(self, text: str) -> None:
        """Whole lines."""
        count = self._left_out
        note = f"avckpt: {count} message(s) left out here: nobody read them\n" if count else ""
        if self._write((note + text).encode(errors="backslashreplace")):
            self._left_out = 0
        else:
            self._left_out += 1

    def _write(self, data: bytes) -> bool:
        try:
            while data:
                if not has_room(self._fd, 0 if self._left_out else WAIT_MS):
                    return False
                # Blocks if another process has filled the pipe since; a descriptor that does not block would
                # be theirs, too.
                data = data[os.write(self._fd, data[: select.PIPE_BUF]) :]
        except OSError:
            return False
        return True
