# SPDX-License-Identifier: Apache-2.0
"""A process's IDs in its user namespace."""

from __future__ import annotations

import pytest
from avckpt.supervision.inside import _inside

MAP = "         0     100000       1000\n      1000     300000          9\n"


@pytest.mark.parametrize(
    ("ours", "inside"),
    [(100000, 0), (100999, 999), (101000, None), (300008, 1008), (300009, None), (0, None), (65534, None)],
)
def test_a_number_in_another_user_namespace(ours: int, inside: int | None) -> None:
    assert _inside(ours, MAP) == inside


def test_a_number_in_our_own() -> None:
    everything = "         0          0 4294967295\n"
    assert [_inside(number, everything) for number in (0, 1000, 4294967294)] == [0, 1000, 4294967294]
