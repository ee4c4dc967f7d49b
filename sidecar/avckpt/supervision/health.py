# SPDX-License-Identifier: Apache-2.0
"""Health checks of containers whose `avckpt.restore.on` names `unhealthy`.

The sidecar runs the container's own check (`podman run --health-cmd ...`, or its image's
HEALTHCHECK) itself, at the check's own interval: Podman leaves that to systemd timers, which do
not exist everywhere. Where they do, both run without conflict.

A check that passes vouches for the generations that were held at the pass before it: the
application that continued from them was healthy later. When `retries` checks in a row have
failed, the application is rolled back to the newest generation that was vouched for; those taken
since may contain the hang.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from avckpt_hooks.shared.files import read_own
from avckpt_hooks.shared.protocol import MAX_BYTES
from avckpt_hooks.shared.tell import printable

from avckpt.containers.cgroup import is_paused
from avckpt.containers.process import age_s
from avckpt.containers.protected import Protected
from avckpt.errors import AvckptError, Busy, TargetGone, of_any
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind
from avckpt.guard import Command
from avckpt.supervision.inside import Done, run_inside

if TYPE_CHECKING:
    from avckpt.engine import Guard

LOOK_S = 0.2
"""Seconds between polls for the answer of the hook's process."""
KNOWN_WITHIN_S = 90.0
"""How long to wait for it: longer than that process tries."""
LEAST_INTERVAL_S = 0.1
OUTPUT_SHOWN = 120


@dataclass(frozen=True)
class HealthCheck:
    """What is run, and when it counts.  The defaults are Podman's."""

    command: tuple[str, ...]
    interval_s: float
    """0: disabled."""
    timeout_s: float = 30.0
    retries: int = 3
    start_period_s: float = 0.0
    """Failures that early do not count, as long as no check has passed."""
    has_startup_check: bool = False
    """No failure counts, however late, as long as no check has passed."""


def health_check_of(found: object, *, has_startup_check: bool = False) -> HealthCheck | None:
    """A health check from `podman inspect` (`Config.Healthcheck`); None: the container has none.

    Durations there are nanoseconds, and zeros are omitted. An interval of 0 is
    `--health-interval=disable`: without the option Podman has filled in its default. Raises
    ValueError for anything else.
    """
    if not found:
        return None
    if not isinstance(found, dict):
        raise ValueError(f"{found!r} is no health check")
    test = found.get("Test") or ["NONE"]
    if not isinstance(test, list) or not all(isinstance(word, str) for word in test):
        raise ValueError(f"{test!r} is no command")
    kind, *words = test
    if kind == "NONE" or not words:
        return None
    command = ("/bin/sh", "-c", words[0]) if kind == "CMD-SHELL" else tuple(words if kind == "CMD" else test)

    def seconds(key: str, default: float = 0.0) -> float:
        value = found.get(key) or 0
        if not isinstance(value, int) or not 0 <= value < 1 << 63:  # Go's time.Duration
            raise ValueError(f"{key} is {value!r}")
        return value / 1e9 or default

    retries = found.get("Retries") or HealthCheck.retries
    if not isinstance(retries, int) or retries < 1:
        raise ValueError(f"Retries is {retries!r}")
    interval_s = seconds("Interval")
    return HealthCheck(
        command,
        max(interval_s, LEAST_INTERVAL_S) if interval_s else 0.0,
        seconds("Timeout", HealthCheck.timeout_s),
        retries,
        seconds("StartPeriod"),
        has_startup_check,
    )


@dataclass
class Pulse:
    """Counts.  No I/O."""

    check: HealthCheck
    failures: int = 0
    """In a row."""
    passed: bool = False
    """Ever."""

    def take(self, healthy: bool, age_s: float) -> bool:
        """A check of an application that runs for `age_s`; True: it is unhealthy now, and counting
        restarts."""
        if healthy:
            self.failures, self.passed = 0, True
            return False
        if not self.passed and (self.check.has_startup_check or age_s < self.check.start_period_s):
            return False
        self.failures += 1
        if self.failures < self.check.retries:
            return False
        self.failures = 0
        return True


Tell = Callable[[EventRecord], EventRecord]
"""Distributes it; returns the event as distributed, with a number (`seq`) if it is stored."""


class Ward(Protocol):
    """The part of a container's watch that is needed here."""

    container: Protected
    pidfd: int
    guard: Guard | None


async def watch_health(ward: Ward, answer: Path, tell: Tell) -> None:
    """Checks one container until it is cancelled or the container has ended.

    `answer` is the file in which the hook's process says what the health check
    is (`protocol.health_path()`).
    """
    check = await _known(answer, tell)
    if check is None:
        return
    watcher = _Watcher(ward, tell, Pulse(check))
    with contextlib.suppress(TargetGone):
        while True:
            await asyncio.sleep(check.interval_s)
            await watcher.look()


async def _known(answer: Path, tell: Tell) -> HealthCheck | None:
    deadline = time.monotonic() + KNOWN_WITHIN_S
    why = "the hooks did not find it out"
    while time.monotonic() < deadline:
        try:
            said = json.loads(read_own(str(answer), MAX_BYTES))
            has_startup_check = bool(said.get("startup_healthcheck"))
            check = health_check_of(said.get("healthcheck"), has_startup_check=has_startup_check)
            if check is not None and check.interval_s:
                return check
            why = said.get("error") or "it has none (podman run --health-cmd, or HEALTHCHECK in its image)"
            if check is not None:
                why = "it is switched off (--health-interval=disable)"
            break
        except FileNotFoundError:
            pass  # not yet
        except OSError as error:  # no descriptors left, for example: it may work in a moment
            why = f"{answer} cannot be read: {error.strerror}"
        except (ValueError, AttributeError, RecursionError) as error:
            why = f"{answer} cannot be read: {error}"
            break
        await asyncio.sleep(LOOK_S)
    tell(EventRecord(Kind.HEALTH, detail=f"avckpt.restore.on names unhealthy, but no health check is run: {why}"))
    return None


@dataclass
class _Watcher:
    """One container's checks, from one to the next."""

    ward: Ward
    tell: Tell
    pulse: Pulse
    troubled: bool = False
    """A failure since the last pass has been reported."""

    async def look(self) -> None:
        """One check, and its consequences. Raises only TargetGone, when the container has ended."""
        container = self.ward.container
        if not container.app_pid or is_paused(container.init_pid):
            return
        restores = container.restores
        try:
            done = await self._run()
            app_age_s = age_s(container.init_pid)
        except TargetGone:
            raise
        except Exception as error:  # noqa: BLE001 - whatever stops this check, the next one may work
            # Our failure, which no rollback would fix: not counted.
            self._complain("its health check cannot be run", of_any(error))
            return
        if container.restores != restores or is_paused(container.init_pid):
            return  # the check spanned two applications, or one that could not answer
        unhealthy = self.pulse.take(done.status == 0, app_age_s)
        if done.status == 0:
            self._passed()
        elif unhealthy or self.pulse.failures:
            self._failed(done, unhealthy)

    async def _run(self) -> Done:
        pidfd = os.dup(self.ward.pidfd)  # the container may end at any time, and its watch with it
        try:
            return await run_inside(pidfd, self.pulse.check.command, timeout_s=self.pulse.check.timeout_s)
        finally:
            os.close(pidfd)

    def _passed(self) -> None:
        if self.troubled:
            self.tell(EventRecord(Kind.HEALTH, detail="its health check passes again"))
        self.troubled = False
        with contextlib.suppress(TargetGone, Busy):  # it has ended, or the next check that passes vouches
            self._order(Command.VOUCH)

    def _failed(self, done: Done, unhealthy: bool) -> None:
        check = self.pulse.check
        count = check.retries if unhealthy else self.pulse.failures
        detail = f"its health check failed {count} time(s) of {check.retries}"
        why = AvckptError(describe(done, check))
        if not unhealthy:
            self._complain(detail, why)
        elif not self.ward.container.generations:
            self._complain(f"{detail}, nothing is held to go back to", why)
        else:
            try:
                self._order(Command.UNHEALTHY)
            except AvckptError as error:
                self._complain(f"{detail}, it cannot be rolled back", error)
            else:
                self.troubled = True
                self.tell(EventRecord(Kind.HEALTH, detail=f"{detail}: rolled back ({why})"))

    def _complain(self, detail: str, error: AvckptError) -> None:
        # Its end is reported only if the failure was (not every interval reports it).
        self.troubled |= self.tell(EventRecord(Kind.HEALTH, detail=detail, error=error)).seq > 0

    def _order(self, command: Command) -> None:
        if self.ward.guard is not None:
            self.ward.guard.command(command, 0)


def describe(done: Done, check: HealthCheck) -> str:
    """How a check failed, in a clause."""
    text = f"no answer within {check.timeout_s:g} s" if done.timed_out else f"status {done.status}"
    said = printable(" ".join(done.output.split()))
    return f"{text}: {said[:OUTPUT_SHOWN]}" if said else text
