# SPDX-License-Identifier: Apache-2.0
"""What guards with avckpt.interval=auto may use of the CPUs together."""

from __future__ import annotations

import dataclasses

import pytest
from avckpt.budget import ACTIVE_S, CpuBudget, most_each
from avckpt.events.vocabulary import Kind
from avckpt.guard import Event
from avckpt.policy import settings_of

AUTO = settings_of({"avckpt.enable": "true", "avckpt.interval": "auto"}).config
FIXED = settings_of({"avckpt.enable": "true", "avckpt.interval": "3s"}).config
OWN = AUTO.budget_cpu


def report(cookie: int, checkpoints: int, interval_s: float) -> Event:
    return dataclasses.replace(Event(Kind.CHECKPOINT, cookie=cookie), checkpoints=checkpoints, interval_s=interval_s)


@pytest.mark.parametrize(
    ("needs", "most"),
    [
        ([], float("inf")),
        ([0.05] * 5, float("inf")),
        ([0.05] * 20, 0.0125),
        ([0.001] * 50 + [0.15] * 2, 0.1),  # what the fifty leave
        ([0.5], 0.25),
    ],
)
def test_all_stay_within_the_total_and_none_needs_what_is_left(needs: list[float], most: float) -> None:
    assert most_each(needs, 0.25) == pytest.approx(most)
    assert sum(min(need, most) for need in needs) <= 0.2501


def test_those_that_always_take_checkpoints_share_equally() -> None:
    budget = CpuBudget(total=0.25)
    for second in range(4):
        shares = [budget.share(n, AUTO, 100.0 + second, report(n, 10, 0.1)) for n in range(100)]
    assert shares == [pytest.approx(0.0025)] * 100


def test_those_that_take_few_leave_the_rest_to_the_busy() -> None:
    """A hundred with a checkpoint of 1 ms every 3 s, beside one with ten a second."""
    budget = CpuBudget(total=0.25)
    shares = dict.fromkeys(range(101), OWN)
    for second in range(0, 12, 3):
        for n in range(100):
            shares[n] = budget.share(n, AUTO, 100.0 + second, report(n, 1, 0.001 / shares[n]))
        for more in range(3):
            shares[100] = budget.share(100, AUTO, 100.0 + second + more, report(100, 10, 0.1))
    assert shares[100] == OWN


def test_what_is_idle_or_has_a_fixed_interval_takes_no_share() -> None:
    budget = CpuBudget(total=0.05)
    for cookie in range(10):
        budget.share(cookie, AUTO, 100.0)
    assert [budget.share(20 + n, FIXED, 100.0) for n in range(10)] == [FIXED.budget_cpu] * 10
    assert budget.share(0, AUTO, 101.0) == pytest.approx(0.005)
    assert budget.share(0, AUTO, 100.5 + ACTIVE_S) == pytest.approx(0.05)
