# SPDX-License-Identifier: Apache-2.0
"""A web server as puma in cluster mode: processes that share a listening socket, with threads.

    python3 server_prefork.py PORT

GET /NUMBER is answered NUMBER.  Some answers take a while, so that requests are under way all the time.
"""

import os
import socket
import sys
import threading
import time

WORKERS = 2
ANSWER = b"HTTP/1.1 200 OK\r\nContent-Type: text/plain\r\nContent-Length: %d\r\n\r\n%s"


def read_request(connection: socket.socket, held: bytes) -> tuple[bytes, bytes]:
    """The path of the next request (b"" at the end of the stream), and what came after it."""
    while b"\r\n\r\n" not in held:
        more = connection.recv(65536)
        if not more:
            return b"", b""
        held += more
    head, _, rest = held.partition(b"\r\n\r\n")
    return head.split(b" ", 2)[1], rest


def serve(connection: socket.socket) -> None:
    """One connection until its end."""
    held = b""
    with connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while True:
            try:
                path, held = read_request(connection, held)
                if not path:
                    return
                body = path.strip(b"/")
                time.sleep((0, 0, 0.002, 0.01)[int(body) % 4])
                connection.sendall(ANSWER % (len(body), body))
            except OSError:
                return


def work(listener: socket.socket) -> None:
    """A worker: a thread for every connection."""
    while True:
        connection, _ = listener.accept()
        threading.Thread(target=serve, args=(connection,), daemon=True).start()


def main() -> None:
    """The master: starts workers, and others for those that end."""
    listener = socket.create_server(("127.0.0.1", int(sys.argv[1])), backlog=128)
    alive = 0
    while True:
        while alive < WORKERS:
            if os.fork() == 0:
                work(listener)
            alive += 1
        os.wait()
        alive -= 1


if __name__ == "__main__":
    main()
