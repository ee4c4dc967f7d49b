# SPDX-License-Identifier: Apache-2.0
"""Closing what strangers have sent us, or may have: the last close(2) of a file can take any time.

A TCP socket waits for its peer (SO_LINGER), a file of FUSE for its server. A descriptor in a packet
that nobody reads is closed with the connection that it came by.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading

CLONE_FILES = 0x400
"""linux/sched.h"""

_libc = ctypes.CDLL(None, use_errno=True)


def let_go(*fds: int) -> None:
    """Closes descriptors without waiting for anybody; they were the caller's.

    A thread with a table of its own has the last ones, and ends: whoever ends does not linger, and whatever
    else it may have to wait for, nothing else waits for it.
    """
    if not fds:
        return
    copied, closed = threading.Event(), threading.Event()
    with contextlib.suppress(RuntimeError):  # no thread can be started
        threading.Thread(target=_end_with, args=(fds, copied, closed), name="avckpt-close", daemon=True).start()
        copied.wait()
    for fd in fds:
        os.close(fd)
    closed.set()


def _end_with(fds: tuple[int, ...], copied: threading.Event, closed: threading.Event) -> None:
    has_table = _libc.unshare(CLONE_FILES) == 0
    copied.set()
    if not has_table:
        return
    # What it waits for must not keep our other files open.
    first = 0
    for fd in sorted(fds):
        os.closerange(first, fd)
        first = fd + 1
    os.closerange(first, os.sysconf("SC_OPEN_MAX"))
    closed.wait()
