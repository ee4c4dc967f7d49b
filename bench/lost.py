# SPDX-License-Identifier: Apache-2.0
"""What a crash costs the clients of a server: operations that it had acknowledged and then forgot.

    .venv/bin/python -m bench.lost [--kills 20] [--servers redis,http] [--intervals auto,3s,100ms]

redis-server (Debian's, persistence off) and an HTTP server of Python's standard library each count requests. One
client on the same machine sends the next one as soon as it has the answer to the last. At a random moment the server
is killed by SIGKILL; the client connects again, and the next answer says how many were forgotten. The intervals
take turns, kill by kill. Each server runs under an avckpt-init and a sidecar daemon without Podman.

Needs root, redis-server and what `make setup-build` builds. Prints a table and writes bench/results/lost.json.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import random
import signal
import socket
import statistics
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from testkit.harness import ROOT, free_port, wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

RESULTS = ROOT / "bench" / "results" / "lost.json"
PATIENCE_S = 30.0
LONGEST_S = {"3s": 3.0}
"""An interval's checkpoints are so far apart at most under load; else a second is plenty."""
HTTP = """
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
counted = 0
class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    def do_GET(self):
        global counted
        counted += 1
        text = b"%d" % counted
        self.send_response(200)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text)
    def log_message(self, *args):
        pass
class Server(ThreadingHTTPServer):
    allow_reuse_address = daemon_threads = True
Server(("127.0.0.1", int(sys.argv[1])), Handler).serve_forever()
"""


class Client(ABC):
    """One connection."""

    @abstractmethod
    def count(self) -> int:
        """Has the server count one more; its answer. Raises OSError or http.client.HTTPException."""

    @abstractmethod
    def close(self) -> None:
        """Ends the connection."""


class RedisClient(Client):
    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=2.0)

    def count(self) -> int:
        self._socket.sendall(b"*2\r\n$4\r\nINCR\r\n$1\r\nn\r\n")
        answer = b""
        while not answer.endswith(b"\r\n"):
            more = self._socket.recv(64)
            if not more:
                raise ConnectionResetError
            answer += more
        return int(answer[1:])

    def close(self) -> None:
        self._socket.close()


class HttpClient(Client):
    def __init__(self, port: int) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=2.0)

    def count(self) -> int:
        self._connection.request("GET", "/")
        return int(self._connection.getresponse().read())

    def close(self) -> None:
        self._connection.close()


CLIENTS: dict[str, type[RedisClient | HttpClient]] = {"redis": RedisClient, "http": HttpClient}
GONE = (OSError, http.client.HTTPException, ValueError)


def command(server: str, port: int) -> list[str]:
    if server == "http":
        return [sys.executable, "-S", "-c", HTTP, str(port)]
    return ["redis-server", "--save", "", "--appendonly", "no", "--bind", "127.0.0.1", "--port", str(port)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--servers", default="redis,http")
    parser.add_argument("--intervals", default="auto,3s,100ms")
    options = parser.parse_args()
    rows = []
    for server in options.servers.split(","):
        found = measure(server, options.intervals.split(","), options.kills)
        rows += found
        for row in found:
            print({key: value for key, value in row.items() if not isinstance(value, list)}, flush=True)
    RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


def measure(server: str, intervals: list[str], kills: int) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as directory, local_sidecar(Path(directory)) as sidecar:
        sidecar.start()
        subjects = [Subject(sidecar, server, interval) for interval in intervals]
        for kill in range(kills):
            for subject in subjects:
                subject.crash()
            print(f"{server}: {kill + 1} of {kills}", file=sys.stderr, flush=True)
        return [subject.row() for subject in subjects]


class Subject:
    """A server in a container, and what its crashes have cost."""

    def __init__(self, sidecar: LocalSidecar, server: str, interval: str) -> None:
        labels = {"avckpt.enable": "true", "avckpt.interval": interval, "avckpt.restore.max": "64/60s"}
        self._sidecar, self._server, self._interval, self._port = sidecar, server, interval, free_port()
        self._container: Container = sidecar.protected(f"{server}-{interval}", command(server, self._port), labels)
        sidecar.wait_for(self._container, timeout_s=PATIENCE_S, state="protected")
        self._rates: list[float] = []
        self._lost: list[int] = []
        self._ages_ms: list[float] = []
        self._gaps_ms: list[float] = []

    def crash(self) -> None:
        """Load, SIGKILL, and the first answer after it."""
        longest_s = LONGEST_S.get(self._interval, 0.5)
        began = time.monotonic()
        due_s = began + max(longest_s, 1.0) + random.uniform(0, longest_s)
        pid, answered = self._container.app_pid, 0
        with self._client() as client:
            before = acknowledged = client.count()
            while time.monotonic() < due_s:
                acknowledged = client.count()
            self._rates.append((acknowledged - before) / (time.monotonic() - began))
            os.kill(pid, signal.SIGKILL)
            killed = time.monotonic()
            # What was counted until the signal arrived.
            with contextlib.suppress(*GONE):
                while time.monotonic() < killed + 1:
                    answered = client.count()
                    if answered <= acknowledged:
                        break
                    acknowledged = answered
        if not 0 < answered <= acknowledged:
            answered = self._first_answer()
        self._gaps_ms.append(1000 * (time.monotonic() - killed))
        self._lost.append(acknowledged - answered + 1)
        restores = len(self._lost)
        row = self._sidecar.wait_for(self._container, timeout_s=PATIENCE_S, restores=restores, state="protected")
        self._ages_ms.append(1000 * row["last_restore_age_s"])

    @contextlib.contextmanager
    def _client(self) -> Iterator[Client]:
        client = CLIENTS[self._server](self._port)
        try:
            yield client
        finally:
            client.close()

    def _first_answer(self) -> int:
        def ask() -> int:
            with contextlib.suppress(*GONE), self._client() as client:
                return client.count()
            return 0

        return wait_until(ask, PATIENCE_S, "the server answers again", every_s=0.001)

    def row(self) -> dict[str, Any]:
        return {
            "server": self._server,
            "interval": self._interval,
            "kills": len(self._lost),
            "operations_per_s": round(statistics.median(self._rates)),
            "lost_median": statistics.median(self._lost),
            "lost_p90": quantile(self._lost, 0.9),
            "lost_max": max(self._lost),
            "age_median_ms": round(statistics.median(self._ages_ms), 1),
            "age_p90_ms": round(quantile(self._ages_ms, 0.9), 1),
            "age_max_ms": round(max(self._ages_ms), 1),
            "gap_median_ms": round(statistics.median(self._gaps_ms), 1),
            "load": round(os.getloadavg()[0], 1),
            "lost": sorted(self._lost),
            "ages_ms": sorted(round(age, 1) for age in self._ages_ms),
        }


def quantile(values: list[Any], share: float) -> Any:
    return sorted(values)[min(int(share * len(values)), len(values) - 1)]


if __name__ == "__main__":
    main()
