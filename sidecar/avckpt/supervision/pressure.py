# SPDX-License-Identifier: Apache-2.0
"""Memory: when generations are dropped to spare applications, and when they come back.

A container near its own limit loses its oldest generation; under pressure on the whole
host, the container whose generations hold most does. Generations that would free next
to nothing are kept. They come back, at first after `BACK_AFTER_S`, and each time later
if that was too early.
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import os
import select
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from avckpt.containers.looks import look
from avckpt.containers.protected import Protected
from avckpt.errors import DeadlineMissed

NEAR = 0.90
"""Fraction of the limit above which generations are dropped."""
BACK_AFTER_S = 15.0
BACK_AFTER_MOST_S = 600.0
WORTH = 0.01
"""Fraction of the limit (or of the host's memory / 100): dropping generations that hold less does not
help."""
LEAST_WORTH_BYTES = 1 << 20
NEWEST_WORTH = 0.25
"""Fraction of the application's own memory: a newest generation that holds less is kept when the host is
short."""

PSI = Path("/proc/pressure/memory")
TRIGGERS = (b"some 150000 1000000", b"some 300000 2000000")
"""Microseconds stalled of a window; the second needs no privilege (Documentation/accounting/psi.rst)."""
AVAILABLE = 0.05
"""Fraction of the host's memory, without PSI: less than this available is pressure."""
AVAILABLE_STALLED = 0.20
"""The same with PSI. The kernel counts tasks that wait for memory in a control group at its own limit, too:
any container can have that go on for ever, and what others hold would not help it."""


class Advice(enum.Enum):
    """What to do with one container's generations."""

    KEEP = "keep"
    DROP_OLDEST = "drop oldest"
    REFILL = "refill"


@dataclass
class Allowance:
    """The state of one container. Decides; no I/O.  Times are CLOCK_MONOTONIC seconds."""

    short: bool = False
    """Generations were dropped and are not back yet."""
    back_at_s: float = 0.0
    back_after_s: float = BACK_AFTER_S
    refilled_at_s: float = -BACK_AFTER_MOST_S

    def near_limit(self, used_bytes: int, limit_bytes: int) -> bool:
        """Whether reading the generations' memory is worthwhile."""
        return used_bytes >= NEAR * limit_bytes

    def advise(self, used_bytes: int, limit_bytes: int, held_bytes: int, generations: int, now_s: float) -> Advice:
        """For a container with a limit. `held_bytes`: by its generations alone (0: not read).

        The newest one is not dropped: an application that leaks needs it in a moment, and the kernel takes it
        where the application would have room without it (native/engine/guard/guard_memory.c).
        """
        if self.near_limit(used_bytes, limit_bytes):
            if generations < 2 or held_bytes < max(WORTH * limit_bytes, LEAST_WORTH_BYTES):
                return Advice.KEEP
            self.gave_up(now_s)
            return Advice.DROP_OLDEST
        return self.come_back(now_s)

    def gave_up(self, now_s: float) -> None:
        """A generation was dropped now."""
        if not self.short:
            # Soon after they had come back: that was too early.
            early = now_s - self.refilled_at_s < 2 * self.back_after_s
            self.back_after_s = min(2 * self.back_after_s, BACK_AFTER_MOST_S) if early else BACK_AFTER_S
        self.short = True
        self.back_at_s = now_s + self.back_after_s

    def come_back(self, now_s: float) -> Advice:
        """Memory is available again."""
        if not self.short or now_s < self.back_at_s:
            return Advice.KEEP
        self.short = False
        self.refilled_at_s = now_s
        return Advice.REFILL


class HostPressure:
    """Detects when the host is short of memory: little is available and, where the kernel has PSI, tasks wait.

    `fd` is readable (poll(2)) once per window in which they do, until it has been polled: the moment to ask
    `is_high()`. None: there is no PSI, ask all the time.
    """

    def __init__(self, psi: Path | None = None) -> None:
        self._trigger = -1
        self._epoll: select.epoll | None = None
        for trigger in TRIGGERS:
            with contextlib.suppress(OSError):
                fd = os.open(psi or PSI, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
                try:
                    os.write(fd, trigger + b"\0")
                    # asyncio waits for input only; the trigger says "priority".
                    self._epoll = select.epoll()
                    self._epoll.register(fd, select.EPOLLPRI)
                except OSError:
                    os.close(fd)
                    self._epoll = None
                    raise
                self._trigger = fd
                break

    @property
    def fd(self) -> int | None:
        """To wait on; None: there is no PSI here."""
        return self._epoll.fileno() if self._epoll is not None else None

    def is_high(self) -> bool:
        """Whether so little memory is available now that the host is short of it."""
        total, available = _host_memory()
        return available < (AVAILABLE if self.fd is None else AVAILABLE_STALLED) * total

    def close(self) -> None:
        """Removes the trigger."""
        if self._epoll is not None:
            self._epoll.close()
            os.close(self._trigger)
            self._epoll = None


def held_bytes(app_pid: int, template_pids: Iterable[int]) -> int:
    """Memory that templates hold and the application does not use: what giving them all up would free.

    Walks page tables, the application's too: milliseconds per gigabyte. Processes that are gone count
    as 0.
    """
    templates = [_rollup(pid) for pid in template_pids]
    app = _rollup(app_pid)
    if not app or not any(templates):
        return 0
    # Each page counts once, in shares, over all who have it mapped; what the
    # application has mapped, it would keep.
    shares = sum(each.get("Pss_Anon", 0) for each in (app, *templates))
    return max(shares - app.get("Anonymous", 0), 0)


async def held_by(container: Protected) -> int:
    """The same for a container, for its `memory_bytes`, too; without anybody else waiting for it.

    Of one that cannot be looked at within a second it is what the last look found that came back.
    """
    await measure([container])
    return container.memory_bytes if container.generations else 0


async def measure(containers: Iterable[Protected]) -> list[Protected]:
    """Reads the `memory_bytes` of all of them at once; returns those of which it came within a second."""
    measured = []

    async def read(container: Protected) -> None:
        app_pid, init_pid = container.app_pid, container.init_pid

        def find_out() -> None:
            container.memory_bytes = held_bytes(app_pid, templates_of(init_pid))

        with contextlib.suppress(DeadlineMissed):
            if container.generations:
                await look("memory", init_pid, find_out)
            measured.append(container)

    await asyncio.gather(*map(read, containers))
    return measured


def is_worth_it(container: Protected, held: int) -> bool:
    """Whether a host short of memory gains if this container drops its oldest generation."""
    if container.generations > 1:
        return held >= LEAST_WORTH_BYTES
    return held >= max(NEWEST_WORTH * _own_bytes(container.app_pid), LEAST_WORTH_BYTES)


def _own_bytes(pid: int) -> int:
    """Memory of no file."""
    try:
        _, resident, of_files, *_ = Path(f"/proc/{pid}/statm").read_text().split()
    except OSError:
        return 0
    return (int(resident) - int(of_files)) * os.sysconf("SC_PAGESIZE")


def templates_of(init_pid: int) -> list[int]:
    """The templates below an avckpt-init, with the newest one's spare; empty when it is gone."""
    found = []
    with contextlib.suppress(OSError):
        for pid in Path(f"/proc/{init_pid}/task/{init_pid}/children").read_text().split():
            with contextlib.suppress(OSError):
                # The application is a child, too, and its name may be any bytes.
                if Path(f"/proc/{pid}/comm").read_bytes() in (b"avckpt-tmpl\n", b"avckpt-spare\n"):
                    found.append(int(pid))
    return found


def _rollup(pid: int) -> dict[str, int]:
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    except OSError:
        return {}
    return {line.split(":")[0]: int(line.split()[1]) * 1024 for line in lines}


def _host_memory() -> tuple[int, int]:
    fields = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
    return tuple(int(fields[name].split()[0]) * 1024 for name in ("MemTotal", "MemAvailable"))  # type: ignore[return-value]


def now_s() -> float:
    """The clock of `Allowance`."""
    return time.monotonic()
