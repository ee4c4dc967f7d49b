# SPDX-License-Identifier: Apache-2.0
"""Connections: what processes of one application have asked each other is rolled back with them; a Unix connection
with a process outside, which is not rolled back, is cut."""

from __future__ import annotations

import os
import random
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import wait_until
from testkit.scenario import checkpoint

KILLS = 60 if os.environ.get("AVCKPT_LONG") == "1" else 12
CLIENTS = 4


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def kill_some_times(guard: GuardProcess, until: Callable[[], Callable[[], bool]]) -> None:
    rng = random.Random(1)
    app = guard.wait("attached")["app_pid"]
    for _ in range(KILLS):
        checkpoint(guard)
        time.sleep(rng.uniform(0, 0.05))
        since = guard.mark()
        os.kill(app, signal.SIGKILL)
        app = guard.wait("restored", since=since)["app_pid"]
        wait_until(until(), PATIENCE_S, "every client has answers")


def all_have_answers(victim: Victim) -> Callable[[], bool]:
    """Whether each of its clients has some more than now."""
    before = victim.see().counter

    def check() -> bool:
        seen = victim.see()
        assert not seen.violations, victim.said
        return all(seen.counter[i] > before[i] + 20 for i in range(CLIENTS))

    return check


@pytest.mark.parametrize("command", ["stream", "record", "stream --again", "record --again", "tcp", "tcp6"])
def test_every_question_has_its_answer(command: str, tmp_path: Path) -> None:
    """The server is killed at random moments; its clients, which go back with it, wait for no lost answer."""
    with Victim(f"callers {CLIENTS} {command}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        kill_some_times(guard, lambda: all_have_answers(victim))


TYPES = {"stream": socket.SOCK_STREAM, "record": socket.SOCK_SEQPACKET}


def answer_all(connection: socket.socket) -> None:
    """Each number with the next one, as the victim does."""
    with connection, suppress(ConnectionError):
        while len(asked := connection.recv(8, socket.MSG_WAITALL)) == 8:
            connection.sendall((int.from_bytes(asked, "little") + 1).to_bytes(8, "little"))


@contextmanager
def server(path: Path, kind: str) -> Iterator[None]:
    with socket.socket(socket.AF_UNIX, TYPES[kind]) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            while True:
                try:
                    connection = listener.accept()[0]
                except OSError:
                    return
                threading.Thread(target=answer_all, args=(connection,), daemon=True).start()

        thread = threading.Thread(target=serve)
        thread.start()
        yield
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()


class Asker(threading.Thread):
    """A client outside, which keeps its connection until it ends."""

    def __init__(self, path: Path, kind: str) -> None:
        super().__init__()
        self.path, self.kind = path, kind
        self.answers, self.ended, self.wrong, self.stopped = 0, 0, 0, False

    def run(self) -> None:
        number = 0
        while not self.stopped:
            with socket.socket(socket.AF_UNIX, TYPES[self.kind]) as connection:
                connection.settimeout(PATIENCE_S)
                try:
                    connection.connect(str(self.path))
                    while not self.stopped:
                        number += 2
                        connection.sendall(number.to_bytes(8, "little"))
                        answer = connection.recv(8, socket.MSG_WAITALL)
                        if not answer:
                            break
                        self.answers += 1
                        self.wrong += int.from_bytes(answer, "little") != number + 1
                except (ConnectionError, FileNotFoundError):
                    pass
            self.ended += 1


@pytest.mark.parametrize("where", ["", "--in-child"])
@pytest.mark.parametrize("kind", TYPES)
def test_a_server_outside_answers_what_was_asked(kind: str, where: str, tmp_path: Path) -> None:
    """Its clients are killed: none takes the answer to what it has forgotten, or waits for one that it had."""
    path = tmp_path / "server"
    with (
        server(path, kind),
        Victim(f"callers {CLIENTS} {kind} {path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        kill_some_times(guard, lambda: all_have_answers(victim))


@pytest.mark.parametrize("kind", TYPES)
def test_clients_outside_have_their_own_answers(kind: str, tmp_path: Path) -> None:
    """Their server is killed: their connections end, and they connect again."""
    path = tmp_path / "server"
    clients = [Asker(path, kind) for _ in range(CLIENTS)]
    with (
        Victim(f"callers 0 {kind} {path}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        for client in clients:
            client.start()

        def all_go_on() -> Callable[[], bool]:
            before = [client.answers for client in clients]
            return lambda: all(client.answers > n + 20 for client, n in zip(clients, before, strict=True))

        try:
            kill_some_times(guard, all_go_on)
        finally:
            for client in clients:
                client.stopped = True
                client.join()
    assert [client.wrong for client in clients] == [0] * CLIENTS
    assert all(client.ended >= KILLS for client in clients)
