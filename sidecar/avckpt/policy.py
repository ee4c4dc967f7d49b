# SPDX-License-Identifier: Apache-2.0
"""From a container's labels to its guard's settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from avckpt_hooks.shared.labels import AUTOMATIC_MAX, KEEP_MAX, LABELS, PREFIX, LabelError, Policy, parse_policy, shown

from avckpt.errors import LabelsWrong
from avckpt.guard import Again, Files, GuardConfig, Images, Tcp

REMAINS_S = {"off": 1.0, "mini": 5.0, "on": 30.0}
"""How long a dead application's memory is kept at most, by `avckpt.core`: to find out where it died, or to
write a core."""


@dataclass(frozen=True)
class Settings:
    """The effective settings of one container."""

    said: Mapping[str, str]
    """Label by label, as written; missing ones have the built-in default."""
    policy: Policy
    config: GuardConfig

    def text(self, key: str) -> str:
        """The setting of a label, as in a label; empty: there is none."""
        if key == "avckpt.interval" and not self.policy.automatic:
            return self.said.get(key, AUTOMATIC_MAX)
        return self.said.get(key, LABELS[key].default)

    @property
    def in_force(self) -> dict[str, str]:
        """Every setting without its prefix, as in a label; empty: there is none. Of commands only the
        program."""
        return {key[len(PREFIX) :]: shown(text) if (text := self.text(key)) else "" for key in LABELS}


@dataclass(frozen=True)
class Change:
    """A changed setting. Texts as in a label; empty: there is none."""

    setting: str
    """The label without its prefix."""
    before: str
    after: str

    def __str__(self) -> str:
        before, after = (shown(text) if text else "none" for text in (self.before, self.after))
        return f"{self.setting} {before} -> {after}"


@dataclass(frozen=True)
class Reloaded:
    """A container with new settings, or, with a `problem`, with its old ones."""

    container: str
    changes: tuple[Change, ...]
    problem: str = ""
    """Why the file does not apply to it; empty: it does."""

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


def guard_config(policy: Policy) -> GuardConfig:
    """The engine's part of a policy."""
    return GuardConfig(
        interval_s=policy.interval_s,
        interval_min_s=policy.interval_min_s if policy.automatic else 0.0,
        budget_freeze=policy.budget_freeze,
        budget_cpu=policy.budget_cpu,
        # One more for rollbacks from a hang, and one where the newest is only a moment old: see
        # docs/policy.md.
        keep=min(policy.keep + policy.restore_on.unhealthy + (policy.automatic or policy.keep_apart_s > 0), KEEP_MAX),
        apart_s=policy.keep_apart_s,
        restore_on_signal=policy.restore_on.signal,
        restore_on_exit=policy.restore_on.exit,
        restore_on_statuses=policy.restore_on.statuses,
        restore_max=policy.restore_max,
        restore_window_s=policy.restore_window_s,
        quiesce_s=policy.quiesce_s,
        shm_bytes=policy.shm_bytes,
        deadline_s=policy.deadline_s if policy.deadline_late == "cold" else 0.0,
        remains_s=REMAINS_S[policy.core],
        files=Files[policy.files.upper()],
        tcp=Tcp[policy.tcp.upper().replace("-", "_")],
        again=Again.of(policy.again),
        images=Images[policy.images.upper()],
        together=policy.together,
    )


def settings_of(labels: Mapping[str, str]) -> Settings:
    """The policy of a container's labels (or annotations). Raises LabelsWrong with one line for users."""
    try:
        policy = parse_policy(labels)
    except LabelError as error:
        raise LabelsWrong(str(error)) from error
    said = {key: value.strip() for key, value in labels.items() if key in LABELS}
    return Settings(said, policy, guard_config(policy))


def changes(before: Settings, after: Settings) -> list[Change]:
    """The differences, in alphabetical order; 3s and 3000ms are equal."""
    found = []
    for key in sorted(LABELS):
        texts = [settings.text(key) for settings in (before, after)]
        if texts[0] != texts[1] and _meaning(key, texts[0]) != _meaning(key, texts[1]):
            found.append(Change(key[len(PREFIX) :], texts[0], texts[1]))
    return found


def _meaning(key: str, text: str) -> object:
    return LABELS[key].parse(text) if text else None
