# SPDX-License-Identifier: Apache-2.0
"""An asyncio server with everything an event loop is used for; see README.md for what it is asked."""

from __future__ import annotations

import asyncio
import hashlib
import os
import random
import signal
import sys
import time
import zlib
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor

LETTERS = "abcdefghijklmnop"
MONEY = 1000
PATIENCE_S = 20.0

counters: Counter[str] = Counter()
beats: defaultdict[str, int] = defaultdict(int)
wrong: list[str] = []
connections = 0

accounts = [MONEY] * 32
on_the_way: dict[int, int] = {}


def data(n: int, seed: int) -> str:
    out = []
    for _ in range(n):
        seed = (seed * 1103515245 + 12345) & 0x7FFFFFFF
        out.append(LETTERS[seed >> 16 & 15])
    return "".join(out)


async def transfer(me: int) -> None:
    """Takes money, waits, pays it in."""
    while True:
        amount, to = random.randint(1, 9), random.randrange(len(accounts))
        accounts[random.randrange(len(accounts))] -= amount
        on_the_way[me] = amount
        await asyncio.sleep(random.random() * 0.01)
        accounts[to] += on_the_way.pop(me)
        beats[f"transfer {me}"] += 1


async def produce(queue: asyncio.Queue[int]) -> None:
    n = 0
    while True:
        await queue.put(n)
        n += 1
        beats["produce"] += 1
        if n % 16 == 0:
            await asyncio.sleep(0.002)


async def consume(queue: asyncio.Queue[int]) -> None:
    wanted = 0
    while True:
        try:
            n = await asyncio.wait_for(queue.get(), 0.05)
        except asyncio.TimeoutError:
            continue
        if n != wanted:
            wrong.append(f"queue: {n} instead of {wanted}")
        wanted = n + 1
        beats["consume"] += 1


async def ping_pong(name: str, mine: asyncio.Event, other: asyncio.Event) -> None:
    while True:
        await mine.wait()
        mine.clear()
        beats[name] += 1
        await asyncio.sleep(0.001)
        other.set()


async def hash_in_threads(me: int, pool: ThreadPoolExecutor) -> None:
    """Threads of a pool, woken by futexes, which wake the loop through a socketpair."""
    block = data(20000, me).encode()
    right = hashlib.sha256(block).digest()
    while True:
        if await asyncio.get_running_loop().run_in_executor(pool, lambda: hashlib.sha256(block).digest()) != right:
            wrong.append("a hash is another one")
        beats[f"thread pool {me}"] += 1
        await asyncio.sleep(0.003)


def tick() -> None:
    """A timer of the loop; sends a signal, which comes back through the loop's self-pipe."""
    beats["timer"] += 1
    os.kill(os.getpid(), signal.SIGUSR1)
    asyncio.get_running_loop().call_later(0.01, tick)


def on_signal() -> None:
    beats["signal"] += 1


async def check() -> str:
    before = dict(beats)
    deadline = time.monotonic() + PATIENCE_S
    while still := [name for name, n in before.items() if beats[name] < n + 2]:
        if time.monotonic() > deadline:
            return f"bad these stand still: {', '.join(still)}"
        await asyncio.sleep(0.005)
    # No other task runs in between.
    money = sum(accounts) + sum(on_the_way.values())
    if money != MONEY * len(accounts):
        return f"bad the accounts hold {money}"
    return f"bad {wrong[0]}" if wrong else f"ok connections={connections} tasks={len(before)}"


async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    global connections
    connections += 1
    try:
        while line := await reader.readline():
            number, what, *args = line.decode().split()
            if what == "inc":
                counters[args[0]] += 1
                answer = str(counters[args[0]])
            elif what == "data":
                text = data(int(args[0]), int(args[1]))
                answer = f"{zlib.crc32(text.encode()):08x} {text}"
            else:
                answer = await check()
            writer.write(f"{number} {answer}\n".encode())
            await writer.drain()
    except ConnectionError:
        pass
    finally:
        connections -= 1
        writer.close()


async def main() -> None:
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGUSR1, on_signal)
    queue: asyncio.Queue[int] = asyncio.Queue(8)
    ping, pong = asyncio.Event(), asyncio.Event()
    ping.set()
    pool = ThreadPoolExecutor(3)
    tasks = [
        *(asyncio.create_task(transfer(n)) for n in range(8)),
        asyncio.create_task(produce(queue)),
        asyncio.create_task(consume(queue)),
        asyncio.create_task(ping_pong("ping", ping, pong)),
        asyncio.create_task(ping_pong("pong", pong, ping)),
        *(asyncio.create_task(hash_in_threads(n, pool)) for n in range(3)),
    ]
    tick()
    await asyncio.start_server(serve, "0.0.0.0", 7000)
    await asyncio.gather(*tasks)  # raises what one of them raises


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
