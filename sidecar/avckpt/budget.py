# SPDX-License-Identifier: Apache-2.0
"""`avckpt.interval=auto` on a machine with many containers: their guards share one budget of CPU time. No I/O."""

from __future__ import annotations

from dataclasses import dataclass, field

from avckpt.guard import GuardConfig

TOTAL = 0.25
"""Of one CPU, for all of them together."""
ACTIVE_S = 5.0
"""A guard that has reported no checkpoint for this long needs no share: its application is idle. One that takes
them reports every 4 s at the latest."""


def share_of(own: float, total: float, active: int) -> float:
    """What one guard may use, as a fraction of a CPU: its label's budget, or an equal part of the total."""
    return min(own, total / max(active, 1))


@dataclass
class CpuBudget:
    """Who is taking checkpoints.

    Ask for a guard's share whenever it reports some, at most once a second: an idle one is left alone.
    """

    total: float = TOTAL
    _active: dict[int, float] = field(default_factory=dict)
    """Cookies, and when they last reported."""

    def share(self, cookie: int, config: GuardConfig, now_s: float) -> float:
        """What a guard may use, which counts as active from now on. `config`: by its labels; `now_s`:
        time.monotonic()."""
        if not config.interval_min_s:
            return config.budget_cpu
        self._active[cookie] = now_s
        self._active = {each: at_s for each, at_s in self._active.items() if now_s - at_s < ACTIVE_S}
        return share_of(config.budget_cpu, self.total, len(self._active))
