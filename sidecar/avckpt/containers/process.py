# SPDX-License-Identifier: Apache-2.0
"""Naming a process so that PID reuse cannot confuse it: a pidfd, or a PID with its start time."""

from __future__ import annotations

import os
import select
import time
from pathlib import Path

from avckpt.errors import TargetGone

COMMAND_BYTES = 4096
"""A process can set the place and length of its arguments itself (PR_SET_MM): gigabytes, if it likes."""


def stat_fields(pid: int) -> list[str]:
    """Those of /proc/PID/stat, proc(5), from the third on: state, parent, ...

    Raises OSError, also when there is no such process.
    """
    text = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    # Field 2 is the name in parentheses and may hold anything, parentheses too.
    return text.rpartition(")")[2].split()


def start_time(pid: int) -> int:
    """When `pid` started, in clock ticks since boot: field 22 of /proc/PID/stat, proc(5).

    Raises TargetGone when there is no such process.
    """
    try:
        return int(stat_fields(pid)[22 - 3])
    except (FileNotFoundError, ProcessLookupError) as error:
        raise TargetGone("no such process", pid=pid) from error


def age_s(pid: int) -> float:
    """Seconds since `pid` started, including suspend.

    By the kernel's clock: the time of day of a vehicle jumps by decades when it
    is first set. Raises TargetGone when there is no such process.
    """
    started = start_time(pid) / os.sysconf("SC_CLK_TCK")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - started


def status(pid: int) -> dict[str, str]:
    """The fields of /proc/PID/status, proc(5).  Raises OSError, also when there is no such process."""
    text = Path(f"/proc/{pid}/status").read_text(errors="replace")  # its name may be any bytes
    lines = (line.partition(":") for line in text.split("\n"))
    return {name: value.strip() for name, colon, value in lines if colon}


def command_line(pid: int) -> list[str]:
    """The arguments of a process, the first COMMAND_BYTES of them.  Raises OSError, also when there is no such process.

    Not for the daemon's own thread: they are read from its memory, which may take any time.
    """
    with Path(f"/proc/{pid}/cmdline").open("rb") as file:
        return [os.fsdecode(word) for word in file.read(COMMAND_BYTES).split(b"\0")]


def open_pidfd(pid: int, started: int) -> int:
    """A pidfd of the process that has this PID *and* this start time; the caller closes it.

    Raises TargetGone when that process has exited, even if its PID is in use again.
    """
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError as error:
        raise TargetGone("no such process", syscall="pidfd_open", errno=error.errno or 0, pid=pid) from error
    # Checked only now: the pidfd refers to one process for good, so if the start time is right after it was
    # opened, it is the right one. In the other order the PID could be reused in between.
    try:
        found = start_time(pid)
        if found != started or has_ended(pidfd):
            raise TargetGone("its PID belongs to another process now", pid=pid)
    except BaseException:
        os.close(pidfd)
        raise
    return pidfd


def open_app(pid: int, init: int, init_pidfd: int) -> int:
    """A pidfd of the application `pid` below that avckpt-init; the caller closes it.  Raises TargetGone."""
    if pid == init:  # there is no avckpt-init
        return os.dup(init_pidfd)
    try:
        pidfd = os.pidfd_open(pid)
    except OSError as error:
        raise TargetGone("its application does not run", pid=pid) from error
    # Checked only now: the pidfd refers to one process for good. A reused PID is not init's child, or is one
    # of our templates.
    try:
        fields = status(pid)
        is_ours = int(fields["PPid"]) == init and not fields["Name"].startswith("avckpt-")
    except OSError:
        is_ours = False
    if not is_ours or has_ended(pidfd):
        os.close(pidfd)
        raise TargetGone("its application does not run", pid=pid)
    return pidfd


def has_ended(pidfd: int) -> bool:
    """Whether the process of a pidfd has ended (a zombie has)."""
    poller = select.poll()
    poller.register(pidfd, select.POLLIN)
    return bool(poller.poll(0))


def is_pidfd(fd: int) -> bool:
    """Whether a descriptor is a pidfd.  Asks nothing of the file itself."""
    return os.readlink(f"/proc/thread-self/fd/{fd}") == "anon_inode:[pidfd]"


def is_foreign(pidfd: int) -> bool:
    """Whether the process is in a PID namespace that is neither ours nor below ours."""
    return _fdinfo_pid(pidfd) == 0


def pid_of(pidfd: int) -> int:
    """The PID behind a pidfd, in our own PID namespace; 0 when it is not visible here or has ended.

    For messages, and for telling whether two *live* pidfds are the same process.
    """
    return max(_fdinfo_pid(pidfd), 0)


def _fdinfo_pid(pidfd: int) -> int:
    """0: it has no PID in our namespace; -1: it has exited and was reaped (pidfd_show_fdinfo() in the
    kernel)."""
    for line in Path(f"/proc/self/fdinfo/{pidfd}").read_text().splitlines():
        if line.startswith("Pid:"):
            return int(line.split()[1])
    return -1
