# SPDX-License-Identifier: Apache-2.0
"""The state of one protected container, and how events change it. No I/O."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from avckpt.events.vocabulary import Kind, describe_wait_status, why_dropped, why_not_restored
from avckpt.guard import SMALL, Event, GuardConfig


class State(enum.Enum):
    """The state of a container."""

    STARTING = "starting"
    """Guarded, but no checkpoint yet: a death now is final."""
    PROTECTED = "protected"
    """At least one generation is held."""
    UNPROTECTED = "unprotected"
    """It runs as if avckpt were not there; `reason` says why."""
    NODES = "nodes"
    """A launcher, which is left alone: what it starts through avckpt-init is protected."""
    LISTENING = "listening"
    """Not to be protected: it is only notified of others in its group."""
    RESTORING = "restoring"
    """The app died; nothing runs at this moment."""
    ENDED = "ended"

    @property
    def guarded(self) -> bool:
        """It is to have generations of its own."""
        return self not in (State.NODES, State.LISTENING)


@dataclass
class Protected:
    """One run of a container, from its init's start to its init's end.

    Instants (`_at`) are seconds since the epoch, durations (`_s`) seconds; None: has not happened.
    """

    id: str
    name: str
    cookie: int
    """Which guard: unique in this process, so that two runs of one container are never confused."""
    init_pid: int
    """In this process's PID namespace, for people."""
    config: GuardConfig
    registered_at: float
    group: str = ""
    """`avckpt.group`; empty: none."""
    line: int = 0
    """The line of its group that the newest generation, or the one restored last, is part of; 0: none."""
    node_of: str = ""
    """Id of the container in which it is a node, "host", or empty: it is a container."""
    adopted: bool = False
    """It ran already when the sidecar started."""
    state: State = State.STARTING
    reason: str = "avckpt-init has not started yet"
    """Why it is not (fully) protected, or how it ended; empty when all is well."""
    app_pid: int = 0
    app_pid_inside: int = 0
    guard_pid: int = 0
    """Of its avckpt-guard; 0: there is none."""
    command: str = ""
    """Its program, as it was seen last; empty: it was not."""
    threads: int = 0
    generation: int = 0
    generations: int = 0
    checkpoints: int = 0
    missed: int = 0
    restores: int = 0
    attempt: int = 0
    """Restores within the time of avckpt.restore.max, at the last one."""
    dropped: int = 0
    """Generations dropped early."""
    last_dropped: str = ""
    """Which, and why."""
    memory_bytes: int = 0
    last_checkpoint_at: float | None = None
    last_freeze_s: float | None = None
    last_images: str = ""
    """How the last checkpoint saved the memory, if there was a choice."""
    last_fork_reason: str = ""
    last_interval_s: float = 0.0
    """The guard's interval as of the last checkpoint; 0: there was none."""
    last_quiescent: bool | None = None
    last_death: str = ""
    last_death_at: float | None = None
    last_death_ns: int = 0
    """The same on CLOCK_MONOTONIC, for durations; 0: has not happened."""
    last_restore_s: float | None = None
    last_restore_age_s: float | None = None
    """The age of the generation of the last restore."""
    ended_at: float | None = None

    @property
    def label(self) -> str:
        """Its name in messages: the name, or the short id."""
        return self.name or self.id[:12]

    @property
    def interval_s(self) -> float:
        """The current time between checkpoints."""
        return (self.config.interval_min_s and self.last_interval_s) or self.config.interval_s

    def apply(self, event: Event, at: float) -> None:
        """Applies an event of this container's guard that happened at `at`."""
        if event.app_pid:
            self.app_pid = event.app_pid
            self.app_pid_inside = event.app_pid_inside
        self.generations = event.generations
        if not self.generations:
            self.memory_bytes = 0
        kind = event.kind
        if kind is Kind.ATTACHED:
            self._to(State.STARTING, "no checkpoint yet")
        elif kind is Kind.CHECKPOINT:
            self._to(State.PROTECTED, self._crashing(event.at_ns))
            self.checkpoints += event.checkpoints or 1
            self.last_interval_s = event.interval_s
            self.generation = event.generation
            self.line = event.line
            self.threads = event.threads
            self.last_checkpoint_at = at
            self.last_freeze_s = event.freeze_s
            self.last_fork_reason = event.fork_reason if event.fork_reason != SMALL else ""
            self.last_images = event.images if event.images == "dirty" or self.last_fork_reason else ""
            self.last_quiescent = event.quiescent
        elif kind is Kind.MISSED:
            self.missed += 1
            self._suffer(f"checkpoint missed: {event.error}")
        elif kind in (Kind.UNPROTECTED, Kind.GUARD_LOST):
            self._to(State.UNPROTECTED, str(event.error))
        elif kind is Kind.DIED:
            self._to(State.RESTORING)
            self.last_death = describe_wait_status(event.wait_status)
            self.last_death_at = at
            self.last_death_ns = event.at_ns
        elif kind is Kind.RESTORED:
            self.restores = event.restores
            self.attempt = event.attempt
            self.generation = event.generation
            self.line = event.line
            self.threads = event.threads
            self.last_restore_s = event.restore_s
            self.last_restore_age_s = event.age_s
            self._to(State.PROTECTED, self._crashing(event.at_ns))
        elif kind is Kind.DROPPED:
            self.dropped += 1
            self.last_dropped = f"generation {event.generation}: {why_dropped(event.reason)}"
            if self.state is State.PROTECTED:
                left = f"; {event.generations} left" if event.generations else ""
                why = f": {event.error}" if event.error else ""
                self._suffer(f"{self.last_dropped}{why}{left}")
        elif kind is Kind.GAVE_UP:
            how = describe_wait_status(event.wait_status)
            self._to(State.ENDED, f"{how}; {why_not_restored(event.reason, event.error)}")
            self.generations = 0
            self.memory_bytes = 0

    def end(self, at: float) -> None:
        """Its init is gone."""
        if self.state is not State.ENDED:
            # By a guard that held a checkpoint, any other end would have been told.
            how = "was stopped or killed" if self.state is State.PROTECTED else "has ended, no guard saw how"
            self._to(State.ENDED, f"{'it' if self.node_of else 'the container'} {how}")
        self.generations = 0
        self.memory_bytes = 0
        self.ended_at = at

    def listen(self) -> None:
        """It is notified of others, and has no guard: its main process is its application."""
        self.app_pid = self.init_pid
        self._to(State.LISTENING, "only hears of others in its group: avckpt.enable is not true")

    def launch(self) -> None:
        """It has no guard: its main process is a launcher, and its nodes have theirs."""
        self.app_pid = self.init_pid
        self._to(State.NODES, "what it starts by $AVCKPT_INIT is protected, each by itself")

    def fail(self, reason: str) -> None:
        """It has no guard, and why."""
        self._to(State.UNPROTECTED, reason)

    def to_json(self) -> dict[str, object]:
        """All fields for users and programs; the keys are part of the API."""
        return {
            "id": self.id,
            "name": self.name,
            "group": self.group,
            "line": self.line,
            "node_of": self.node_of,
            "state": self.state.value,
            "reason": self.reason,
            "init_pid": self.init_pid,
            "app_pid": self.app_pid,
            "app_pid_inside": self.app_pid_inside,
            "guard_pid": self.guard_pid,
            "threads": self.threads,
            "interval_s": self.interval_s,
            "automatic": self.config.interval_min_s > 0,
            "keep": self.config.keep,
            "generation": self.generation,
            "generations": self.generations,
            "checkpoints": self.checkpoints,
            "missed": self.missed,
            "restores": self.restores,
            "attempt": self.attempt,
            "restore_max": self.config.restore_max,
            "dropped": self.dropped,
            "last_dropped": self.last_dropped,
            "memory_bytes": self.memory_bytes,
            "last_checkpoint_at": self.last_checkpoint_at,
            "last_freeze_s": self.last_freeze_s,
            "last_images": self.last_images,
            "last_fork_reason": self.last_fork_reason,
            "last_quiescent": self.last_quiescent,
            "last_death": self.last_death,
            "last_death_at": self.last_death_at,
            "last_restore_s": self.last_restore_s,
            "last_restore_age_s": self.last_restore_age_s,
            "adopted": self.adopted,
            "registered_at": self.registered_at,
            "ended_at": self.ended_at,
        }

    def _crashing(self, at_ns: int) -> str:
        """What is being done about a recurring crash; empty: nothing."""
        window_s = self.config.restore_window_s
        if self.attempt < 2 or at_ns - self.last_death_ns > window_s * 1e9:
            return ""
        text = f"keeps crashing: restore {self.attempt} of {self.config.restore_max} within {window_s:g} s"
        return f"{text}; given up: {self.last_dropped}" if self.last_dropped else text

    def _suffer(self, reason: str) -> None:
        """A checkpoint failed: generations already held still protect it."""
        if self.state is State.PROTECTED and not self.generations:
            self._to(State.UNPROTECTED, f"{reason}; checkpoints go on as soon as they can")
        else:
            self.reason = reason

    def _to(self, state: State, reason: str = "") -> None:
        self.state = state
        self.reason = reason
