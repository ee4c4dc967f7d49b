# SPDX-License-Identifier: Apache-2.0
"""Processes with descriptors inherited from their parent."""

from __future__ import annotations

import shutil
import signal
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from testkit.guarded import GuardProcess, Victim, config, kill_at_random
from testkit.harness import SLOWNESS, wait_until
from testkit.scenario import disturb, restored


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("size", ["3/20", "44/400"])
def test_what_children_have_from_their_parents(size: str, tmp_path: Path) -> None:
    """The same open files under the same numbers, except for their own; more than a guard may have open."""
    with (
        Victim(f"heirs {size} {tmp_path}", tmp_path) as victim,
        GuardProcess(config(freeze_deadline_s=1.0 * SLOWNESS), [victim.pid]) as guard,
    ):
        for _ in range(2):
            guard.wait("attached")
            # New threads of so many processes may be slow to come home from their parasites.
            wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 60 * SLOWNESS, "a checkpoint")
            for _kill in range(2):
                disturb(victim)
                event = restored(victim, guard)
                assert "error" not in event, event


def test_what_a_set_watches_is_registered_again_by_one_of_them(tmp_path: Path) -> None:
    """All have it, and would remove and add the same at the same time."""
    with Victim("crowd watched 4 500", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(6):
            assert guard.checkpoint()["kind"] == "checkpoint"
            event = restored(victim, guard, looks=False)
            assert "error" not in event, event
            victim.wait_beats()


@pytest.mark.parametrize("kind", ["kept", "twins", "saved", "for-good"])
def test_others_in_their_places(kind: str, tmp_path: Path) -> None:
    """A child replaces a file and the parent puts it back, also between the stages of a checkpoint."""
    with Victim(f"redirect {kind}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 12, (0.01, 0.12))


def counted_checkpoint(guard: GuardProcess, summary: Path) -> bool:
    """Takes one while strace counts; false: it was missed."""
    status = Path(f"/proc/{guard.pid}/status")
    command = ["strace", "-f", "-c", "-qq", "-o", str(summary), "-p", str(guard.pid)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as strace:
        traced = f"TracerPid:\t{strace.pid}\n"
        wait_until(lambda: traced in status.read_text(), 10 * SLOWNESS, "strace traces it", 0.001)
        answer = guard.command("checkpoint")
        strace.send_signal(signal.SIGINT)
    return bool(answer["kind"] == "checkpoint")


def calls_of_a_checkpoint(victim: Victim, folder: Path) -> Counter[str]:
    """How often a guard makes each system call for one that is not its first."""
    summary = folder / f"{victim.board.path.name}.calls"
    with GuardProcess(config(freeze_deadline_s=5.0 * SLOWNESS), [victim.pid]) as guard:
        for _ in range(2):
            wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 60 * SLOWNESS, "a checkpoint")
        wait_until(lambda: counted_checkpoint(guard, summary), 60 * SLOWNESS, "one that is counted")
    lines = [line.split() for line in summary.read_text().splitlines()[2:-2]]
    return Counter({line[-1]: int(line[3]) for line in lines})


@pytest.mark.skipif(not shutil.which("strace"), reason="strace is what counts; it is not installed")
def test_what_children_share_is_compared_once(tmp_path: Path) -> None:
    """By kcmp(2), after the freeze, and not also in the look before it."""
    children, pairs = 8, 100
    with Victim(f"heirs {children}/{pairs} {tmp_path}", tmp_path) as victim:
        calls = calls_of_a_checkpoint(victim, tmp_path)
    shared = (children + 1) * 2 * pairs  # one of them has a child, too
    # strace makes everything slow, so that it may take four tries, of which three do not get that far.
    assert shared / 2 < calls["kcmp"] < 1.8 * shared
