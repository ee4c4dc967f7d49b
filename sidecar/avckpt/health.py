# SPDX-License-Identifier: Apache-2.0
"""Health checks of containers whose `avckpt.restore.on` names `unhealthy`.

The sidecar runs the container's own check (`podman run --health-cmd ...`, or
its image's HEALTHCHECK) by itself, at the check's own interval: Podman leaves
that to systemd timers, which are not everywhere.  Where they are, both run,
and neither minds.

A check that passes vouches for the generations that were held at the pass before
it: the application that went on from them was healthy later.  When `retries` checks in a row have
failed, the application is rolled back to the newest generation that was vouched
for; those taken since may hold the very hang.
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

from avckpt.cgroup import groups_of
from avckpt.errors import AvckptError, TargetGone
from avckpt.event_record import EventRecord, Kind
from avckpt.events import Command
from avckpt.inside import Done, run_inside
from avckpt.printable import printable
from avckpt.protected import Protected

if TYPE_CHECKING:
    from avckpt.native import Guard

LOOK_S = 0.2
"""How often the answer of the hook's process is looked for, until it is there."""
KNOWN_WITHIN_S = 90.0
"""How long it is waited for: longer than that process tries."""
LEAST_INTERVAL_S = 0.1
OUTPUT_SHOWN = 120


@dataclass(frozen=True)
class HealthCheck:
    """What is run, and when it counts.  The defaults are Podman's."""

    command: tuple[str, ...]
    interval_s: float = 30.0
    timeout_s: float = 30.0
    retries: int = 3
    start_period_s: float = 0.0
    """Failures that early do not count, as long as no check has passed."""


def health_check_of(found: object) -> HealthCheck | None:
    """A health check from `podman inspect` (`Config.Healthcheck`); None: the container has none.

    Durations there are nanoseconds, and 0 is Podman's default.  Raises
    ValueError for what is not such a thing.
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

    def seconds(key: str, default: float) -> float:
        value = found.get(key) or 0
        if not isinstance(value, int) or value < 0:
            raise ValueError(f"{key} is {value!r}")
        return value / 1e9 or default

    retries = found.get("Retries") or HealthCheck.retries
    if not isinstance(retries, int) or retries < 1:
        raise ValueError(f"Retries is {retries!r}")
    return HealthCheck(
        command,
        max(seconds("Interval", HealthCheck.interval_s), LEAST_INTERVAL_S),
        seconds("Timeout", HealthCheck.timeout_s),
        retries,
        seconds("StartPeriod", 0.0),
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
        """A check of an application that runs for `age_s`; True: it is unhealthy now, and counting starts anew."""
        if healthy:
            self.failures, self.passed = 0, True
            return False
        if not self.passed and age_s < self.check.start_period_s:
            return False
        self.failures += 1
        if self.failures < self.check.retries:
            return False
        self.failures = 0
        return True


class Ward(Protocol):
    """What is needed of a container's watch."""

    container: Protected
    pidfd: int
    guard: Guard | None


async def watch_health(ward: Ward, answer: Path, tell: Callable[[EventRecord], object]) -> None:
    """Checks one container until it is cancelled or the container has ended.

    `answer` is the file in which the hook's process says what the health check
    is (`protocol.health_path()`).
    """
    pidfd = os.dup(ward.pidfd)  # the container may end at any time, and its watch with it
    try:
        check = await _known(answer, tell)
        if check is not None:
            await _check_for_ever(ward, pidfd, check, tell)
    except TargetGone:
        return
    finally:
        os.close(pidfd)


async def _known(answer: Path, tell: Callable[[EventRecord], object]) -> HealthCheck | None:
    deadline = time.monotonic() + KNOWN_WITHIN_S
    why = "the hooks did not find it out"
    while time.monotonic() < deadline:
        with contextlib.suppress(FileNotFoundError):
            try:
                said = json.loads(answer.read_text())
                check = health_check_of(said.get("healthcheck"))
                if check is not None:
                    return check
                why = said.get("error") or "it has none (podman run --health-cmd, or HEALTHCHECK in its image)"
            except (ValueError, AttributeError) as error:
                why = f"{answer} can not be read: {error}"
            break
        await asyncio.sleep(LOOK_S)
    tell(
        EventRecord(Kind.HEALTH, detail=f"avckpt.restore.on names unhealthy, but its health check is not known: {why}")
    )
    return None


async def _check_for_ever(ward: Ward, pidfd: int, check: HealthCheck, tell: Callable[[EventRecord], object]) -> None:
    pulse = Pulse(check)
    troubled = False
    while True:
        await asyncio.sleep(check.interval_s)
        container = ward.container
        if not container.app_pid or _is_paused(container.init_pid):
            continue
        restores = container.restores
        try:
            done = await run_inside(pidfd, check.command, timeout_s=check.timeout_s)
        except TargetGone:
            raise
        except AvckptError as error:
            # Ours to mend, and nothing that a rollback would: not counted.
            tell(EventRecord(Kind.HEALTH, detail="its health check can not be run", error=error))
            continue
        if container.restores != restores or _is_paused(container.init_pid):
            continue  # the check has seen two applications, or one that could not answer
        unhealthy = pulse.take(done.status == 0, time.time() - container.registered_at)
        if done.status == 0:
            if troubled:
                tell(EventRecord(Kind.HEALTH, detail="its health check passes again"))
            troubled = False
            _order(ward, Command.VOUCH, 0)
        elif unhealthy or pulse.failures:
            troubled = True
            count = check.retries if unhealthy else pulse.failures
            what_now = ""
            if unhealthy:
                what_now = ": rolled back" if container.generations else ": nothing is held to go back to"
            detail = f"its health check failed {count} time(s) of {check.retries}{what_now} ({describe(done, check)})"
            tell(EventRecord(Kind.HEALTH, detail=detail))
            if unhealthy and container.generations:
                _order(ward, Command.UNHEALTHY, 0)


def describe(done: Done, check: HealthCheck) -> str:
    """How a check failed, in a clause."""
    text = f"no answer within {check.timeout_s:g} s" if done.timed_out else f"status {done.status}"
    said = printable(" ".join(done.output.split()))
    return f"{text}: {said[:OUTPUT_SHOWN]}" if said else text


def _order(ward: Ward, command: Command, ticket: int) -> None:
    if ward.guard is not None:
        with contextlib.suppress(TargetGone):
            ward.guard.command(command, ticket)


def _is_paused(init_pid: int) -> bool:
    try:
        return groups_of(init_pid).is_frozen()
    except OSError:
        return False
