# SPDX-License-Identifier: Apache-2.0
"""`avckpt.interval=auto` on a machine with many containers: their guards share one budget of CPU time. No I/O."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from avckpt.guard import Event, GuardConfig

TOTAL = 0.25
"""Of one CPU, for all of them together."""
ACTIVE_S = 5.0
"""A guard that has reported no checkpoint for this long needs no share: its application is idle. One that takes
them reports every 4 s at the latest."""
ROOM = 2.0
"""One that uses less than its share needs so many times what it uses, or it could never use more."""


def most_each(needs: Iterable[float], total: float) -> float:
    """What each may use at most, so that all stay within the total: who needs less leaves the rest to others."""
    ascending = sorted(needs)
    for n, need in enumerate(ascending):
        equal = total / (len(ascending) - n)
        if need > equal:
            return equal
        total -= need
    return math.inf


@dataclass
class _Active:
    at_s: float
    """When it last reported."""
    share: float
    need: float


@dataclass
class CpuBudget:
    """Who is taking checkpoints.

    Ask for a guard's share whenever it reports some, at most once a second: an idle one is left alone.
    """

    total: float = TOTAL
    _active: dict[int, _Active] = field(default_factory=dict)
    """By cookie."""

    def share(self, cookie: int, config: GuardConfig, now_s: float, taken: Event | None = None) -> float:
        """What a guard may use, which counts as active from now on, as a fraction of a CPU.

        `config`: by its labels; `now_s`: time.monotonic(); `taken`: its report, None: it begins, or has others.
        """
        own = config.budget_cpu
        if not config.interval_min_s:
            return own
        before = self._active.get(cookie)
        active = self._active[cookie] = _Active(now_s, own, own)
        if before is not None and taken is not None:
            # Of the checkpoints that its share allows, how many it has taken.
            used = taken.checkpoints * taken.interval_s / max(now_s - before.at_s, 1e-3)
            active.need = min(own, ROOM * used * before.share)
        self._active = {each: one for each, one in self._active.items() if now_s - one.at_s < ACTIVE_S}
        active.share = min(own, most_each((one.need for one in self._active.values()), self.total))
        return active.share
