# SPDX-License-Identifier: Apache-2.0
"""Restores of a program that has opened thousands of descriptors since its checkpoint.

    .venv/bin/python -m bench.descriptors [--counts 0,5000,19800] [--restores 20] [--in-child]

tests/victims/openings.c opens so many of a kind, with or without having closed a file that it had
open at the checkpoint, and is killed; with --in-child its child does so, and both are.  Prints
median and longest time, in ms, from the death's report until the program runs again; and what
close_range(2) of as many takes in an unprotected process, in turns with the restores.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import socket
import statistics
import struct
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from bench.subjects import build
from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import wait_until


def connect_to_self() -> tuple[int, int]:
    """Both ends of a TCP connection, which is reset when it is closed, so that its port is free again."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        one = socket.create_connection(listener.getsockname())
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        return one.detach(), listener.accept()[0].detach()


KINDS: dict[str, Callable[[], tuple[int, ...]]] = {
    "null": lambda: (os.open("/dev/null", os.O_RDONLY),),
    "file": lambda: (os.open("/etc/passwd", os.O_RDONLY),),
    "eventfd": lambda: (os.eventfd(0),),
    "pair": lambda: tuple(end.detach() for end in socket.socketpair()),
    "pipe": os.pipe,
    "peers": connect_to_self,
    "tcp": lambda: (socket.socket(socket.AF_INET, socket.SOCK_STREAM).detach(),),
}


def is_past(victim: Victim, rounds: int) -> bool:
    """It has opened them once more."""
    return victim.see().counter[0] > rounds


def kernel_ms(kind: str, opened: int) -> float:
    """What the kernel takes to close so many, in this process."""
    fds: set[int] = set()
    while len(fds) < opened:
        fds.update(KINDS[kind]())
    last = max(fds, default=-1)
    first = last + 1
    while first - 1 in fds:
        first -= 1
    for gap in [fd for fd in fds if fd < first]:
        os.close(gap)
    since = time.monotonic()
    if fds:  # Python 3.11 takes an empty range for all there are
        os.closerange(first, last + 1)
    return 1000 * (time.monotonic() - since)


def restores_ms(kind: str, closes: str, opened: int, restores: int, folder: Path) -> tuple[list[float], list[float]]:
    """Of restores, each with the same checkpoint to go back to; and of the kernel alone."""
    found, kernel = [], []
    with (
        Victim(f"openings {opened} {kind}{closes}", folder) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", 10, "a checkpoint")
        for _ in range(restores):
            kernel.append(kernel_ms(kind, opened))
            before, since = victim.see().counter[0], guard.mark()
            os.kill(victim.player, signal.SIGUSR1)
            wait_until(partial(is_past, victim, before), 30, "they are open")
            victim.kill_app()
            event = guard.wait("restored", since=since)
            assert "error" not in event, event
            found.append(1000 * event["restore_s"])
            victim.wait_beats(3)
    return found, kernel


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", default="0,5000,19800", help="%(default)s")
    parser.add_argument("--kinds", default=",".join(KINDS), help="%(default)s")
    parser.add_argument("--restores", type=int, default=20, help="%(default)s")
    parser.add_argument("--in-child", action="store_true")
    asked = parser.parse_args()
    where = " --in-child" if asked.in_child else ""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    build()
    print("opened  kind              median  longest  kernel alone")
    for kind, closes in ((kind, closes) for kind in asked.kinds.split(",") for closes in ("", " --closes")):
        for count in map(int, asked.counts.split(",")):
            with tempfile.TemporaryDirectory() as folder:
                resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
                found, kernel = restores_ms(kind, closes + where, count, asked.restores, Path(folder))
            print(
                f"{count:6}  {kind + closes:16} {statistics.median(found):7.2f}  {max(found):7.2f}"
                f"  {statistics.median(kernel):12.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
