# SPDX-License-Identifier: Apache-2.0
"""Nobody is outside of the Landlock domain that it was in: what cannot be put back into its own is not protected."""

from __future__ import annotations

import signal
from functools import partial
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until

ASKED_AGAIN = 10
"""Checkpoints within which every thread is asked."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("whole", ["", "--whole "])
@pytest.mark.parametrize("who", ["--in-child", "--in-thread", "--in-thread --in-child"])
def test_a_domain_of_its_own_is_refused(who: str, whole: str, tmp_path: Path) -> None:
    with Victim(f"fenced {whole}{who} 1", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        guard.wait("checkpoint", count=ASKED_AGAIN)
        since = guard.mark()
        victim.kill_app(signal.SIGUSR1)
        told = guard.wait("unprotected", since=since)
        assert "a Landlock domain of its own" in told["error"]["message"]
        wait_until(lambda: victim.others() == [], 5, "nothing is left in the container", every_s=0.001)
        victim.wait_beats(20)
        victim.kill_app()
        assert victim.end() == 128 + signal.SIGKILL


@pytest.mark.parametrize("who", ["--in-child", "--in-thread", "--in-thread --in-child", ""])
def test_one_that_all_are_in_is_no_hindrance(who: str, tmp_path: Path) -> None:
    with Victim(f"fenced --whole {who} 1", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        for _ in range(3):
            guard.wait("checkpoint", since=guard.mark(), count=ASKED_AGAIN)
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats(5)
        assert not [event for event in guard.events if event["kind"] == "unprotected"]


def test_one_that_the_main_thread_enters_later(tmp_path: Path) -> None:
    """Its holder, which is not in that domain, is made again, and nobody is refused for it."""
    with Victim("fenced 1", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        for domains in range(1, 3):
            guard.wait("checkpoint", since=guard.mark(), count=ASKED_AGAIN)
            victim.kill_app(signal.SIGUSR1)
            wait_until(partial(lambda n: victim.see().counter[0] == n, domains), PATIENCE_S, "it is in that domain")
            guard.wait("checkpoint", since=guard.mark(), count=ASKED_AGAIN)
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats(5)
            assert victim.see().counter[0] == domains
        assert not [event for event in guard.events if event["kind"] == "unprotected"]
