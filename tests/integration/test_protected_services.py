# SPDX-License-Identifier: Apache-2.0
"""Servers in protected containers, as their clients see them."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time

import pytest

from testkit.harness import Container, ContainerFactory, Sidecar, take_checkpoint, wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; clients have time limits of their own"
)

LATER = 2000
"""More than LATE_LEAST of files_late.c."""

ASYNCIO_SERVER = """
import asyncio, os, threading

count = 0
lock = threading.Lock()

async def serve(reader, writer):
    mine = 0
    while line := await reader.readline():
        mine += 1
        writer.write(b'%d %d %s' % (os.getpid(), mine, line))
        await writer.drain()
    writer.close()

def tick():
    global count
    while True:
        with lock:
            count += 1
        threading.Event().wait(0.01)

async def main():
    threading.Thread(target=tick, daemon=True).start()
    server = await asyncio.start_server(serve, '0.0.0.0', 7000)
    n = 0
    while True:
        print('tick', n, flush=True)
        n += 1
        await asyncio.sleep(0.05)

asyncio.run(main())
"""


class Peer:
    """A client that keeps one connection and never makes another."""

    def __init__(self, host: str, port: int) -> None:
        connected = wait_until(lambda: connect(host, port), 15, f"{host}:{port} answers")
        assert connected is not None
        self.socket = connected
        self.received = b""

    def line(self) -> bytes:
        """The next line."""
        while b"\n" not in self.received:
            data = self.socket.recv(65536)
            assert data, "the connection was closed"
            self.received += data
        line, _, self.received = self.received.partition(b"\n")
        return line.rstrip(b"\r")

    def ask(self, text: str) -> bytes:
        """Sends a line and returns the answer."""
        self.socket.sendall(text.encode() + b"\n")
        return self.line()

    def redis(self, *words: str) -> bytes:
        """Sends a command in Redis' protocol; the answer, for a bulk string its text."""
        self.socket.sendall(b"*%d\r\n" % len(words) + b"".join(b"$%d\r\n%s\r\n" % (len(w), w.encode()) for w in words))
        first = self.line()
        return self.line() if first[:1] == b"$" and first != b"$-1" else first


def connect(host: str, port: int) -> socket.socket | None:
    try:
        peer = socket.create_connection((host, port), 5)
    except OSError:
        return None
    peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return peer


def ticks(made: Container) -> list[int]:
    return [int(line.split()[1]) for line in made.logs().splitlines() if line.startswith("tick ")]


@pytest.mark.parametrize("network", ["bridge", "host"])
def test_an_asyncio_server_keeps_its_connection(sidecar: Sidecar, container: ContainerFactory, network: str) -> None:
    """CPython with threads and an event loop: one connection across all restores, and a log that goes on."""
    made = container.protected(
        "python3",
        *("-c", ASYNCIO_SERVER),
        labels={"interval": "100ms", "restore.max": "60/60s", "tcp": "keep"},
        options=[f"--network={network}"],
    )
    peer = Peer(made.ip or "127.0.0.1", 7000)
    pid = int(peer.ask("hello").split()[0])
    sidecar.wait_generation(made, 3)
    before = made.inspect()["State"]["StartedAt"]
    for n in range(1, 6):
        os.kill(sidecar.app_pid(made), signal.SIGSEGV if n % 2 else signal.SIGKILL)
        # Sent while nobody is there, or to the restored one.
        answer = peer.ask(f"question {n}").split()
        assert int(answer[0]) == pid
        assert answer[2:] == [b"question", str(n).encode()]
        entry = sidecar.wait_restores(made, n)
        assert entry["state"] == "protected"
        sidecar.wait_generation(made, entry["generation"] + 1)
    assert made.status == "running"
    assert made.inspect()["State"]["StartedAt"] == before
    seen = ticks(made)
    # Started once; a restore goes back by at most a few intervals.
    assert seen.count(0) == 1
    assert all(after > earlier - 20 for earlier, after in zip(seen, seen[1:]))
    wait_until(lambda: max(ticks(made)) > max(seen) + 5, 5, "the log goes on")


def test_thousands_of_later_connections_end(sidecar: Sidecar, container: ContainerFactory) -> None:
    """Those that it had at the checkpoint go on; the restored server takes new ones at once."""
    made = container.protected("python3", "-c", ASYNCIO_SERVER, labels={"interval": "1h"}, options=["--network=host"])
    kept = Peer("127.0.0.1", 7000)
    assert kept.ask("hello").split()[1:] == [b"1", b"hello"]
    take_checkpoint(sidecar.client, made.name)
    with contextlib.ExitStack() as later:
        peers = [Peer("127.0.0.1", 7000) for _ in range(LATER)]
        for peer in peers:
            later.enter_context(peer.socket)
            assert peer.ask("hello").split()[1:] == [b"1", b"hello"]
        os.kill(sidecar.app_pid(made), signal.SIGKILL)
        entry = sidecar.wait_restores(made, 1)
        assert entry["state"] == "protected"
        assert kept.ask("again").split()[1:] == [b"2", b"again"]
        assert Peer("127.0.0.1", 7000).ask("hello").split()[1:] == [b"1", b"hello"]
        for peer in peers:
            peer.socket.settimeout(15)
            with contextlib.suppress(ConnectionResetError):
                assert peer.socket.recv(1) == b""


def test_redis_keeps_its_client_and_its_data(sidecar: Sidecar, container: ContainerFactory) -> None:
    """Keys set before the checkpoint are there; keys set after it are not."""
    made = container.protected(
        "redis-server",
        *("--save", "", "--appendonly", "no", "--protected-mode", "no", "--bind", "0.0.0.0"),
        labels={"interval": "1h", "tcp": "keep"},
        options=["--user", "1000:1000", "--workdir", "/tmp"],
    )
    peer = Peer(made.ip, 6379)
    client = peer.redis("CLIENT", "ID")
    for n in range(200):
        assert peer.redis("SET", f"key:{n}", f"value {n}") == b"+OK"
    assert peer.redis("INCRBY", "counter", "41") == b":41"
    take_checkpoint(sidecar.client, made.name)
    assert peer.redis("SET", "late", "lost") == b"+OK"
    for n in range(1, 4):
        os.kill(sidecar.app_pid(made), signal.SIGKILL)
        assert peer.redis("PING") == b"+PONG"
        sidecar.wait_restores(made, n)
        assert peer.redis("CLIENT", "ID") == client
        assert [peer.redis("GET", f"key:{n}") for n in range(200)] == [f"value {n}".encode() for n in range(200)]
        assert peer.redis("GET", "late") == b"$-1"
        assert peer.redis("INCR", "counter") == b":42"
    # Also for those who come new.
    assert Peer(made.ip, 6379).redis("DBSIZE") == b":201"


def test_an_exec_session_survives(sidecar: Sidecar, container: ContainerFactory) -> None:
    """A `podman exec` process is no part of the application, and is not affected by its death."""
    made = container.protected("sleep", "1000", labels={"interval": "100ms"})
    sidecar.wait_generation(made, 2)
    with subprocess.Popen(
        ["podman", "exec", "-i", made.name, "cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as session:
        assert session.stdin is not None
        assert session.stdout is not None
        for n in range(3):
            session.stdin.write(b"%d\n" % n)
            session.stdin.flush()
            assert session.stdout.readline() == b"%d\n" % n
            os.kill(sidecar.app_pid(made), signal.SIGKILL)
            sidecar.wait_restores(made, n + 1)
        # Templates go on being made beside it.
        entry = sidecar.find(made)
        assert entry is not None
        sidecar.wait_generation(made, entry["generation"] + 2)
        session.stdin.write(b"end\n")
        session.stdin.close()
        assert session.stdout.readline() == b"end\n"
        assert session.wait(10) == 0


def test_a_peer_sees_the_end_of_a_removed_container(sidecar: Sidecar, container: ContainerFactory) -> None:
    """No template keeps the container's connections open."""
    made = container.protected(
        "python3", "-c", ASYNCIO_SERVER, labels={"interval": "100ms"}, options=["--network=host"]
    )
    peer = Peer("127.0.0.1", 7000)
    peer.ask("hello")
    sidecar.wait_generation(made, 3)
    made.remove()
    peer.socket.settimeout(2)
    started = time.monotonic()
    with contextlib.suppress(ConnectionResetError):
        assert peer.socket.recv(1) == b""
    assert time.monotonic() - started < 1
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", 7000), 1)
