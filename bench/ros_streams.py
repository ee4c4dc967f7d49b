# SPDX-License-Identifier: Apache-2.0
"""Where a ROS connection stands: at the beginning of a message, or in the middle of one.

Every scan of the recorded drive has the same number of points, so on the
connection of /points_raw all messages are equally long, and the number of bytes
that the subscriber has taken from it tells.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
import termios
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress

POINTS, POINT_STEP = 60_000, 32
FIELDS = ("x", "y", "z", "intensity")
# As roscpp serializes sensor_msgs/PointCloud2: header, height and width, fields,
# is_bigendian, point_step and row_step, data, is_dense; and the length in front.
SCAN_BYTES = (
    4
    + (4 + 8 + 4 + len("lidar"))
    + 8
    + (4 + sum(4 + len(name) + 4 + 1 + 4 for name in FIELDS))
    + 1
    + 8
    + (4 + POINTS * POINT_STEP)
    + 1
)

_SYS_PIDFD_GETFD = 438
_TCP_ESTABLISHED = 1
_libc = ctypes.CDLL(None, use_errno=True)


def borrow(pidfd: int, fd: int) -> int:
    """A duplicate of another process' descriptor.  Raises OSError."""
    ours: int = _libc.syscall(_SYS_PIDFD_GETFD, pidfd, fd, 0)
    if ours < 0:
        raise OSError(ctypes.get_errno(), "pidfd_getfd")
    return ours


class Stream:
    """A duplicate of another process' TCP connection.  Close it soon: while it is there, so is the connection."""

    def __init__(self, fd: int) -> None:
        self._socket = socket.socket(fileno=fd)

    def close(self) -> None:
        self._socket.close()

    @property
    def established(self) -> bool:
        return self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] == _TCP_ESTABLISHED

    @property
    def received(self) -> int:
        """Bytes that have come in."""
        # tcpi_bytes_received, linux/tcp.h
        info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 136)
        received: int = struct.unpack_from("Q", info, 128)[0]
        return received

    @property
    def taken(self) -> int:
        """Bytes that the application has read."""
        while True:
            before = self.received
            unread = struct.unpack("i", fcntl.ioctl(self._socket, termios.FIONREAD, b"\0" * 4))[0]
            if self.received == before:
                return before - int(unread)


def _tcp_sockets(pid: int) -> Iterator[tuple[int, Stream]]:
    pidfd = os.pidfd_open(pid)
    try:
        for name in os.listdir(f"/proc/{pid}/fd"):
            with suppress(OSError):
                if not os.readlink(f"/proc/{pid}/fd/{name}").startswith("socket:"):
                    continue
                fd = borrow(pidfd, int(name))
                stream = Stream(fd)
                try:
                    if stream.established:
                        yield int(name), stream
                finally:
                    stream.close()
    finally:
        os.close(pidfd)


def scan_fd(pid: int) -> int | None:
    """The descriptor on which a process receives the scans: that with the most bytes, one scan at least.

    None if there is none.  Raises OSError when the process is gone.
    """
    best: tuple[int, int] | None = None
    for fd, stream in _tcp_sockets(pid):
        received = stream.received
        if received > SCAN_BYTES and (best is None or received > best[0]):
            best = received, fd
    return best[1] if best else None


@contextmanager
def scan_stream(pid: int) -> Iterator[Stream]:
    """The connection on which a process receives the scans.  Raises LookupError, OSError."""
    fd = scan_fd(pid)
    if fd is None:
        raise LookupError(f"process {pid} receives no scans")
    pidfd = os.pidfd_open(pid)
    try:
        stream = Stream(borrow(pidfd, fd))
    finally:
        os.close(pidfd)
    try:
        yield stream
    finally:
        stream.close()


class Ruler:
    """Tells positions within messages.  Needs to see a connection at rest first, for the handshake's length."""

    def __init__(self) -> None:
        self._seen: Counter[int] = Counter()

    def see(self, taken: int) -> None:
        """A position that is most likely the end of a message."""
        self._seen[taken % SCAN_BYTES] += 1

    def inside(self, taken: int) -> int:
        """Bytes taken of the message at this position; 0: it stands between two."""
        (start, _) = self._seen.most_common(1)[0]
        return (taken - start) % SCAN_BYTES
