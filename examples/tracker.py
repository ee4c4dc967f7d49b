# SPDX-License-Identifier: Apache-2.0
"""A stand-in for a vehicle's tracker: threads that keep state, and a TCP connection that lasts.

It knows nothing of avckpt.  Four threads update a shared state under a lock; a
client asks over TCP, one line per question, and gets one line of JSON:

    {"question": 7, "answers": 7, "pid": 2, "tids": [3, 4, 5, 6], "started": ..., "updates": 4711, "consistent": true}

    python3 tracker.py [PORT]
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time

THREADS = 4
UPDATE_EVERY_S = 0.005
LOG_EVERY_S = 1.0


class State:
    """What the threads share: one counter per thread, and their sum, which must always agree."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.by_thread = [0] * THREADS
        self.total = 0
        self.answers = 0

    def update(self, index: int) -> None:
        """One step of one thread."""
        with self.lock:
            self.by_thread[index] += 1
            self.total += 1

    def snapshot(self) -> dict[str, object]:
        """The state as a client gets to see it."""
        with self.lock:
            consistent = sum(self.by_thread) == self.total
            return {"answers": self.answers, "updates": self.total, "consistent": consistent}


def work(state: State, index: int) -> None:
    """A tracking thread."""
    while True:
        state.update(index)
        time.sleep(UPDATE_EVERY_S)


def log(state: State) -> None:
    """Says once in a while that all is well."""
    while True:
        time.sleep(LOG_EVERY_S)
        now = state.snapshot()
        print(f"tracker: {now['updates']} updates, {now['answers']} answers", flush=True)


def serve(state: State, port: int) -> None:
    """Answers clients, one after the other, for ever."""
    started = time.time()
    server = socket.create_server(("0.0.0.0", port))
    print(f"tracker: started as PID {os.getpid()}, port {port}", flush=True)
    while True:
        connection, _ = server.accept()
        with connection, connection.makefile("r") as questions:
            for question in questions:
                state.answers += 1
                answer = {
                    "question": int(question),
                    "pid": os.getpid(),
                    # As the kernel has them, not as Python remembers them.
                    "tids": sorted(int(tid) for tid in os.listdir("/proc/self/task") if int(tid) != os.getpid()),
                    "started": started,
                    **state.snapshot(),
                }
                connection.sendall(json.dumps(answer).encode() + b"\n")


def main() -> None:
    state = State()
    for index in range(THREADS):
        threading.Thread(target=work, args=(state, index), daemon=True).start()
    threading.Thread(target=log, args=(state,), daemon=True).start()
    serve(state, int(sys.argv[1]) if len(sys.argv) > 1 else 7000)


if __name__ == "__main__":
    main()
