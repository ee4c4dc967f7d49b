# SPDX-License-Identifier: Apache-2.0
"""Signals pending at the checkpoint are pending after a restore."""

from __future__ import annotations

import ctypes
import signal
import threading
from functools import partial
from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config, kill_at_random, sleep_exactly

SHARED = pytest.mark.shared_machine("signals come as fast as a guard is to work")


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("command", ["pending 1", "pending 12", "signals 6 --pending"])
def test_pending_signals(command: str, where: str, tmp_path: Path) -> None:
    """With their values, codes and senders, in order, and each only once."""
    with Victim(f"{command} {where}", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        kill_at_random(guard, victim, 60, (0.005, 0.08))


@SHARED
@pytest.mark.parametrize("signum", [signal.SIGABRT, signal.SIGTERM, signal.SIGRTMIN])
def test_a_deadly_signal_is_in_no_image(signum: int, tmp_path: Path) -> None:
    """Sent during a checkpoint, it stays pending until the application runs: an image with it could not live."""
    with Victim("busy 64", tmp_path) as victim, GuardProcess(config(0.001), [victim.pid]) as guard:
        guard.wait("checkpoint", count=5)
        for n in range(1, 21):
            since = guard.mark()
            victim.kill_app(signum)
            guard.wait("restored", since=since)
            victim.wait_beats(3)
            guard.wait("checkpoint", since=since)
            deaths = [event for event in guard.events if event.get("kind") == "died"]
            assert len(deaths) == n, deaths[-3:]


class Ticks:
    """A storm of the signal that the guard's deadline timer sends (tracee.c), which interrupts its calls."""

    SIGNAL = signal.SIGRTMAX - 2

    def __init__(self, guard: GuardProcess) -> None:
        tasks = Path(f"/proc/{guard.pid}/task")
        (self._tid,) = [int(task.name) for task in tasks.iterdir() if (task / "comm").read_text() == "avckpt-guard\n"]
        self._pid, self._over = guard.pid, threading.Event()
        self._thread = threading.Thread(target=self._send)

    def __enter__(self) -> Ticks:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _send(self) -> None:
        tgkill = partial(ctypes.CDLL(None).tgkill, self._pid, self._tid, self.SIGNAL)
        while not self._over.is_set():
            tgkill()
            sleep_exactly(30e-6)  # more often, nothing else would get done


@SHARED
def test_signals_of_the_guard_cut_no_queue_short(tmp_path: Path) -> None:
    """PTRACE_PEEKSIGINFO returns fewer signals than there are when its caller is interrupted."""
    with Victim("pending 12", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        guard.wait("checkpoint")
        with Ticks(guard):
            kill_at_random(guard, victim, 60, (0.005, 0.08))
