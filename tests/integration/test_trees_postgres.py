# SPDX-License-Identifier: Apache-2.0
"""PostgreSQL with avckpt.files=strict: when idle it is restored completely, under write load it starts cold."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from testkit.harness import Container, ContainerFactory, Sidecar, wait_until
from testkit.trees import LONG, RESTORE_S, Tree, trees_image, write_files

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "a cluster of processes under load may not stop in time"
)

IDLE_KILLS = 20 if LONG else 3
LOAD_KILLS = 50 if LONG else 3
SESSIONS = 8
BIN = "/usr/lib/postgresql/15/bin"

START = f"""#!/bin/sh
# Runs as the user postgres; the data stay in the container over its restarts.
set -e
data=/var/lib/postgresql/data
if [ ! -s $data/PG_VERSION ]; then
    {BIN}/initdb --pgdata=$data --auth=trust --no-sync >/dev/null
fi
port=$1
shift
exec {BIN}/postgres -D $data -c port=$port -c listen_addresses=127.0.0.1 -c unix_socket_directories=/tmp \\
    -c shared_buffers=16MB -c max_connections=40 -c logging_collector=off "$@"
"""
SILENT = ("-c", "wal_level=minimal", "-c", "max_wal_senders=0", "-c", "autovacuum=off")
"""Idle it writes nothing.  As it is otherwise, it notes every now and then what it is about, and `strict` sees it."""


class Session:
    """psql with one connection that it never replaces."""

    def __init__(self, clients: Container, port: int) -> None:
        self.process = subprocess.Popen(
            [
                *("podman", "exec", "-i", clients.name, f"{BIN}/psql", "--no-psqlrc", "-qAt"),
                *("-h", "127.0.0.1", "-p", str(port), "-U", "postgres", "-v", "ON_ERROR_STOP=1", "postgres"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            bufsize=1,
        )

    def ask(self, statement: str) -> str:
        """One statement with one row as its answer.  Raises ConnectionError when the session has ended."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self.process.stdin.write(statement + ";\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        except OSError as error:
            raise ConnectionError(str(error)) from error
        if not line:
            assert self.process.stderr is not None
            self.process.wait()
            raise ConnectionError(f"{statement}: {self.process.stderr.read()}")
        return line.rstrip("\n")

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):
                    stream.close()


class Database:
    """A protected PostgreSQL, and an unprotected container of the same image for its clients."""

    def __init__(self, sidecar: Sidecar, factory: ContainerFactory, folder: Path, port: int, *options: str) -> None:
        write_files(folder, {"start.sh": START})
        image = trees_image(factory.podman)
        self.sidecar = sidecar
        self.port = port
        self.clients = factory("sleep", "infinity", image=image, options=["--network=host"])
        self.server = factory.protected(
            *("/files/start.sh", str(port), *options),
            labels={"interval": "500ms", "files": "strict", "shm": "64MB", "restore.max": "64/1s"},
            options=[
                *("--network=host", "--user", "postgres", "--restart=on-failure:1000"),
                *("--volume", f"{folder}:/files:ro"),
            ],
            image=image,
        )
        self.sessions: list[Session] = []
        self.wait_ready()

    def session(self) -> Session:
        made = Session(self.clients, self.port)
        self.sessions.append(made)
        return made

    def close(self) -> None:
        for session in self.sessions:
            session.close()

    @property
    def is_ready(self) -> bool:
        done = self.clients.exec(
            *(f"{BIN}/pg_isready", "-q", "-h", "127.0.0.1", "-p", str(self.port)), check=False, timeout_s=RESTORE_S
        )
        return done.status == 0

    def wait_ready(self) -> None:
        wait_until(
            lambda: self.is_ready, 2 * RESTORE_S, f"PostgreSQL answers; its log: {self.server.logs()[-800:]}", 0.2
        )

    def run(self, program: str, *args: str, timeout_s: float = 4 * RESTORE_S) -> str:
        """Runs a client program that must succeed."""
        connection = ("-h", "127.0.0.1", "-p", str(self.port), "-U", "postgres")
        return self.clients.exec(f"{BIN}/{program}", *connection, *args, timeout_s=timeout_s).stdout

    def query(self, statement: str) -> str:
        return self.run("psql", "--no-psqlrc", "-qAt", "-c", statement, "postgres").strip()

    def wait_protected(self) -> Tree:
        """Waits for two generations of the server that runs now."""
        self.sidecar.wait_generation(self.server, 2, 2 * RESTORE_S)
        return Tree(self.sidecar, self.server)

    def check_contents(self) -> None:
        """Checks every table against its indexes and every page against its checksum."""
        self.run("pg_amcheck", "--install-missing", "--heapallindexed", "--all")


@pytest.fixture
def start(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, free_port: Callable[[], int]
) -> Iterator[Callable[..., Database]]:
    with contextlib.ExitStack() as stack:

        def make(*options: str) -> Database:
            made = Database(sidecar, container, tmp_path, free_port(), *options)
            stack.callback(made.close)
            return made

        yield make


@pytest.mark.timeout(900)
def test_idle_it_is_restored_whole_with_its_connections(start: Callable[..., Database]) -> None:
    """Backends, the state and locks of their sessions, and all background processes."""
    database = start(*SILENT)
    database.run("pgbench", "-i", "-q", "-s", "1", "postgres")
    database.query("checkpoint")
    sessions = [database.session() for _ in range(SESSIONS)]
    backends = []
    for n, session in enumerate(sessions):
        backends.append(session.ask("select pg_backend_pid()"))
        assert session.ask(f"set application_name = 's{n}'; prepare plus(int) as select $1 + {n}; select 1") == "1"
        assert session.ask(f"create temp table mine as select generate_series(1, {n + 10}) i; select 1") == "1"
        assert session.ask(f"select pg_advisory_lock({n}) is null") == "f"
    tree = database.wait_protected()
    for _ in range(IDLE_KILLS):
        tree.next_generation()
        time.sleep(0.3)
        tree.next_generation()
        before = [place for place in tree.places() if place[4] == "postgres"]
        tree.kill()
        assert [place for place in tree.places() if place[4] == "postgres"] == before
        for n, session in enumerate(sessions):
            assert session.ask("select pg_backend_pid()") == backends[n]
            assert session.ask("select current_setting('application_name')") == f"s{n}"
            assert session.ask("execute plus(100)") == str(100 + n)
            assert session.ask("select sum(i) from mine") == str((n + 10) * (n + 11) // 2)
            assert session.ask(f"select pg_try_advisory_lock({(n + 1) % SESSIONS})") == "f"
        assert database.query("select count(*) from pg_locks where locktype = 'advisory'") == str(SESSIONS)
    assert database.server.inspect()["RestartCount"] == 0
    # And it does its work.
    database.run("pgbench", "-c", "4", "-T", "2", "postgres")
    assert balances(database).count(balances(database)[0]) == 4
    database.check_contents()


def balances(database: Database) -> list[str]:
    """Four sums that every committed pgbench transaction changes by the same amount."""
    return database.query(
        "select (select coalesce(sum(abalance), 0) from pgbench_accounts), "
        "(select coalesce(sum(tbalance), 0) from pgbench_tellers), "
        "(select coalesce(sum(bbalance), 0) from pgbench_branches), "
        "(select coalesce(sum(delta), 0) from pgbench_history)"
    ).split("|")


class Ledger:
    """Commits consecutive numbers, and remembers which of them were acknowledged."""

    def __init__(self, database: Database) -> None:
        self.database = database
        self.acknowledged: list[int] = []
        self.next = 1

    def write_until(self, enough: Callable[[], bool]) -> None:
        """Commits until told to stop, or until the connection ends."""
        session = self.database.session()
        with contextlib.suppress(ConnectionError):
            while not enough():
                number = self.next
                self.next += 1
                if session.ask(f"insert into ledger values ({number}) returning id") == str(number):
                    self.acknowledged.append(number)
        session.close()
        self.database.sessions.remove(session)

    def check(self) -> None:
        """No acknowledged commit is missing."""
        stored = set(map(int, self.database.query("select id from ledger").split()))
        lost = [number for number in self.acknowledged if number not in stored]
        assert lost == [], f"{len(lost)} of {len(self.acknowledged)} committed transactions are lost: {lost[:10]}"


@pytest.mark.timeout(3000)
def test_under_write_load_it_starts_cold_and_loses_nothing(start: Callable[..., Database]) -> None:
    """Data written since the checkpoint rules out a restore; PostgreSQL recovers by itself."""
    rng = random.Random(5)
    database = start()
    database.run("pgbench", "-i", "-q", "-s", "2", "postgres")
    database.query("create table ledger (id bigint primary key)")
    ledger = Ledger(database)
    restores = 0
    for n in range(1, LOAD_KILLS + 1):
        tree = database.wait_protected()
        init = database.server.pid
        with subprocess.Popen(
            [
                *("podman", "exec", database.clients.name, f"{BIN}/pgbench", "-n", "-c", "4", "-T", "600"),
                *("-h", "127.0.0.1", "-p", str(database.port), "-U", "postgres", "postgres"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as load:
            enough = time.monotonic() + rng.uniform(0.5, 2.0)
            count = len(ledger.acknowledged) + 10
            ledger.write_until(lambda end=enough, least=count: ended(ledger, end, least))  # type: ignore[misc]
            os.kill(tree.main, signal.SIGKILL)
            database.clients.exec("pkill", "pgbench", check=False)
            load.wait(RESTORE_S)
        wait_until(lambda old=init: database.is_ready and settled(database, old), 3 * RESTORE_S, "it is back")  # type: ignore[misc]
        restores += database.server.pid == init
        ledger.check()
        sums = balances(database)
        assert sums.count(sums[0]) == 4, f"kill {n}: {sums}"
    database.check_contents()
    print(f"{LOAD_KILLS} kills: {restores} restores, {LOAD_KILLS - restores} cold starts")
    # Somebody wrote all the time: a restore is the rare exception.
    assert restores <= LOAD_KILLS // 2


def ended(ledger: Ledger, end: float, least: int) -> bool:
    return time.monotonic() > end and len(ledger.acknowledged) >= least


def settled(database: Database, old_init: int) -> bool:
    """Waits until it was restored or started anew; the old postmaster's last moments do not count."""
    if database.server.pid not in (0, old_init):
        return True
    entry = database.sidecar.find(database.server)
    return entry is not None and entry["restores"] > 0
