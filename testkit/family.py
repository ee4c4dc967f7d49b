# SPDX-License-Identifier: Apache-2.0
"""The processes of a victim's container, seen from outside."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from testkit.guarded import PATIENCE_S, Victim
from testkit.harness import wait_until
from testkit.procfs import below, children_of


@dataclass(frozen=True)
class Member:
    """One process.  `pid` is ours; the other numbers are those of its own PID namespace."""

    pid: int
    inside: int
    parent: int
    group: int
    session: int
    name: str
    state: str
    is_traced: bool

    @property
    def is_zombie(self) -> bool:
        return self.state == "Z"

    @property
    def place(self) -> tuple[int, int, int, int, str, bool]:
        """What is to be the same after a restore."""
        return (self.inside, self.parent, self.group, self.session, self.name, self.is_zombie)


def look(pid: int) -> Member | None:
    """None: it is gone."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
        status = Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    numbers = {key: int(found.split()[-1]) for key, found in re.findall(r"^NS(pid|pgid|sid):(.*)$", status, re.M)}
    name, rest = stat[stat.index("(") + 1 :].rsplit(")", 1)
    state, parent = rest.split()[:2]
    try:
        above = Path(f"/proc/{parent}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None  # it has just got another one
    line = next(line for line in above.splitlines() if line.startswith("NSpid:"))
    # A zombie has given its numbers back; stat still has some of them.
    if not numbers.get("pid"):
        return None
    return Member(
        pid,
        numbers["pid"],
        int(line.split()[-1]),
        numbers.get("pgid", 0),
        numbers.get("sid", 0),
        name,
        state,
        "\nTracerPid:\t0\n" not in status,
    )


def members(victim: Victim) -> list[Member]:
    """The application: everything below init that is not avckpt's."""
    seen = [look(pid) for pid in below(victim.pid)]
    return [member for member in seen if member is not None and not member.name.startswith("avckpt-")]


def main_process(victim: Victim) -> int:
    """In our PID namespace; also where an orphan makes `Victim.app` ambiguous.  Waits while it is being restored."""

    def find() -> int:
        number = victim.see().pid
        found = (look(pid) for pid in children_of(victim.pid))
        fits = (m.pid for m in found if m and m.inside == number and not m.name.startswith("avckpt-"))
        return next(fits, 0)

    return wait_until(find, PATIENCE_S, f"{victim.command} is there", every_s=0.001)


def kill_main(victim: Victim, signum: int = signal.SIGKILL) -> None:
    """Kills the main process, as it is now."""
    os.kill(main_process(victim), signum)


def left_alone(seen: Callable[[], list[Member]], timeout_s: float, whose: str) -> list[Member]:
    """Those that are seen while no guard traces any of them.

    While one does it is making templates or holders, which get their names, or are reaped, only some moments later,
    on a busy machine after seconds: a look at that time is no look.
    """

    def look_again() -> list[Member]:
        now = seen()
        return [] if any(member.is_traced for member in now) else now

    return wait_until(look_again, timeout_s, f"{whose} is left alone", every_s=0.005)


def places(victim: Victim) -> list[tuple[int, int, int, int, str, bool]]:
    """Who is where; for a tree that does not change, to be compared with another moment's."""
    return sorted(member.place for member in left_alone(lambda: members(victim), PATIENCE_S, victim.command))


def strangers(victim: Victim, allowed: int = 0) -> list[Member]:
    """Children of init that are neither the application's nor avckpt's.  `allowed`: so many orphans are its own."""
    main = victim.see().pid
    found = (look(pid) for pid in children_of(victim.pid))
    others = [m for m in found if m and m.inside != main and not m.name.startswith("avckpt-") and not m.is_zombie]
    return others if len(others) > allowed else []


def wait_whole(victim: Victim, allowed: int = 0) -> None:
    """Nobody of it is left stopped by a tracer, and nobody is there who does not belong to it."""
    wait_until(
        lambda: not any(m.state == "t" for m in members(victim)) or victim.see().violations,
        PATIENCE_S,
        f"every process of {victim.command} runs",
    )
    # What was killed may have to be reaped yet.
    wait_until(lambda: not strangers(victim, allowed), PATIENCE_S, f"{strangers(victim, allowed)} are gone")


def progress(victim: Victim) -> None:
    """Its main process beats, and what the others do goes on, too."""
    before = victim.see().counter[:3]
    victim.wait_beats(5)
    wait_until(
        lambda: any(now > was for was, now in zip(before, victim.see().counter[:3])) or victim.see().violations,
        PATIENCE_S,
        f"the processes of {victim.command} go on",
    )
    victim.check()


def ours(victim: Victim, name: str = "avckpt-") -> list[int]:
    """Templates ("avckpt-tmpl"), spare ("avckpt-spare") and holders ("avckpt-hold") in its container."""
    found = [look(pid) for pid in children_of(victim.pid)]
    return [m.pid for m in found if m is not None and m.name.startswith(name) and not m.is_zombie]
