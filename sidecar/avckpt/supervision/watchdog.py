# SPDX-License-Identifier: Apache-2.0
"""The main process of the sidecar's container: kills a daemon that gives no sign of life, and starts another.

Guards protect their containers without the daemon; but without it no new container is protected, and no event
is reported.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import select
import signal
import time
from collections.abc import Callable

from avckpt.containers.process import stat_fields

log = logging.getLogger("avckpt")

LOOK_S = 1.0
"""Seconds between signs of life, and between checks for them."""
PATIENCE = 10
"""After this many checks in vain it is killed. Checks are counted, not time: a pause stops both."""
START = 50
"""This many more before the first sign: it has to be loaded from a disk."""
STARVED = 10
"""A factor for one that is runnable but gets no CPU."""
AGAIN_S = 3.0
"""A daemon that exits by itself within this time has a persistent problem."""
PR_SET_PDEATHSIG = 1

_libc = ctypes.CDLL(None, use_errno=True)


def keep_alive(serve: Callable[[int], int]) -> int:
    """Runs `serve` in a child, again whenever that is killed; the status with which it ended by itself.

    `serve` is given the descriptor to which it writes a byte every LOOK_S.  SIGTERM, SIGINT and SIGHUP are
    passed on.  Precondition: this process has one thread.
    """
    child = 0
    stopping = False

    def pass_on(signum: int, _frame: object) -> None:
        nonlocal stopping
        stopping |= signum != signal.SIGHUP
        if child:
            with contextlib.suppress(ProcessLookupError):
                os.kill(child, signum)

    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    for signum in numbers:
        signal.signal(signum, pass_on)
    while True:
        signs, beat = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
        child = os.fork()
        if child == 0:
            os.close(signs)
            _become_daemon(serve, beat, numbers)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
        os.close(beat)
        since_s = time.monotonic()
        try:
            status = _watch(child, signs)
        finally:
            os.close(signs)
        ended, child = child, 0
        if stopping or os.WIFEXITED(status):
            return os.waitstatus_to_exitcode(status) if os.WIFEXITED(status) else 128 + os.WTERMSIG(status)
        log.error("the daemon (pid %d) was killed by signal %d: another one is started", ended, os.WTERMSIG(status))
        if time.monotonic() - since_s < AGAIN_S:
            time.sleep(AGAIN_S)


def _become_daemon(serve: Callable[[int], int], beat: int, numbers: tuple[signal.Signals, ...]) -> None:
    parent = os.getppid()
    status = 1
    try:
        _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        for signum in numbers:
            signal.signal(signum, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
        if os.getppid() == parent:
            status = serve(beat)
    finally:
        os._exit(status)


def _watch(child: int, signs: int) -> int:
    """Waits until it has ended; its wait status."""
    silent = -START
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status
        heard, _, _ = select.select([signs], [], [], LOOK_S)
        if heard and os.read(signs, 4096):
            silent = 0
            continue
        if heard:  # it has closed its end: it is ending
            time.sleep(0.05)
            continue
        silent += 1
        if silent >= PATIENCE * (STARVED if _state(child) == "R" else 1):
            log.error("the daemon (pid %d) has given no sign of life for %d s: it is killed", child, silent)
            os.kill(child, signal.SIGKILL)
            return os.waitpid(child, 0)[1]


def _state(pid: int) -> str:
    try:
        return stat_fields(pid)[0]
    except OSError:
        return ""
