# SPDX-License-Identifier: Apache-2.0
"""The sidecar's end of the hooks' socket.

Podman holds a container's lock while its hook waits for our answer, so the
handler must answer at once.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Union

from avckpt_hooks.shared import protocol
from avckpt_hooks.shared.protocol import Deregister, Register

from avckpt.errors import AvckptError, of_any
from avckpt.lock import identity

log = logging.getLogger("avckpt")

Handler = Callable[[Union[Register, Deregister], Union[int, None]], None]
"""Takes a request and its pidfd (the handler's to close).  Raises AvckptError or OSError to refuse."""

MAX_WAITING = 64
"""Connections that have not sent their request yet."""
PAUSE_S = 0.2
"""How long to stop accepting when the kernel is out of resources."""
SHORT_OF = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


def bind_socket(path: Path, kind: socket.SocketKind) -> socket.socket:
    """A listening Unix socket that only root may connect to; replaces what a killed sidecar left behind."""
    path.unlink(missing_ok=True)
    listening = socket.socket(socket.AF_UNIX, kind | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    # The mode must be right before any process can connect: connect(2) is
    # checked against the inode, and fchmod(2) on a socket does not reach it.
    old = os.umask(0o177)
    try:
        listening.bind(str(path))
    except OSError:
        listening.close()
        raise
    finally:
        os.umask(old)
    listening.listen(MAX_WAITING)
    return listening


class HookListener:
    """Accepts hooks, one request and one reply per connection.  Runs in the event loop that is running."""

    def __init__(self, path: Path, handler: Handler) -> None:
        self._path = path
        self._handler = handler
        self._loop = asyncio.get_running_loop()
        self._timers: dict[socket.socket, asyncio.TimerHandle] = {}
        self._pause: asyncio.TimerHandle | None = None
        self._is_short = False
        """The last accept failed, which has been logged."""
        self._listen()

    async def keep(self) -> bool:
        """Makes the socket again if its file was removed or replaced; whether it was.  Raises OSError."""
        if identity(self._path) == self._file:
            return False
        before, paused = self._socket, self._pause
        self._listen()
        if paused is not None:
            paused.cancel()
        self._loop.remove_reader(before)
        before.close()
        return True

    def _listen(self) -> None:
        self._socket = bind_socket(self._path, socket.SOCK_SEQPACKET)
        self._file = identity(self._path)
        self._loop.add_reader(self._socket, self._accept)

    def close(self) -> None:
        """Ends every connection and removes the socket."""
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._socket)
        self._socket.close()
        for connection in list(self._timers):
            self._drop(connection)
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._socket.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:
            if error.errno not in SHORT_OF:
                raise
            self._wait(error)
            return
        self._is_short = False
        connection.setblocking(False)
        if len(self._timers) >= MAX_WAITING:
            connection.close()
            return
        self._timers[connection] = self._loop.call_later(protocol.TIMEOUT_S, self._drop, connection)
        self._loop.add_reader(connection, self._serve, connection)

    def _wait(self, error: OSError) -> None:
        """Pauses accepting. Clients keep waiting, so the socket stays readable."""
        if not self._is_short:
            log.error(
                "hooks cannot be answered (%s): containers that start now run unprotected at first; "
                "give the sidecar more descriptors (podman run --ulimit nofile=N)",
                error.strerror,
            )
        self._is_short = True
        self._loop.remove_reader(self._socket)
        self._pause = self._loop.call_later(PAUSE_S, self._loop.add_reader, self._socket, self._accept)

    def _serve(self, connection: socket.socket) -> None:
        try:
            error = self._answer(connection)
            connection.send(protocol.encode_reply(error))
        except BlockingIOError:
            return  # not readable after all
        except OSError as problem:
            log.debug("a hook went away: %s", problem)
        self._drop(connection)

    def _answer(self, connection: socket.socket) -> str | None:
        try:
            request, pidfd = protocol.receive_request(connection)
        except protocol.ProtocolError as error:
            return _refused(error)
        try:
            self._handler(request, pidfd)
        except (AvckptError, OSError) as error:
            return _refused(of_any(error))
        return None

    def _drop(self, connection: socket.socket) -> None:
        timer = self._timers.pop(connection, None)
        if timer is not None:
            timer.cancel()
            self._loop.remove_reader(connection)
            connection.close()


def _refused(error: Exception) -> str:
    log.warning("refused a hook's request: %s", error)
    return str(error)
