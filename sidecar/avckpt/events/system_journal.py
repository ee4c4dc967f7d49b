# SPDX-License-Identifier: Apache-2.0
"""systemd's journal: what happened to a container is told under the unit that started it.

`journalctl -u web.service` shows it between the lines that the application has written.
"""

from __future__ import annotations

import contextlib
import logging
import socket
from pathlib import Path

SOCKET = Path("/run/systemd/journal/socket")
"""systemd-journald(8); the sidecar's container mounts the folder."""
PRIORITIES = {logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6}
"""syslog(3)'s, for the levels of `avckpt.events.journal`."""


class SystemJournal:
    """Writes to it without ever waiting: a line that it has no room for is lost, and is in the sidecar's own log."""

    def __init__(self, path: Path = SOCKET) -> None:
        self._path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)

    def tell(self, pid: int, container: str, level: int, text: str) -> None:
        """A line about the container in which `pid` runs; nothing where there is no journal.

        The unit is found by journald: of OBJECT_PID, which only root may name, it adds the unit
        (systemd.journal-fields(7)).
        """
        fields = {
            "MESSAGE": f"{container}: {text}",
            "PRIORITY": str(PRIORITIES.get(level, 6)),
            "SYSLOG_IDENTIFIER": "avckpt",
            "CONTAINER_NAME": container,
            "OBJECT_PID": str(pid),
        }
        with contextlib.suppress(OSError):
            self._socket.sendto(b"".join(_encoded(*item) for item in fields.items()), self._path)

    def close(self) -> None:
        self._socket.close()


def _encoded(name: str, value: str) -> bytes:
    """With its length, as the journal's native protocol has it: a value may contain anything, newlines as well."""
    data = value.encode(errors="surrogateescape")
    return name.encode() + b"\n" + len(data).to_bytes(8, "little") + data + b"\n"
