# SPDX-License-Identifier: Apache-2.0
"""A server with a thread for each connection, and threads that wait for each other by all that `threading` has."""

from __future__ import annotations

import contextlib
import hashlib
import queue
import random
import socket
import socketserver
import threading
import time
import zlib
from collections import Counter, defaultdict

LETTERS = "abcdefghijklmnop"
MONEY = 1000
PATIENCE_S = 20.0

lock = threading.Lock()
counters: Counter[str] = Counter()
beats: defaultdict[str, int] = defaultdict(int)
wrong: list[str] = []
connections = 0


def data(n: int, seed: int) -> str:
    out = []
    for _ in range(n):
        seed = (seed * 1103515245 + 12345) & 0x7FFFFFFF
        out.append(LETTERS[seed >> 16 & 15])
    return "".join(out)


class Bank:
    """A lock for each account; two are always taken in order."""

    def __init__(self, size: int) -> None:
        self.locks = [threading.RLock() for _ in range(size)]
        self.accounts = [MONEY] * size

    def move_for_ever(self, me: int) -> None:
        while True:
            first, second = sorted(random.sample(range(len(self.accounts)), 2))
            amount = random.randint(-9, 9)
            with self.locks[first], self.locks[second]:
                self.accounts[first] -= amount
                if random.random() < 0.1:
                    time.sleep(0.0005)  # holding both
                self.accounts[second] += amount
            beats[f"bank {me}"] += 1
            time.sleep(0.002)

    def sum(self) -> int:
        for each in self.locks:
            each.acquire()
        money = sum(self.accounts)
        for each in self.locks:
            each.release()
        return money


def produce(numbers: queue.Queue[int]) -> None:
    n = 0
    while True:
        numbers.put(n)
        n += 1
        beats["produce"] += 1
        time.sleep(0.001)


def consume(numbers: queue.Queue[int]) -> None:
    wanted = 0
    while True:
        try:
            n = numbers.get(timeout=0.05)
        except queue.Empty:
            continue
        if n != wanted:
            wrong.append(f"queue: {n} instead of {wanted}")
        wanted = n + 1
        beats["consume"] += 1


turn = [0]
turned = threading.Condition()


def take_turns(me: int, of: int) -> None:
    while True:
        with turned:
            turned.wait_for(lambda: turn[0] % of == me)
            turn[0] += 1
            turned.notify_all()
        beats[f"condition {me}"] += 1
        time.sleep(0.001)


def meet(me: int, barrier: threading.Barrier) -> None:
    while True:
        barrier.wait()
        beats[f"barrier {me}"] += 1
        time.sleep(0.003)


def tick() -> None:
    """A threading.Timer is a new thread each time."""
    beats["timer"] += 1
    threading.Timer(0.02, tick).start()


def hash_for_ever(me: int, gate: threading.BoundedSemaphore) -> None:
    block = data(50000, me).encode()
    right = hashlib.sha256(block).digest()
    while True:
        with gate:
            if hashlib.sha256(block).digest() != right:  # without the interpreter's lock
                wrong.append("a hash is another one")
        beats[f"hash {me}"] += 1
        time.sleep(0.004)


def check(bank: Bank) -> str:
    before = dict(beats)
    deadline = time.monotonic() + PATIENCE_S
    while still := [name for name, n in before.items() if beats[name] < n + 2]:
        if time.monotonic() > deadline:
            return f"bad these stand still: {', '.join(still)}"
        time.sleep(0.005)
    money = bank.sum()
    if money != MONEY * len(bank.accounts):
        return f"bad the accounts hold {money}"
    return f"bad {wrong[0]}" if wrong else f"ok connections={connections} threads={threading.active_count()}"


class Session(socketserver.StreamRequestHandler):
    bank: Bank

    def handle(self) -> None:
        global connections
        with lock:
            connections += 1
        try:
            self.answer()
        except ConnectionError:
            pass
        finally:
            with lock:
                connections -= 1

    def answer(self) -> None:
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for line in self.rfile:
            number, what, *args = line.decode().split()
            if what == "inc":
                with lock:
                    counters[args[0]] += 1
                    answer = str(counters[args[0]])
            elif what == "data":
                text = data(int(args[0]), int(args[1]))
                answer = f"{zlib.crc32(text.encode()):08x} {text}"
            else:
                answer = check(self.bank)
            self.wfile.write(f"{number} {answer}\n".encode())

    def finish(self) -> None:
        with contextlib.suppress(ConnectionError):
            super().finish()


class Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    request_queue_size = 64


def main() -> None:
    bank = Session.bank = Bank(16)
    numbers: queue.Queue[int] = queue.Queue(8)
    barrier = threading.Barrier(3)
    gate = threading.BoundedSemaphore(2)
    work = [
        *(threading.Thread(target=bank.move_for_ever, args=(n,)) for n in range(4)),
        threading.Thread(target=produce, args=(numbers,)),
        threading.Thread(target=consume, args=(numbers,)),
        *(threading.Thread(target=take_turns, args=(n, 3)) for n in range(3)),
        *(threading.Thread(target=meet, args=(n, barrier)) for n in range(3)),
        *(threading.Thread(target=hash_for_ever, args=(n, gate)) for n in range(3)),
    ]
    for thread in work:
        thread.start()
    tick()
    Server(("0.0.0.0", 7000), Session).serve_forever()


if __name__ == "__main__":
    main()
