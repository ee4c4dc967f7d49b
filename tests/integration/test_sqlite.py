# SPDX-License-Identifier: Apache-2.0
"""A database in a protected container: commits survive, and memory never goes back behind them.

`make test-sqlite` kills it hundreds of times.
"""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.databases.observer import Observer
from testkit.databases.rounds import LOAD, Bank, kill_at_random
from testkit.harness import ContainerFactory, Sidecar, take_checkpoint

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; kills come at random moments"
)

KILLS = 4


@pytest.fixture
def observer() -> Iterator[Observer]:
    """A process outside that is told of each commit."""
    with Observer() as made:
        yield made


def transact(bank: Bank, token: str) -> None:
    """One whole transaction."""
    begin(bank, token)
    end(bank)


def begin(bank: Bank, token: str) -> None:
    since = bank.observer.mark()
    bank.observer.say(f"begin {token}")
    bank.observer.wait("begun", since=since)


def end(bank: Bank) -> None:
    since = bank.observer.mark()
    bank.observer.say("commit")
    bank.observer.wait("committed", since=since)


def checkpoint(sidecar: Sidecar, bank: Bank) -> None:
    # What was written right before a checkpoint counts as written since it.
    time.sleep(0.1)
    take_checkpoint(sidecar.client, bank.container.name, 60)


@pytest.mark.parametrize("journal", ["delete", "wal"])
@pytest.mark.parametrize("files", ["auto", "strict"])
def test_restores_only_what_agrees_with_the_database(
    files: str, journal: str, sidecar: Sidecar, container: ContainerFactory, observer: Observer, tmp_path: Path
) -> None:
    bank = Bank(container, observer, tmp_path, files, ["--journal", journal], restart="always", interval="1h")
    transact(bank, "first")
    checkpoint(sidecar, bank)
    # Nobody has written since: it goes on where it was.
    done = bank.kill()
    assert (done.outcome, done.damage) == ("restored", [])
    transact(bank, "second")
    # Written since: started anew, by Podman, and protected again.
    done = bank.kill()
    assert (done.outcome, done.damage) == ("cold", [])
    assert f"avckpt.files={files}" in done.detail
    assert len(observer.lines("start")) == 2
    # In the middle of a transaction, whose end the checkpoint does not know.
    begin(bank, "third")
    checkpoint(sidecar, bank)
    end(bank)
    done = bank.kill()
    assert (done.outcome, done.damage) == ("cold", [])
    assert observer.lines("start")[-1].rest == "3"


def test_strict_sees_a_database_that_is_opened_for_each_transaction(
    sidecar: Sidecar, container: ContainerFactory, observer: Observer, tmp_path: Path
) -> None:
    bank = Bank(container, observer, tmp_path, "strict", ["--reopen"], restart="on-failure", interval="1h")
    transact(bank, "first")
    checkpoint(sidecar, bank)
    assert bank.kill().outcome == "restored"
    transact(bank, "second")
    done = bank.kill()
    assert (done.outcome, done.damage) == ("cold", [])


@pytest.mark.parametrize("journal", ["truncate", "wal"])
def test_rewind_loses_transactions(
    journal: str, sidecar: Sidecar, container: ContainerFactory, observer: Observer, tmp_path: Path
) -> None:
    """Why `strict` exists: a restored process overwrites newer transactions with the end of an old one.

    (With a journal that is deleted, its open one is gone, which often ends in an I/O error instead.)
    """
    bank = Bank(container, observer, tmp_path, "rewind", ["--journal", journal], interval="1h")
    transact(bank, "first")
    begin(bank, "second")
    checkpoint(sidecar, bank)
    end(bank)
    for n in range(3, 10):
        transact(bank, f"transaction {n}")
    assert bank.kill().outcome == "restored"
    # It stands in the middle of the second, and has what it wants to write in memory.
    since = observer.mark()
    observer.say("commit")
    observer.wait("committed", "error", since=since)
    assert bank.audit().damage, "nothing was lost"


@pytest.mark.parametrize("journal", ["delete", "wal"])
@pytest.mark.parametrize("files", ["auto", "strict"])
def test_under_write_load(
    files: str, journal: str, sidecar: Sidecar, container: ContainerFactory, observer: Observer, tmp_path: Path
) -> None:
    bank = Bank(container, observer, tmp_path, files, [*LOAD, "--journal", journal], restart="always")
    rng = random.Random(1)
    for _ in range(KILLS):
        done = kill_at_random(bank, rng)
        assert done.outcome in ("restored", "cold")
        assert done.damage == []
    assert len(observer.told()) > KILLS
