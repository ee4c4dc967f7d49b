# SPDX-License-Identifier: Apache-2.0
"""A client's connection, and what can go wrong on it."""

from __future__ import annotations

import random
import socket
from abc import ABC, abstractmethod


class Closed(Exception):
    """The server, or the kernel for it, has ended the connection."""


class NoAnswer(Exception):
    """Nothing came within the client's patience."""


class Garbled(Exception):
    """What came is no answer to what was asked."""


class Inconsistent(Exception):
    """The program has found, or its client can see, that its state is broken."""


class Wire:
    """A TCP connection.  Every method raises Closed and NoAnswer."""

    def __init__(self, host: str, port: int, patience_s: float) -> None:
        try:
            self._socket = socket.create_connection((host, port), patience_s)
        except TimeoutError as error:
            raise NoAnswer("connect") from error
        except OSError as error:
            raise Closed(str(error)) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = b""

    def send(self, data: bytes) -> None:
        try:
            self._socket.sendall(data)
        except TimeoutError as error:
            raise NoAnswer("send") from error
        except OSError as error:
            raise Closed(str(error)) from error

    def line(self) -> bytes:
        """The next line, without its end."""
        while b"\n" not in self._received:
            self._more()
        line, _, self._received = self._received.partition(b"\n")
        return line.rstrip(b"\r")

    def exactly(self, n: int) -> bytes:
        """The next `n` bytes."""
        while len(self._received) < n:
            self._more()
        data, self._received = self._received[:n], self._received[n:]
        return data

    def close(self) -> None:
        self._socket.close()

    def _more(self) -> None:
        try:
            data = self._socket.recv(1 << 18)
        except TimeoutError as error:
            raise NoAnswer("receive") from error
        except OSError as error:
            raise Closed(str(error)) from error
        if not data:
            raise Closed("end of file")
        self._received += data


class Session(ABC):
    """One connection of a client to a program.

    Every request has a number of its own, and its answer names it: what a
    process that went back says a second time is told from what was asked.
    """

    persistent = True
    """Whether the client's counter outlives the connection."""
    counts_data = False
    """Whether data() counts, too."""

    def __init__(self, host: str, name: str, patience_s: float) -> None:
        self.name = name
        self.stale = 0
        """Answers that came a second time."""
        self.wire = Wire(host, self.port, patience_s)
        self._last = 0

    port = 7000

    def number(self) -> int:
        """For the next request."""
        self._last += 1
        return self._last

    def is_ours(self, said: bytes, wanted: int) -> bool:
        """Whether an answer is the one to the request `wanted`; an earlier one's is counted.  Raises Garbled."""
        if not said.isdigit() or not 0 < int(said) <= wanted:
            raise Garbled(f"an answer to {said[:40]!r}, and {wanted} was asked")
        if int(said) < wanted:
            self.stale += 1
        return int(said) == wanted

    @abstractmethod
    def count(self) -> int:
        """Has the program count this client one up; the new value.  Raises Closed, NoAnswer, Garbled."""

    @abstractmethod
    def data(self, rng: random.Random) -> None:
        """Asks for data and compares them.  Raises the same."""

    @abstractmethod
    def check(self) -> int:
        """Everything about the program that can be checked; how many connections it believes to have.

        Raises Inconsistent, and the same.
        """

    def close(self) -> None:
        self.wire.close()
