# SPDX-License-Identifier: Apache-2.0
"""The vocabulary of events: from the guard's numbers to the API's names.

The only mapping from numbers of `avckpt/engine.h` to names; logs, API, history and
metrics use these names, and docs/events.md lists them.
"""

from __future__ import annotations

import enum
import functools
import os
import signal
from typing import TypeVar

from avckpt.errors import AvckptError

E = TypeVar("E", bound="_Named")


class _Named(str, enum.Enum):
    """`value` is the name in the API, `number` the engine's; 0: not an engine's."""

    number: int

    def __new__(cls: type[E], value: str, number: int = 0) -> E:
        member = str.__new__(cls, value)
        member._value_ = value
        member.number = number
        return member

    @classmethod
    @functools.cache
    def of(cls: type[E], number: int) -> E:
        """The member with the engine's number.  Raises ValueError when there is none."""
        for member in cls:
            if member.number == number and number:
                return member
        raise ValueError(f"{number} is no {cls.__name__.lower()}")


class Kind(_Named):
    """What happened: `enum avc_event_kind`, and kinds of the daemon."""

    ATTACHED = "attached", 1
    CHECKPOINT = "checkpoint", 2
    MISSED = "missed", 3
    UNPROTECTED = "unprotected", 4
    DIED = "died", 5
    RESTORED = "restored", 6
    GAVE_UP = "gave_up", 7
    ENDED = "ended", 8
    REFUSED = "refused", 9
    DROPPED = "dropped", 10
    GUARD_LOST = "guard_lost", 11
    HELD = "held", 12
    WAITS = "waits", 13
    REGISTERED = "registered"
    HEALTH = "health"
    CONFIGURED = "configured"
    CRASH = "crash"
    CORE = "core"
    LATE = "late"
    NOTIFIED = "notified"
    NOTIFY_FAILED = "notify_failed"
    SIDECAR_STARTED = "sidecar_started"
    SIDECAR_STOPPED = "sidecar_stopped"


class Reason(_Named):
    """Why, and what followed: `enum avc_reason`."""

    SIGNAL = "signal", 1
    EXIT = "exit", 2
    COMMAND = "manual", 3
    CLEAN_EXIT = "clean_exit", 4
    STOPPED = "stopped", 5
    POLICY = "policy", 6
    LIMIT = "limit", 7
    FAILED = "failed", 8
    EMPTY = "empty", 9
    UNHEALTHY = "unhealthy", 10
    MEMORY = "memory", 11
    KILLED = "killed", 12
    CRASHED = "crashed", 13
    EXECUTED = "executed", 14
    LOOP = "loop", 15
    LATE = "late", 16
    GROUP = "group", 17
    UNSHARED = "unshared", 18
    FILTER = "filter", 19
    RESTORED = "restored"


CAUSES = (Reason.SIGNAL, Reason.EXIT, Reason.UNHEALTHY, Reason.COMMAND, Reason.GROUP)
"""Why an application died, or was rolled back."""

GAVE_UP_WORDS = {
    Reason.CLEAN_EXIT: "it ended by itself",
    Reason.STOPPED: "it was asked to stop",
    Reason.POLICY: "avckpt.restore.on does not name this end",
    Reason.LIMIT: "the restores of avckpt.restore.max are used up",
    Reason.LATE: "it would have come later than avckpt.deadline",
    Reason.LOOP: "it died the same way within a second of each of two restores",
    Reason.FAILED: "no generation could be restored",
    Reason.EMPTY: "no checkpoint was held",
}
"""Why a death was not followed by a restore."""

DROPPED_WORDS = {
    Reason.CRASHED: "what is restored from it keeps crashing",
    Reason.UNHEALTHY: "it was taken after the last good health check",
    Reason.MEMORY: "memory is short",
    Reason.KILLED: "its template was killed (by the OOM killer, or from inside)",
    Reason.EXECUTED: "the application has executed another program",
    Reason.UNSHARED: "the application has a new table of descriptors (unshare, close_range)",
}
"""Why a generation was dropped early."""

OUTCOMES = (Reason.RESTORED, *GAVE_UP_WORDS)
"""What followed a death."""

EXPECTED = frozenset({Reason.CLEAN_EXIT, Reason.STOPPED})
"""Intended exits: not worth a warning."""

FAILURES = tuple(reason for reason in GAVE_UP_WORDS if reason not in (*EXPECTED, Reason.POLICY))
"""Outcomes of deaths that a restore should have undone."""


def why_dropped(reason: Reason | None) -> str:
    """Why a generation was dropped, in words."""
    return "" if reason is None else DROPPED_WORDS.get(reason, "")


def why_not_restored(reason: Reason | None, error: AvckptError | None) -> str:
    """Why a death was not followed by a restore, in words."""
    words = GAVE_UP_WORDS[reason if reason in GAVE_UP_WORDS else Reason.FAILED]
    if error is None or reason is Reason.EMPTY:
        return words
    return f"{words}: {error}"


def describe_wait_status(wait_status: int) -> str:
    """A status of waitpid(2) in words: "killed by SIGSEGV", "exited with status 3"."""
    if not 0 <= wait_status <= 0xFFFF:
        return f"ended with wait status {wait_status:#x}"
    if os.WIFSIGNALED(wait_status):
        return f"killed by {signal_name(os.WTERMSIG(wait_status))}"
    if os.WIFEXITED(wait_status):
        return f"exited with status {os.WEXITSTATUS(wait_status)}"
    return f"ended with wait status {wait_status:#x}"


def signal_name(number: int) -> str:
    """SIGSEGV for 11; real-time signals as SIGRTMIN+3."""
    try:
        return signal.Signals(number).name
    except ValueError:
        if signal.SIGRTMIN < number <= signal.SIGRTMAX:
            return f"SIGRTMIN+{number - signal.SIGRTMIN}"
        return f"signal {number}"
