# SPDX-License-Identifier: Apache-2.0
"""A bank on SQLite, run inside a protected container: every committed transaction is told to an observer.

    bank.py HOST PORT DATABASE [--journal delete|truncate|persist|wal] [--mmap]
            [--reopen] [--burst S] [--idle S] [--think S] [--pause S]

With --burst it moves money for random times around S seconds, then rests for such times around
--idle.  Without, it does what the observer says: a line "begin TOKEN" or "commit".

A transaction has a TOKEN, ENTRIES entries and two accounts.  It is told ("committed TOKEN TIME") after COMMIT
has returned, so whatever was told has to be in the database for ever.  What the bank knows in its own
memory (balances, how many transactions there are) is compared with the database after every burst; when they
differ it says "disagree ..." and ends, as it does after an error of SQLite's ("error ...").
"""

from __future__ import annotations

import argparse
import os
import random
import socket
import sqlite3
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

ACCOUNTS, MONEY, ENTRIES = 200, 1000, 8

SCHEMA = f"""
CREATE TABLE IF NOT EXISTS account (id INTEGER PRIMARY KEY, balance INTEGER NOT NULL, note TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS tx (token TEXT PRIMARY KEY, at REAL NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS entry (token TEXT NOT NULL, n INTEGER NOT NULL, text TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS entry_token ON entry (token, n);
CREATE INDEX IF NOT EXISTS account_balance ON account (balance);
INSERT OR IGNORE INTO account
    WITH RECURSIVE one (id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM one WHERE id < {ACCOUNTS})
    SELECT id, {MONEY}, hex(randomblob(100)) FROM one;
"""


class Bank:
    """The database, and what is known of it in memory."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.observer = connect(options.host, options.port)
        self.connection: sqlite3.Connection | None = None
        with self.database() as database:
            database.executescript("BEGIN IMMEDIATE;" + SCHEMA + "COMMIT;")
            self.balances, self.count = look(database)
        self.tell(f"start {self.count}")

    def tell(self, line: str) -> None:
        self.observer.sendall(line.encode() + b"\n")

    def open(self) -> sqlite3.Connection:
        """A connection as the options say."""
        options = self.options
        database = sqlite3.connect(options.database, isolation_level=None, timeout=60)
        database.execute(f"PRAGMA journal_mode = {options.journal}")
        database.execute("PRAGMA synchronous = FULL")
        if options.mmap:
            database.execute("PRAGMA mmap_size = 67108864")
        return database

    @contextmanager
    def database(self) -> Iterator[sqlite3.Connection]:
        """The one connection, or a new one each time (--reopen)."""
        if self.connection is None:
            self.connection = self.open()
        yield self.connection
        if self.options.reopen:
            self.connection.close()
            self.connection = None

    def begin(self, token: str) -> tuple[int, int, int]:
        """All of a transaction but its COMMIT; the database stays open.  Which accounts, and how much."""
        if self.connection is None:
            self.connection = self.open()
        database = self.connection
        database.execute("BEGIN IMMEDIATE")
        source, target = random.sample(range(1, ACCOUNTS + 1), 2)
        amount = random.randint(1, 50)
        for n in range(ENTRIES):
            text = os.urandom(random.randint(20, 150)).hex()
            database.execute("INSERT INTO entry VALUES (?, ?, ?)", (token, n, text))
        time.sleep(random.uniform(0.0, self.options.think))
        for account, change in ((source, -amount), (target, amount)):
            # From memory, as a program that believes itself to be the only one does.
            database.execute("UPDATE account SET balance = ? WHERE id = ?", (self.balances[account] + change, account))
        database.execute("INSERT INTO tx VALUES (?, ?)", (token, time.time()))
        return source, target, amount

    def commit(self, token: str, source: int, target: int, amount: int) -> None:
        """Its end."""
        with self.database() as database:
            database.execute("COMMIT")
            self.balances[source] -= amount
            self.balances[target] += amount
            self.count += 1
        self.tell(f"committed {token} {time.monotonic():.6f}")

    def check(self) -> None:
        """Memory and file agree, or this is the end."""
        with self.database() as database:
            balances, count = look(database)
        if (balances, count) != (self.balances, self.count):
            self.tell(f"disagree memory knows {self.count} transactions, the database {count}")
            sys.exit(3)

    def work(self) -> None:
        """For ever."""
        while True:
            until = time.monotonic() + random.uniform(0.2, 1.8) * self.options.burst
            while time.monotonic() < until:
                token = os.urandom(12).hex()
                self.commit(token, *self.begin(token))
                time.sleep(random.uniform(0.0, self.options.pause))
            self.check()
            self.tell("idle")
            time.sleep(random.uniform(0.2, 1.8) * self.options.idle)
            self.check()
            self.tell("busy")

    def obey(self) -> None:
        """Does what the observer says, until it says no more."""
        pending: tuple[str, int, int, int] | None = None
        for line in self.observer.makefile():
            word, _, token = line.strip().partition(" ")
            if word == "begin":
                pending = (token, *self.begin(token))
                self.tell(f"begun {token}")
            elif word == "commit" and pending is not None:
                self.commit(*pending)
                pending = None
            elif word == "check":
                self.check()
                self.tell("checked")


def look(database: sqlite3.Connection) -> tuple[dict[int, int], int]:
    """Balances and the number of transactions, as the database has them."""
    database.execute("BEGIN")
    balances = dict(database.execute("SELECT id, balance FROM account"))
    (count,) = database.execute("SELECT count(*) FROM tx").fetchone()
    database.execute("COMMIT")
    return balances, count


def connect(host: str, port: int) -> socket.socket:
    """To the observer, who may be late."""
    while True:
        try:
            made = socket.create_connection((host, port), 5)
        except OSError:
            time.sleep(0.1)
            continue
        made.settimeout(None)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return made


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("host")
    parser.add_argument("port", type=int)
    parser.add_argument("database")
    parser.add_argument("--journal", default="delete")
    parser.add_argument("--mmap", action="store_true", help="PRAGMA mmap_size")
    parser.add_argument("--reopen", action="store_true", help="a connection for each transaction")
    parser.add_argument("--burst", type=float, default=0.0)
    parser.add_argument("--idle", type=float, default=0.0)
    parser.add_argument("--think", type=float, default=0.0, help="at most so many seconds inside a transaction")
    parser.add_argument("--pause", type=float, default=0.0, help="at most so many seconds between transactions")
    options = parser.parse_args()
    bank = Bank(options)
    try:
        if options.burst:
            bank.work()
        else:
            bank.obey()
    except sqlite3.Error as error:
        bank.tell(f"error {error}")
        sys.exit(3)


if __name__ == "__main__":
    main()
