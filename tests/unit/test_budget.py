# SPDX-License-Identifier: Apache-2.0
"""What guards with avckpt.interval=auto may use of the CPUs together."""

from __future__ import annotations

import pytest
from avckpt.budget import ACTIVE_S, CpuBudget, share_of
from avckpt.policy import settings_of

AUTO = settings_of({"avckpt.enable": "true", "avckpt.interval": "auto"}).config
FIXED = settings_of({"avckpt.enable": "true", "avckpt.interval": "3s"}).config


@pytest.mark.parametrize(
    ("own", "active", "share"),
    [(0.05, 0, 0.05), (0.05, 1, 0.05), (0.05, 5, 0.05), (0.05, 20, 0.0125), (0.01, 20, 0.01), (0.5, 1, 0.25)],
)
def test_a_share_is_the_label_s_or_an_equal_part(own: float, active: int, share: float) -> None:
    assert share_of(own, 0.25, active) == pytest.approx(share)


def test_those_that_take_checkpoints_share_and_never_take_more_than_the_total() -> None:
    budget = CpuBudget(total=0.25)
    for _ in range(2):
        shares = [budget.share(cookie, AUTO, 100.0) for cookie in range(100)]
    assert sum(shares) == pytest.approx(0.25)


def test_what_is_idle_or_has_a_fixed_interval_takes_no_share() -> None:
    budget = CpuBudget(total=0.05)
    for cookie in range(10):
        budget.share(cookie, AUTO, 100.0)
    assert [budget.share(20 + n, FIXED, 100.0) for n in range(10)] == [FIXED.budget_cpu] * 10
    assert budget.share(0, AUTO, 101.0) == pytest.approx(0.005)
    assert budget.share(0, AUTO, 100.5 + ACTIVE_S) == pytest.approx(0.05)
