# SPDX-License-Identifier: Apache-2.0
"""Clients that ask a program all the time, and judge every answer.

What a client may see depends on whether the program was killed in between.
`Load.epoch` tells: it is odd from just before a kill until the restore has been
seen.  An answer to a request that was sent in an even epoch, and read before
it ended, comes from a program that was not killed since: nothing is forgiven
there.
"""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from dataclasses import dataclass, field

from testkit.programs.wire import Closed, Garbled, NoAnswer, Session

CLIENTS = 4
PATIENCE_S = 0.5
"""Of a client with a time limit; doubled each time that it was too short."""
VISITS = 20
"""Requests of the first client on one connection; the others keep theirs."""


@dataclass
class Load:
    """All clients of one container."""

    session: type[Session]
    host: str
    limited: bool
    """Whether the clients have a time limit, and forgive what a rolled back stream does to them."""
    seed: int
    hangs_s: float = 30.0
    """A client without a time limit that has waited for so long waits for ever."""
    epoch: int = 0
    failures: list[str] = field(default_factory=list)
    clients: list[Client] = field(default_factory=list)
    seen: Counter[str] = field(default_factory=Counter)
    """What the clients met: answers, closed, no answer, garbled, stale."""
    stopping: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self) -> None:
        self.clients = [Client(self, n) for n in range(CLIENTS)]
        for client in self.clients:
            client.start()

    def stop(self) -> None:
        """Ends the clients; waits for a request that is under way."""
        self.stopping = True
        for client in self.clients:
            client.join()

    def mark(self) -> None:
        """Remembers what has been acknowledged, just before a checkpoint is taken."""
        for client in self.clients:
            client.marked = client.acknowledged

    def commit(self) -> None:
        """The checkpoint was taken: no restore goes behind what was acknowledged before it."""
        for client in self.clients:
            client.floor = client.marked

    def fail(self, why: str) -> None:
        with self.lock:
            self.failures.append(why)

    def met(self, what: str, times: int = 1) -> None:
        with self.lock:
            self.seen[what] += times

    def served(self, times: int) -> bool:
        """Whether every client was told its counter that many times, by requests sent in this epoch."""
        return all(client.counted[self.epoch] >= times for client in self.clients)


@dataclass(frozen=True)
class Acknowledged:
    """A counter's value as a client was told it, and on which of its connections."""

    value: int = 0
    connection: int = 0


class Client(threading.Thread):
    """One client with one connection at a time."""

    def __init__(self, load: Load, number: int) -> None:
        super().__init__(name=f"client {number}", daemon=True)
        self.load = load
        self.number = number
        self.rng = random.Random(load.seed * 100 + number)
        self.acknowledged = self.marked = self.floor = Acknowledged()
        self.counted: Counter[int] = Counter()
        """Answers with the counter, by the epoch in which the request was sent."""
        self.doing = ""
        self._session: Session | None = None
        self._connections = 0
        self._sent = 0
        """Requests that count; on this connection, where the counter is the connection's."""
        self._owed = 0
        """How many of them had no answer: each may have been counted, may not, or may be later."""
        self._told_in = 0
        """The epoch in which the counter was asked for that `acknowledged` has."""
        self._heard_in = 0
        """The epoch of the last request that had an answer, or of the connect."""
        self._patience_s = PATIENCE_S if load.limited else load.hangs_s

    def run(self) -> None:
        try:
            while not self.load.stopping and not self.load.failures:
                self._one()
                time.sleep(self.rng.uniform(0, 0.008))
        except Exception as error:  # noqa: BLE001 - a client that dies would look like one that is content
            self.load.fail(f"{self.name}: {type(error).__name__}: {error}")
        finally:
            self._leave()

    def _one(self) -> None:
        """One request, and everything that may come of it."""
        sent_in = self.load.epoch
        try:
            if self._session is None:
                self._enter(sent_in)
            self._ask(sent_in)
        except Closed as error:
            self._lost("closed", str(error), forgiven=self._killed_since(self._heard_in))
        except NoAnswer as error:
            self._lost(
                "no answer", f"hangs: no answer within {self.load.hangs_s:g} s ({error})", forgiven=self.load.limited
            )
            self._patience_s *= 2
        except Garbled as error:
            self._lost("garbled", str(error), forgiven=self.load.limited and self._killed_since(self._heard_in))
        else:
            self._patience_s = PATIENCE_S if self.load.limited else self.load.hangs_s

    def _enter(self, sent_in: int) -> None:
        self.doing = "connect"
        # A program of many clients knows each by a name.
        self._session = self.load.session(self.load.host, f"client{self.number}", self._patience_s)
        self._connections += 1
        self._heard_in = sent_in
        if not self._session.persistent:
            self._sent = 0
            self._owed = 0
            self.acknowledged = Acknowledged(0, self._connections)
            self._told_in = sent_in

    def _ask(self, sent_in: int) -> None:
        session = self._session
        assert session is not None
        counts = self.rng.random() < 0.7
        self.doing = "count" if counts else "data"
        stale = session.stale
        self._sent += counts or session.counts_data
        self._owed += counts or session.counts_data
        if counts:
            self._judge(session.count())
        else:
            session.data(self.rng)
        if session.stale > stale:
            self.load.met("stale", session.stale - stale)
            if not (self.load.limited and self._killed_since(self._heard_in)):
                self.load.fail(f"{self.name}: an answer came a second time ({self.doing})")
        self.load.met("answers")
        self._heard_in = sent_in
        if counts:
            self._told_in = sent_in
            self.counted[sent_in] += 1
        if self.number == 0 and self.rng.random() < 1 / VISITS:
            self._leave()

    def _judge(self, value: int) -> None:
        """Compares the counter with what is known of it."""
        last, others = self.acknowledged.value, self._owed - 1
        if value > self._sent:
            why = f"the counter is {value} after {self._sent} requests"
        elif self._killed_since(self._told_in):
            # Not behind what was acknowledged before the newest checkpoint.
            floor = self.floor.value if self.floor.connection in (0, self._connections) else 0
            why = "" if value > floor else f"the counter is {value}, and {floor} was acknowledged before the checkpoint"
            self._owed -= 1
        else:
            ok = last < value <= last + 1 + others
            why = "" if ok else f"the counter went from {last} to {value} without a kill, {others} had no answer"
            self._owed -= value - last
        if why:
            self.load.fail(f"{self.name}: {why}")
        session = self._session
        assert session is not None
        self.acknowledged = Acknowledged(value, 0 if session.persistent else self._connections)

    def _killed_since(self, epoch: int) -> bool:
        """Whether the program may have been killed since that epoch, or in it."""
        now = self.load.epoch
        return now != epoch or now % 2 == 1

    def _lost(self, what: str, why: str, *, forgiven: bool) -> None:
        if not forgiven:
            self.load.fail(f"{self.name}: {what}, not to be explained by a kill ({self.doing}): {why}")
        self.load.met(what)
        self._leave()
        if what == "closed":
            time.sleep(0.01)

    def _leave(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None
