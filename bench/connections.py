# SPDX-License-Identifier: Apache-2.0
"""What counting the bytes of connections costs a freeze (avckpt.tcp).

    python -m bench.connections [--connections 0,100,1000] [--checkpoints 100]

tests/victims/tcpecho.c with so many idle connections; checkpoints with `keep`, which counts
nothing, and with `reset-moved`, in turns.  Prints medians in ms.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import statistics
import tempfile
from pathlib import Path

from avckpt.guard import Tcp

from bench.subjects import build
from testkit.guarded import GuardProcess, Victim, config
from testkit.harness import wait_until

WAYS = (Tcp.KEEP, Tcp.RESET_MOVED)
TURNS = 5
WARM_UP = 3


def freezes_ms(count: int, checkpoints: int, folder: Path) -> dict[Tcp, list[float]]:
    """Freeze times with so many connections."""
    found: dict[Tcp, list[float]] = {tcp: [] for tcp in WAYS}
    with Victim("tcpecho 0", folder) as victim, contextlib.ExitStack() as connections:
        wait_until(lambda: victim.see().counter[1], 10, "its port")
        for _ in range(count):
            peer = connections.enter_context(socket.create_connection(("127.0.0.1", victim.see().counter[1]), 5))
            peer.sendall(b"hello\n")
            peer.recv(100)
        for _ in range(TURNS):
            for tcp in WAYS:
                with GuardProcess(config(tcp=tcp), [victim.pid]) as guard:
                    for n in range(WARM_UP + checkpoints // TURNS):
                        answer = guard.command("checkpoint")
                        if n >= WARM_UP and answer["kind"] == "checkpoint":
                            found[tcp].append(1000 * answer["freeze_s"])
    return found


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--connections", default="0,100,1000", help="%(default)s")
    parser.add_argument("--checkpoints", type=int, default=100, help="of each kind (%(default)s)")
    asked = parser.parse_args()
    build()
    print("connections  " + "  ".join(tcp.name.lower() for tcp in WAYS))
    for count in map(int, asked.connections.split(",")):
        with tempfile.TemporaryDirectory() as folder:
            found = freezes_ms(count, asked.checkpoints, Path(folder))
        print(f"{count:11}  " + "  ".join(f"{statistics.median(found[tcp]):.2f}" for tcp in WAYS), flush=True)


if __name__ == "__main__":
    main()
