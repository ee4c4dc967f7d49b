# SPDX-License-Identifier: Apache-2.0
"""The event record: made from a guard's events, and unchanged by a round trip through JSON."""

from __future__ import annotations

import json
import signal
from dataclasses import fields, replace

import pytest
from avckpt.errors import DeadlineMissed, KernelError, NothingToRestore
from avckpt.events.record import EventRecord, of_guard
from avckpt.events.vocabulary import GAVE_UP_WORDS, Kind, Reason
from avckpt.guard import Event

RESTORED = Event(
    Kind.RESTORED,
    7,
    reason=Reason.SIGNAL,
    at_ns=5_000_000_000,
    app_pid=4711,
    app_pid_inside=2,
    wait_status=signal.SIGSEGV | 0x80,
    threads=21,
    generation=4,
    generations=2,
    attempt=1,
    restores=3,
    freeze_s=0.0025,
    restore_s=0.006,
    age_s=1.5,
)


def test_a_restore_has_everything_that_is_asked_of_it() -> None:
    record = of_guard(RESTORED, container="web", id="ab" * 32, group="chain", at=1000.0)
    assert record == EventRecord(
        Kind.RESTORED,
        container="web",
        id="ab" * 32,
        group="chain",
        at=1000.0,
        monotonic_s=5.0,
        reason=Reason.SIGNAL,
        outcome=Reason.RESTORED,
        wait_status=signal.SIGSEGV | 0x80,
        generation=4,
        generations=2,
        age_s=1.5,
        lost_s=1.506,
        freeze_s=0.0025,
        restore_s=0.006,
        threads=21,
        attempt=1,
        restores=3,
        app_pid=4711,
        app_pid_inside=2,
    )


@pytest.mark.parametrize("kind", list(Kind))
def test_through_json_and_back(kind: Kind) -> None:
    record = EventRecord(
        kind,
        container="wéb",
        id="ab" * 32,
        at=1.25,
        seq=12,
        reason=Reason.EXIT,
        outcome=Reason.FAILED,
        wait_status=3 << 8,
        generation=4,
        age_s=1.5,
        freeze_s=0.0,
        quiescent=False,
        detail="a clause",
        error=KernelError("the PID was taken", operation="restore", syscall="clone", errno=11, pid=4),
    )
    data = json.loads(json.dumps(record.to_json()))
    assert data["message"]
    back = EventRecord.from_json(data)
    for each in fields(EventRecord):
        if each.name != "error":
            assert getattr(back, each.name) == getattr(record, each.name), each.name
    assert isinstance(back.error, KernelError)
    assert back.error.to_json() == data["error"]


def test_what_means_nothing_is_left_out_and_zero_is_not_nothing() -> None:
    data = EventRecord(Kind.CHECKPOINT, freeze_s=0.0, quiescent=False).to_json()
    assert "restore_s" not in data
    assert "error" not in data
    assert (data["freeze_s"], data["quiescent"]) == (0.0, False)


def test_a_newer_release_may_say_more() -> None:
    assert EventRecord.from_json({"kind": "died", "novelty": [1]}) == EventRecord(Kind.DIED)


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"kind": "novelty"},
        {"kind": "died", "at": "noon"},
        {"kind": "died", "seq": True},
        {"kind": "died", "error": 1},
    ],
)
def test_what_is_no_event_is_refused(data: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        EventRecord.from_json(data)


@pytest.mark.parametrize(
    ("wait_status", "reason", "commanded", "cause"),
    [
        (signal.SIGKILL, Reason.SIGNAL, None, Reason.SIGNAL),
        (3 << 8, Reason.EXIT, None, Reason.EXIT),
        (signal.SIGKILL, Reason.COMMAND, None, Reason.COMMAND),
        (signal.SIGKILL, Reason.COMMAND, Reason.COMMAND, Reason.COMMAND),
        (signal.SIGKILL, Reason.COMMAND, Reason.UNHEALTHY, Reason.UNHEALTHY),
    ],
)
def test_why_it_died(wait_status: int, reason: Reason, commanded: Reason | None, cause: Reason) -> None:
    event = Event(Kind.RESTORED, 1, reason=reason, wait_status=wait_status)
    assert of_guard(event, commanded=commanded).reason is cause


@pytest.mark.parametrize("reason", list(GAVE_UP_WORDS))
def test_every_way_to_give_up_is_an_outcome_of_that_name(reason: Reason) -> None:
    record = of_guard(Event(Kind.GAVE_UP, 1, reason=reason, wait_status=9))
    assert record.outcome is not None
    assert record.outcome.name == reason.name
    assert record.reason is Reason.SIGNAL


def test_messages() -> None:
    unhealthy = of_guard(RESTORED, commanded=Reason.UNHEALTHY)
    assert unhealthy.message.startswith("unhealthy, rolled back, restored in 6.0 ms from generation 4 (1.5 s old)")
    again = replace(RESTORED, again="drop-input,stagger", input_dropped=2)
    assert of_guard(again).message.endswith("restore 3, with drop-input (of 2 descriptor(s)), stagger")
    nothing = Event(Kind.GAVE_UP, 1, reason=Reason.EMPTY, wait_status=9, error=NothingToRestore("none"))
    assert of_guard(nothing).message == "not restored (killed by SIGKILL): no checkpoint was held"
    missed = of_guard(Event(Kind.MISSED, 1, generations=2, freeze_s=0.05, error=DeadlineMissed("too slow")))
    assert (missed.message, missed.freeze_s) == ("checkpoint missed: too slow", 0.05)
