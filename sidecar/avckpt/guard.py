# SPDX-License-Identifier: Apache-2.0
"""Commands, settings and events of guards: the plain data of
`avckpt/engine.h`.

Nothing here needs the native library, so that decisions on events can be read
and tested without it.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from dataclasses import dataclass, fields

from avckpt.errors import AvckptError
from avckpt.events.vocabulary import Kind, Reason


class Command(enum.IntEnum):
    """`enum avc_command`."""

    CHECKPOINT = 1
    RESTORE = 2
    DROP_OLDEST = 3
    REFILL = 4
    VOUCH = 5
    UNHEALTHY = 6
    UNVOUCH = 7
    RELEASE = 8
    LIST = 9
    ABANDON = 10
    SEEN = 11


class Files(enum.IntEnum):
    """`enum avc_files`: regular files at a restore."""

    REWIND = 0
    KEEP = 1
    STRICT = 2
    AUTO = 3


class Tcp(enum.IntEnum):
    """`enum avc_tcp`: established TCP connections at a restore."""

    RESET_MOVED = 0
    RESET = 1
    KEEP = 2
    MESSAGES = 3


class Again(enum.IntFlag):
    """`enum avc_again`: what a restore changes soon after another one."""

    SAME = 0
    DROP_INPUT = 1
    STAGGER = 2

    @classmethod
    def of(cls, words: Iterable[str]) -> Again:
        """From words of the label avckpt.restore.again."""
        return cls(sum(cls[word.upper().replace("-", "_")] for word in words))

    @property
    def words(self) -> str:
        """As in the label; empty: nothing."""
        return ",".join(str(each.name).lower().replace("_", "-") for each in type(self) if each & self)


class Images(enum.IntEnum):
    """`enum avc_images`: how a checkpoint saves the memory of a process."""

    FORK = 0
    DIRTY = 1
    AUTO = 2


SMALL = "it is small"
"""The reason that is no news: a copy would not be better."""

FORK_REASONS = (
    "",
    "avckpt.images=fork",
    "there is no older image yet",
    "it is new, or has just ended, or a process above it adopts orphans",
    "the kernel cannot watch its memory",
    "it has a seccomp filter of its own, or is not dumpable",
    "it has memory of a kind that cannot be watched",
    "a device may write to its memory",
    "what a fork inherits has changed",
    "its mappings have changed",
    "it writes too much",
    "the older images are a minute old",
    "the older images have too many pages of their own",
    SMALL,
    "memory for copies is short",
    "forks may be more frequent",
)
"""`enum avc_fork_reason`: why a checkpoint was taken by a fork."""


@dataclass(frozen=True)
class GuardConfig:
    """`struct avc_config` without the pidfd.  Durations in seconds."""

    interval_s: float
    """Between checkpoints; 0: only on command."""
    keep: int
    """Generations kept."""
    restore_on_signal: bool
    restore_on_exit: bool
    restore_on_statuses: frozenset[int]
    restore_max: int
    """Restores within `restore_window_s`."""
    restore_window_s: float
    quiesce_s: float
    """How long to wait for a quiescent moment."""
    shm_bytes: int = 4_000_000
    """Shared memory of the application's own that is rolled back with it, at most."""
    memory_limit_bytes: int = 0
    """Of the container, with swap; 0: none known."""
    tasks_max: int = 0
    """Of the container (its pids limit); 0: none known."""
    deadline_s: float = 0.0
    """A restore that takes longer than this after the death is abandoned; 0: none is."""
    remains_s: float = 0.0
    """How long the memory of a dead application is kept for analysis; 0: it is not."""
    freeze_deadline_s: float = 0.0
    """The longest time to wait for the app to stop; 0: the engine's default."""
    files: Files = Files.REWIND
    tcp: Tcp = Tcp.RESET_MOVED
    images: Images = Images.FORK
    again: Again = Again.SAME
    """What a restore changes soon after another one."""
    together: bool = False
    """Its checkpoints are those of its group's lines, which the daemon commands at `interval_s`."""
    late: bool = False
    """The application has run without this guard: its first checkpoint is due soon, not after `interval_s`."""
    interval_min_s: float = 0.0
    """Not 0: as often as the budgets allow, between this and `interval_s` apart."""
    budget_freeze: float = 0.03
    """The fraction of the application's time."""
    budget_cpu: float = 0.05
    """The fraction of one CPU's time."""
    apart_s: float = 0.0
    """All generations but the newest are at least so far apart; with `interval_min_s`, 0: `interval_s`."""


@dataclass(frozen=True)
class Event:
    """`struct avc_event`.  `_s` is a duration in seconds, `_ns` an instant of CLOCK_MONOTONIC."""

    kind: Kind
    cookie: int
    reason: Reason | None = None
    ticket: int = 0
    at_ns: int = 0
    app_pid: int = 0
    app_pid_inside: int = 0
    wait_status: int = 0
    threads: int = 0
    generation: int = 0
    line: int = 0
    """The line of its group; 0: none."""
    replaced: int = 0
    """Of a checkpoint: the generation that it replaces; 0: none."""
    generations: int = 0
    attempt: int = 0
    quiescent: bool = False
    restores: int = 0
    checkpoints: int = 0
    remains_pid: int = 0
    likeness_pid: int = 0
    interval_s: float = 0.0
    freeze_max_s: float = 0.0
    freeze_s: float = 0.0
    stop_s: float = 0.0
    clone_s: float = 0.0
    wait_s: float = 0.0
    images: str = ""
    """Of a checkpoint: "fork" or "dirty"."""
    fork_reason: str = ""
    """Why it was a fork, in words; not for avckpt.images=fork."""
    copied: int = 0
    """Pages."""
    died_ns: int = 0
    restore_s: float = 0.0
    fork_s: float = 0.0
    threads_s: float = 0.0
    age_s: float = 0.0
    again: str = ""
    """What a restore has changed, as in avckpt.restore.again."""
    input_dropped: int = 0
    """Descriptors."""
    error: AvckptError | None = None

    def to_json(self) -> dict[str, object]:
        """The non-empty fields, for programs."""
        data: dict[str, object] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if value and field.name not in ("kind", "reason", "error", "cookie"):
                data[field.name] = value
        data["kind"] = self.kind.value
        if self.reason is not None:
            data["reason"] = self.reason.value
        if self.error is not None:
            data["error"] = self.error.to_json()
        return data


def generation_to_json(event: Event) -> dict[str, object]:
    """A generation that is held, as an event HELD reports it."""
    return {
        "generation": event.generation,
        "age_s": event.age_s,
        "freeze_s": event.freeze_s,
        "threads": event.threads,
        "crashes": event.attempt,
    }
