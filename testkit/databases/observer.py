# SPDX-License-Identifier: Apache-2.0
"""Who is told of every committed transaction, and asks the database for it afterwards."""

from __future__ import annotations

import contextlib
import socket
import sqlite3
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from testkit.databases.bank import ACCOUNTS, ENTRIES, MONEY
from testkit.harness import wait_until


@dataclass(frozen=True)
class Line:
    """What the bank said, and when it was heard (CLOCK_MONOTONIC)."""

    at_s: float
    word: str
    rest: str


class Observer:
    """Listens on a port of 127.0.0.1; outlives the bank's deaths.  A context manager."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._lock = threading.Lock()
        self._lines: list[Line] = []
        self._last: socket.socket | None = None
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def __enter__(self) -> Observer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # close() would leave accept() waiting.
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def lines(self, *words: str, since: int = 0) -> list[Line]:
        """Everything that began with one of these words, in the order it came."""
        with self._lock:
            return [line for line in self._lines[since:] if line.word in words]

    def mark(self) -> int:
        """A moment: give it to lines() or wait() as `since`."""
        with self._lock:
            return len(self._lines)

    def wait(self, *words: str, since: int = 0, count: int = 1, timeout_s: float = 30.0) -> Line:
        """The `count`th such line."""

        def look() -> list[Line]:
            found = self.lines(*words, since=since)
            return found if len(found) >= count else []

        return wait_until(look, timeout_s, f"the bank says {' or '.join(words)}", 0.005)[count - 1]

    def say(self, line: str) -> None:
        """To the bank that has connected last."""
        assert self._last is not None
        self._last.sendall(line.encode() + b"\n")

    def told(self) -> list[str]:
        """The tokens of committed transactions."""
        return [line.rest.split()[0] for line in self.lines("committed")]

    def committed_s(self) -> list[float]:
        """When they were, by the bank's own clock (CLOCK_MONOTONIC)."""
        return [float(line.rest.split()[1]) for line in self.lines("committed")]

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                self._last = connection
                threading.Thread(target=self._hear, args=[connection], daemon=True).start()

    def _hear(self, connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection, connection.makefile() as stream:
            for text in stream:
                word, _, rest = text.rstrip("\n").partition(" ")
                with self._lock:
                    self._lines.append(Line(time.monotonic(), word, rest))


@dataclass(frozen=True)
class Audit:
    """What is wrong with a database."""

    integrity: str
    """What PRAGMA integrity_check says first: "ok"; or the error that SQLite had."""
    missing: int
    """Transactions that were told and are not there, or not with all their entries."""
    twice: int
    """Transactions that were told more than once."""
    money: int
    """What the accounts have more than they should."""

    @property
    def damage(self) -> list[str]:
        """In words; empty: none."""
        found = []
        if self.integrity != "ok":
            found.append(f"integrity_check: {self.integrity}")
        if self.missing:
            found.append(f"{self.missing} committed transactions lost")
        if self.money:
            found.append(f"the accounts have {self.money:+} too much")
        return found


def audit(database: Path, told: list[str]) -> Audit:
    """Looks at the database, as any other program would; whoever uses it may go on."""
    twice = sum(1 for times in Counter(told).values() if times > 1)
    try:
        with contextlib.closing(sqlite3.connect(database, timeout=60, isolation_level=None)) as connection:
            connection.execute("BEGIN")
            (integrity,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
            entries = dict(connection.execute("SELECT token, count(DISTINCT n) FROM entry GROUP BY token"))
            there = {token for (token,) in connection.execute("SELECT token FROM tx")}
            (money,) = connection.execute("SELECT sum(balance) FROM account").fetchone()
            connection.execute("COMMIT")
    except sqlite3.Error as error:
        return Audit(str(error), 0, twice, 0)
    missing = sum(1 for token in set(told) if token not in there or entries.get(token) != ENTRIES)
    return Audit(integrity, missing, twice, money - ACCOUNTS * MONEY)
