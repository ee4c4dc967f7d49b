# SPDX-License-Identifier: Apache-2.0
"""The `avckpt.*` labels: what they may say, and what they mean.

Hook and sidecar read labels through this module only, so that what one accepts
is understood by the other.

Rules that the table of labels does not express:
- Labels and annotations of the same name mean the same. One name with two
different values is an error, because either may be meant.
- Unknown names and malformed values are errors whether `avckpt.enable` is true
  or not: `avckpt.enabled=true` must not quietly start an unprotected container.
- Without `avckpt.enable` a container is not protected, whatever else is set;
  with `avckpt.group` and `avckpt.notify` it is notified of the recoveries of others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

PREFIX = "avckpt."
RESERVED = frozenset({"avckpt.version", "avckpt.name", "avckpt.id"})
"""Stamped on a protected container by the precreate hook; not for users to set."""

KEEP_MAX = 16
"""AVC_KEEP_MAX of the engine."""
RESTORES_MAX = 64
"""AVC_RESTORES_MAX of the engine: the number that it remembers."""

VALUE_MAX = 2048
"""Characters.  The sidecar takes microseconds for each character of a command, and does nothing else meanwhile."""
SHM_MAX_BYTES = 1_000_000_000
SHM_LEAST_BYTES = 4096
AUTOMATIC_MAX = "3s"
"""The longest time between two checkpoints at avckpt.interval=auto, and the default where that cannot be."""


class LabelError(ValueError):
    """A label that cannot be honoured. The text is one line for users."""

    def __init__(self, key: str, value: str | None, why: str, allowed: str) -> None:
        setting = shown(key) if value is None else f"{shown(key)}={shown(value, key)}"
        super().__init__(f"label {setting}: {why}; {allowed}")
        self.key = key
        self.value = value
        self.why = why
        self.allowed = allowed


@dataclass(frozen=True)
class RestoreOn:
    """Which kinds of exit of the app are abnormal."""

    signal: bool = True
    """Killed by a signal that was not requested."""
    exit: bool = True
    """Any non-zero exit status."""
    statuses: frozenset[int] = frozenset()
    """These exit statuses, 1..255."""
    unhealthy: bool = False
    """The container's health check fails."""


@dataclass(frozen=True)
class Notify:
    """How to notify a container of a recovery: by a signal, or by a command run in it."""

    signal: int = 0
    """0: none."""
    command: tuple[str, ...] = ()
    """Program and arguments; empty: none."""


@dataclass(frozen=True)
class Policy:
    """What the labels of one container ask for.  Durations in seconds."""

    enable: bool = False
    interval_s: float = 3.0
    """Time between checkpoints; with `automatic` the longest."""
    automatic: bool = True
    """As often as the budgets allow, and not while the application is idle."""
    interval_min_s: float = 0.02
    """With `automatic`: the shortest time between two."""
    budget_freeze: float = 0.03
    """With `automatic`: the fraction of its time that checkpoints may stop the application."""
    budget_cpu: float = 0.05
    """With `automatic`: the fraction of one CPU that they may use."""
    keep: int = 2
    """Generations kept, 1..KEEP_MAX."""
    keep_apart_s: float = 0.0
    """These are at least so far apart; 0: as far as the checkpoints that they are of."""
    restore_on: RestoreOn = field(default_factory=RestoreOn)
    restore_max: int = 5
    """At most so many restores within `restore_window_s`."""
    restore_window_s: float = 60.0
    again: frozenset[str] = frozenset()
    """What a restore changes soon after another one: drop-input, stagger."""
    quiesce_s: float = 0.02
    """How long to wait for a quiescent moment; 0: not at all."""
    shm_bytes: int = 4_000_000
    """Shared memory of the application's own that is rolled back with it, at most."""
    files: str = "auto"
    """Regular files at a restore: auto, rewind, keep or strict."""
    io_uring: bool = True
    """Whether the container may use it; an application that does cannot be protected."""
    tcp: str = "reset-moved"
    """Established TCP connections at a restore: reset-moved, reset, keep or messages."""
    scope: str = "container"
    """What is protected: the container as a whole, or the nodes that its launcher starts by avckpt-init."""
    images: str = "auto"
    """How a checkpoint gets the application's memory: fork, dirty or auto."""
    deadline_s: float = 0.0
    """A recovery that takes longer is reported; 0: none is."""
    deadline_late: str = "go-on"
    """What then happens: go-on, or cold (it is abandoned, and the container ends)."""
    mark: bool = False
    """Whether a restore adds a line to the container's own log."""
    core: str = "off"
    """A core file for each death that is undone: off, mini (stacks) or on."""
    group: str = ""
    """Containers that can be notified of each other's recoveries; empty: none."""
    recovery: str = "apart"
    """How its members recover: apart, or together, from checkpoints of one instant."""
    notify: Notify | None = None
    """For recoveries of others in the group."""
    notify_self: Notify | None = None
    """For its own recoveries."""

    @property
    def guarded(self) -> bool:
        """It has a guard: it is to be protected, and as a whole."""
        return self.enable and self.scope == "container"

    @property
    def together(self) -> bool:
        """It is rolled back with its group."""
        return self.guarded and self.recovery == "together"

    @property
    def listens(self) -> bool:
        """It is notified of others' recoveries, which needs no protection of its own."""
        return self.notify is not None and bool(self.group)


def parse_policy(mapping: Mapping[str, str]) -> Policy:
    """What `mapping` (labels or annotations; other names are ignored) asks for.

    Raises LabelError for the first name or value, in alphabetical order, that
    cannot be honoured.
    """
    fields: dict[str, Any] = {}
    for key in sorted(mapping):
        if not key.startswith(PREFIX) or key in RESERVED:
            continue
        value = mapping[key].strip()
        label = LABELS.get(key)
        if label is None:
            raise _unknown(key)
        try:
            if len(value) > VALUE_MAX:
                raise ValueError(f"longer than {VALUE_MAX} characters")
            fields.update(label.parse(value))
        except ValueError as error:
            raise LabelError(key, value, str(error), "allowed: " + label.allowed) from None
    if fields.get("recovery") == "together":
        fields.setdefault("automatic", False)
    policy = Policy(**fields)
    if policy.restore_on.unhealthy and policy.keep < 2:
        # A hang is detected late: by then the newest generation hangs, too.
        raise LabelError(
            "avckpt.keep", mapping["avckpt.keep"], "too few for avckpt.restore.on=unhealthy", "allowed there: 2 to 16"
        )
    if policy.deadline_late == "cold" and not policy.deadline_s:
        raise LabelError(
            "avckpt.deadline.late", mapping["avckpt.deadline.late"], "there is no deadline", "add avckpt.deadline=50ms"
        )
    if policy.scope == "nodes" and policy.restore_on.unhealthy:
        raise LabelError(
            "avckpt.restore.on",
            mapping.get("avckpt.restore.on"),
            "a health check covers a whole container",
            "leave unhealthy out, or avckpt.scope=nodes",
        )
    if policy.enable and policy.notify is not None and not policy.group:
        raise LabelError(
            "avckpt.notify",
            mapping["avckpt.notify"],
            "without a group there are no recoveries to report",
            "add avckpt.group=NAME, or use avckpt.notify.self for its own recoveries",
        )
    if policy.recovery == "together":
        _check_together(policy, mapping)
    return policy


def _check_together(policy: Policy, mapping: Mapping[str, str]) -> None:
    """Raises LabelError for settings that cannot be combined with avckpt.group.recovery=together."""
    if not policy.group:
        raise LabelError("avckpt.group.recovery", "together", "there is no group", "add avckpt.group=NAME")
    if policy.keep_apart_s:
        raise LabelError(
            "avckpt.keep.apart",
            mapping["avckpt.keep.apart"],
            "a group that recovers together keeps its newest lines",
            "leave it out, or give a longer avckpt.interval",
        )
    if policy.again:
        raise LabelError(
            "avckpt.restore.again",
            mapping["avckpt.restore.again"],
            "a group that recovers together goes back to one instant",
            "leave it out",
        )
    if policy.automatic:
        raise LabelError(
            "avckpt.interval",
            "auto",
            "a group that recovers together needs a fixed interval",
            "give it a time, as 500ms",
        )
    if policy.deadline_late == "cold":
        raise LabelError(
            "avckpt.deadline.late", "cold", "no member of a group that recovers together restarts alone", "use go-on"
        )
    if policy.tcp not in ("reset-moved", "reset"):
        # Bytes sent since the checkpoint would be received, and then sent once more.
        raise LabelError(
            "avckpt.tcp",
            mapping.get("avckpt.tcp"),
            "a group that recovers together would receive what was sent since the checkpoint",
            "allowed there: reset-moved or reset",
        )


def merge(labels: Mapping[str, str], annotations: Mapping[str, str]) -> dict[str, str]:
    """The `avckpt.*` entries of both.  Raises LabelError where they disagree.

    Annotations with reserved names are left out (an earlier start of the same
    container may have stamped them); labels with reserved names are errors.
    """
    merged: dict[str, str] = {}
    for key, value in labels.items():
        if key in RESERVED:
            raise LabelError(key, value, "avckpt sets this itself", "remove the label")
        if key.startswith(PREFIX):
            merged[key] = value
    for key, value in annotations.items():
        if not key.startswith(PREFIX) or key in RESERVED:
            continue
        if merged.setdefault(key, value).strip() != value.strip():
            raise LabelError(
                key,
                merged[key],
                f"the annotation of the same name says {shown(value, key)}",
                "give one of them, or the same value to both",
            )
    return merged


def of_container(annotations: Mapping[str, str], name: str) -> dict[str, str]:
    """The annotations that hold for one container of a pod.

    `avckpt.keep/lidar` is meant for the container `lidar` alone, and precedes `avckpt.keep`.
    `podman generate kube` writes a container's annotations so, and `podman kube play` gives
    those of a pod to all of its containers, which it calls POD-CONTAINER; to a runtime of
    Kubernetes they are POD/CONTAINER.
    """
    common: dict[str, str] = {}
    own: dict[str, tuple[str, str]] = {}
    for key, value in annotations.items():
        ours, slash, container = key.partition("/")
        if not key.startswith(PREFIX) or not slash:
            common[key] = value
            continue
        meant = name == container or name.endswith((f"-{container}", f"/{container}"))
        # Of `lidar` and `front-lidar`, the longer one.
        if meant and len(container) >= len(own.get(ours, ("", ""))[0]):
            own[ours] = (container, value)
    return {**common, **{key: value for key, (_, value) in own.items()}}


@dataclass(frozen=True)
class Label:
    """One row of the table of labels."""

    default: str
    """As a user would write it; empty: there is none."""
    allowed: str
    """What a value may be, as a clause for error messages."""
    parse: Callable[[str], dict[str, Any]]
    """Text to fields of Policy.  Raises ValueError with a clause that says why."""


_UNITS_S = {"ms": 0.001, "s": 1.0, "m": 60.0, "h": 3600.0}
_TRUE = frozenset({"true", "1", "yes", "on"})
_FALSE = frozenset({"false", "0", "no", "off"})


def _duration_s(text: str, least: str, most: str) -> float:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)(ms|s|m|h)", text, re.ASCII)
    if found is None:
        if re.fullmatch(r"\d+(\.\d+)?", text, re.ASCII):
            raise ValueError("a duration needs a unit")
        raise ValueError("not a duration")
    value_s = float(found[1]) * _UNITS_S[found[2]]
    if least and value_s < _duration_s(least, "", ""):
        raise ValueError(f"less than {least}")
    if most and value_s > _duration_s(most, "", ""):
        raise ValueError(f"more than {most}")
    return value_s


def _whole(text: str, least: int, most: int) -> int:
    if not re.fullmatch(r"\d{1,9}", text, re.ASCII):
        raise ValueError("not a whole number")
    if not least <= int(text) <= most:
        raise ValueError(f"not within {least} to {most}")
    return int(text)


def _truth(text: str, otherwise: str) -> bool:
    """Also as YAML's boolean: of `off` without quotes Compose makes the label "False"."""
    if text.lower() not in _TRUE | _FALSE:
        raise ValueError(otherwise)
    return text.lower() in _TRUE


def _parse_enable(text: str) -> dict[str, Any]:
    return {"enable": _truth(text, "neither true nor false")}


def _on_or_off(field_name: str) -> Callable[[str], dict[str, Any]]:
    def parse(text: str) -> dict[str, Any]:
        return {field_name: _truth(text, "neither on nor off")}

    return parse


def _parse_core(text: str) -> dict[str, Any]:
    return {"core": text if text == "mini" else "on" if _truth(text, "unknown value") else "off"}


def _parse_interval(text: str) -> dict[str, Any]:
    if text == "auto":
        return {"automatic": True, "interval_s": _duration_s(AUTOMATIC_MAX, "", "")}
    return {"automatic": False, "interval_s": _duration_s(text, "10ms", "24h")}


def _parse_interval_min(text: str) -> dict[str, Any]:
    return {"interval_min_s": _duration_s(text, "5ms", AUTOMATIC_MAX)}


def _share(field_name: str) -> Callable[[str], dict[str, Any]]:
    def parse(text: str) -> dict[str, Any]:
        found = re.fullmatch(r"(\d{1,3}(?:\.\d{1,3})?)\s*%", text, re.ASCII)
        if found is None:
            raise ValueError("not a percentage")
        if not 0.1 <= float(found[1]) <= 50:
            raise ValueError("not within 0.1% to 50%")
        return {field_name: float(found[1]) / 100}

    return parse


def _parse_keep(text: str) -> dict[str, Any]:
    return {"keep": _whole(text, 1, KEEP_MAX)}


def _parse_restore_on(text: str) -> dict[str, Any]:
    words = [word.strip() for word in text.split(",")]
    statuses = set()
    for word in words:
        if word.isdecimal():
            status = _whole(word, 0, 999999999)
            if not 1 <= status <= 255:
                raise ValueError(f"{word} is not an exit code that can mean failure (1 to 255)")
            statuses.add(status)
        elif word not in ("signal", "exit", "unhealthy"):
            raise ValueError(f"{shown(word)} is unknown" if word else "an entry is empty")
    restore_on = RestoreOn("signal" in words, "exit" in words, frozenset(statuses), "unhealthy" in words)
    return {"restore_on": restore_on}


def _parse_restore_max(text: str) -> dict[str, Any]:
    count, slash, window = text.partition("/")
    if not slash:
        raise ValueError("not a number of restores, a slash and a time")
    return {
        "restore_max": _whole(count.strip(), 1, RESTORES_MAX),
        "restore_window_s": _duration_s(window.strip(), "1s", "24h"),
    }


def _parse_again(text: str) -> dict[str, Any]:
    words = [word.strip() for word in text.split(",")]
    for word in words:
        if word not in ("drop-input", "stagger") and words != ["same"]:
            raise ValueError(f"{shown(word)} is unknown" if word != "same" else "same goes with nothing else")
    return {"again": frozenset(words) - {"same"}}


def _parse_keep_apart(text: str) -> dict[str, Any]:
    return {"keep_apart_s": 0.0 if text == "0" else _duration_s(text, "", "24h")}


def _parse_deadline(text: str) -> dict[str, Any]:
    return {"deadline_s": _duration_s(text, "1ms", "1h")}


def _parse_quiesce(text: str) -> dict[str, Any]:
    return {"quiesce_s": 0.0 if text == "0" else _duration_s(text, "", "1s")}


def _one_of(field_name: str, *values: str) -> Callable[[str], dict[str, Any]]:
    def parse(text: str) -> dict[str, Any]:
        if text not in values:
            raise ValueError("unknown value")
        return {field_name: text}

    return parse


def _parse_shm(text: str) -> dict[str, Any]:
    found = re.fullmatch(r"(\d{1,12})\s*([KMG]?)(I?)B?", text.upper(), re.ASCII)
    if found is None or (found[3] and not found[2]):
        raise ValueError("not a size")
    size_bytes = int(found[1]) * (1024 if found[3] else 1000) ** " KMG".index(found[2] or " ")
    if size_bytes > SHM_MAX_BYTES:
        raise ValueError("too large, it is copied while the application stands still")
    if 0 < size_bytes < SHM_LEAST_BYTES:
        raise ValueError("less than a page: is its unit missing?")
    return {"shm_bytes": size_bytes}


def _parse_group(text: str) -> dict[str, Any]:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,62}", text, re.ASCII):
        raise ValueError("not a name")
    return {"group": text}


def _parse_notify(text: str) -> dict[str, Any]:
    return {"notify": _notify(text)}


def _parse_notify_self(text: str) -> dict[str, Any]:
    return {"notify_self": _notify(text)}


def _notify(text: str) -> Notify:
    kind, colon, what = text.partition(":")
    if kind not in ("signal", "exec") or not colon or not what.strip():
        raise ValueError("neither a signal nor a command")
    if kind == "signal":
        return Notify(signal=_signal_number(what.strip()))
    import shlex

    try:
        return Notify(command=tuple(shlex.split(what)))
    except ValueError:
        raise ValueError("a quotation that does not end") from None


def _signal_number(text: str) -> int:
    import signal

    found = re.fullmatch(r"(?:SIG)?(RTMIN|RTMAX)([+-]\d{1,2})?", text.upper(), re.ASCII)
    if found is not None:
        number = int(getattr(signal, "SIG" + found[1])) + int(found[2] or 0)
    elif text.isdecimal():
        number = _whole(text, 1, 64)
    else:
        name = text.upper() if text.upper().startswith("SIG") else "SIG" + text.upper()
        number = int(getattr(signal.Signals, name, 0))
    # Below SIGRTMIN two real-time signals belong to the C library.
    if number not in signal.valid_signals() or signal.SIGSYS < number < signal.SIGRTMIN:
        raise ValueError(f"{shown(text)} is no signal")
    if number in (signal.SIGKILL, signal.SIGSTOP):
        raise ValueError("that signal cannot be caught")
    return number


_NOTIFY = "signal:NAME, as signal:USR1, or exec:PROGRAM ARGS, as exec:/bin/reconnect --fast"
_DURATION = "a number with ms, s, m or h"

LABELS: dict[str, Label] = {
    "avckpt.enable": Label("false", "true or false", _parse_enable),
    "avckpt.interval": Label("auto", f"auto, or {_DURATION}, from 10ms to 24h, as 500ms, 3s or 1m", _parse_interval),
    "avckpt.interval.min": Label("20ms", f"{_DURATION}, from 5ms to {AUTOMATIC_MAX}, as 20ms", _parse_interval_min),
    "avckpt.budget.freeze": Label("3%", "a percentage from 0.1% to 50%, as 3%", _share("budget_freeze")),
    "avckpt.budget.cpu": Label("5%", "a percentage from 0.1% to 50%, as 5%", _share("budget_cpu")),
    "avckpt.keep": Label("2", f"a whole number from 1 to {KEEP_MAX}", _parse_keep),
    "avckpt.keep.apart": Label("0", f"0, or {_DURATION}, up to 24h, as 3s", _parse_keep_apart),
    "avckpt.restore.on": Label(
        "signal,exit",
        "signal, exit, unhealthy and exit codes from 1 to 255, joined by commas",
        _parse_restore_on,
    ),
    "avckpt.restore.max": Label(
        "5/60s",
        f"restores per time, 1 to {RESTORES_MAX} within 1s to 24h, as 5/60s",
        _parse_restore_max,
    ),
    "avckpt.restore.again": Label("same", "same, drop-input, stagger, or drop-input,stagger", _parse_again),
    "avckpt.tcp": Label(
        "reset-moved",
        "reset-moved, reset, keep or messages",
        _one_of("tcp", "reset-moved", "reset", "keep", "messages"),
    ),
    "avckpt.files": Label("auto", "auto, rewind, keep or strict", _one_of("files", "auto", "rewind", "keep", "strict")),
    "avckpt.io_uring": Label("on", "on or off", _on_or_off("io_uring")),
    "avckpt.images": Label("auto", "auto, fork or dirty", _one_of("images", "fork", "dirty", "auto")),
    "avckpt.shm": Label("4MB", "a size up to 1GB, as 0, 512KB or 4MB", _parse_shm),
    "avckpt.quiesce": Label("20ms", f"0, or {_DURATION}, up to 1s, as 20ms", _parse_quiesce),
    "avckpt.deadline": Label("", f"{_DURATION}, from 1ms to 1h, as 50ms", _parse_deadline),
    "avckpt.deadline.late": Label("go-on", "go-on or cold", _one_of("deadline_late", "go-on", "cold")),
    "avckpt.mark": Label("off", "on or off", _on_or_off("mark")),
    "avckpt.core": Label("off", "off, mini or on", _parse_core),
    "avckpt.scope": Label("container", "container or nodes", _one_of("scope", "container", "nodes")),
    "avckpt.group": Label("", "a name: letters, digits and -_., at most 63", _parse_group),
    "avckpt.group.recovery": Label("apart", "apart or together", _one_of("recovery", "apart", "together")),
    "avckpt.notify": Label("", _NOTIFY, _parse_notify),
    "avckpt.notify.self": Label("", _NOTIFY, _parse_notify_self),
}
"""Every label a user may set."""


LOOKALIKE = re.compile(r"[avckpt]{5,7}(?:[._-]|$)", re.IGNORECASE)
"""Prefixes of names that were meant for us, right or wrong."""


def meant_by(name: str) -> str:
    """The label that was probably meant by a name that is not ours; "" if it looks like none."""
    import difflib  # costs milliseconds: not for names unlike ours

    plain = name.lower().replace("_", ".").replace("-", ".")
    if plain == PREFIX.rstrip("."):  # `avckpt=true`, or in YAML a mapping of that name
        return f"{PREFIX}enable"
    near = difflib.get_close_matches(plain, LABELS, n=1, cutoff=0.9)
    return near[0] if near else ""


def _unknown(key: str) -> LabelError:
    import difflib  # takes milliseconds, which an error may cost, but not every start

    near = difflib.get_close_matches(key, LABELS, n=1)
    if near:
        return LabelError(key, None, "unknown label", f"did you mean {near[0]}?")
    return LabelError(key, None, "unknown label", "known are " + ", ".join(sorted(LABELS)))


def shown(text: str, key: str = "") -> str:
    """A short, printable form of any value.

    Of a command only the program: its arguments may be secrets, and messages end
    up in logs that others read. Also where "exec:" was forgotten.
    """
    if text.startswith("exec:") or key.startswith(f"{PREFIX}notify"):
        program, *arguments = text.split(None, 1) or [""]
        text = f"{program} ..." if arguments else program
    printable = "".join(c if c.isprintable() else "?" for c in text)
    printable = printable if len(printable) <= 60 else printable[:57] + "..."
    return printable or '""'
