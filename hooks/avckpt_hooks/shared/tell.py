# SPDX-License-Identifier: Apache-2.0
"""How a hook reports something to the user who started a container.

Podman discards the standard error of a precreate hook, and crun that of every
stage. Users see the standard error of Podman and crun: `podman run`'s
terminal for a hook that Podman runs, the container's log (`podman logs`) for
one that the OCI runtime runs, as conmon gives the runtime the container's.
"""

from __future__ import annotations

import os
import stat

WAIT_MS = 200
"""Whoever reads does so within this time."""
_LINE_MAX = 2000  # well below PIPE_BUF: a line is written whole or not at all
_DAEMON_WARNING = 3 << 3 | 4  # LOG_DAEMON | LOG_WARNING, see syslog(3)
_SYS_PIDFD_GETFD = 438  # the same on every architecture


def parent(line: str, pid: int | None = None) -> bool:
    """Writes one line, made printable, to the standard error of the parent (or `pid`).

    True if a user can read it there. Never raises, never waits longer than WAIT_MS
    for a reader.
    """
    try:
        fd = _stderr_of(os.getppid() if pid is None else pid)
    except OSError:
        return False
    try:
        return _write(fd, line)
    except OSError:
        return False
    finally:
        os.close(fd)


def journal(line: str) -> None:
    """Hands one line, made printable, to syslog (and so to journald).  Never raises, never waits."""
    import socket
    import time

    # Not syslog(3): while journald hangs and its queue is full, that blocks, and the container waits for us.
    packet = f"<{_DAEMON_WARNING}>{time.strftime('%b %e %T')} avckpt[{os.getpid()}]: {printable(line)[:_LINE_MAX]}"
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as log:
            log.sendto(packet.encode(errors="replace"), "/dev/log")
    except OSError:
        pass  # no listener, or a busy one


def printable(line: str) -> str:
    r"""One line with the same visible characters; all others become escapes (`\n`, `\x1b`, `\u202e`).

    Images and applications influence names, labels and output: they must not be able to forge lines
    in root's log, or to control root's terminal.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


def has_room(fd: int, wait_ms: int) -> bool:
    """Whether a write(2) of PIPE_BUF bytes would not wait, or fail at once; waits that long for a reader."""
    import select

    poll = select.poll()
    poll.register(fd, select.POLLOUT)
    return bool(poll.poll(wait_ms))


def _stderr_of(pid: int) -> int:
    """A descriptor for `pid`'s standard error.  Raises OSError."""
    # The descriptor itself, by pidfd_getfd(2), instead of reopening the file: with `2>file` a second open
    # file description has its own offset, so that the writers overwrite each other; a socket cannot be opened
    # at all.
    try:
        return _borrow(pid, 2)
    except OSError:
        flags = os.O_WRONLY | os.O_APPEND | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC
        return os.open(f"/proc/{pid}/fd/2", flags)


def _borrow(pid: int, number: int) -> int:
    import ctypes

    pidfd = os.pidfd_open(pid)
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        fd: int = libc.syscall(_SYS_PIDFD_GETFD, pidfd, number, 0)
        if fd < 0:
            raise OSError(ctypes.get_errno(), "pidfd_getfd")
        return fd
    finally:
        os.close(pidfd)


def _write(fd: int, line: str) -> bool:
    status = os.fstat(fd)
    if stat.S_ISCHR(status.st_mode) and status.st_rdev == os.makedev(1, 3):  # /dev/null
        return False
    # A raw terminal (as set by podman run -t) does not return to column 1 by itself.
    end = "\r\n" if os.isatty(fd) else "\n"
    if not has_room(fd, WAIT_MS):
        return False
    packet = (printable(line)[:_LINE_MAX] + end).encode(errors="replace")
    return os.write(fd, packet) == len(packet)
