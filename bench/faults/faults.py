# SPDX-License-Identifier: Apache-2.0
"""A program with a fault in it, as faults.cpp: `python faults.py FAULT PORT`."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
import random
import resource
import signal
import socket
import sys
import threading
import time

triggered = 0


def on_trigger(*_: object) -> None:
    """Brings the fault out."""
    global triggered
    triggered += 1


def recurse(n: int) -> int:
    return recurse(n + 1) + 1


def limit(what: int, most: int) -> None:
    resource.setrlimit(what, (most, most))


def deadlock() -> None:
    one, other = threading.Lock(), threading.Lock()

    def work() -> None:
        with one:
            time.sleep(0.05)
            other.acquire()

    threading.Thread(target=work, daemon=True).start()
    with other:
        time.sleep(0.1)
        one.acquire()


def break_down(fault: str) -> None:
    libc = ctypes.CDLL(None)
    libc.malloc.restype = ctypes.c_void_p
    if fault == "null pointer":
        ctypes.string_at(0)
    elif fault == "double free":
        block = ctypes.c_void_p(libc.malloc(40))
        libc.free(block)
        libc.free(block)
    elif fault == "stack overflow":
        limit(resource.RLIMIT_DATA, 512 << 20)
        sys.setrecursionlimit(10**9)
        recurse(0)
    elif fault == "uncaught exception":
        raise RuntimeError("nobody catches this")
    elif fault == "assertion":
        raise AssertionError
    elif fault == "index out of range":
        [][7]
    elif fault == "abort":
        os.abort()
    elif fault == "exit with a status":
        sys.exit(3)
    elif fault == "disk full":
        with open("/dev/full", "w") as full:
            full.write("result")
    elif fault == "timer without a handler":
        signal.alarm(1)
    elif fault == "truncated mapped file":
        fd = os.memfd_create("mapped")
        os.ftruncate(fd, 8192)
        mapped = mmap.mmap(fd, 8192, mmap.MAP_SHARED)
        os.ftruncate(fd, 0)
        mapped[4096]
    elif fault == "memory leak to a limit":
        limit(resource.RLIMIT_DATA, 512 << 20)
        eaten = []
        while True:
            eaten.append(bytearray(b"x" * (1 << 20)))
    elif fault == "descriptor leak":
        limit(resource.RLIMIT_NOFILE, 256)
        opened = []
        while True:
            opened.append(os.open("/dev/null", os.O_RDONLY))
    elif fault.startswith("deadlock"):
        deadlock()
    elif fault.startswith("livelock"):
        while True:
            pass
    elif fault.startswith("lost wake-up"):
        condition = threading.Condition()
        with condition:
            condition.wait()
    elif fault == "killed from outside":
        os.kill(os.getpid(), signal.SIGKILL)
    elif fault == "poison input" or (fault == "poison input, one in four" and random.randrange(4) == 0):
        raise ValueError("poison")


class Program:
    """The series, a term at a time, until it is told to break down."""

    def __init__(self, fault: str, port: int) -> None:
        self._fault = fault
        self._to = ("127.0.0.1", port)
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._kept, self._number, self._seen, self._bad_in = [0] * 1000, 0, 0, 0
        self._leaked: list[bytearray] | None = None
        self._inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._inbox.bind(("127.0.0.1", 0))
        self._jobs, self._queue = os.pipe()
        for fd in (self._inbox.fileno(), self._jobs):
            os.set_blocking(fd, False)
        self._child = 0
        if fault == "death of a child":
            self._child = os.fork()
            while not self._child:
                time.sleep(1000)

    def step(self) -> bool:
        """Whether there is another one."""
        if "own watchdog" in self._fault:
            signal.alarm(2)
        self._take_input()
        kept, number = self._kept, self._number
        kept[(number + 1) % 1000] = (kept[number % 1000] * 6364136223846793005 + 1442695040888963407) % 2**64
        self._number = number = number + 1
        self._out.sendto(f"{number} {kept[number % 1000]}".encode(), self._to)
        if self._child and os.waitpid(self._child, os.WNOHANG)[0] == self._child:
            sys.exit(4)
        if self._leaked is not None:
            self._leaked.append(bytearray(b"x" * (1 << 20)))
        if self._bad_in:
            self._bad_in -= 1
            if not self._bad_in:
                ctypes.string_at(8)
        if self._seen == triggered:
            return True
        self._seen = triggered
        return self._break_down()

    def _take_input(self) -> None:
        for fd in (self._inbox.fileno(), self._jobs):
            with contextlib.suppress(BlockingIOError):
                if os.read(fd, 1) == b"x":
                    raise ValueError("a bad message")

    def _break_down(self) -> bool:
        if self._fault == "corruption before the checkpoint":
            self._bad_in = 50
        elif self._fault == "wrong value, no crash":
            self._kept[self._number % 1000] ^= 1 << 20
        elif self._fault == "memory leak to the OOM killer":
            self._leaked = []
        elif self._fault == "burst of bad messages":
            for _ in range(50):
                self._out.sendto(b"x", self._inbox.getsockname())
        elif self._fault == "bad job in a queue":
            os.write(self._queue, b"." * 150 + b"x")
        elif self._fault == "death of a child":
            os.kill(self._child, signal.SIGKILL)
        elif self._fault == "fault in another thread":
            threading.Thread(target=lambda: ctypes.string_at(0)).start()
        elif self._fault.startswith("death of a thread"):
            return False
        else:
            break_down(self._fault)
        return True

    def work(self) -> None:
        while self.step():
            time.sleep(0.01)


def main() -> None:
    """Computes, sends, and breaks down when it is told to."""
    fault, port = sys.argv[1], int(sys.argv[2])
    signal.signal(signal.SIGUSR1, on_trigger)
    program = Program(fault, port)
    if fault.startswith("death of a thread"):
        threading.Thread(target=program.work).start()
        while True:
            time.sleep(0.01)
    program.work()


if __name__ == "__main__":
    main()
