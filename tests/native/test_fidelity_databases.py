# SPDX-License-Identifier: Apache-2.0
"""avckpt.files=auto: memory goes back beside a log, and not behind a database."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest
from avckpt.guard import Files

from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import wait_until
from testkit.scenario import checkpoint

IN_PLACE = "was written in place since the checkpoint"
DELETED = "was deleted since the checkpoint"


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def write(victim: Victim) -> None:
    """Has it write; waits, since what was written within one tick before a checkpoint counts as written after it."""
    done = victim.see().counter[0]
    victim.kill_app(signal.SIGUSR1)
    wait_until(lambda: victim.see().counter[0] > done, 10, "it has written")


@pytest.mark.parametrize("how", ["append", "output", "recording", "rotate", "read", "status", "replace", "pulse"])
def test_goes_back_beside_files_that_are_only_written_on(how: str, tmp_path: Path) -> None:
    with (
        Victim(f"ledger {how} {tmp_path}", tmp_path) as victim,
        GuardProcess(config(files=Files.AUTO), [victim.pid]) as guard,
    ):
        time.sleep(0.05)
        checkpoint(guard)
        write(victim)
        victim.kill_app()
        guard.wait("restored")
        victim.wait_beats()


def test_goes_back_again_and_again_beside_output(tmp_path: Path) -> None:
    """It has written more to its log since than the checkpoint knows of."""
    with (
        Victim(f"ledger output {tmp_path}", tmp_path) as victim,
        GuardProcess(config(files=Files.AUTO), [victim.pid]) as guard,
    ):
        for n in range(1, 4):
            checkpoint(guard)
            write(victim)
            write(victim)
            victim.kill_app()
            guard.wait("restored", count=n)
            victim.wait_beats()


@pytest.mark.parametrize(
    ("how", "why"),
    [
        *((how, IN_PLACE) for how in ("in-place", "at-end", "extend", "close", "locked", "mapped", "worker")),
        ("temporary", DELETED),
        ("scratch", DELETED),
        ("named", DELETED),
    ],
)
def test_starts_cold_behind_a_database(how: str, why: str, memory: Path, tmp_path: Path) -> None:
    with (
        Victim(f"ledger {how} {memory if how == 'named' else tmp_path}", tmp_path) as victim,
        GuardProcess(config(files=Files.AUTO), [victim.pid]) as guard,
    ):
        time.sleep(0.05)
        # The older of two knows as little of it as the newer.
        checkpoint(guard)
        checkpoint(guard)
        if how != "mapped":  # a page that is dirty may be written without a sign
            victim.kill_app()
            guard.wait("restored")
            victim.wait_beats()
        write(victim)
        since = guard.mark()
        answer = guard.command("restore")
        assert answer["kind"] == "refused", answer
        assert why in str(answer["error"])
        assert victim.popen.poll() is None
        victim.kill_app()
        gave_up = guard.wait("gave_up", since=since)
        assert "avckpt.files=auto" in str(gave_up["error"])
        assert why in str(gave_up["error"])
        assert victim.end() == 128 + signal.SIGKILL


def test_goes_back_to_shared_memory_that_had_no_name_any_more(memory: Path, tmp_path: Path) -> None:
    with (
        Victim(f"ledger named {memory}", tmp_path) as victim,
        GuardProcess(config(files=Files.AUTO), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        write(victim)
        checkpoint(guard)
        victim.kill_app()
        guard.wait("restored")
        victim.wait_beats()


def test_goes_back_behind_a_database_if_it_is_told_to(tmp_path: Path) -> None:
    with (
        Victim(f"ledger in-place {tmp_path}", tmp_path) as victim,
        GuardProcess(config(files=Files.REWIND), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        write(victim)
        victim.kill_app()
        guard.wait("restored")
        victim.wait_beats()
