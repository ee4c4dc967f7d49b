# SPDX-License-Identifier: Apache-2.0
"""Pending events of epoll, inotify and timers, and owners of locks, after a restore."""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config
from testkit.scenario import KILLS, checkpoint, disturb, disturb_and_restore, restored


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("how", ["numbers", "numbers-closed", "numbers-left"])
def test_what_is_watched_under_a_closed_number(how: str, where: str, tmp_path: Path) -> None:
    """epoll keeps watching a description after its number is closed; several may have had the same number."""
    with (
        Victim(f"events {how} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("what", ["timers", "periods", "owner"])
def test_timers_and_locks(what: str, where: str, tmp_path: Path) -> None:
    """fdinfo shows the same timer settings; F_GETLK and fdinfo name the process that holds a lock."""
    with (
        Victim(f"events {what} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


def test_events_of_a_watch_that_is_gone(tmp_path: Path) -> None:
    """They were unread at the checkpoint and still are."""
    with (
        Victim(f"events unread {tmp_path}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        for _ in range(3):
            checkpoint(guard)
            disturb(victim)
            event = restored(victim, guard)
            assert "error" not in event, event


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("how", ["unread-read", "unread-closed"])
def test_lost_events_are_told_of(how: str, where: str, tmp_path: Path) -> None:
    """A reader that would wait for them gets IN_Q_OVERFLOW."""
    with (
        Victim(f"events {how} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        for _ in range(KILLS):
            disturb(victim)
            assert "IN_Q_OVERFLOW" in restored(victim, guard)["error"]["detail"]
