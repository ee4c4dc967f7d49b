# SPDX-License-Identifier: Apache-2.0
"""Unix connections between processes of one application: what they have asked each other is rolled back with them."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until
from testkit.scenario import checkpoint

KILLS = 60 if os.environ.get("AVCKPT_LONG") == "1" else 12
CLIENTS = 4


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("command", ["stream", "record", "stream --again", "record --again"])
def test_every_question_has_its_answer(command: str, tmp_path: Path) -> None:
    """The server is killed at random moments; its clients, which go back with it, wait for no lost answer."""
    rng = random.Random(1)
    with Victim(f"callers {CLIENTS} {command}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        app = guard.wait("attached")["app_pid"]
        for _ in range(KILLS):
            checkpoint(guard)
            time.sleep(rng.uniform(0, 0.05))
            since = guard.mark()
            os.kill(app, signal.SIGKILL)
            app = guard.wait("restored", since=since)["app_pid"]
            before = victim.see().counter

            def all_go_on(before: tuple[int, ...] = before) -> bool:
                seen = victim.see()
                assert not seen.violations, victim.said
                return all(seen.counter[i] > before[i] + 20 for i in range(CLIENTS))

            wait_until(all_go_on, PATIENCE_S, "every client has answers")
