# SPDX-License-Identifier: Apache-2.0
"""Real programs under load: a few of the rounds that `make test-programs` makes 200 of."""

from __future__ import annotations

import pytest

from testkit.harness import Podman, Sidecar
from testkit.programs.registry import PROGRAMS, Missing, find
from testkit.programs.rounds import MODES, run

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "programs under load have time limits of their own"
)

ROUNDS = 4


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", [program.name for program in PROGRAMS])
def test_every_round_succeeds(sidecar: Sidecar, podman: Podman, name: str, mode: str) -> None:
    """Checkpoint, random wait, SIGKILL, restore: clients and the program's own check find nothing wrong."""
    try:
        outcome = run(find(name), mode, ROUNDS, podman, tell=print)
    except Missing as missing:
        pytest.skip(str(missing))
    assert outcome.failures == []
    assert outcome.successes == ROUNDS
