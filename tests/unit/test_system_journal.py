# SPDX-License-Identifier: Apache-2.0
"""What systemd's journal is sent, and that nothing waits for it."""

from __future__ import annotations

import logging
import socket
from pathlib import Path

from avckpt.events.system_journal import SystemJournal


def field(name: bytes, value: bytes) -> bytes:
    return name + b"\n" + len(value).to_bytes(8, "little") + value + b"\n"


def test_a_line_names_the_process_whose_unit_it_belongs_to(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journald:
        journald.bind(str(tmp_path / "socket"))
        SystemJournal(tmp_path / "socket").tell(4711, "web", logging.WARNING, "restored in 3 ms\nPRIORITY=0")
        said = journald.recv(4096)
    assert field(b"MESSAGE", b"web: restored in 3 ms\nPRIORITY=0") in said
    assert field(b"OBJECT_PID", b"4711") in said
    assert field(b"PRIORITY", b"4") in said
    assert field(b"CONTAINER_NAME", b"web") in said


def test_a_journal_that_is_not_there_or_does_not_read_delays_nothing(tmp_path: Path) -> None:
    SystemJournal(tmp_path / "none").tell(1, "web", logging.INFO, "registered")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journald:
        journald.bind(str(tmp_path / "socket"))
        journal = SystemJournal(tmp_path / "socket")
        for _ in range(5000):  # more than a socket holds (net.unix.max_dgram_qlen)
            journal.tell(1, "web", logging.INFO, "registered")
        assert journald.recv(4096)
