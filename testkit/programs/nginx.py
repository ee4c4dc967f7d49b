# SPDX-License-Identifier: Apache-2.0
"""nginx in one process: kept connections, files by sendfile(2), its own counts."""

from __future__ import annotations

import random
import re

from testkit.programs.wire import Garbled, Inconsistent, Session

COMMAND = ("nginx", "-e", "stderr", "-c", "/sources/nginx.conf")
FILE = b"".join(b"%07d\n" % n for n in range(32768))


class NginxSession(Session):
    persistent = False
    counts_data = True

    def count(self) -> int:
        body = self._get("/count")
        if not body.isdigit():
            raise Garbled(f"{body[:80]!r} is no number")
        return int(body)

    def data(self, rng: random.Random) -> None:
        first = rng.choice((0, rng.randrange(len(FILE))))
        last = rng.randrange(first, len(FILE))
        body = self._get("/file", f"Range: bytes={first}-{last}\r\n")
        if body != FILE[first : last + 1]:
            raise Garbled(f"bytes {first}-{last} of the file are not what was sent ({len(body)} bytes)")

    def check(self) -> int:
        if self._get("/file") != FILE:
            raise Inconsistent("the file has other bytes")
        status = self._get("/status").decode()
        found = re.match(
            r"Active connections: (\d+)\s+server accepts handled requests\s+(\d+) (\d+) (\d+)\s+"
            r"Reading: (\d+) Writing: (\d+) Waiting: (\d+)",
            status,
        )
        if not found:
            raise Inconsistent(f"status {status!r}")
        active, accepts, handled, requests, reading, writing, waiting = map(int, found.groups())
        if accepts != handled or requests < 1 or active != reading + writing + waiting:
            raise Inconsistent(f"counts that do not agree: {' '.join(status.split())}")
        return active

    def _get(self, path: str, headers: str = "") -> bytes:
        wanted = self.number()
        self.wire.send(f"GET {path}?id={wanted} HTTP/1.1\r\nHost: programs\r\n{headers}\r\n".encode())
        while True:
            number, body = self._response()
            if self.is_ours(number, wanted):
                return body

    def _response(self) -> tuple[bytes, bytes]:
        status = self.wire.line()
        if status not in (b"HTTP/1.1 200 OK", b"HTTP/1.1 206 Partial Content"):
            raise Garbled(f"{status[:80]!r}")
        fields = {}
        while line := self.wire.line():
            name, _, value = line.partition(b": ")
            fields[name.lower()] = value
        if not fields.get(b"content-length", b"").isdigit():
            raise Garbled(f"no length: {fields!r:.200}")
        return fields.get(b"x-id", b""), self.wire.exactly(int(fields[b"content-length"]))
