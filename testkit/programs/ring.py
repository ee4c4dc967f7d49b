# SPDX-License-Identifier: Apache-2.0
"""A member of a ring that passes numbered tokens over TCP, or Unix sockets, at full rate.

    python ring.py INDEX MEMBERS PORT|FOLDER

Member 0 makes the tokens 1, 2, 3, ... and stops for a moment when WINDOW of them are under way; the
others pass them on.  Each keeps a ledger, the number of the last token that it got and gave; nothing
may be lost, come twice, or come that was not sent.  Where a connection is lost, the receiver of the
next one says what it has, and the sender goes on from there: it must not have given less.

Says READY, a line "GOT GAVE LOST_CONNECTIONS" ten times a second, and WRONG and why before it ends.
"""

from __future__ import annotations

import contextlib
import select
import socket
import sys
import time

WINDOW = 2000
TOKEN = 8
ROOM = 65536

index, members = map(int, sys.argv[1:3])
got = gave = lost = 0


def address(of: int) -> str | tuple[str, int]:
    return ("127.0.0.1", int(sys.argv[3]) + of) if sys.argv[3].isdigit() else f"{sys.argv[3]}/{of}"


def new_socket() -> socket.socket:
    return socket.socket(socket.AF_INET if sys.argv[3].isdigit() else socket.AF_UNIX)


listening = new_socket()
listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
listening.bind(address(index))
listening.listen(8)
listening.setblocking(False)
before: socket.socket | None = None
after: socket.socket | None = None
come = bytearray()
going = bytearray()
greeting = bytearray()
greeted = False
told = connected = 0.0


def wrong(why: str) -> None:
    print(f"WRONG {index}: {why}", flush=True)
    sys.exit(0)


def take(number: int) -> None:
    global got
    if number != got + 1:
        wrong(f"got {number} after {got}")
    got = number
    if index == 0 and got > gave:
        wrong(f"got {got}, and gave {gave}")
    if index:
        give(number)


def give(number: int) -> None:
    global gave
    gave = number
    if greeted:
        going.extend(number.to_bytes(TOKEN, "big"))


def drop_after() -> None:
    global after, greeted, lost
    if after is not None:
        after.close()
        lost += greeted
    after, greeted = None, False
    going.clear()
    greeting.clear()


def drop_before() -> None:
    global before
    if before is not None:
        before.close()
    before = None
    come.clear()


def connect() -> None:
    global after, connected
    connected = time.monotonic()
    caller = new_socket()
    caller.settimeout(0.2)
    try:
        caller.connect(address((index + 1) % members))
    except OSError:
        caller.close()
        return
    caller.setblocking(False)
    after = caller


def greet(data: bytes) -> None:
    """What the one behind us has already."""
    global greeted
    greeting.extend(data)
    if len(greeting) < TOKEN:
        return
    has = int.from_bytes(greeting, "big")
    if has > gave:
        wrong(f"member {(index + 1) % members} has {has}, and was given {gave}")
    greeted = True
    for number in range(has + 1, gave + 1):
        going.extend(number.to_bytes(TOKEN, "big"))


def read_before() -> None:
    assert before is not None
    try:
        data = before.recv(ROOM)
    except BlockingIOError:
        return
    except OSError:
        data = b""
    if not data:
        drop_before()
        return
    come.extend(data)
    whole = len(come) // TOKEN * TOKEN
    for at in range(0, whole, TOKEN):
        take(int.from_bytes(come[at : at + TOKEN], "big"))
    del come[:whole]


def read_after() -> None:
    assert after is not None
    try:
        data = after.recv(TOKEN)
    except BlockingIOError:
        return
    except OSError:
        data = b""
    if not data or greeted:
        drop_after()
    else:
        greet(data)


def write_after() -> None:
    assert after is not None
    try:
        del going[: after.send(going)]
    except BlockingIOError:
        return
    except OSError:
        drop_after()


def accept() -> None:
    global before
    with contextlib.suppress(OSError):
        caller, _ = listening.accept()
        drop_before()
        before = caller
        before.setblocking(False)
        before.send(got.to_bytes(TOKEN, "big"))


print("READY", flush=True)
while True:
    if after is None and time.monotonic() - connected > 0.02:
        connect()
    while index == 0 and gave - got < WINDOW and len(going) < ROOM and greeted:
        give(gave + 1)
    reading = [each for each in (listening, before, after) if each is not None]
    can_read, can_write, _ = select.select(reading, [after] if after is not None and going else [], [], 0.02)
    if listening in can_read:
        accept()
    if before is not None and before in can_read:
        read_before()
    if after is not None and after in can_read:
        read_after()
    if after is not None and after in can_write:
        write_after()
    if time.monotonic() - told > 0.1:
        told = time.monotonic()
        print(got, gave, lost, flush=True)
