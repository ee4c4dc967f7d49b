# SPDX-License-Identifier: Apache-2.0
"""What a new configuration file means for one container that runs.  No I/O."""

from __future__ import annotations

from dataclasses import dataclass

from avckpt.policy import Change


@dataclass(frozen=True)
class Reloaded:
    """A container that goes by other settings now, or, with a `problem`, by its old ones."""

    container: str
    changes: tuple[Change, ...]
    problem: str = ""
    """Why the file does not hold for it; empty: it does."""

    @property
    def what(self) -> str:
        """In a line: "interval 3s -> 500ms, keep 2 -> 4"."""
        return ", ".join(map(str, self.changes))

    def to_json(self) -> dict[str, object]:
        """For the API."""
        return {
            "container": self.container,
            "changes": [
                {"setting": change.setting, "before": change.before, "after": change.after} for change in self.changes
            ],
            "problem": self.problem,
        }
