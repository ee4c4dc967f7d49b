# SPDX-License-Identifier: Apache-2.0
"""From a container's labels to what its guard is told."""

from __future__ import annotations

from collections.abc import Mapping

from avckpt_hooks.labels import KEEP_MAX, LabelError, Policy, parse_policy

from avckpt.errors import LabelsWrong
from avckpt.events import Files, GuardConfig, Tcp


def guard_config(policy: Policy) -> GuardConfig:
    """The part of a policy that is the engine's."""
    return GuardConfig(
        interval_s=policy.interval_s,
        # One more to go back to from a hang: see docs/policy.md.
        keep=min(policy.keep + policy.restore_on.unhealthy, KEEP_MAX),
        restore_on_signal=policy.restore_on.signal,
        restore_on_exit=policy.restore_on.exit,
        restore_on_statuses=policy.restore_on.statuses,
        restore_max=policy.restore_max,
        restore_window_s=policy.restore_window_s,
        quiesce_s=policy.quiesce_s,
        shm_bytes=policy.shm_bytes,
        files=Files[policy.files.upper()],
        tcp=Tcp[policy.tcp.upper().replace("-", "_")],
    )


def config_of_labels(labels: Mapping[str, str]) -> GuardConfig:
    """What the labels (or annotations) of a container say.  Raises LabelsWrong with one line for a person."""
    try:
        return guard_config(parse_policy(labels))
    except LabelError as error:
        raise LabelsWrong(str(error)) from error
