# SPDX-License-Identifier: Apache-2.0
"""Control groups of a container as files: where they are, memory and limit, frozen or not.

Version 1, 2 and hybrids of both. Paths are the host's: the sidecar's own view may be a
namespace with a part of the tree only, so process 1's mounts are read first (the sidecar
runs with the host's PID namespace).
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from avckpt_hooks.shared.files import read_bounded

log = logging.getLogger("avckpt")

CLONE_NEWCGROUP = 0x02000000
OWN_MOUNTS = Path("/run/avckpt-cgroup")
"""In the sidecar's own file system."""
UNLIMITED_BYTES = 1 << 62
"""Version 1 writes "no limit" as a number near 2**63."""
FILE_BYTES = 1 << 16
OUTSIDE = 0.05
"""Less must be left outside by this part of the limit.  A pod has hardly more memory than its only container."""


def see_whole_tree() -> None:
    """Makes every container's groups visible to this process.  Best effort; call it before there are threads.

    In a cgroup namespace of our own /proc/PID/cgroup would read as `/../../...`, and of version 1 even a
    privileged container has only its own part of each hierarchy mounted: missing ones are mounted again.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with contextlib.suppress(OSError):
        fd = os.open("/proc/1/ns/cgroup", os.O_RDONLY | os.O_CLOEXEC)
        try:
            if libc.setns(fd, CLONE_NEWCGROUP) != 0:
                log.debug("the host's cgroup namespace cannot be entered: %s", os.strerror(ctypes.get_errno()))
        finally:
            os.close(fd)
    whole = {mount.controllers for mount in _mounts("self") if mount.root == "/"}
    for line in _lines(Path("/proc/self/cgroup")):
        _, names, _ = line.split(":", 2)
        controllers = frozenset(names.split(",")) - {""}
        if controllers in whole or os.path.isdir("/proc/1/root/sys/fs/cgroup"):
            continue
        where = OWN_MOUNTS / (names.replace("=", "-") or "unified")
        options = names if not names.startswith("name=") else f"none,{names}"
        kind = b"cgroup" if controllers else b"cgroup2"
        try:
            where.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            log.debug("%s cannot be made: %s", where, error)
            return
        if libc.mount(b"avckpt", bytes(where), kind, 0, options.encode() if controllers else None) != 0:
            log.debug("cgroup %s cannot be mounted: %s", names, os.strerror(ctypes.get_errno()))


@dataclass(frozen=True)
class Mount:
    """One mounted hierarchy."""

    version: int
    controllers: frozenset[str]
    """Of version 1, `name=...` included; empty for version 2."""
    root: str
    """Which part of the hierarchy is mounted."""
    where: Path


@dataclass(frozen=True)
class Groups:
    """The control groups of one process."""

    directories: tuple[Path, ...]
    """One per hierarchy."""
    memory: Path | None
    """Where its memory is counted; None: nowhere that we can see."""
    freezers: tuple[Path, ...]
    """Of both versions, where there are both."""
    memory_version: int = 2
    pids: Path | None = None
    """Where its tasks are counted."""

    @property
    def procs(self) -> list[Path]:
        """Files to write a PID to, so that it belongs to the same groups."""
        return [directory / "cgroup.procs" for directory in self.directories]

    def memory_limit_bytes(self) -> int | None:
        """The hard limit; None: there is none (or the group is gone)."""
        return None if self.memory is None else _limit_bytes(self.memory, self.memory_version)

    def memory_and_swap_bytes(self) -> int | None:
        """The limit at which the OOM killer acts: the hard limit, plus allowed swap; None: no limit."""
        limit = self.memory_limit_bytes()
        if limit is None or self.memory is None:
            return None
        text = _read(self.memory / ("memory.swap.max" if self.memory_version == 2 else "memory.memsw.limit_in_bytes"))
        swap = int(text) if text.isdecimal() else (UNLIMITED_BYTES if text else 0)
        if self.memory_version == 1:  # both together
            swap = max(swap - limit, 0)
        return limit + min(swap, _host_swap_bytes())

    def memory_used_bytes(self) -> int | None:
        """What counts against the limit and cannot simply be reclaimed: usage less clean file pages."""
        return None if self.memory is None else _used_bytes(self.memory, self.memory_version)

    def first_to_run_out_bytes(self, used: int | None) -> int | None:
        """`memory_and_swap_bytes()`; None, too, if a group above, or the host, has less room left than this one.

        The OOM killer acts where memory runs out first, and counts in thousandths of the memory *there*.
        `used` is what memory_used_bytes() says.
        """
        limit = None if used is None else self.memory_and_swap_bytes()
        if limit is None or used is None:
            return None
        return None if self._room_outside_bytes() < limit - used - OUTSIDE * limit else limit

    def _room_outside_bytes(self) -> int:
        """The smallest amount left in a group above, or on the host."""
        fields = _host_memory()
        room = [fields["MemAvailable"] + fields["SwapFree"]]
        for folder in _upwards(self.memory.parent) if self.memory else ():
            limit, used = _limit_bytes(folder, self.memory_version), _used_bytes(folder, self.memory_version)
            if limit is not None and used is not None:
                room.append(limit - used)
        return min(room)

    def tasks_max(self) -> int | None:
        """How many there may be, in this group and in those above; None: any number."""
        texts = [_read(folder / "pids.max") for folder in _upwards(self.pids)] if self.pids else []
        return min((int(text) for text in texts if text.isdecimal()), default=None)

    def is_frozen(self) -> bool:
        """Whether it is paused (podman pause)."""
        return any(
            _read(freezer / "freezer.state") in ("FROZEN", "FREEZING")
            or "frozen 1" in _read(freezer / "cgroup.events").splitlines()
            for freezer in self.freezers
        )


def _upwards(group: Path) -> Iterator[Path]:
    """This one, and those above it that can be seen."""
    for folder in (group, *group.parents):
        if not (folder / "cgroup.procs").exists():
            return
        yield folder


def groups_of(pid: int) -> Groups:
    """The groups of `pid` that can be seen.  Raises OSError when the process is gone."""
    directories: list[Path] = []
    memory = pids = unified = None
    freezers: list[Path] = []
    version = 2
    # Read once: a busy host has hundreds of mounts, and version 1 a dozen groups for each process.
    mounts = [(prefix, mount) for owner, prefix in (("1", "/proc/1/root"), ("self", "")) for mount in _mounts(owner)]
    for line in _lines(Path(f"/proc/{pid}/cgroup")):
        _, names, path = line.split(":", 2)
        controllers = frozenset(names.split(",")) - {""}
        directory = _directory(mounts, controllers, path)
        if directory is None:
            continue
        directories.append(directory)
        if not controllers:
            unified = directory
            freezers.append(directory)
        if "memory" in controllers:
            memory, version = directory, 1
        if "pids" in controllers:
            pids = directory
        if "freezer" in controllers:
            freezers.append(directory)
    if memory is None and unified is not None and (unified / "memory.max").exists():
        memory = unified
    return Groups(tuple(directories), memory, tuple(freezers), version, pids or unified)


def is_paused(pid: int) -> bool:
    """Whether the container of `pid` is (podman pause); False when the process is gone."""
    try:
        return groups_of(pid).is_frozen()
    except OSError:
        return False


def _directory(mounts: list[tuple[str, Mount]], controllers: frozenset[str], path: str) -> Path | None:
    for prefix, mount in mounts:
        if mount.controllers != controllers or (mount.version == 2) != (not controllers):
            continue
        inner = os.path.relpath(path, mount.root)
        if inner.startswith(".."):
            continue
        directory = Path(f"{prefix}{mount.where}") / inner
        if os.path.isdir(directory):  # pathlib raises without permission
            return directory
    return None


def _mounts(owner: str) -> list[Mount]:
    try:
        lines = _lines(Path(f"/proc/{owner}/mountinfo"))
    except OSError:
        return []
    mounts = []
    for line in lines:
        # proc(5): id parent dev root where options... - type source super-options
        before, _, after = line.partition(" - ")
        words, (kind, _, options) = before.split(" "), after.split(" ", 2)
        if kind == "cgroup2":
            mounts.append(Mount(2, frozenset(), words[3], Path(words[4])))
        elif kind == "cgroup":
            named = frozenset(options.split(",")) - {"rw", "ro", "xattr", "noprefix", "clone_children"}
            mounts.append(
                Mount(1, frozenset(o for o in named if not o.startswith("release_agent")), words[3], Path(words[4]))
            )
    return mounts


def _host_swap_bytes() -> int:
    return _host_memory()["SwapTotal"]


def _host_memory() -> dict[str, int]:
    fields = (line.split(":", 1) for line in _lines(Path("/proc/meminfo")))
    return {name: int(value.split()[0]) * 1024 for name, value in fields}


def _limit_bytes(folder: Path, version: int) -> int | None:
    text = _read(folder / ("memory.max" if version == 2 else "memory.limit_in_bytes"))
    limit = int(text) if text.isdecimal() else UNLIMITED_BYTES
    return limit if limit < UNLIMITED_BYTES else None


def _used_bytes(folder: Path, version: int) -> int | None:
    text = _read(folder / ("memory.current" if version == 2 else "memory.usage_in_bytes"))
    if not text.isdecimal():
        return None
    prefix = "" if version == 2 else "total_"
    stat = fields_of(folder / "memory.stat")
    cache = sum(int(stat.get(prefix + key, 0)) for key in ("inactive_file", "active_file"))
    return max(int(text) - cache, 0)


def fields_of(path: Path) -> dict[str, str]:
    """Of a file with a name and a value in each line; empty when it cannot be read."""
    return dict(line.split(" ", 1) for line in _read(path).splitlines() if " " in line)


def _lines(path: Path) -> list[str]:
    """A file of /proc that contains names: any bytes, with only blanks, newlines and backslashes escaped.

    Raises OSError.
    """
    return os.fsdecode(path.read_bytes()).split("\n")[:-1]


def _read(path: Path) -> str:
    try:
        return read_bounded(str(path), FILE_BYTES).decode().strip()
    except (OSError, ValueError):
        return ""
