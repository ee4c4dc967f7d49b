# SPDX-License-Identifier: Apache-2.0
"""How often something may happen that others bring about."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass
class Bucket:
    """So often at once, and then so often a second.  Times are CLOCK_MONOTONIC seconds."""

    most: float
    per_s: float
    left: float = field(init=False)
    at_s: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.left = self.most

    def has_one(self, now_s: float | None = None) -> bool:
        """Whether there was one left (now), which is taken."""
        self._fill(now_s)
        if self.left < 1:
            return False
        self.left -= 1
        return True

    def is_full(self, now_s: float | None = None) -> bool:
        """Whether it is as good as a new one."""
        self._fill(now_s)
        return self.left >= self.most

    def _fill(self, now_s: float | None) -> None:
        now_s = time.monotonic() if now_s is None else now_s
        self.left = min(self.left + (now_s - self.at_s) * self.per_s, self.most)
        self.at_s = now_s
