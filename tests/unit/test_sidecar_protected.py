# SPDX-License-Identifier: Apache-2.0
"""The state of a container, from the events of its guard."""

from __future__ import annotations

import dataclasses
import signal

import pytest
from avckpt.containers.protected import Protected, State
from avckpt.errors import DeadlineMissed, NothingToRestore, Unsupported
from avckpt.events.vocabulary import Kind, Reason, describe_wait_status, signal_name
from avckpt.guard import Event, GuardConfig

CONFIG = GuardConfig(
    interval_s=3.0,
    keep=2,
    restore_on_signal=True,
    restore_on_exit=True,
    restore_on_statuses=frozenset(),
    restore_max=5,
    restore_window_s=60.0,
    quiesce_s=0.02,
)
S = 1_000_000_000
ATTACHED = Event(Kind.ATTACHED, 1, app_pid=4711, app_pid_inside=2)
CHECKPOINT = Event(
    Kind.CHECKPOINT,
    1,
    app_pid=4711,
    app_pid_inside=2,
    threads=21,
    generation=1,
    generations=1,
    freeze_s=0.0025,
    quiescent=True,
)
MISSED = Event(Kind.MISSED, 1, generations=1, error=DeadlineMissed("thread 4712 did not stop", pid=4712))
UNPROTECTED = Event(Kind.UNPROTECTED, 1, error=Unsupported("it has an io_uring"))
DIED = Event(Kind.DIED, 1, wait_status=signal.SIGKILL, reason=Reason.SIGNAL)
RESTORED = Event(
    Kind.RESTORED,
    1,
    wait_status=signal.SIGKILL,
    reason=Reason.SIGNAL,
    threads=21,
    generation=1,
    generations=1,
    restores=1,
    restore_s=0.006,
    age_s=1.5,
)
GAVE_UP = Event(Kind.GAVE_UP, 1, wait_status=3 << 8, reason=Reason.POLICY)


def protected(*events: Event) -> Protected:
    container = Protected(id="ab" * 32, name="web", cookie=1, init_pid=4710, config=CONFIG, registered_at=1000.0)
    for number, event in enumerate(events):
        container.apply(event, 1001.0 + number)
    return container


@pytest.mark.parametrize(
    ("events", "state"),
    [
        ([], State.STARTING),
        ([ATTACHED], State.STARTING),
        ([ATTACHED, CHECKPOINT], State.PROTECTED),
        ([ATTACHED, MISSED], State.STARTING),
        ([ATTACHED, CHECKPOINT, MISSED], State.PROTECTED),
        ([ATTACHED, UNPROTECTED], State.UNPROTECTED),
        ([ATTACHED, UNPROTECTED, MISSED], State.UNPROTECTED),
        ([ATTACHED, UNPROTECTED, CHECKPOINT], State.PROTECTED),
        ([ATTACHED, CHECKPOINT, DIED], State.RESTORING),
        ([ATTACHED, CHECKPOINT, DIED, RESTORED], State.PROTECTED),
        ([ATTACHED, CHECKPOINT, DIED, GAVE_UP], State.ENDED),
    ],
)
def test_state_follows_events(events: list[Event], state: State) -> None:
    assert protected(*events).state is state


def test_a_checkpoint_is_remembered() -> None:
    container = protected(ATTACHED, CHECKPOINT)
    assert (container.app_pid, container.app_pid_inside, container.threads) == (4711, 2, 21)
    assert (container.generation, container.generations, container.checkpoints) == (1, 1, 1)
    assert (container.last_checkpoint_at, container.last_freeze_s, container.last_quiescent) == (1002.0, 0.0025, True)
    assert container.reason == ""


def test_a_missed_checkpoint_is_counted_and_keeps_what_is_held() -> None:
    container = protected(ATTACHED, CHECKPOINT, MISSED)
    assert (container.missed, container.generations) == (1, 1)
    assert "thread 4712 did not stop" in container.reason
    container.apply(CHECKPOINT, 1010.0)
    assert container.reason == ""


def test_a_missed_checkpoint_that_cost_what_was_held_leaves_it_unprotected() -> None:
    container = protected(ATTACHED, CHECKPOINT, dataclasses.replace(MISSED, generations=0))
    assert (container.state, container.generations) == (State.UNPROTECTED, 0)
    assert "thread 4712 did not stop" in container.reason
    container.apply(CHECKPOINT, 1010.0)
    assert (container.state, container.reason) == (State.PROTECTED, "")


def test_unprotected_gives_up_what_was_held_and_says_why() -> None:
    container = protected(ATTACHED, CHECKPOINT, UNPROTECTED)
    assert container.generations == 0
    assert "io_uring" in container.reason


def test_a_restore_is_remembered() -> None:
    container = protected(ATTACHED, CHECKPOINT, DIED, RESTORED)
    assert container.restores == 1
    assert container.last_death == "killed by SIGKILL"
    assert container.last_death_at == 1003.0
    assert (container.last_restore_s, container.last_restore_age_s) == (0.006, 1.5)


def test_what_keeps_crashing_is_said_whatever_the_time_of_day() -> None:
    """The clock is set from 1970 to now between a crash and the next checkpoint."""
    died = Event(Kind.DIED, 1, at_ns=100 * S, wait_status=signal.SIGKILL)
    restored = Event(Kind.RESTORED, 1, at_ns=100 * S, attempt=2, generations=1)
    container = protected(ATTACHED, CHECKPOINT, died, restored)
    container.apply(Event(Kind.CHECKPOINT, 1, at_ns=101 * S), 1.8e9)
    assert container.reason == "keeps crashing: restore 2 of 5 within 60 s"
    container.apply(Event(Kind.CHECKPOINT, 1, at_ns=161 * S), 1.8e9)
    assert container.reason == ""


def test_the_end_says_how_it_ended() -> None:
    container = protected(ATTACHED, CHECKPOINT, DIED, GAVE_UP)
    container.end(2000.0)
    assert container.reason == "exited with status 3; avckpt.restore.on does not name this end"
    assert container.ended_at == 2000.0
    assert container.generations == 0


def test_an_end_with_nothing_held_says_so_once() -> None:
    nothing = NothingToRestore("no generation is held", operation="restore")
    container = protected(ATTACHED, DIED, Event(Kind.GAVE_UP, 1, wait_status=9, reason=Reason.EMPTY, error=nothing))
    assert container.reason == "killed by SIGKILL; no checkpoint was held"


def test_an_end_without_a_word_is_a_stop() -> None:
    container = protected(ATTACHED, CHECKPOINT)
    container.end(2000.0)
    assert container.state is State.ENDED
    assert container.reason == "the container was stopped or killed"


@pytest.mark.parametrize("events", [(), (ATTACHED,)])
def test_an_end_before_the_first_checkpoint_may_be_any(events: tuple[Event, ...]) -> None:
    """A command that takes a moment has exited by itself, before its guard was there."""
    container = protected(*events)
    container.end(2000.0)
    assert container.reason == "the container has ended, no guard saw how"


def test_json_names_every_field_that_the_api_promises() -> None:
    data = protected(ATTACHED, CHECKPOINT, DIED, RESTORED).to_json()
    assert data["state"] == "protected"
    assert data["interval_s"] == 3.0
    assert data["last_restore_s"] == 0.006
    assert {"id", "name", "reason", "generations", "restores", "last_freeze_s", "last_death"} <= set(data)


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (signal.SIGSEGV, "killed by SIGSEGV"),
        (signal.SIGSEGV | 0x80, "killed by SIGSEGV"),
        (7 << 8, "exited with status 7"),
        (0, "exited with status 0"),
    ],
)
def test_wait_status_in_words(status: int, words: str) -> None:
    assert describe_wait_status(status) == words


def test_signals_without_a_name() -> None:
    assert signal_name(signal.SIGRTMIN + 3) == "SIGRTMIN+3"
    assert signal_name(33) == "signal 33"
