# SPDX-License-Identifier: Apache-2.0
"""redis-server: transactions, Lua, expiry and its background threads, over its own protocol."""

from __future__ import annotations

import random
import re
import time
import zlib
from typing import Any

from testkit.programs.wire import Garbled, Inconsistent, Session

COMMAND = (
    "redis-server",
    *("--save", "", "--appendonly", "no", "--protected-mode", "no", "--bind", "0.0.0.0", "--port", "7000"),
)

COUNT = """
local n = redis.call('INCR', 'c:' .. ARGV[1])
redis.call('RPUSH', 'l:' .. ARGV[1], n)
redis.call('LTRIM', 'l:' .. ARGV[1], -500, -1)
redis.call('ZADD', 'all', n, ARGV[1])
return {ARGV[2], n}
"""

DATA = """
redis.call('SET', 'd:' .. ARGV[2], ARGV[3])
redis.call('SET', 'h:' .. ARGV[2], ARGV[4])
return {ARGV[1], redis.call('GET', 'd:' .. ARGV[5]), redis.call('GET', 'h:' .. ARGV[5])}
"""

# Counter, list and sorted set are three accounts of the same.
CHECK = """
for _, key in ipairs(redis.call('KEYS', 'c:*')) do
  local name, n = key:sub(3), tonumber(redis.call('GET', key))
  local list = redis.call('LRANGE', 'l:' .. name, 0, -1)
  if #list ~= math.min(n, 500) then return {ARGV[1], key .. ': a list of ' .. #list .. ' at ' .. n} end
  for i, item in ipairs(list) do
    if tonumber(item) ~= n - #list + i then return {ARGV[1], key .. ': item ' .. i .. ' is ' .. item} end
  end
  if tonumber(redis.call('ZSCORE', 'all', name)) ~= n then return {ARGV[1], key .. ': another score'} end
end
return {ARGV[1], 'ok'}
"""

PATIENCE_S = 20.0


class RedisSession(Session):
    def count(self) -> int:
        wanted = self.number()
        self._send("EVAL", COUNT, "0", self.name, str(wanted))
        answer = self._array(wanted, 0)
        if not isinstance(answer[1], int):
            raise Garbled(f"{answer!r} is no number")
        return answer[1]

    def data(self, rng: random.Random) -> None:
        """Sets a value and its checksum, and gets another pair."""
        text = rng.choice("abcdefgh") * rng.choice((0, 10, 1000, 20000))
        put, get = rng.randrange(50), rng.randrange(50)
        wanted = self.number()
        # One command: of a transaction of several, a program that has gone back may have
        # read the half, and would take the next one's for the rest.
        self._send("EVAL", DATA, "0", str(wanted), str(put), text, str(zlib.crc32(text.encode())), str(get))
        _, value, crc = self._array(wanted, 0)
        if value is not None and crc != b"%d" % zlib.crc32(value):
            raise Garbled(f"d:{get} has {len(value)} bytes with checksum {zlib.crc32(value)}, h:{get} says {crc!r}")

    def check(self) -> int:
        wanted = self.number()
        self._send("EVAL", CHECK, "0", str(wanted))
        said = self._array(wanted, 0)[1]
        if said != b"ok":
            raise Inconsistent(said.decode())
        self._check_threads()
        return self._info("connected_clients")

    def _check_threads(self) -> None:
        """A set so large that a background thread frees it, and a key that the timer has to find expired."""
        freed, expired = self._info("lazyfreed_objects"), self._info("expired_keys")
        wanted = self.number()
        self._send("MULTI")
        self._send("SADD", "big", *(f"member {n}" for n in range(500)))
        self._send("UNLINK", "big")
        self._send("SET", "short", "1", "PX", "1")
        self._send("ECHO", str(wanted))
        self._send("EXEC")
        self._array(wanted, -1)
        deadline = time.monotonic() + PATIENCE_S
        while self._info("lazyfreed_objects") <= freed or self._info("expired_keys") <= expired:
            if time.monotonic() > deadline:
                raise Inconsistent("a background thread or the timer stands still")
            time.sleep(0.005)

    def _info(self, field: str) -> int:
        wanted = self.number()
        self._send("MULTI")
        self._send("INFO", "everything")
        self._send("ECHO", str(wanted))
        self._send("EXEC")
        found = re.search(rb"\b%s:(\d+)" % field.encode(), self._array(wanted, -1)[0])
        if not found:
            raise Garbled(f"INFO without {field}")
        return int(found[1])

    def _send(self, *words: str) -> None:
        self.wire.send(b"*%d\r\n" % len(words) + b"".join(b"$%d\r\n%s\r\n" % (len(w), w.encode()) for w in words))

    def _array(self, wanted: int, place: int) -> list[Any]:
        """The next array that has the number `wanted` at that place; +OK and +QUEUED before it are passed over."""
        while True:
            answer = self._answer()
            if isinstance(answer, list):
                if not answer or not isinstance(answer[place], bytes):
                    raise Garbled(f"{answer!r:.80}")
                if self.is_ours(answer[place], wanted):
                    return answer
            elif answer not in (b"OK", b"QUEUED"):
                raise Garbled(f"{answer!r:.80}")

    def _answer(self) -> Any:
        line = self.wire.line()
        kind, rest = line[:1], line[1:]
        if kind == b"+":
            return rest
        if kind not in (b":", b"$", b"*") or not re.fullmatch(rb"-?\d{1,9}", rest):
            raise Garbled(f"{line[:80]!r}")
        n = int(rest)
        if kind == b":":
            return n
        if n < 0:
            return None
        if kind == b"*":
            return [self._answer() for _ in range(n)]
        text = self.wire.exactly(n + 2)
        if text[n:] != b"\r\n":
            raise Garbled("a string of another length")
        return text[:n]
