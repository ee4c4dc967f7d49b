# SPDX-License-Identifier: Apache-2.0
"""Client of the servers of our own; README.md has the protocol."""

from __future__ import annotations

import random
import re
import zlib

from testkit.programs.wire import Garbled, Inconsistent, Session


class LineSession(Session):
    def count(self) -> int:
        answer = self._ask(f"inc {self.name}")
        if not answer.isdigit():
            raise Garbled(f"{answer[:80]!r} is no number")
        return int(answer)

    def data(self, rng: random.Random) -> None:
        n = rng.choice((0, 10, 1000, 20000))
        crc, _, text = self._ask(f"data {n} {rng.randrange(1 << 30)}").partition(b" ")
        if len(text) != n or crc != b"%08x" % zlib.crc32(text):
            raise Garbled(f"{len(text)} letters with checksum {zlib.crc32(text):08x}, and {n} with {crc!r} were told")

    def check(self) -> int:
        answer = self._ask("check").decode()
        found = re.match(r"ok connections=(\d+)", answer)
        if not found:
            raise Inconsistent(answer)
        return int(found[1])

    def _ask(self, request: str) -> bytes:
        wanted = self.number()
        self.wire.send(f"{wanted} {request}\n".encode())
        while True:
            number, _, answer = self.wire.line().partition(b" ")
            if self.is_ours(number, wanted):
                return answer
