# SPDX-License-Identifier: Apache-2.0
"""avckpt.tcp=messages: a death in the middle of a message costs this message, and nothing else."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from avckpt.guard import Tcp

from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import SLOWNESS, wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "messages are in the middle at random moments"
)

# An emulated sender is silent for longer within a message.
AT_SPEED = pytest.mark.skipif(SLOWNESS > 1, reason="8 ms without a byte are a pause between messages")
SHORT, LONG = b"m" * 1000, b"m" * 300_000
SILENT_S = 0.1


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def connect(victim: Victim) -> socket.socket:
    taken = victim.see().counter[2]
    client = socket.create_connection(("127.0.0.1", victim.see().counter[1]), 5)
    wait_until(lambda: victim.see().counter[2] > taken, 10, "it takes the connection", 0.001)
    return client


def send(client: socket.socket, body: bytes) -> None:
    client.sendall(struct.pack("<I", len(body)) + body)


def more_than(victim: Victim, counter: int, before: int, action: Callable[[], None] = lambda: None) -> None:
    """Does something, then waits until a counter of the board exceeds that value."""
    action()
    wait_until(lambda: victim.see().counter[counter] > before, 10, f"counter {counter} of the board grows", 0.001)


def sent(victim: Victim, client: socket.socket, messages: int = 1) -> None:
    """Sends messages one after another, and waits until each was received."""
    for _ in range(messages):
        more_than(victim, 0, victim.see().counter[0], lambda: send(client, SHORT))


def is_reset(client: socket.socket) -> bool:
    client.settimeout(5)
    try:
        return client.recv(1) == b""
    except ConnectionResetError:
        return True


def start(victim: Victim, guard: GuardProcess) -> socket.socket:
    """A connection, and a checkpoint while it is idle."""
    client = connect(victim)
    sent(victim, client)
    time.sleep(SILENT_S)
    guard.command("checkpoint")
    return client


def kill_inside_a_message(victim: Victim, guard: GuardProcess, client: socket.socket, count: int = 1) -> None:
    """Kills it in the middle of reading a message whose rest is in the kernel's buffers already."""
    before = victim.see().counter[4]
    send(client, LONG)
    wait_until(lambda: victim.see().counter[4] > before + 20_000, 10, "it reads the message", 0.001)
    victim.kill_app()
    guard.wait("restored", count=count)


@AT_SPEED
def test_what_is_left_of_a_message_is_read_away(tmp_path: Path) -> None:
    with (
        Victim("stream", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.MESSAGES), [victim.pid]) as guard,
    ):
        client = start(victim, guard)
        for n in range(1, 7):
            kill_inside_a_message(victim, guard, client, n)
            sent(victim, client, 3)
        assert victim.see().counter[3] == 0
        assert victim.see().counter[2] == 1  # one connection, all the time
        victim.check()


def test_without_it_the_stream_is_lost(tmp_path: Path) -> None:
    """Shows that the test above would fail if nothing were done."""
    with (
        Victim("stream", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.KEEP), [victim.pid]) as guard,
    ):
        client = start(victim, guard)
        kill_inside_a_message(victim, guard, client)
        wait_until(lambda: victim.see().counter[3] > 0, 20, "it takes the rest for a message")


def test_between_messages_a_connection_goes_on(tmp_path: Path) -> None:
    with (
        Victim("stream", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.MESSAGES), [victim.pid]) as guard,
    ):
        client = start(victim, guard)
        for n in range(1, 5):
            sent(victim, client, 3)
            time.sleep(SILENT_S)
            victim.kill_app()
            guard.wait("restored", count=n)
            sent(victim, client, 2)
        assert victim.see().counter[2] == 1
        assert victim.see().counter[3] == 0


@AT_SPEED
def test_a_message_cut_by_the_checkpoint_ends_the_connection(tmp_path: Path) -> None:
    """The restored process has its first half, and other data would follow it."""
    with (
        Victim("stream", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.MESSAGES), [victim.pid]) as guard,
    ):
        client = connect(victim)
        guard.wait("attached")
        for n in range(1, 4):
            whole, read = victim.see().counter[0], victim.see().counter[4]
            client.sendall(struct.pack("<I", len(LONG)) + LONG[:30_000])
            more_than(victim, 4, read + 20_000)
            # The rest keeps coming, however long the checkpoint takes: or it would be a pause.
            with ThreadPoolExecutor(1) as pool:
                checkpoint = pool.submit(guard.command, "checkpoint")
                rest = memoryview(LONG)[30_000:]
                while not checkpoint.done():
                    assert len(rest) > 10, "the checkpoint takes for ever"
                    client.sendall(rest[:10])
                    rest = rest[10:]
                    time.sleep(0.001)
                assert checkpoint.result()["kind"] == "checkpoint"
            client.sendall(rest)
            more_than(victim, 0, whole)
            time.sleep(SILENT_S)
            victim.kill_app()
            guard.wait("restored", count=n)
            assert is_reset(client)
            client = connect(victim)
            sent(victim, client, 2)
            assert victim.see().counter[3] <= n  # the message that was never finished
