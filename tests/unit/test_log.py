# SPDX-License-Identifier: Apache-2.0
"""No container fills the sidecar's log."""

from __future__ import annotations

import logging

import pytest
from avckpt.events.log import AT_ONCE, Log


def test_who_has_too_much_to_say_is_cut_short_and_nobody_else(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="avckpt")
    log = Log()
    told = sum(log.tell(f"noisy/{i}" if i % 2 else "noisy", logging.INFO, f"line {i}") for i in range(2 * AT_ONCE))
    assert AT_ONCE <= told < AT_ONCE + 10
    assert len(caplog.messages) == told
    assert log.tell("quiet", logging.INFO, "is there")

    log.tell_what_is_left_out()
    log.tell_what_is_left_out()
    assert caplog.messages[told:] == [
        "quiet: is there",
        f"noisy: {2 * AT_ONCE - told} line(s) left out here; its events are in avckpt events",
    ]


def test_routine_takes_no_room() -> None:
    log = Log()
    assert all(log.tell("web", logging.DEBUG, "checkpoint") for _ in range(2 * AT_ONCE))
    assert log.tell("web", logging.INFO, "died")


def test_who_is_quiet_again_is_forgotten() -> None:
    log = Log()
    log.tell("web", logging.INFO, "died")
    (room,) = log._rooms.values()
    room.bucket.at_s -= 10
    log.tell_what_is_left_out()
    assert not log._rooms
