# SPDX-License-Identifier: Apache-2.0
"""A checkpoint is missed while there is nothing to go back to: the next is tried soon, however long the interval.

And ever less often, so that one of which none succeeds is hardly ever stopped.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from testkit.cgroups import Cgroup, freezer
from testkit.family import ours
from testkit.guarded import BUILD, PATIENCE_S, GuardProcess, Victim, config, injected
from testkit.harness import wait_until
from testkit.procfs import below

pytestmark = pytest.mark.shared_machine("a checkpoint that should succeed is missed where others take the CPU")

HOUR_S = 3600.0
USER = 2_000_000 + os.getpid()
"""The limit counts a user's tasks on all of the machine: those of another run of these tests must not be among them."""
SOMEBODY = f"/usr/bin/setpriv --reuid {USER} --regid {USER} --clear-groups --bounding-set -all --inh-caps -all"
PAUSE_S = 2.5
TRIES = 6
"""In PAUSE_S: at 0, 0.1, 0.2, 0.4, 0.8 and 1.6 s."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def somebody_runs() -> bool:
    return any(process.info["uids"].real == USER for process in psutil.process_iter(["uids"]) if process.info["uids"])


def missed(guard: GuardProcess) -> int:
    return sum(event.get("kind") == "missed" for event in guard.events)


@pytest.mark.parametrize("version", [1, 2])
def test_paused_before_its_first_one(version: int, tmp_path: Path) -> None:
    pause = freezer(version)
    with pause, Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(HOUR_S), [victim.pid]) as guard:
        guard.wait("attached")
        pause.take(victim.app)
        pause.wait()
        answer = guard.command("checkpoint")
        assert answer["kind"] == "missed"
        time.sleep(PAUSE_S)
        assert missed(guard) <= TRIES
        pause.go()
        guard.wait("checkpoint")
        victim.wait_beats(20)


def test_no_room_for_a_template_at_first() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # the victim is not root
        command = f"{SOMEBODY} /usr/bin/prlimit --nproc=4:64 {BUILD}/idle 0 4"
        with Victim(command, Path(folder)) as victim, GuardProcess(config(HOUR_S), [victim.pid]) as guard:
            guard.wait("attached")
            assert guard.command("checkpoint")["kind"] == "missed"
            time.sleep(PAUSE_S)
            assert 3 <= missed(guard) <= TRIES
            subprocess.run([*SOMEBODY.split(), "/usr/bin/prlimit", f"--pid={victim.app}", "--nproc=64:64"], check=True)
            guard.wait("checkpoint", timeout_s=2 * PAUSE_S)
        wait_until(lambda: not somebody_runs(), PATIENCE_S, "nobody is left who counts with the next ones")


def fails_late(guard: GuardProcess) -> bool:
    """Misses one because the main process's template is lost, if nothing else asks for a pidfd before that."""
    with injected(guard, "pidfd_open", "error=ESRCH:when=1"):
        answer = guard.command("checkpoint")
    return bool(answer.get("error", {}).get("operation") == "keep template")


def test_a_restore_after_one_that_failed_late(tmp_path: Path) -> None:
    """The other process's template has just been made by its holder, which is still in that call, clone(2)."""
    with Victim("idle 1 2 --in-child", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        wait_until(lambda: fails_late(guard), PATIENCE_S, "one that fails late")
        victim.kill_app()
        event = guard.wait_for(lambda event: event.get("kind") in ("restored", "gave_up"), "end of the restore")
        assert event["kind"] == "restored", event
        assert "error" not in event
        victim.wait_beats()


def holders(victim: Victim) -> int:
    return len(ours(victim, "avckpt-hold"))


def lacks_holders_after_a_restore(pause: Cgroup, victim: Victim, guard: GuardProcess, wanted: int) -> bool:
    """It is paused while its processes are given their new holders, one after the other, if that is soon enough."""
    since = guard.mark()
    victim.kill_app()
    guard.wait("restored", since=since)
    pause.wait()
    time.sleep(0.2)
    lacking = holders(victim) < wanted
    pause.go()
    return lacking


def test_holders_that_a_restore_could_not_make_are_made_soon(tmp_path: Path) -> None:
    """Until then another death loses what only the children have open, and the next checkpoint is an hour away."""
    with freezer(1) as pause, Victim("tree 12", tmp_path) as victim:
        for pid in (victim.pid, *below(victim.pid)):
            pause.take(pid)
        with GuardProcess(config(), [victim.pid]) as guard:
            guard.checkpoint()
            wanted = holders(victim)
            wait_until(
                lambda: lacks_holders_after_a_restore(pause, victim, guard, wanted),
                PATIENCE_S,
                "it is paused before all have their holders",
            )
            wait_until(lambda: holders(victim) == wanted, PATIENCE_S, "all have their holders")
            victim.wait_beats()
