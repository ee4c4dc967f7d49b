# SPDX-License-Identifier: Apache-2.0
"""The lock that says there is a sidecar for a runtime directory."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path

from avckpt.errors import Busy


def identity(path: Path) -> tuple[int, int] | None:
    """Which file there is at a path; None: there is none.  Raises OSError."""
    try:
        status = os.lstat(path)
    except FileNotFoundError:
        return None
    return status.st_dev, status.st_ino


class Lock:
    """Held from `take()` to `release()`.  The file stays, or two sidecars could lock different files."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._path = run_dir / "lock"
        self._fd = -1

    def take(self) -> None:
        """Takes it, also where its file was removed since it was taken.  Raises Busy when another one holds it."""
        fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(fd, 32, 0).decode("ascii", "replace").strip()
            os.close(fd)
            raise Busy(
                f"a sidecar is running already (pid {holder or 'unknown'}, {self._run_dir}): stop it first, "
                "or use that one"
            ) from error
        with contextlib.suppress(OSError):  # a full disk: another one is not told whom it finds
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)
        self.release()
        self._fd = fd

    def is_in_place(self) -> bool:
        """Whether the next sidecar would find the file that is locked.  Raises OSError."""
        status = os.fstat(self._fd)
        return identity(self._path) == (status.st_dev, status.st_ino)

    def release(self) -> None:
        """Unlocks it."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1
