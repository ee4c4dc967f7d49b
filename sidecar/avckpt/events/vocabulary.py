# SPDX-License-Identifier: Apache-2.0
"""What a guard tells: the events of `avckpt/engine.h` as plain data, and their words.

Nothing here needs the native library, so that what decides on events can be
read and tested without it.
"""

from __future__ import annotations

import enum
import os
import signal
from dataclasses import dataclass, fields

from avckpt.errors import AvckptError


class EventKind(enum.IntEnum):
    """`enum avc_event_kind`."""

    ATTACHED = 1
    CHECKPOINT = 2
    MISSED = 3
    UNPROTECTED = 4
    DIED = 5
    RESTORED = 6
    GAVE_UP = 7
    ENDED = 8
    REFUSED = 9
    DROPPED = 10
    GUARD_LOST = 11


class Reason(enum.IntEnum):
    """`enum avc_reason`."""

    NONE = 0
    SIGNAL = 1
    EXIT = 2
    COMMAND = 3
    CLEAN_EXIT = 4
    STOPPED = 5
    POLICY = 6
    LIMIT = 7
    FAILED = 8
    EMPTY = 9
    UNHEALTHY = 10
    MEMORY = 11
    KILLED = 12
    CRASHED = 13
    EXECUTED = 14


GAVE_UP_WORDS = {
    Reason.CLEAN_EXIT: "it ended by itself",
    Reason.STOPPED: "it was asked to stop",
    Reason.POLICY: "avckpt.restore.on does not name this end",
    Reason.LIMIT: "the restores of avckpt.restore.max are used up",
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
}
"""Why a generation was given up before its time."""

EXPECTED_ENDS = frozenset({Reason.CLEAN_EXIT, Reason.STOPPED})
"""Ends that somebody meant: not worth a warning."""


@dataclass(frozen=True)
class Event:
    """`struct avc_event`.  `_s` is a duration in seconds, `_ns` an instant of CLOCK_MONOTONIC."""

    kind: EventKind
    cookie: int
    reason: Reason = Reason.NONE
    ticket: int = 0
    at_ns: int = 0
    app_pid: int = 0
    app_pid_inside: int = 0
    wait_status: int = 0
    threads: int = 0
    generation: int = 0
    generations: int = 0
    attempt: int = 0
    quiescent: bool = False
    restores: int = 0
    freeze_s: float = 0.0
    stop_s: float = 0.0
    clone_s: float = 0.0
    died_ns: int = 0
    restore_s: float = 0.0
    fork_s: float = 0.0
    threads_s: float = 0.0
    age_s: float = 0.0
    error: AvckptError | None = None

    def to_json(self) -> dict[str, object]:
        """The fields that say something, for the API; enums by their names in lower case."""
        data: dict[str, object] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if value and field.name not in ("kind", "reason", "error", "cookie"):
                data[field.name] = value
        data["kind"] = self.kind.name.lower()
        if self.reason is not Reason.NONE:
            data["reason"] = self.reason.name.lower()
        if self.error is not None:
            data["error"] = self.error.to_json()
        return data


def why_not_restored(reason: Reason, error: AvckptError | None) -> str:
    """Why a death was not followed by a restore, in words."""
    words = GAVE_UP_WORDS.get(reason, reason.name.lower())
    if error is None or reason is Reason.EMPTY:
        return words
    return f"{words}: {error}"


def describe_wait_status(wait_status: int) -> str:
    """A status of waitpid(2) in words: "killed by SIGSEGV", "exited with status 3"."""
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
