# SPDX-License-Identifier: Apache-2.0
"""Looks into /proc.  A process that has just ended is an empty answer, no error, where the docstring says so."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
from pathlib import Path

GONE = (FileNotFoundError, ProcessLookupError)
KCMP_VM, KCMP_SYSVSEM = 1, 6


def children_of(pid: int) -> list[int]:
    """The children of a process's main thread, oldest first, zombies included; empty when it is gone."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except GONE:
        return []


def below(pid: int) -> list[int]:
    """Every process below one, nearest first, threads' children and zombies included; empty when it is gone."""
    found, at = [pid], 0
    while at < len(found):
        with contextlib.suppress(*GONE):
            for task in os.listdir(f"/proc/{found[at]}/task"):
                found += map(int, Path(f"/proc/{found[at]}/task/{task}/children").read_text().split())
        at += 1
    return found[1:]


def comm_of(pid: int) -> str:
    """The name of proc(5); "" when there is no such process."""
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except GONE:
        return ""


def state_of(pid: int) -> str:
    """The letter of proc(5): R, S, T, Z ...; X when there is no such process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except GONE:
        return "X"


def started(pid: int) -> int:
    """When a process started, in ticks since boot; 0 when it has ended, a zombie included."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except GONE:
        return 0
    return 0 if fields[0] in "ZX" else int(fields[19])


def numbers_of(pid: int) -> list[int]:
    """A task's numbers in its PID namespaces, ours first, its own last.  Raises OSError when it is gone."""
    status = Path(f"/proc/{pid}/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("NSpid:"))
    return [int(word) for word in line.split()[1:]]


def inside(pid: int) -> int:
    """A task's number in its own PID namespace.  Raises OSError when it is gone."""
    return numbers_of(pid)[-1]


def threads(pid: int) -> dict[int, str]:
    """Threads of a process: inner TID and name.  Raises OSError when it is gone."""
    found = {}
    for tid in os.listdir(f"/proc/{pid}/task"):
        with contextlib.suppress(*GONE):  # it has just ended
            found[inside(int(tid))] = Path(f"/proc/{pid}/task/{tid}/comm").read_text().strip()
    return found


def peak_kb(pid: int) -> int:
    """The peak resident size of a process.  Raises OSError when it is gone."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


def figures(pid: int) -> dict[str, int]:
    """What /proc/PID/status and smaps_rollup give as one number each, kB where it is memory.

    "Pss", say, is what a process has of memory when shared pages are divided.  Raises OSError when it is gone.
    """
    found = {}
    for name in ("status", "smaps_rollup"):
        for line in Path(f"/proc/{pid}/{name}").read_text().splitlines():
            key, _, value = line.partition(":")
            words = value.split()
            if words and words[0].isdigit():
                found[key] = int(words[0])
    return found


def status_of(tid: int) -> dict[str, str]:
    """The lines of /proc/TID/status.  Raises OSError when it is gone."""
    lines = Path(f"/proc/{tid}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def share(what: int, a: int, b: int) -> bool:
    """Whether two processes have the same of that kind; kcmp(2)."""
    number = {"x86_64": 312, "aarch64": 272}[platform.machine()]
    return bool(ctypes.CDLL(None).syscall(number, a, b, what, 0, 0) == 0)
