# SPDX-License-Identifier: Apache-2.0
"""Two programs that only make sense together, for group.yaml: a planner numbers commands, and a driver counts them.

They know nothing of avckpt.  The driver answers each command with the number of commands that it has
carried out.  If that is not the number of the command, one of them has forgotten or repeated something:
as when only one is restored from a checkpoint.

    python3 group.py driver PORT
    python3 group.py planner PORT
"""

from __future__ import annotations

import socket
import sys
import time

LOG_EVERY_S = 0.5
EVERY_S = 0.002


def driver(port: int) -> None:
    """Carries out commands, and counts."""
    server = socket.create_server(("127.0.0.1", port))
    print("driver: listens", flush=True)
    connection, _ = server.accept()
    for done, _ in enumerate(connection.makefile(), 1):
        connection.sendall(b"%d\n" % done)
    sys.exit("driver: the planner hung up")


def planner(port: int) -> None:
    """Sends commands, one after the other."""
    connection = connect(port)
    print("planner: connected", flush=True)
    answers = connection.makefile()
    number, logged = 0, time.monotonic()
    while True:
        number += 1
        connection.sendall(b"%d\n" % number)
        answer = answers.readline().strip()
        if answer != str(number):
            sys.exit(
                f"planner: THEY DISAGREE: this was command {number}, and the driver has done {answer or 'nothing'}"
            )
        if time.monotonic() - logged >= LOG_EVERY_S:
            logged = time.monotonic()
            print(f"planner: {number} commands, and they agree", flush=True)
        time.sleep(EVERY_S)


def connect(port: int) -> socket.socket:
    """Waits for the driver."""
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port))
        except ConnectionRefusedError:
            time.sleep(0.1)


if __name__ == "__main__":
    {"driver": driver, "planner": planner}[sys.argv[1]](int(sys.argv[2]))
