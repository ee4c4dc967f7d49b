# SPDX-License-Identifier: Apache-2.0
"""avckpt.files, avckpt.tcp and avckpt.shm, on real containers."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from testkit.harness import Container, ContainerFactory, Sidecar, free_port, take_checkpoint, wait_until

pytestmark = pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long")

# Appends to a file when told "write", counts in anonymous shared memory when told "count"; answers any
# line with the file's offset, the count, and when it was started.
KEEPER = """
import mmap, os, socketserver, sys, time
file = open("/tmp/ledger", "w+b", buffering=0)
shared = mmap.mmap(-1, 4096)
started = time.monotonic_ns()
address = sys.argv[1]
class Server(socketserver.TCPServer if address.isdigit() else socketserver.UnixStreamServer):
    allow_reuse_address = True
class Handler(socketserver.StreamRequestHandler):
    def handle(self):
        for line in self.rfile:
            if line == b"write\\n":
                file.write(b"0123456789")
            if line == b"count\\n":
                shared[0] += 1
            self.wfile.write(b"%d %d %d\\n" % (os.lseek(file.fileno(), 0, os.SEEK_CUR), shared[0], started))
Server(("127.0.0.1", int(address)) if address.isdigit() else "\\0" + address, Handler).serve_forever()
"""


class Client:
    """One connection to the keeper."""

    def __init__(self, address: int | str) -> None:
        """A port, or an abstract name of a Unix socket."""
        if isinstance(address, int):
            self._socket = socket.create_connection(("127.0.0.1", address), timeout=5)
        else:
            self._socket = socket.socket(socket.AF_UNIX)
            self._socket.settimeout(5)
            self._socket.connect("\0" + address)
        self._lines = self._socket.makefile("rb")

    def close(self) -> None:
        self._lines.close()
        self._socket.close()

    def ask(self, line: str) -> tuple[int, int, int]:
        """Offset, count, start.  Raises ConnectionError when the connection is no more."""
        self._socket.sendall(line.encode() + b"\n")
        answer = self._lines.readline()
        if not answer:
            raise ConnectionError("closed")
        offset, count, started = map(int, answer.split())
        return offset, count, started


@contextmanager
def connected(address: int | str) -> Iterator[Client]:
    def connect() -> Client | None:
        try:
            return Client(address)
        except OSError:
            return None

    client = wait_until(connect, 10, "the keeper answers")
    assert client is not None
    try:
        yield client
    finally:
        client.close()


def start(factory: ContainerFactory, address: int | str, *options: str, **labels: str) -> Container:
    """Starts a keeper whose checkpoints are taken on command."""
    return factory.protected(
        *("python3", "-c", KEEPER, str(address)),
        labels={"interval": "1h", "restore.max": "60/60s", **labels},
        options=["--network=host", *options],
    )


@pytest.mark.parametrize(
    ("labels", "offset", "count"),
    [({}, 10, 1), ({"files": "keep"}, 20, 1), ({"shm": "0"}, 10, 2)],
)
def test_offsets_and_shared_memory(
    sidecar: Sidecar, container: ContainerFactory, labels: dict[str, str], offset: int, count: int
) -> None:
    port = free_port()
    keeper = start(container, port, **{"tcp": "keep", **labels})
    with connected(port) as client:
        client.ask("write")
        started = client.ask("count")[2]
        take_checkpoint(sidecar.client, keeper.name)
        client.ask("write")
        assert client.ask("count") == (20, 2, started)
        os.kill(sidecar.app_pid(keeper), signal.SIGKILL)
        sidecar.wait_restores(keeper, 1)
        # The same connection.
        assert client.ask("look") == (offset, count, started)


@pytest.mark.parametrize(
    ("kind", "labels", "moved", "lives"),
    [
        ("tcp", {"tcp": "reset"}, False, False),
        ("tcp", {}, True, False),
        ("tcp", {}, False, True),
        ("tcp", {"tcp": "keep"}, True, True),
        ("unix", {}, False, False),
        ("unix", {"tcp": "keep"}, True, True),
    ],
)
def test_connections(
    sidecar: Sidecar, container: ContainerFactory, kind: str, labels: dict[str, str], moved: bool, lives: bool
) -> None:
    port = free_port()
    address = port if kind == "tcp" else f"keeper-{port}"
    keeper = start(container, address, **labels)
    with connected(address) as client:
        started = client.ask("look")[2]
        take_checkpoint(sidecar.client, keeper.name)
        if moved:
            client.ask("look")
        os.kill(sidecar.app_pid(keeper), signal.SIGKILL)
        sidecar.wait_restores(keeper, 1)
        if lives:
            assert client.ask("look")[2] == started
        else:
            with pytest.raises(ConnectionError):
                client.ask("look")
    # Peers reconnect, to the very same process.
    with connected(address) as client:
        assert client.ask("look")[2] == started


@pytest.mark.parametrize("written", [False, True])
def test_strict(sidecar: Sidecar, container: ContainerFactory, written: bool) -> None:
    port = free_port()
    keeper = start(container, port, "--restart=on-failure", files="strict")
    with connected(port) as client:
        started = client.ask("write")[2]
    # What was written right before a checkpoint counts as written since it.
    time.sleep(0.1)
    take_checkpoint(sidecar.client, keeper.name)
    if written:
        with connected(port) as client:
            client.ask("write")
    os.kill(sidecar.app_pid(keeper), signal.SIGKILL)

    def look() -> int | None:
        """When the process that answers was started; None while only a dying one is there."""
        try:
            with connected(port) as again:
                return again.ask("look")[2]
        except OSError:
            return None

    assert (wait_until(look, 10, "an answer") == started) is not written
