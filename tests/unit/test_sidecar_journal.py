# SPDX-License-Identifier: Apache-2.0
"""Which events become a line of the sidecar's log."""

from __future__ import annotations

import dataclasses
import logging
import signal

import pytest
from avckpt.errors import AvckptError, DeadlineMissed, KernelError, Unsupported
from avckpt.events.journal import OFTEN_AT_ONCE, OFTEN_S, SELDOM_S, Journal
from avckpt.events.record import EventRecord, of_guard
from avckpt.events.vocabulary import Kind, Reason
from avckpt.guard import Event


def missed(at_s: float) -> EventRecord:
    return of_guard(Event(Kind.MISSED, 1, at_ns=int(at_s * 1e9), error=DeadlineMissed("a thread did not stop")))


def unprotected(why: str) -> EventRecord:
    return of_guard(Event(Kind.UNPROTECTED, 1, error=Unsupported(why)))


def checkpoint(generation: int) -> EventRecord:
    return of_guard(Event(Kind.CHECKPOINT, 1, generation=generation, threads=3, freeze_s=0.00123, quiescent=True))


def test_only_the_first_checkpoint_is_worth_a_line() -> None:
    journal = Journal()
    assert journal.line(checkpoint(1)) == (
        logging.INFO,
        "protected: first checkpoint, generation 1, 3 thread(s), frozen 1.23 ms",
    )
    level, _ = journal.line(checkpoint(2)) or (0, "")
    assert level == logging.DEBUG


def test_missed_checkpoints_are_counted_not_repeated() -> None:
    journal = Journal()
    first = journal.line(missed(100.0))
    assert first is not None
    assert first[0] == logging.WARNING
    assert journal.line(missed(101.0)) is None
    assert journal.line(missed(102.0)) is None
    later = journal.line(missed(100.0 + SELDOM_S))
    assert later is not None
    assert later[1].endswith("(and 2 more since this was last said)")


def test_what_an_application_brings_about_at_will_has_an_end() -> None:
    """It executes another program after each checkpoint, or is refused for another reason each time."""
    journal = Journal()
    told = []
    for i in range(1000):
        at_ns = int((100 + i / 10) * 1e9)
        for record in (
            dataclasses.replace(checkpoint(i), monotonic_s=at_ns / 1e9),
            of_guard(Event(Kind.DROPPED, 1, at_ns=at_ns, generation=i, reason=Reason.EXECUTED)),
            dataclasses.replace(unprotected(f"reason {i}"), monotonic_s=at_ns / 1e9),
            dataclasses.replace(checkpoint(i), monotonic_s=at_ns / 1e9),
            missed(100 + i / 10),
        ):
            line = journal.line(record)
            if line is not None and line[0] >= logging.INFO:
                told.append(line[1])
    assert OFTEN_AT_ONCE <= len(told) <= OFTEN_AT_ONCE + 100 / OFTEN_S + 1
    assert "more lines of that kind before)" in told[-1]
    # What it dies of is told all the same.
    assert journal.line(of_guard(Event(Kind.DIED, 1, wait_status=9))) is not None
    assert journal.line(of_guard(Event(Kind.DROPPED, 1, generation=1, reason=Reason.CRASHED))) is not None


def test_a_miss_that_cost_what_was_held_is_told_at_once_and_so_is_the_next_checkpoint() -> None:
    journal = Journal()
    journal.line(missed(100.0))
    journal.line(checkpoint(1))
    kept = dataclasses.replace(missed(101.0), generations=1)
    assert journal.line(kept) is None
    level, text = journal.line(missed(102.0)) or (0, "")
    assert level == logging.WARNING
    assert text == "checkpoint missed: a thread did not stop; nothing is held to go back to"
    assert journal.line(missed(103.0)) is None
    assert (journal.line(checkpoint(2)) or (0, ""))[0] == logging.INFO


@pytest.mark.parametrize(("reason", "level"), [(Reason.MEMORY, logging.WARNING), (Reason.EXECUTED, logging.INFO)])
def test_the_checkpoint_after_the_last_generation_was_given_up_is_told(reason: Reason, level: int) -> None:
    journal = Journal()
    journal.line(checkpoint(1))
    journal.line(checkpoint(2))
    dropped = Event(Kind.DROPPED, 1, reason=reason, generation=1, generations=1)
    assert (journal.line(of_guard(dropped)) or (0, ""))[0] == level
    assert (journal.line(checkpoint(3)) or (0, ""))[0] == logging.DEBUG
    assert (journal.line(of_guard(dataclasses.replace(dropped, generations=0))) or (0, ""))[0] == level
    assert (journal.line(checkpoint(4)) or (0, ""))[0] == logging.INFO


def test_a_guard_that_is_replaced_for_its_filter_is_no_warning() -> None:
    lost = Event(Kind.GUARD_LOST, 1, error=AvckptError("it was killed"))
    assert Journal().line(of_guard(lost)) == (logging.WARNING, "runs unprotected: it was killed")
    replaced = dataclasses.replace(lost, reason=Reason.FILTER, error=AvckptError("a reason"))
    assert Journal().line(of_guard(replaced)) == (logging.INFO, "gets a guard without a seccomp filter: a reason")


def health(at_s: float, detail: str, error: AvckptError | None = None) -> EventRecord:
    return EventRecord(Kind.HEALTH, monotonic_s=at_s, detail=detail, error=error)


def test_a_check_that_fails_is_told_once_a_minute_and_what_is_done_about_it_always() -> None:
    journal = Journal()
    status = AvckptError("status 1")
    assert journal.line(health(100.0, "failed 1 time(s) of 3", status)) == (
        logging.WARNING,
        "failed 1 time(s) of 3: status 1",
    )
    assert journal.line(health(101.0, "failed 2 time(s) of 3", status)) is None
    assert journal.line(health(102.0, "failed 3 time(s) of 3: rolled back")) is not None
    assert journal.line(health(103.0, "failed 1 time(s) of 3", status)) is None
    later = journal.line(health(100.0 + SELDOM_S, "failed 2 time(s) of 3", status))
    assert later is not None
    assert later[1] == "failed 2 time(s) of 3: status 1 (and 2 more since this was last said)"


def test_unprotected_is_said_once_per_reason() -> None:
    journal = Journal()
    assert journal.line(unprotected("it has children")) == (
        logging.WARNING,
        "runs unprotected: it has children",
    )
    assert journal.line(unprotected("it has children")) is None
    assert journal.line(unprotected("it has an io_uring")) is not None


def test_protection_that_comes_back_is_said() -> None:
    journal = Journal()
    journal.line(checkpoint(1))
    journal.line(unprotected("it has children"))
    level, text = journal.line(checkpoint(2)) or (0, "")
    assert level == logging.INFO
    assert text.startswith("protected")
    assert journal.line(unprotected("it has children")) is not None


def test_a_death_and_its_restore() -> None:
    journal = Journal()
    assert journal.line(of_guard(Event(Kind.DIED, 1, wait_status=signal.SIGSEGV))) == (
        logging.INFO,
        "died: killed by SIGSEGV",
    )
    restored = Event(
        Kind.RESTORED,
        1,
        wait_status=signal.SIGSEGV,
        restore_s=0.0061,
        age_s=1.25,
        generation=4,
        threads=21,
        restores=2,
    )
    assert journal.line(of_guard(restored)) == (
        logging.WARNING,
        "killed by SIGSEGV, restored in 6.1 ms from generation 4 (1.2 s old), 21 thread(s), restore 2",
    )


def test_a_rollback_on_command_is_no_crash() -> None:
    line = Journal().line(of_guard(Event(Kind.RESTORED, 1, reason=Reason.COMMAND, wait_status=signal.SIGKILL)))
    assert line is not None
    assert line[1].startswith("rolled back on command, restored in ")


@pytest.mark.parametrize(
    ("reason", "level", "words"),
    [
        (Reason.STOPPED, logging.INFO, "it was asked to stop"),
        (Reason.CLEAN_EXIT, logging.INFO, "it ended by itself"),
        (Reason.LIMIT, logging.ERROR, "avckpt.restore.max are used up"),
        (Reason.EMPTY, logging.ERROR, "no checkpoint was held"),
    ],
)
def test_a_restore_that_did_not_happen(reason: Reason, level: int, words: str) -> None:
    line = Journal().line(of_guard(Event(Kind.GAVE_UP, 1, wait_status=1 << 8, reason=reason)))
    assert line is not None
    assert line[0] == level
    assert words in line[1]
    assert "exited with status 1" in line[1]


def test_a_failed_restore_names_the_error() -> None:
    error: AvckptError = KernelError("the PID was taken", operation="restore", syscall="clone", errno=11)
    line = Journal().line(of_guard(Event(Kind.GAVE_UP, 1, wait_status=9, reason=Reason.FAILED, error=error)))
    assert line is not None
    assert "restore: the PID was taken (clone: Resource temporarily unavailable)" in line[1]
