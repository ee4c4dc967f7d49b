# SPDX-License-Identifier: Apache-2.0
"""Clients with one connection each.  Every request has a number that no other has, and its answer says it."""

from __future__ import annotations

import http.client
import itertools
import random
import threading
import time
from dataclasses import dataclass, field
from types import TracebackType

from testkit.harness import wait_until

PATIENCE_S = 2.0
"""A client without an answer for so long connects anew."""


@dataclass
class Clients:
    """Asks GET /NUMBER on connections that are kept, as pools of connections do.  A context manager."""

    port: int
    count: int = 8
    asked: int = 0
    answered: int = 0
    closed: int = 0
    """Connections that the server, or the kernel for it, has ended."""
    silent: int = 0
    """Requests without an answer: the client has waited for PATIENCE_S."""
    wrong: list[str] = field(default_factory=list)
    """Answers that are another request's, or no answers."""

    def __post_init__(self) -> None:
        self._numbers = itertools.count(1)
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=self._ask, args=(n,), daemon=True) for n in range(self.count)]

    def __enter__(self) -> Clients:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def wait_answered(self, n: int, timeout_s: float = 60.0) -> None:
        """Until there are `n` answers in all, or a wrong one."""
        wait_until(lambda: self.answered >= n or self.wrong, timeout_s, f"{n} answers: {self}", every_s=0.005)

    def _ask(self, client: int) -> None:
        rng = random.Random(client)
        connection: http.client.HTTPConnection | None = None
        while not self._stop.is_set():
            with self._lock:
                number = next(self._numbers)
                self.asked += 1
            try:
                if connection is None:
                    connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
                connection.request("GET", f"/{number}")
                response = connection.getresponse()
                body = response.read().decode(errors="replace").strip("/\n")
            except (OSError, http.client.HTTPException) as error:
                with self._lock:
                    self.silent += isinstance(error, TimeoutError)
                    self.closed += not isinstance(error, TimeoutError)
                if connection is not None:
                    connection.close()
                connection = None
                self._stop.wait(0.01)
                continue
            with self._lock:
                if response.status in (502, 503, 504):
                    pass  # a proxy that says of its own backend that there is no answer: true
                elif body != str(number):
                    self.wrong.append(f"/{number} is answered {response.status} {body[:80]!r}")
                else:
                    self.answered += 1
            # A pool's connection lies idle for a while, too.
            time.sleep(rng.choice((0.0, 0.0, 0.0, 0.02)))
