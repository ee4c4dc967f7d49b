# SPDX-License-Identifier: Apache-2.0
"""The clients of testkit/programs detect wrong servers: each of these lies in a different way."""

from __future__ import annotations

import socketserver
import threading
import zlib
from collections import Counter
from collections.abc import Iterator

import pytest

from testkit.harness import wait_until
from testkit.programs.lines import LineSession
from testkit.programs.load import Load


class Liar(socketserver.ThreadingTCPServer):
    """Answers like the servers of testkit/programs, until `lie` says otherwise."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Session)
        self.counters: Counter[str] = Counter()
        self.lie = ""
        self.released = threading.Event()


class Session(socketserver.StreamRequestHandler):
    server: Liar

    def handle(self) -> None:
        for line in self.rfile:
            number, what, *args = line.decode().split()
            answer = self.count(args[0]) if what == "inc" else self.data(int(args[0]))
            lie = self.server.lie
            if lie == "hang":
                self.server.released.wait(30)
                return
            if lie == "close":
                return
            if lie == "twice":
                self.wfile.write(f"{number} {answer}\n".encode())
            if lie == "torn":
                answer = f"\n{answer}"
            self.wfile.write(f"{number} {answer}\n".encode())

    def count(self, name: str) -> str:
        step = {"skips": 2, "stands still": 0, "goes back": -3}.get(self.server.lie, 1)
        self.server.counters[name] += step
        return str(self.server.counters[name])

    def data(self, n: int) -> str:
        text = "a" * n
        if self.server.lie == "other data" and n:
            text = "a" * (n - 1) + "b"
        return f"{zlib.crc32(b'a' * n):08x} {text}"


@pytest.fixture
def server() -> Iterator[Liar]:
    with Liar() as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.released.set()
        server.shutdown()
        thread.join()


@pytest.fixture(params=[False, True], ids=["strict", "limited"])
def load(request: pytest.FixtureRequest, server: Liar) -> Iterator[Load]:
    """Clients that have been served for a while."""

    class ToServer(LineSession):
        port = server.server_address[1]

    load = Load(ToServer, "127.0.0.1", limited=request.param, seed=1, hangs_s=1.0)
    load.start()
    wait_until(lambda: load.served(5) or load.failures, 20, "every client is served")
    assert load.failures == []
    yield load
    server.released.set()
    load.stop()


def kill(load: Load, server: Liar, *, back_by: int) -> None:
    """As if the server had been killed and restored."""
    load.epoch += 1
    for name in server.counters:
        server.counters[name] = max(0, server.counters[name] - back_by)
    load.epoch += 1


@pytest.mark.parametrize("lie", ["skips", "stands still", "goes back", "close", "twice", "torn", "other data"])
def test_without_a_kill_nothing_is_forgiven(load: Load, server: Liar, lie: str) -> None:
    server.lie = lie
    wait_until(lambda: load.failures, 20, "a client finds it")


def test_only_a_client_with_a_time_limit_forgives_that_nothing_comes(load: Load, server: Liar) -> None:
    server.lie = "hang"
    wait_until(lambda: load.seen["no answer"] > 3 or load.failures, 20, "the clients wait")
    assert bool(load.failures) is not load.limited


def test_only_a_client_with_a_time_limit_forgives_what_is_said_twice(load: Load, server: Liar) -> None:
    load.epoch += 1
    server.lie = "twice"
    wait_until(lambda: load.seen["stale"] > 3 or load.failures, 20, "the clients hear it")
    assert bool(load.failures) is not load.limited


def test_a_counter_may_go_back_to_the_checkpoint(load: Load, server: Liar) -> None:
    load.mark()
    load.commit()
    marked = min(client.floor.value for client in load.clients)
    wait_until(lambda: min(client.acknowledged.value for client in load.clients) > marked + 5, 20, "the counters go on")
    kill(load, server, back_by=2)
    wait_until(lambda: load.served(3) or load.failures, 20, "every client is served")
    assert load.failures == []


def test_a_counter_may_not_go_back_behind_the_checkpoint(load: Load, server: Liar) -> None:
    wait_until(lambda: load.served(10), 20, "the counters go on")
    load.mark()
    load.commit()
    kill(load, server, back_by=max(server.counters.values()) - 3)
    wait_until(lambda: load.failures, 20, "a client finds it")
    assert "acknowledged before the checkpoint" in load.failures[0]
