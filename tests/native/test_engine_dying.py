# SPDX-License-Identifier: Apache-2.0
"""An image is never of a process that is already dying: one crash costs one restore."""

from __future__ import annotations

from pathlib import Path

import pytest
from avckpt.guard import Files

from testkit.guarded import PATIENCE_S, WHERE, GuardProcess, Victim, config
from testkit.harness import wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "which of two comes first, a death or a checkpoint, is the scheduler's choice"
)

CRASHES = 3
SIGNALS = ("segv", "bus", "fpe", "ill", "abrt", "trap", "sys")
STYLES = ("plain", "full", "open", "python", "sysv", "breakpad", "exit")


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def crash_often(tmp_path: Path, options: str) -> None:
    """While checkpoints are taken as often as possible."""
    with (
        Victim(f"reporter {options}", tmp_path) as victim,
        GuardProcess(config(0.01, keep=3, files=Files.AUTO), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=3)
        since = guard.mark()
        for crash in range(1, CRASHES + 1):
            # Right after one, so that the next finds it in the handler: an image of the moment before
            # the crash, which it has been decided on, is good, and crashes again.
            guard.wait("checkpoint", since=guard.mark(), count=2)
            victim.board.set_counter(0, crash)
            guard.wait("restored", since=since, count=crash)
            victim.wait_beats(3)
        seen = victim.see()
        assert seen.counter[1:3] == (CRASHES, CRASHES), "crashes, and reports of them"
        assert sum(event.get("kind") == "restored" for event in guard.events) == CRASHES


@pytest.mark.parametrize("style", STYLES)
def test_styles(tmp_path: Path, style: str) -> None:
    """Handlers as the usual crash reporters install them."""
    crash_often(tmp_path, f"segv {style}")


@pytest.mark.parametrize("style", STYLES)
def test_styles_in_another_thread(tmp_path: Path, style: str) -> None:
    """The main thread is blocked and is not in the handler."""
    crash_often(tmp_path, f"abrt {style} --in-thread")


@pytest.mark.parametrize("name", SIGNALS)
def test_signals(tmp_path: Path, name: str) -> None:
    """Every signal that means a crash."""
    crash_often(tmp_path, f"{name} plain")


@pytest.mark.parametrize("style", ["plain", "open"])
def test_a_child(tmp_path: Path, style: str) -> None:
    """No image is taken of a tree of which one process is dying; the parent then ends as the child did."""
    crash_often(tmp_path, f"segv {style} --in-child")


def test_a_report_over_the_last_one_is_no_database(tmp_path: Path) -> None:
    """Every crash writes its report over the same file, which a checkpoint that is not taken sees open."""
    crash_often(tmp_path, f"segv full --into {tmp_path}/report.log")


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("name", ["segv", "bus", "fpe", "ill"])
def test_the_handler_is_left_for_good(tmp_path: Path, name: str, where: str) -> None:
    """As a Go panic does, which makes its report after it has left the handler of the fault."""
    crash_often(tmp_path, f"{name} leave --report-ms 60 {where}".strip())


@pytest.mark.parametrize("where", WHERE)
def test_faults_that_are_mended(tmp_path: Path, where: str) -> None:
    """A program that handles faults as part of its normal work is protected like any other."""
    with (
        Victim(f"reporter segv mend {where}".strip(), tmp_path) as victim,
        GuardProcess(config(0.01), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=100)
        missed = [event for event in guard.events if event.get("kind") == "missed"]
        assert len(missed) < 10, missed[:3]
        reports = victim.see().counter[2]
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        wait_until(lambda: victim.see().counter[2] > reports + 50, PATIENCE_S, "more faults")
        victim.check()
