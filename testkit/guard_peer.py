# SPDX-License-Identifier: Apache-2.0
"""A process that starts guards, and nothing else: so that tests can give them commands, and kill them.

    python -m testkit.guard_peer CONFIG INIT_PID...

CONFIG is a GuardConfig as JSON.  One guard per init, cookies from 1.  Every event is a line of
JSON on standard output.  Commands are lines on standard input:

    checkpoint COOKIE TICKET       restore COOKIE TICKET      with a time in s behind it: not later
    burst COOKIE TICKET N          N checkpoints back to back; one line {"burst": TICKET, ...} at the end
    check COOKIE MS                kills a guard that has not been heard of for so long
    tasks COOKIE LIMIT             its container may have so many, from now on
    memory COOKIE BYTES            the same
    start COOKIE PID               another guard in place of that one, for the application below that init
    stop                           stops the guards and ends

The end of the input ends it as `stop` does.  AVCKPT_TEST_GUARD names another avckpt-guard to start.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import select
import sys
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import avckpt.engine
from avckpt.engine import Engine, Guard
from avckpt.errors import TargetGone
from avckpt.events.vocabulary import Kind, Reason
from avckpt.guard import Command, Event, GuardConfig


def config_of_json(text: str) -> GuardConfig:
    """A GuardConfig from the JSON of its fields."""
    fields = json.loads(text)
    fields["restore_on_statuses"] = frozenset(fields["restore_on_statuses"])
    return GuardConfig(**fields)


@dataclass
class Burst:
    """Checkpoints back to back: the next is asked for when the last is answered."""

    cookie: int
    ticket: int
    left: int
    taken: int = 0
    missed: int = 0
    freeze_s: list[float] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)

    def take(self, event: Event) -> None:
        """Counts the answer to one of them."""
        self.left -= 1
        if event.kind is Kind.CHECKPOINT:
            self.taken += 1
            self.freeze_s.append(event.freeze_s)
        else:
            self.missed += 1
            self.reasons[str(event.error)] += 1

    def to_json(self) -> dict[str, object]:
        """What came out."""
        return {
            "burst": self.ticket,
            "taken": self.taken,
            "missed": self.missed,
            "freeze_s": sorted(self.freeze_s)[len(self.freeze_s) // 2] if self.freeze_s else 0.0,
            "reasons": dict(self.reasons),
        }


class Peer:
    """The guards, and what is under way."""

    def __init__(self, engine: Engine, config: GuardConfig, pids: list[int]) -> None:
        self.engine = engine
        self.guards: dict[int, Guard] = {}
        self.config = config
        for cookie, pid in enumerate(pids, 1):
            self.start(cookie, pid)
        self.burst: Burst | None = None

    def start(self, cookie: int, pid: int) -> None:
        """One guard."""
        pidfd = os.pidfd_open(pid)
        self.guards[cookie] = self.engine.start_guard(pidfd, self.config, cookie)
        os.close(pidfd)

    def start_another(self, cookie: int, pid: int) -> None:
        """What there is to be told of the one before is told first."""
        self.guards[cookie].stop()
        self.take_events()
        self.start(cookie, pid)
        tell({"kind": "started", "guards": [guard.pid for guard in self.guards.values()]})

    def serve(self) -> None:
        """Until told to stop."""
        buffer = b""
        while True:
            for fd in select.select([0, self.engine.event_fd], [], [])[0]:
                if fd != 0:
                    self.take_events()
                    continue
                data = os.read(0, 4096)
                if not data:
                    return
                *lines, buffer = (buffer + data).split(b"\n")
                for line in lines:
                    if line == b"stop":
                        return
                    with contextlib.suppress(TargetGone):  # guard_lost tells
                        self.obey(line.decode().split())

    def obey(self, words: list[str]) -> None:
        """One line of the input."""
        cookie, ticket = int(words[1]), int(words[2])
        if words[0] == "check":
            self.guards[cookie].check(ticket / 1000)
            return
        if words[0] in ("tasks", "memory"):
            limit: dict[str, Any] = {{"tasks": "tasks_max", "memory": "memory_limit_bytes"}[words[0]]: ticket}
            self.config = dataclasses.replace(self.config, **limit)
            self.guards[cookie].configure(self.config)
            return
        if words[0] == "start":
            self.start_another(cookie, int(words[2]))
            return
        if words[0] == "burst":
            self.burst = Burst(cookie, ticket, int(words[3]))
            self.guards[cookie].command(Command.CHECKPOINT, ticket)
        else:
            self.guards[cookie].command(Command[words[0].upper()], ticket, float(words[3]) if len(words) > 3 else 0.0)

    def take_events(self) -> None:
        """Tells what happened."""
        while (event := self.engine.next_event()) is not None:
            burst = self.burst
            if burst is not None and event.ticket == burst.ticket:
                burst.take(event)
                if burst.left:
                    self.guards[burst.cookie].command(Command.CHECKPOINT, burst.ticket)
                else:
                    self.burst = None
                    tell(burst.to_json())
            else:
                tell({**event.to_json(), "cookie": event.cookie})
            if event.kind is Kind.GUARD_LOST and event.reason is Reason.FILTER:
                tell({"kind": "started", "guards": [guard.pid for guard in self.guards.values()]})


def tell(message: dict[str, object]) -> None:
    """One line of the output."""
    print(json.dumps(message), flush=True)


def main() -> None:
    """See above."""
    if program := os.environ.get("AVCKPT_TEST_GUARD"):
        setattr(avckpt.engine, "guard_binary", lambda: Path(program))  # noqa: B010
    with Engine() as engine:
        peer = Peer(engine, config_of_json(sys.argv[1]), [int(pid) for pid in sys.argv[2:]])
        tell({"kind": "started", "guards": [guard.pid for guard in peer.guards.values()]})
        peer.serve()
        for guard in peer.guards.values():
            guard.stop()
        peer.take_events()
        tell({"kind": "stopped"})
        # Kept for a look from outside at what is left behind, until the input ends.
        while os.read(0, 4096):
            continue


if __name__ == "__main__":
    main()
