# SPDX-License-Identifier: Apache-2.0
"""Files that only root may read: a record holds labels, a health check holds commands, and both may hold secrets."""

from __future__ import annotations

import contextlib
import os
import stat


class TooLong(ValueError):
    """A file is longer than anything that belongs there."""


def make_private(directory: str) -> None:
    """Creates `directory`, or removes the access of others to an existing one.  Raises OSError."""
    os.makedirs(directory, mode=0o700, exist_ok=True)
    if stat.S_IMODE(os.stat(directory).st_mode) != 0o700:
        os.chmod(directory, 0o700)


def write_private(path: str, content: bytes) -> None:
    """Writes a file at once or not at all, in a directory that is made private, too.  Raises OSError."""
    make_private(os.path.dirname(path))
    write_at_once(path, content)


def write_at_once(path: str, content: bytes, mode: int = 0o600) -> None:
    """Writes a file at once or not at all, in a directory that is left as it is.  Raises OSError."""
    temporary = f"{path}.{os.getpid()}"
    with contextlib.suppress(FileNotFoundError):
        os.unlink(temporary)  # of an earlier process with our PID
    # The mode is set from the start: a process that opens the file while it is readable could keep reading
    # it.
    fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
    try:
        with open(fd, "wb") as file:
            file.write(content)
        os.replace(temporary, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


def read_bounded(path: str, most_bytes: int, more_flags: int = 0) -> bytes:
    """The contents of a file of at most `most_bytes`.  Raises TooLong, OSError."""
    with open(path, "rb", buffering=0, opener=lambda name, flags: os.open(name, flags | more_flags)) as file:
        content = bytearray()
        # One byte more than allowed; /proc returns about a page at a time.
        while len(content) <= most_bytes:
            part = file.read(most_bytes + 1 - len(content))
            if not part:
                return bytes(content)
            content += part
    raise TooLong(f"{path} is longer than {most_bytes} bytes")


def read_own(path: str, most_bytes: int) -> bytes:
    """The same of a file in a folder of ours: a fifo in its place holds nobody up, and is read as empty."""
    return read_bounded(path, most_bytes, os.O_NONBLOCK)
