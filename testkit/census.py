# SPDX-License-Identifier: Apache-2.0
"""What application, init, templates and sidecar have of everything that can leak, at one moment and over time."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from testkit.procfs import below, figures

Row = dict[str, float]
"""One moment: "at_s", and a figure for each name like "sidecar.fds"."""

MEMORY = ("rss_kb", "anon_kb", "page_tables_kb")
"""Figures that may be a little more: allocators and page tables go in steps."""

ARENA_KB = 256
"""Python takes its memory in arenas of this size or more, each a mapping."""

NOT_JUDGED = ("at_s", "pss_kb", "private_kb")
"""What a page of libc counts for changes with every program on the machine that starts or ends."""


@dataclass
class Census:
    """Counts below one avckpt-init and in the sidecar that guards it; PIDs are ours."""

    init_pid: int
    sidecar_pid: int

    def take(self) -> Row | None:
        """The figures of now; None: the application is not there, for it is being restored."""
        row: Row = {"at_s": round(time.monotonic(), 3)}
        apps, templates, spares, holders, zombies, tasks = [], [], 0, 0, 0, 0
        with contextlib.suppress(OSError):
            for pid in below(self.init_pid):
                name, state = name_and_state(pid)
                tasks += len(os.listdir(f"/proc/{pid}/task"))
                if state in "ZX":
                    zombies += 1
                elif name == "avckpt-tmpl":
                    templates.append(pid)
                elif name == "avckpt-spare":
                    spares += 1
                elif name == "avckpt-hold":
                    holders += 1
                else:
                    apps.append(pid)
            if len(apps) != 1:
                return None
            for role, pid in (("app", apps[0]), ("init", self.init_pid), ("sidecar", self.sidecar_pid)):
                row.update({f"{role}.{name}": value for name, value in of_process(pid).items()})
            row["templates.processes"] = len(templates)
            for name in ("rss_kb", "private_kb", "page_tables_kb", "maps"):
                row[f"templates.{name}"] = sum(of_process(pid)[name] for pid in templates)
            row["spares.processes"] = spares
            row["holders.processes"] = holders
            row["container.zombies"] = zombies
            row["container.pids"] = tasks
            row["sidecar.children"] = len(below(self.sidecar_pid))
            return row
        return None  # one of them has just ended


def name_and_state(pid: int) -> tuple[str, str]:
    """Name and letter of proc(5)."""
    stat = Path(f"/proc/{pid}/stat").read_text()
    name, rest = stat[stat.index("(") + 1 :].rsplit(")", 1)
    return name, rest.split()[0]


def of_process(pid: int) -> Row:
    """What one process has."""
    has = figures(pid)
    return {
        "rss_kb": has["VmRSS"],
        "anon_kb": has["RssAnon"],
        "pss_kb": has["Pss"],
        "private_kb": has["Private_Clean"] + has["Private_Dirty"],
        "page_tables_kb": has["VmPTE"],
        "maps": Path(f"/proc/{pid}/maps").read_text().count("\n"),
        "fds": len(os.listdir(f"/proc/{pid}/fd")),
        "threads": has["Threads"],
    }


@dataclass(frozen=True)
class Growth:
    """A figure in the first and in the last third of the time."""

    name: str
    first: float
    """Of memory the lowest, of counts the highest."""
    last: float
    """The lowest."""
    allowed: float

    @property
    def is_leak(self) -> bool:
        return self.last - self.first > self.allowed


def growths(rows: Sequence[Row], memory_allowed_kb: float) -> list[Growth]:
    """How each figure has moved.

    Everything goes up and down with checkpoints and restores, but what has leaked
    never comes back: it lifts the low.
    """
    third = len(rows) // 3
    assert third >= 3, f"only {len(rows)} moments"
    found = []
    for name in rows[0]:
        if name.endswith(NOT_JUDGED):
            continue
        first, last = [row[name] for row in rows[:third]], [row[name] for row in rows[-third:]]
        if name.endswith(MEMORY):
            found.append(Growth(name, min(first), min(last), memory_allowed_kb))
        else:
            arenas = memory_allowed_kb // ARENA_KB if name == "sidecar.maps" else 0
            found.append(Growth(name, max(first), min(last), arenas))
    return found
