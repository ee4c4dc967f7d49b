# SPDX-License-Identifier: Apache-2.0
"""Supervises the daemon's containers beyond deaths: their health, the memory of their generations,
and what the OOM killer leaves of them.

One per daemon, in its event loop. It only sends commands to guards; the results reach it
as events.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Generic, TypeVar

from avckpt_hooks.shared.labels import Policy

from avckpt.containers.cgroup import Groups, groups_of
from avckpt.errors import Busy, TargetGone
from avckpt.events.record import EventRecord
from avckpt.guard import Command
from avckpt.supervision.health import Ward, watch_health
from avckpt.supervision.oom_group import OomGroup, oom_group_of
from avckpt.supervision.pressure import (
    Advice,
    Allowance,
    HostPressure,
    held_by,
    is_worth_it,
    now_s,
)

log = logging.getLogger("avckpt")

LOOK_S = 1.0
"""Seconds between checks of limits."""
SELDOM = 5
"""A container without one may get one (`podman update --memory`): every so many checks."""
W = TypeVar("W", bound=Ward)


@dataclass
class _Care(Generic[W]):
    ward: W
    groups: Groups
    """Where its memory is counted, and limited now or later."""
    allowance: Allowance = field(default_factory=Allowance)
    oom_group: OomGroup | None = None
    health: asyncio.Task[None] | None = None


class Caretaker(Generic[W]):
    """`begin()` and `end()` it for every container, `close()` it at the end."""

    def __init__(self, run_dir: Path, tell: Callable[[W, EventRecord], EventRecord]) -> None:
        self._health_dir = run_dir / "health"
        self._tell = tell
        self._cares: dict[int, _Care[W]] = {}
        self._host: HostPressure | None = None
        self._looking: asyncio.Task[None] | None = None
        self._relieving: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begins to watch the host's memory."""
        self._host = HostPressure()
        if self._host.fd is not None:
            asyncio.get_running_loop().add_reader(self._host.fd, self._look_at_host)

    def begin(self, ward: W, policy: Policy) -> None:
        """A container that is guarded from now on."""
        try:
            groups = groups_of(ward.container.init_pid)
        except OSError:  # it has just ended
            groups = Groups((), None, ())
        care = self._cares[ward.container.cookie] = _Care(ward, groups)
        care.oom_group = oom_group_of(groups, ward.container, ward.pidfd)
        self._tell_limits(care, care.groups.memory_used_bytes())
        if policy.restore_on.unhealthy:
            self._watch_health(care)
        self._look_if_needed()

    def change(self, ward: W, policy: Policy) -> None:
        """Another policy applies from now on; a continuing health check keeps its count."""
        care = self._cares.get(ward.container.cookie)
        if care is None:
            return
        if policy.restore_on.unhealthy:
            if care.health is None or care.health.done():
                self._watch_health(care)
        elif care.health is not None:
            care.health.cancel()
            care.health = None
            self._order(care, Command.UNVOUCH)

    def end(self, ward: W) -> None:
        """Its guard is about to be stopped.  A second call does nothing."""
        care = self._cares.pop(ward.container.cookie, None)
        if care is not None and care.health is not None:
            care.health.cancel()
        if care is not None and care.oom_group is not None:
            care.oom_group.give_back()
            care.oom_group = None

    def is_paused(self, ward: W) -> bool:
        """Whether its container is (podman pause)."""
        care = self._cares.get(ward.container.cookie)
        return care is not None and care.groups.is_frozen()

    async def close(self) -> None:
        """Ends everything that is under way."""
        tasks = [care.health for care in self._cares.values() if care.health is not None]
        for care in list(self._cares.values()):
            self.end(care.ward)
        tasks += [task for task in (self._looking, self._relieving) if task is not None]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        if self._host is not None:
            if self._host.fd is not None:
                asyncio.get_running_loop().remove_reader(self._host.fd)
            self._host.close()

    def _watch_health(self, care: _Care[W]) -> None:
        ward, tell = care.ward, self._tell
        answer = self._health_dir / f"{ward.container.id}.json"
        care.health = asyncio.get_running_loop().create_task(
            watch_health(ward, answer, lambda record: tell(ward, record))
        )
        care.health.add_done_callback(_log_failure)

    def _must_look(self) -> bool:
        blind = self._host is not None and self._host.fd is None
        return any(blind or care.groups.memory or care.allowance.short for care in self._cares.values())

    def _look_if_needed(self) -> None:
        if self._must_look() and (self._looking is None or self._looking.done()):
            self._looking = asyncio.get_running_loop().create_task(self._look())
            self._looking.add_done_callback(_log_failure)

    async def _look(self) -> None:
        for number in itertools.count():
            if not self._must_look():
                return
            await asyncio.sleep(LOOK_S)
            if self._host is not None and self._host.fd is None:
                self._look_at_host()
            for care in list(self._cares.values()):
                if care.oom_group is not None:
                    care.oom_group.look(care.ward.container, care.ward.pidfd)
                limited = care.ward.container.config.memory_limit_bytes or care.allowance.short
                if not limited and number % SELDOM:
                    continue
                limit = care.groups.memory_limit_bytes()
                used = None if limit is None else care.groups.memory_used_bytes()
                self._tell_limits(care, used)
                advice = await self._advise(care, limit, used)
                if advice is Advice.DROP_OLDEST:
                    self._order(care, Command.DROP_OLDEST)
                elif advice is Advice.REFILL:
                    self._order(care, Command.REFILL)

    async def _advise(self, care: _Care[W], limit: int | None, used: int | None) -> Advice:
        if used is None or limit is None:
            return care.allowance.come_back(now_s())
        container = care.ward.container
        held = await held_by(container) if care.allowance.near_limit(used, limit) else 0
        return care.allowance.advise(used, limit, held, container.generations, now_s())

    def _tell_limits(self, care: _Care[W], used: int | None) -> None:
        """Its guard ranks generations by that of memory.  They can change at any time: by `podman update`, or when
        memory runs out elsewhere first."""
        container, guard = care.ward.container, care.ward.guard
        config = replace(
            container.config,
            memory_limit_bytes=care.groups.first_to_run_out_bytes(used) or 0,
            tasks_max=care.groups.tasks_max() or 0,
        )
        if guard is None or config == container.config:
            return
        container.config = config
        with contextlib.suppress(TargetGone, Busy):  # it has ended
            guard.configure(container.config)

    def _look_at_host(self) -> None:
        if self._host is None or not self._host.is_high():
            return
        # Lasting pressure is reported every second; finding who holds most may take longer.
        if self._relieving is None or self._relieving.done():
            self._relieving = asyncio.get_running_loop().create_task(self._relieve())
            self._relieving.add_done_callback(_log_failure)

    async def _relieve(self) -> None:
        most, held_most = None, (False, 0)
        for care in list(self._cares.values()):
            container = care.ward.container
            held = await held_by(container)
            # All older generations are dropped before any container's newest.
            rank = (container.generations > 1, held)
            if is_worth_it(container, held) and rank > held_most:
                most, held_most = care, rank
        if most is None:
            return
        most.allowance.gave_up(now_s())
        log.warning("the host is short of memory: %s gives up a generation", most.ward.container.label)
        self._order(most, Command.DROP_OLDEST)
        self._look_if_needed()

    def _order(self, care: _Care[W], command: Command) -> None:
        if care.ward.guard is not None:
            with contextlib.suppress(TargetGone, Busy):  # it has ended
                care.ward.guard.command(command, 0)


def _log_failure(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and task.exception() is not None:
        log.error("the care of a container has ended", exc_info=task.exception())
