# SPDX-License-Identifier: Apache-2.0
"""Finds out what applications die of, while their guards bring them back."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path

from avckpt_hooks.shared.tell import printable

from avckpt.containers.looks import look
from avckpt.errors import AvckptError
from avckpt.events.vocabulary import signal_name
from avckpt.evidence.crash import Crash, Frame, crash_of, fingerprint, placed
from avckpt.evidence.deaths import WAKE_BYTES, Death, Deaths, Delivery
from avckpt.evidence.kernel_log import KernelLog
from avckpt.evidence.remains import Remains, check_parent, command_of
from avckpt.guard import Event

CALLERS_LEAST = 3
"""Who keeps frame pointers has more callers than that; of others the stack is looked at."""

log = logging.getLogger("avckpt")


@dataclass(frozen=True)
class Case:
    """A death, as far as the kernel told of it by itself."""

    app_pid: int
    wait_status: int
    crash: Crash
    death: Death
    hit: Delivery | None
    remains_pid: int
    likeness_pid: int
    """A task with the memory of the last checkpoint; 0: there is none."""
    init_pid: int
    command: str
    """As it was seen last, alive or dead; empty: it was not."""
    died_ns: int
    """When avckpt-init knew of it, CLOCK_MONOTONIC."""

    @property
    def detected_s(self) -> float | None:
        """From the fatal signal until then; None: there was none, or it is not known."""
        return max(self.died_ns - self.hit.at_ns, 0) / 1e9 if self.hit is not None else None


class Collector:
    """For one event loop; `start()` it there.  What cannot be known is said in the crash, and is no error."""

    def __init__(self, protected: Callable[[], Collection[int]]) -> None:
        self._protected = protected
        self._deaths: Deaths | None = None
        self._log: KernelLog | None = None
        self._problem = "the sidecar does not listen"

    def start(self) -> None:
        """Begins to hear of deaths."""
        try:
            self._deaths = Deaths(self._protected)
        except AvckptError as error:
            self._problem = str(error)
            log.info("where applications die will not be known: %s", error)
            return
        for fd in self._deaths.fds:
            asyncio.get_running_loop().add_reader(fd, self._hear)
        try:
            self._log = KernelLog()
        except OSError as error:
            log.info("addresses of faults will not be known: /dev/kmsg: %s", error.strerror)

    def _hear(self) -> None:
        # Whatever else has to be done comes in between: thousands of threads may die at once.
        if self._deaths is not None and self._deaths.take(WAKE_BYTES):
            asyncio.get_running_loop().call_soon(self._hear)

    def close(self) -> None:
        """Hears no more."""
        if self._deaths is not None:
            for fd in self._deaths.fds:
                asyncio.get_running_loop().remove_reader(fd)
            self._deaths.close()
        if self._log is not None:
            self._log.close()
        self._deaths = self._log = None

    def open_case(self, event: Event, init_pid: int, command: str = "") -> Case:
        """What the kernel told of the end of a process.  At once, and before its number is another one's."""
        pid, wait_status = event.app_pid, event.wait_status
        signum = wait_status & 0x7F
        name = signal_name(signum) if signum else ""
        kept = (event.remains_pid, event.likeness_pid, init_pid, command, event.died_ns)
        if self._deaths is None:
            crash = Crash(signal=name, unknown=self._problem)
            return Case(pid, wait_status, crash, Death(), None, *kept)
        death = self._deaths.of(pid)
        hit = death.fatal(signum) if signum else None
        # A signal that was sent has none: what the log has of that number is of an earlier thread.
        fault = self._log.of(hit.tid) if hit is not None and hit.code > 0 and self._log is not None else None
        crash = crash_of(name, hit, death, fault)
        if crash.sender_pid:
            crash = replace(crash, sender=_name_of(crash.sender_pid))
        if signum and hit is None:
            crash = replace(crash, unknown="the kernel's report of it was lost: too many deaths at once")
        return Case(pid, wait_status, crash, death, hit, *kept)

    async def examine(self, case: Case) -> Crash:
        """With what the memory of the dead tells."""
        if not case.remains_pid:
            return await self._compare(case, replace(case.crash, unknown="its memory was not kept"))
        try:
            crash, frames = await look("remains", case.remains_pid, lambda: _examine(case))
        except (AvckptError, OSError) as error:
            why = f"its memory cannot be read: {error}"
            return await self._compare(case, replace(case.crash, unknown=why))
        return self._identified(case, crash, frames)

    async def _compare(self, case: Case, crash: Crash) -> Crash:
        """Of one whose memory is gone (the OOM killer): places by what was mapped at the last checkpoint."""
        if not case.likeness_pid:
            return self._identified(case, crash)
        try:
            placed_, frames = await look("remains", case.likeness_pid, lambda: _liken(case, crash))
        except (AvckptError, OSError):
            return self._identified(case, crash)
        return self._identified(case, placed_, frames)

    @staticmethod
    def _identified(case: Case, crash: Crash, frames: list[Frame] | None = None) -> Crash:
        if crash.unknown != case.crash.unknown and not crash.command and case.command:  # its memory is gone
            why = f"{crash.unknown}; the command is that of an earlier look"
            crash = replace(crash, command=case.command, unknown=why)
        return replace(crash, fingerprint=fingerprint(crash, case.wait_status, frames or []))


def _remains(pid: int, case: Case) -> Remains:
    """Raises OSError."""
    check_parent(pid, case.init_pid)
    remains = Remains(pid)
    if not remains.maps:
        remains.close()
        raise ProcessLookupError(f"process {pid} has no memory any more")
    return remains


def _liken(case: Case, crash: Crash) -> tuple[Crash, list[Frame]]:
    """Raises OSError."""
    likeness = _remains(case.likeness_pid, case)
    try:
        # Only what the kernel told at the death: this stack is another one.
        frames = likeness.frames(case.hit.callers) if case.hit is not None else []
        return replace(placed(crash, frames), command=command_of(likeness.pid, case.init_pid)), frames
    finally:
        likeness.close()


def _examine(case: Case) -> tuple[Crash, list[Frame]]:
    """Raises OSError."""
    remains = _remains(case.remains_pid, case)
    try:
        frames = _frames(remains, case.hit)
        return replace(placed(case.crash, frames), command=command_of(remains.pid, case.init_pid)), frames
    finally:
        remains.close()


def _frames(remains: Remains, hit: Delivery | None) -> list[Frame]:
    if hit is None or not hit.registers:
        return []
    kept = remains.frames(hit.callers)
    if len(kept) >= CALLERS_LEAST:
        return kept
    return remains.frames([hit.registers["rip"], *remains.on_stack(hit.registers["rsp"])])


def _name_of(pid: int) -> str:
    try:
        return printable(Path(f"/proc/{pid}/comm").read_text(errors="replace").rstrip("\n"))
    except OSError:
        return ""
