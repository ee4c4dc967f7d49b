# SPDX-License-Identifier: Apache-2.0
"""Calls that wait until all is written, or received: a checkpoint does not cut them short."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config, kill_at_random

pytestmark = pytest.mark.skipif(os.uname().machine != "x86_64", reason="elsewhere they are cut short")

GUARDS = 40
KINDS = ("", "--unix", "--tcp", "--unix --send", "--tcp --send", "--unix --receive", "--tcp --receive")
"""Of calls: write(2) into a pipe or a socket, send(2), recv(2) with MSG_WAITALL."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("kind", KINDS)
def test_no_call_is_cut_short(kind: str, where: str, tmp_path: Path) -> None:
    """It waits at nearly every checkpoint, and all registers are what they were."""
    with Victim(f"lengthy {kind} {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        victim.wait_beats()
        for _ in range(100):
            guard.checkpoint()
        victim.wait_beats()
        assert victim.see().counter[1] == 0


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    "kind",
    ["", "--hang-up", "--unix", "--unix --send", "--unix --receive", "--unix --receive --hang-up"],
)
def test_every_byte_once(kind: str, where: str, tmp_path: Path) -> None:
    """Of calls that were waiting at the checkpoint, and went on in the running application; the other end may be
    closed."""
    with Victim(f"lengthy {kind} {where}", tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        kill_at_random(guard, victim, 12, (0.01, 0.12))


@pytest.mark.parametrize("kind", KINDS)
def test_a_signal_ends_a_call(kind: str, tmp_path: Path) -> None:
    """Whenever it comes; nothing else does."""
    with Victim(f"lengthy --alarm {kind}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(100):
            guard.checkpoint()
        victim.wait_beats()
        assert victim.see().counter[2] > 20
        assert victim.see().counter[1] == 0


@pytest.mark.shared_machine("the timeout of a call is compared with the clock")
@pytest.mark.parametrize("kind", ["--unix", "--tcp"])
def test_its_timeout_ends_a_call(kind: str, tmp_path: Path) -> None:
    """With what has come until then."""
    command = f"lengthy --stall --receive {kind}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        guard.wait("checkpoint", count=5)
        victim.wait_beats(10)


@pytest.mark.parametrize("kind", KINDS)
def test_guards_die(kind: str, tmp_path: Path) -> None:
    """The call goes on without one, and with the next; its parasite stays as long as it is needed.  It is cut if
    a guard dies in the moment between stopping the thread and setting its registers."""
    rng = random.Random(3)
    with Victim(f"lengthy {kind}", tmp_path) as victim, GuardProcess(config(0.005), [victim.pid]) as guard:
        for _ in range(GUARDS):
            time.sleep(rng.uniform(0, 0.06))
            guard.start_another(victim.pid)
        victim.wait_beats()
        assert victim.see().counter[1] < GUARDS / 2


@pytest.mark.parametrize("kind", ["--unix", "--tcp --receive"])
def test_under_a_filter_that_looks_at_arguments(kind: str, tmp_path: Path) -> None:
    """It could kill for a call that goes on: such a call is cut short, as by any other stop."""
    with Victim(f"under exacting lengthy {kind}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(50):
            assert guard.checkpoint()["kind"] == "checkpoint"
        victim.wait_beats()
