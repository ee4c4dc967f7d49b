# SPDX-License-Identifier: Apache-2.0
"""A container's own log: a line of ours between those of its application (`avckpt.mark`).

avckpt-init keeps the standard error that Podman has given the container, wherever the application
sends its own.  Nothing is written unless that is a pipe to who collects the log, and has room.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import stat

from avckpt.containers.looks import in_own_thread
from avckpt.containers.process import has_ended, pid_of


class ContainerLog:
    """Of one container.  For an event loop, which never waits for it."""

    def __init__(self) -> None:
        self._under_way: asyncio.Future[None] | None = None

    def tell(self, init_pidfd: int, text: str) -> None:
        """Adds a line, or nothing where that could wait or do harm."""
        if self._under_way is not None and not self._under_way.done():
            return  # its init may have given itself a file of a file system that hangs
        try:
            process = os.open(f"/proc/{pid_of(init_pidfd)}", os.O_PATH | os.O_CLOEXEC)
        except OSError:
            return  # it has ended
        if has_ended(init_pidfd):  # then the number may be another one's
            os.close(process)
        else:
            try:
                self._under_way = in_own_thread(lambda: _write(process, text))
            except RuntimeError:  # no thread can be created
                os.close(process)


def _write(process: int, text: str) -> None:
    """Closes `process`, its folder in /proc."""
    with contextlib.ExitStack() as opened:
        opened.callback(os.close, process)
        # It is full, nobody reads it, or the container has ended.
        opened.enter_context(contextlib.suppress(OSError))
        # Whatever takes its place from here on, only this is opened.
        log = os.open("fd/2", os.O_PATH | os.O_CLOEXEC, dir_fd=process)
        opened.callback(os.close, log)
        if stat.S_ISFIFO(os.fstat(log).st_mode):
            # An open file description of our own: that of the application goes on to block.
            fd = os.open(f"/proc/self/fd/{log}", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
            opened.callback(os.close, fd)
            # All of it or nothing, and never inside of a line's write(2).
            os.write(fd, f"avckpt: {text}".encode(errors="replace")[: select.PIPE_BUF - 1] + b"\n")
