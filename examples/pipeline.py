# SPDX-License-Identifier: Apache-2.0
"""A vehicle's pipeline in small, one role per container; see vehicle.yaml.

    pipeline.py source FILTER_PORT                             50 readings a second
    pipeline.py filter PORT MONITOR_PORT [CRASH_EVERY_S]       smooths them; crashes at random
    pipeline.py monitor PORT                                   says every second how the filter is doing

They talk JSON lines over TCP and know nothing of avckpt.  The filter counts what
it has seen and remembers when it was started: after a crash the monitor sees
whether it is still the same filter, or a new one that has forgotten everything.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator

RATE_HZ = 50
SMOOTHING = 0.02


def send(connection: socket.socket, message: dict[str, float]) -> None:
    """One message, whole."""
    connection.sendall(json.dumps(message).encode() + b"\n")


def messages(connection: socket.socket) -> Iterator[dict[str, float]]:
    """What comes over a connection until it ends.

    A restored receiver has lost the bytes that it had read since its checkpoint.
    The first line afterwards may lack its beginning; it is passed over.
    """
    with connection, contextlib.suppress(ConnectionError):
        for line in connection.makefile("rb"):
            try:
                message = json.loads(line)
            except ValueError:
                continue
            if isinstance(message, dict):
                yield message


def connect(port: int) -> socket.socket:
    """A connection to the next stage, as soon as it is there."""
    while True:
        try:
            connection = socket.create_connection(("127.0.0.1", port))
        except ConnectionRefusedError:
            time.sleep(0.1)
            continue
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection


def listen(port: int) -> socket.socket:
    """The next connection from the stage before."""
    with socket.create_server(("127.0.0.1", port)) as server:
        return server.accept()[0]


def readings(port: int) -> Iterator[dict[str, float]]:
    """What sources send, one after the other."""
    while True:
        yield from messages(listen(port))


def source(port: int) -> None:
    """A sensor."""
    connection = connect(port)
    started = time.monotonic()
    number = 0
    while True:
        number += 1
        send(connection, {"number": number, "value": math.sin(number / RATE_HZ)})
        time.sleep(max(0.0, started + number / RATE_HZ - time.monotonic()))


def crash_maybe(every_s: float) -> None:
    """A bug that strikes out of the blue.

    The dice are the kernel's: Python's own would be rolled back with everything
    else, and fall the same way again.
    """
    if every_s and int.from_bytes(os.urandom(4), "big") < 2**32 / (every_s * RATE_HZ):
        os.kill(os.getpid(), signal.SIGSEGV)


def smooth(port: int, monitor_port: int, crash_every_s: float) -> None:
    """The filter: an average that takes its time to be right again after a cold start."""
    started = time.time()
    print(f"filter: started as PID {os.getpid()}", flush=True)
    output = connect(monitor_port)
    average = 0.0
    for seen, reading in enumerate(readings(port), 1):
        average += SMOOTHING * (abs(reading["value"]) - average)
        send(output, {"number": reading["number"], "seen": seen, "average": average, "started": started})
        crash_maybe(crash_every_s)


def monitor(port: int) -> None:
    """Tells how things go, once a second, and at once when the filter went back in time."""
    print("monitor: waiting for the filter", flush=True)
    while True:
        watch(listen(port))
        print("monitor: the filter hung up", flush=True)


def watch(connection: socket.socket) -> None:
    """One connection of the filter's, to its end."""
    last: dict[str, float] | None = None
    at = said_at = time.monotonic()
    gap_s = 0.0
    count = 0
    for message in messages(connection):
        now = time.monotonic()
        if last is not None:
            gap_s = max(gap_s, now - at)
            # Readings and counts go on together; a filter that went back has the
            # newer readings, and fewer of them.
            lost = (message["number"] - last["number"]) - (message["seen"] - last["seen"])
            if lost > 0:
                print(
                    f"monitor: the filter CRASHED and went on: {lost:.0f} readings forgotten, "
                    f"silent for {(now - at) * 1000:.0f} ms",
                    flush=True,
                )
        last, at = message, now
        count += 1
        if now - said_at >= 1:
            print(
                f"monitor: {count / (now - said_at):.0f} messages/s, longest gap {gap_s * 1000:.0f} ms; the filter has "
                f"run {time.time() - message['started']:.0f} s and seen {message['seen']:.0f} readings",
                flush=True,
            )
            said_at, gap_s, count = now, 0.0, 0


def main() -> None:
    """The role that the command line names."""
    role, *numbers = sys.argv[1:] or ["-h"]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if role == "source":
        source(int(numbers[0]))
    elif role == "filter":
        smooth(int(numbers[0]), int(numbers[1]), float(numbers[2]) if len(numbers) > 2 else 0.0)
    elif role == "monitor":
        monitor(int(numbers[0]))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main()
