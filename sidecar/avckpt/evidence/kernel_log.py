# SPDX-License-Identifier: Apache-2.0
"""The kernel's log of a crash: the address of a fault, which has no other source.

x86 writes a line for each unhandled fault (arch/x86/mm/fault.c, kernel/traps.c), ten in five seconds
at most, unless `debug.exception-trace` is 0.
"""

from __future__ import annotations

import os
import re
from collections import OrderedDict
from dataclasses import dataclass

FAULTS_MAX = 256
LINES_MAX = 5000
"""Read at once; of a log that grows faster than that the rest is skipped."""

# 15 bytes at most, of which the kernel escapes some.  As many as fit: a name may look like a shorter one with a number.
_NAME = r"((?:[^\\]|\\x[0-9a-f]{2}){0,15})"
_FAULT = re.compile(_NAME + r"\[(\d{1,10})\]: segfault at ([0-9a-f]{1,16}) ip ")
_TRAP = re.compile("traps: " + _NAME + r"\[(\d{1,10})\] ")


@dataclass(frozen=True)
class Fault:
    """A thread that raised one."""

    thread: str
    address: int | None
    """None: the CPU does not say."""


class KernelLog:
    """The faults since it was opened, by thread.  For one thread.  Raises OSError when there is no log to read."""

    def __init__(self) -> None:
        self._faults: OrderedDict[int, Fault] = OrderedDict()
        self._fd = os.open("/dev/kmsg", os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        os.lseek(self._fd, 0, os.SEEK_END)

    def of(self, tid: int) -> Fault | None:
        """What was logged of a thread that has died, in the machine's first PID namespace."""
        self._take()
        return self._faults.pop(tid, None)

    def close(self) -> None:
        """Reads no more."""
        os.close(self._fd)

    def _take(self) -> None:
        for _ in range(LINES_MAX):
            try:
                line = os.read(self._fd, 8192)
            except BlockingIOError:
                return
            except BrokenPipeError:  # lines were overwritten before we came
                continue
            except OSError:
                return
            found = fault_of(line)
            if found is not None:
                tid, fault = found
                self._faults[tid] = fault
                while len(self._faults) > FAULTS_MAX:
                    self._faults.popitem(last=False)
        os.lseek(self._fd, 0, os.SEEK_END)


def fault_of(line: bytes) -> tuple[int, Fault] | None:
    """The thread and its fault, of a record of /dev/kmsg; None: it is of something else."""
    head, _, text = line.decode("utf-8", "replace").partition(";")
    level = head.partition(",")[0]
    if not level.isdecimal() or int(level) >= 8:
        return None  # not the kernel: somebody has written it there
    found = _FAULT.match(text)
    if found is not None:
        return int(found[2]), Fault(_name(found[1]), int(found[3], 16))
    found = _TRAP.match(text)
    return None if found is None else (int(found[2]), Fault(_name(found[1]), None))


def _name(escaped: str) -> str:
    plain = re.sub(r"\\x([0-9a-f]{2})", lambda each: chr(int(each[1], 16)), escaped)
    return plain.encode("latin-1", "replace").decode("utf-8", "replace")
