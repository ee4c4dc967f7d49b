# SPDX-License-Identifier: Apache-2.0
"""How hooks log messages: with a /dev/log of the test's own, in a mount namespace of its own."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="a mount namespace of its own needs root")


@pytest.fixture
def log(tmp_path: Path) -> Iterator[socket.socket]:
    """What is to be /dev/log."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "log"))
        yield listener


def journal(line: str, log: str = "") -> None:
    """Calls `tell.journal(line)` where `log` is /dev/log (empty: there is none).  Raises TimeoutExpired."""
    inside = (
        'mount -t tmpfs none /dev; [ -z "$1" ] || { touch /dev/log; mount --bind "$1" /dev/log; }; shift; exec "$@"'
    )
    script = "import sys; from avckpt_hooks.shared import tell; tell.journal(sys.argv[1])"
    command = ["unshare", "--mount", "sh", "-c", inside, "sh", log, sys.executable, "-c", script, line]
    done = subprocess.run(command, timeout=10, check=False, stdin=subprocess.PIPE, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_line_reaches_the_journal(log: socket.socket) -> None:
    journal("avckpt: all is well", log.getsockname())
    log.settimeout(5)
    assert re.fullmatch(rb"<28>\w{3} [ \d]\d \d\d:\d\d:\d\d avckpt\[\d+\]: avckpt: all is well", log.recv(1000))


def test_one_line_is_one_line_in_the_journal(log: socket.socket) -> None:
    journal("avckpt: label \x1b[2J\nfake: line", log.getsockname())
    log.settimeout(5)
    assert log.recv(1000).endswith(rb": avckpt: label \x1b[2J\nfake: line")


def test_a_journal_that_hangs_does_not_hold_a_hook_up(log: socket.socket) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as others, contextlib.suppress(BlockingIOError):
        others.setblocking(False)
        while True:
            others.sendto(b"one more line", log.getsockname())
    journal("avckpt: one too many", log.getsockname())


def test_without_a_journal_nothing_happens() -> None:
    journal("avckpt: nobody hears it")
