# SPDX-License-Identifier: Apache-2.0
"""Reading what strangers send, and closing it: the close(2) of a file can take any time.

That of a TCP socket waits for its peer (SO_LINGER) if it is the last one, that of a file of FUSE for its server
always. A descriptor in a packet that nobody reads is closed with the connection that it came by. So all that is
done by threads that have tables of descriptors of their own, and end: whoever ends does not linger, and whatever
else such a thread may have to wait for, nothing else waits for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import struct
import threading
from collections.abc import Callable

from avckpt_hooks.shared.protocol import received_fds

from avckpt.containers.process import is_pidfd

CLONE_FILES = 0x400
"""linux/sched.h"""
WAITING_MOST = 32
"""Threads that wait for somebody: then `is_busy()`."""
SCM_MAX_FD = 253
"""Descriptors in one packet, include/net/scm.h: what there is no room for, the kernel closes at once."""

_libc = ctypes.CDLL(None, use_errno=True)
_threads: set[int] = set()
"""By number; some of them have ended."""


def is_busy() -> bool:
    """Whether so many things of strangers are waited for that nothing more is to be taken from anybody for now."""
    for tid in list(_threads):
        if not os.path.exists(f"/proc/self/task/{tid}"):
            _threads.discard(tid)
    return len(_threads) >= WAITING_MOST


def let_go(*fds: int) -> None:
    """Closes connections of strangers without waiting for anybody; they were the caller's."""
    closed = threading.Event()
    with contextlib.suppress(RuntimeError):  # no thread can be started
        _apart(fds, closed.wait)
    for fd in fds:
        os.close(fd)
    closed.set()


def receive(connection: socket.socket, most_bytes: int) -> socket.socket:
    """Has a packet read that has come; the result can be read from the socket returned, with `received()`.

    Raises OSError, or RuntimeError when no thread can be started.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    result = theirs.detach()
    try:
        _apart((connection.fileno(), result), lambda: _read(connection, result, most_bytes))
    except BaseException:
        ours.close()
        raise
    finally:
        os.close(result)
    ours.setblocking(False)
    return ours


def received(result: socket.socket, most_bytes: int) -> tuple[bytes, int, list[int]] | None:
    """A packet (too long: one byte more than allowed), how many descriptors came with it, and the one of them that the
    caller must close: a pidfd, if it was the only one.  None: it could not be read."""
    packet, ancillary, _, _ = result.recvmsg(most_bytes + 2, socket.CMSG_SPACE(4), socket.MSG_CMSG_CLOEXEC)
    return (packet[1:], packet[0], received_fds(ancillary)) if packet else None


def _read(connection: socket.socket, result: int, most_bytes: int) -> None:
    with contextlib.suppress(OSError):
        room = socket.CMSG_SPACE(SCM_MAX_FD * struct.calcsize("i"))
        packet, ancillary, _, _ = connection.recvmsg(most_bytes + 1, room, socket.MSG_CMSG_CLOEXEC)
        fds = received_fds(ancillary)
        rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", *fds))] if _is_one_pidfd(fds) else []
        to = socket.socket(fileno=result)
        try:
            to.sendmsg([bytes([len(fds)]) + packet], rights)
        finally:
            to.detach()  # its number is another file's where it would be closed later


def _is_one_pidfd(fds: list[int]) -> bool:
    return len(fds) == 1 and is_pidfd(fds[0])


def _apart(keep: tuple[int, ...], work: Callable[[], object]) -> None:
    """Does it in a thread with a table of its own, in which are only these; returns when it has that.

    Raises RuntimeError when no thread can be started.
    """
    copied = threading.Event()

    def run() -> None:
        _threads.add(threading.get_native_id())
        has_table = _libc.unshare(CLONE_FILES) == 0
        copied.set()
        if not has_table:
            return
        # What it waits for must not keep our other files open.
        first = 0
        for fd in sorted(keep):
            os.closerange(first, fd)
            first = fd + 1
        os.closerange(first, os.sysconf("SC_OPEN_MAX"))
        work()

    threading.Thread(target=run, name="avckpt-stranger", daemon=True).start()
    copied.wait()
