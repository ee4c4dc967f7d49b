# SPDX-License-Identifier: Apache-2.0
"""Reads that a container may delay for as long as it likes, isolated from all other work.

Reading a process's memory through /proc (environ, smaps_rollup, mem) waits for its
mmap_lock, which a process can hold for seconds, especially when memory is short. So each
read has its own thread and is awaited for at most `WAIT_S`. One that does not return
costs a thread until its process exits, and the next read of the same file fails at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import Any, TypeVar

from avckpt.errors import DeadlineMissed

T = TypeVar("T")

WAIT_S = 1.0

_under_way: dict[tuple[str, int], tuple[float, asyncio.Future[Any]]] = {}
"""Reads under way, by subject and process: when each began (the loop's time), and its result."""


async def look(what: str, pid: int, function: Callable[[], T]) -> T:
    """Returns what `function` returns, or raises.  Callers that want the same `what` of `pid` share one call.

    Raises DeadlineMissed when that takes longer than WAIT_S, or no thread can be created for it.
    """
    loop = asyncio.get_running_loop()
    since, future = _under_way.get((what, pid), (loop.time(), None))
    if future is None or future.get_loop() is not loop:
        try:
            future = in_own_thread(function)
        except RuntimeError as error:
            raise DeadlineMissed(f"its {what} cannot be read: {error}", pid=pid) from None
        entry = _under_way[what, pid] = (since, future)

        def forget(_: object) -> None:
            if _under_way.get((what, pid)) is entry:
                del _under_way[what, pid]

        future.add_done_callback(forget)
    wait_s = since + WAIT_S - loop.time()
    if wait_s > 0:
        await asyncio.wait([future], timeout=wait_s)
    if not future.done():
        raise DeadlineMissed(f"its {what} cannot be read within {WAIT_S:g} s", pid=pid)
    result: T = future.result()
    return result


def in_own_thread(function: Callable[[], T]) -> asyncio.Future[T]:
    """What `function` returns, or raises, in a thread of its own.

    Precondition: an event loop runs. Raises RuntimeError when no thread can be created.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def settle(result: T | None, error: BaseException | None) -> None:
        if future.done():
            return  # the caller has been cancelled
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(result)  # type: ignore[arg-type]

    def run() -> None:
        result, failed = None, None
        try:
            result = function()
        except BaseException as error:  # noqa: BLE001 - it is raised where it is waited for
            failed = error
        with contextlib.suppress(RuntimeError):  # the loop has been closed
            loop.call_soon_threadsafe(settle, result, failed)

    threading.Thread(target=run, name="avckpt-look", daemon=True).start()
    return future
