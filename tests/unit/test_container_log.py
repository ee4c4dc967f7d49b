# SPDX-License-Identifier: Apache-2.0
"""A container's log is written to only where that has no other effect (`avckpt.mark`)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from avckpt.events.container_log import _write

# Its standard error is a pipe and a leased file in turns: who opens that for writing breaks the lease, with SIGIO.
HOSTILE = """
import fcntl, os, signal, sys
def broken(*_):
    os.write(1, b"x")
    os._exit(1)
signal.signal(signal.SIGIO, broken)
os.open(sys.argv[1], os.O_CREAT | os.O_RDWR)
file, (_, pipe) = os.open(sys.argv[1], os.O_RDONLY), os.pipe()
os.closerange(0, 1)
for fd in range(3, 64):
    try:
        if os.readlink(f"/proc/self/fd/{fd}") == sys.argv[1] and fd != file: os.close(fd)
    except OSError: pass
fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
os.write(1, b"r")
while True:
    os.dup2(pipe, 2)
    os.dup2(file, 2)
"""
TIMES = 5000


def test_what_takes_the_place_of_a_pipe_is_not_opened(tmp_path: Path) -> None:
    command = [sys.executable, "-S", "-c", HOSTILE, str(tmp_path / "leased")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.read(1) == b"r"
            for _ in range(TIMES):
                _write(os.open(f"/proc/{other.pid}", os.O_PATH | os.O_CLOEXEC), "something")
            assert other.poll() is None
        finally:
            other.kill()


def test_a_pipe_gets_the_line() -> None:
    read, write = os.pipe()
    with subprocess.Popen(["sleep", "30"], stderr=write) as other:
        _write(os.open(f"/proc/{other.pid}", os.O_PATH | os.O_CLOEXEC), "something")
        assert os.read(read, 100) == b"avckpt: something\n"
        other.kill()
    os.close(read)
    os.close(write)
