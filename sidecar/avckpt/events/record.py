# SPDX-License-Identifier: Apache-2.0
"""One event of a container, as all receivers get it.

Log, API, history, notifications and metrics all use `EventRecord`, and the
meaning of a field is defined here only: the API's description and
docs/events.md are checked against it. No I/O.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, cast

from avckpt.errors import AvckptError, from_json
from avckpt.events.vocabulary import (
    CAUSES,
    DROPPED_WORDS,
    GAVE_UP_WORDS,
    OUTCOMES,
    Kind,
    Reason,
    describe_wait_status,
    why_dropped,
    why_not_restored,
)
from avckpt.evidence.crash import Crash
from avckpt.guard import Event

NUMBERS_BELOW = 1 << 64


def said(description: str, default: Any = None, values: tuple[Reason, ...] = ()) -> Any:
    """A field of EventRecord with its meaning, and its values where its type allows more."""
    return field(default=default, metadata={"description": description, "values": values})


@dataclass(frozen=True)
class EventRecord:
    """`_s` is a duration in seconds.  None: not applicable to this kind."""

    kind: Kind = field(metadata={"description": "what happened", "values": ()})
    container: str = said(
        "name of the container, or its short id where it has none; empty: an event of the sidecar", ""
    )
    id: str = said("its id, 64 hex digits", "")
    group: str = said("its `avckpt.group`, empty: none", "")
    at: float = said("time of day, seconds since 1970", 0.0)
    monotonic_s: float = said("the same instant on CLOCK_MONOTONIC; of a checkpoint: all threads were stopped", 0.0)
    seq: int = said("number in the history, increasing; 0: routine (every checkpoint), reported but not stored", 0)
    reason: Reason | None = said(  # noqa: RUF009
        "why the application died: `signal`, `exit`, `unhealthy`, `manual` or `group` (it went back with others); "
        "why a generation was dropped: `crashed`, `unhealthy`, `memory`, `killed` (its template), `executed` "
        "(another program) or `unshared` (it has a new table of descriptors); why a guard was lost: `filter`, or none",
        values=tuple(dict.fromkeys((*CAUSES, *DROPPED_WORDS, Reason.FILTER))),
    )
    outcome: Reason | None = said(  # noqa: RUF009
        "what followed: `restored`, or why not: `clean_exit`, `stopped` (on request), `policy` (avckpt.restore.on), "
        "`limit` (avckpt.restore.max), `loop` (the same death right after a restore, twice), "
        "`late` (avckpt.deadline), `failed`, `empty` (no generation held)",
        values=OUTCOMES,
    )
    wait_status: int | None = said("of the death, as from waitpid(2)")
    generation: int | None = said("number of the generation taken, restored or dropped, from 1")
    line: int | None = said("the line of its group (avckpt.group.recovery) that this generation is part of")
    generations: int | None = said("generations held now")
    age_s: float | None = said("age of the restored generation when the application died, or of the dropped one")
    lost_s: float | None = said("time that the application lost: age_s and restore_s together")
    freeze_s: float | None = said("how long the application was stopped for this generation's checkpoint")
    freeze_own_s: float | None = said("of freeze_s, what it would have been without waiting for the rest of its group")
    checkpoints: int | None = said("checkpoints taken since the last event of this kind, this one included")
    freeze_max_s: float | None = said("the longest freeze of these")
    interval_s: float | None = said("current time between checkpoints")
    restore_s: float | None = said("from the death until the last thread runs again")
    threads: int | None = said("threads of the checkpoint or restore")
    attempt: int | None = said(
        "restores within the period of avckpt.restore.max, this one included unless it was on command or for its "
        "group; of a dropped generation: its crashes"
    )
    restores: int | None = said("restores since the sidecar began to protect this run of the container")
    again: str | None = said("what this restore has changed (avckpt.restore.again): `drop-input`, `stagger`")
    input_dropped: int | None = said("descriptors whose unread input it has dropped")
    left: int | None = said("restores left within the period of avckpt.restore.max")
    quiescent: bool | None = said("whether the application was quiescent at the checkpoint")
    images: str | None = said("how the checkpoint saved memory: fork, or dirty (by copies)")
    fork_reason: str | None = said("why it was forked, where avckpt.images is not fork")
    app_pid: int | None = said("the application's main process, in the sidecar's PID namespace")
    app_pid_inside: int | None = said("the same in the container's")
    detail: str = said("a clause for users, where the other fields do not say it", "")
    core: str | None = said("path of the core file; missing: none was written, and `detail` says why")
    core_bytes: int | None = said("its size, compressed")
    crash_seq: int | None = said("of `core` and `late`: number of the event `crash` that they belong to")
    detected_s: float | None = said(
        "from the fatal signal until avckpt-init noticed the death; unknown for exits, and where the kernel's report "
        "was lost (`crash.unknown`)"
    )
    recovered_s: float | None = said("detected_s and restore_s together")
    crash: Crash | None = said("what it died of, and where")  # noqa: RUF009
    error: AvckptError | None = said("what went wrong, as in the API's errors")  # noqa: RUF009

    @property
    def message(self) -> str:
        """One line for users, without the container's name."""
        return _MESSAGES[self.kind](self)

    def to_json(self) -> dict[str, object]:
        """The fields that apply, and `message`."""
        data: dict[str, object] = {}
        for name in _NAMES:
            value = getattr(self, name)
            if isinstance(value, enum.Enum):
                value = value.value
            elif isinstance(value, (AvckptError, Crash)):
                value = value.to_json()
            if value is not None:
                data[name] = value
        data["message"] = self.message
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, object]) -> EventRecord:
        """The inverse of `to_json()`; unknown fields are left out.

        Raises ValueError when it is no event.
        """
        types = field_types()
        values: dict[str, object] = {}
        for name, value in data.items():
            if name in types:
                values[name] = _value(name, types[name], value)
        if "kind" not in values:
            raise ValueError("it has no kind")
        return cls(**cast("dict[str, Any]", values))


_NAMES = tuple(each.name for each in fields(EventRecord))


def _value(name: str, kind: type, value: object) -> object:
    if kind is AvckptError and isinstance(value, dict):
        return from_json(value)
    if kind is Crash and isinstance(value, dict):
        return Crash.from_json(value)
    if issubclass(kind, enum.Enum):
        return kind(value)
    # JSON has numbers of any length, and Python's JSON has NaN.
    if isinstance(value, (int, float)) and not -NUMBERS_BELOW < value < NUMBERS_BELOW:
        raise ValueError(f"{name} is out of range")
    if type(value) is kind or (kind is float and type(value) is int):
        return value
    raise ValueError(f"{name} is {value!r}")


_TYPES: dict[str, type] = {cls.__name__: cls for cls in (Kind, Reason, AvckptError, Crash, str, int, float, bool)}


def field_types() -> dict[str, type]:
    """Types of the fields of EventRecord by name, without the None."""
    # Read as text: evaluating `int | None` takes Python 3.10.
    return {each.name: _TYPES[str(each.type).partition(" ")[0]] for each in fields(EventRecord)}


_DEATHS = frozenset({Kind.DIED, Kind.WAITS, Kind.RESTORED, Kind.GAVE_UP})
_WHY = frozenset({Kind.DROPPED, Kind.GUARD_LOST})
_COUNTED = frozenset({Kind.CHECKPOINT, Kind.RESTORED, Kind.DROPPED})


def of_guard(
    event: Event,
    *,
    container: str = "",
    id: str = "",
    group: str = "",
    at: float = 0.0,
    commanded: Reason | None = None,
) -> EventRecord:
    """An event of a guard, as a record.

    `commanded` is the reason for a commanded rollback, if any.
    """
    kind = event.kind
    restored = kind is Kind.RESTORED
    taken = kind is Kind.CHECKPOINT
    counted = kind in _COUNTED
    return EventRecord(
        kind=kind,
        container=container,
        id=id,
        group=group,
        at=at,
        monotonic_s=event.at_ns / 1e9,
        reason=event.reason if kind in _WHY else _cause(event, commanded) if kind in _DEATHS else None,
        outcome=_outcome(event),
        wait_status=event.wait_status if kind in _DEATHS else None,
        generation=event.generation if counted or kind is Kind.WAITS else None,
        line=event.line or None,
        generations=event.generations if counted or kind is Kind.MISSED else None,
        age_s=event.age_s if restored or kind is Kind.DROPPED else None,
        lost_s=event.age_s + event.restore_s if restored else None,
        freeze_s=event.freeze_s if taken or restored or kind is Kind.MISSED else None,
        freeze_own_s=event.freeze_s - event.wait_s if taken and event.line else None,
        checkpoints=event.checkpoints if taken else None,
        freeze_max_s=event.freeze_max_s if taken else None,
        interval_s=event.interval_s if taken else None,
        restore_s=event.restore_s if restored else None,
        threads=event.threads if counted and kind is not Kind.DROPPED else None,
        attempt=event.attempt if restored or kind is Kind.DROPPED else None,
        restores=event.restores if restored else None,
        again=event.again or None,
        input_dropped=event.input_dropped or None,
        quiescent=event.quiescent if taken else None,
        images=event.images or None,
        fork_reason=event.fork_reason or None,
        app_pid=event.app_pid or None,
        app_pid_inside=event.app_pid_inside or None,
        detail=why_dropped(event.reason) if kind is Kind.DROPPED else "",
        error=event.error,
    )


def _cause(event: Event, commanded: Reason | None) -> Reason:
    if event.reason is Reason.COMMAND or commanded is not None:
        return commanded or Reason.COMMAND
    if event.reason is Reason.GROUP:
        return Reason.GROUP
    if event.reason is Reason.UNHEALTHY:
        return Reason.UNHEALTHY
    return Reason.SIGNAL if event.wait_status & 0x7F else Reason.EXIT


def _outcome(event: Event) -> Reason | None:
    if event.kind is Kind.RESTORED:
        return Reason.RESTORED
    if event.kind is Kind.GAVE_UP:
        return event.reason if event.reason in GAVE_UP_WORDS else Reason.FAILED
    return None


# ---- in words ---------------------------------------------------------------


def _death(record: EventRecord) -> str:
    if record.reason is Reason.COMMAND and record.kind is not Kind.GAVE_UP:
        return "rolled back on command"
    if record.reason is Reason.UNHEALTHY and record.kind is not Kind.GAVE_UP:
        return "unhealthy, rolled back"
    if record.reason is Reason.GROUP and record.kind is not Kind.GAVE_UP:
        return "rolled back with its group"
    return describe_wait_status(record.wait_status or 0)


def _died(record: EventRecord) -> str:
    if record.reason is Reason.COMMAND:
        return "its application is ended, to be rolled back on command"
    if record.reason is Reason.UNHEALTHY:
        return "its application is ended, to be rolled back: unhealthy"
    return f"died: {describe_wait_status(record.wait_status or 0)}"


def _why_not(record: EventRecord) -> str:
    return why_not_restored(record.outcome or Reason.FAILED, record.error)


def _generation(record: EventRecord) -> str:
    return f"generation {record.generation}" + (f" (line {record.line})" if record.line else "")


def _checkpoint(record: EventRecord) -> str:
    return (
        f"{_generation(record)}, {record.threads} thread(s), frozen {(record.freeze_s or 0) * 1000:.2f} ms"
        f"{', by copies' if record.images == 'dirty' else ''}"
        f"{f', forked ({record.fork_reason})' if record.fork_reason else ''}"
        f"{'' if record.quiescent else ', not at a quiet moment'}"
    )


def _restored(record: EventRecord) -> str:
    return (
        f"{_death(record)}, restored in {(record.restore_s or 0) * 1000:.1f} ms from {_generation(record)} "
        f"({record.age_s or 0:.1f} s old), {record.threads} thread(s), restore {record.restores}{_again(record)}"
        f"{'' if record.error is None else f'; but {record.error}'}"
    )


def _again(record: EventRecord) -> str:
    if not record.again:
        return ""
    dropped = f" (of {record.input_dropped} descriptor(s))" if record.input_dropped else ""
    return ", with " + record.again.replace(",", ", ").replace("drop-input", f"drop-input{dropped}")


def _crashed(record: EventRecord) -> str:
    crash = record.crash or Crash()
    often = f"; this crash for the {_ordinal(crash.count)} time" if crash.count > 1 else ""
    if record.outcome is Reason.RESTORED:
        lost = f"; went back {record.age_s or 0:.1f} s, {record.lost_s or 0:.2f} s lost, {record.left} restore(s) left"
    else:
        lost = "; not restored"
    what = str(crash) or describe_wait_status(record.wait_status or 0)
    command = f"{crash.command}: " if crash.command else ""
    return f"{command}{what}{lost}{often}{f'; {crash.unknown}' if crash.unknown else ''}"


def _ordinal(number: int) -> str:
    last = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{last}"


def _guard_lost(record: EventRecord) -> str:
    if record.reason is Reason.FILTER:
        return f"gets a guard without a seccomp filter: {record.error}"
    return f"runs unprotected: {record.error}"


def _why(record: EventRecord) -> str:
    return f", once more: {record.error}" if record.error else ""


def _nothing_held(record: EventRecord) -> str:
    return "; nothing is held to go back to" if record.generations == 0 else ""


def _crashes(record: EventRecord) -> str:
    return f" ({record.attempt} time(s))" if record.attempt else ""


def _detail(record: EventRecord) -> str:
    return f"{record.detail}: {record.error}" if record.error else record.detail


_MESSAGES: dict[Kind, Callable[[EventRecord], str]] = {
    Kind.REGISTERED: lambda record: record.detail,
    Kind.ATTACHED: lambda record: f"attached to application {record.app_pid} (inside {record.app_pid_inside})",
    Kind.CHECKPOINT: lambda record: f"checkpoint: {_checkpoint(record)}",
    Kind.MISSED: lambda record: f"checkpoint missed: {record.error}{_nothing_held(record)}",
    Kind.UNPROTECTED: lambda record: f"runs unprotected: {record.error or record.detail}",
    Kind.GUARD_LOST: _guard_lost,
    # Only the following event says whether the application was lost.
    Kind.DIED: _died,
    Kind.WAITS: lambda record: f"waits for its group to go back with it{_why(record)}",
    Kind.RESTORED: _restored,
    Kind.CRASH: _crashed,
    Kind.CORE: lambda record: record.detail,
    Kind.LATE: lambda record: f"{record.detail}: {(record.recovered_s or 0) * 1000:.1f} ms after its death",
    Kind.GAVE_UP: lambda record: f"not restored ({describe_wait_status(record.wait_status or 0)}): {_why_not(record)}",
    Kind.DROPPED: lambda record: f"generation {record.generation} is given up: {_detail(record)}{_crashes(record)}",
    Kind.HEALTH: _detail,
    Kind.CONFIGURED: _detail,
    Kind.REFUSED: lambda record: f"command refused: {record.error}",
    Kind.ENDED: lambda record: f"ended: {record.detail}" if record.detail else "ended",
    Kind.NOTIFIED: lambda record: record.detail,
    Kind.HELD: lambda record: f"generation {record.generation} is held",
    Kind.NOTIFY_FAILED: lambda record: f"was not notified: {record.detail}",
    Kind.SIDECAR_STARTED: lambda record: f"the sidecar has started: {record.detail}",
    Kind.SIDECAR_STOPPED: lambda record: f"the sidecar was stopped: {record.detail}",
}
