# SPDX-License-Identifier: Apache-2.0
"""Blocked system calls under checkpoints: no EINTR, and timeouts end in time."""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from testkit.guarded import WHERE, GuardProcess, Victim, config
from testkit.harness import SLOWNESS, wait_until
from testkit.procfs import status_of

pytestmark = pytest.mark.shared_machine("timeouts of blocked calls are compared with the clock")

CHECKPOINTS = 10_000 if os.environ.get("AVCKPT_LONG") == "1" else 300
ROUSING = 1_000
HUGE_PAGES = 8
LONGEST, PUNCTUAL = 3, 7
KINDS_AT = 8
KINDS, TIMED = 54, 38
"""Kinds of calls in eintr.c, all registers checked at each; how many of them have a timeout and are part of "all"."""
UNDER = ("", "under killing ")
"""Without a filter, and under one that kills whom the kernel lets continue a call as restart_syscall(2)."""
UNWOKEN = {9, 10, 11, 19, 22, 38, 46, 52}
"""Places on the board of kinds that nothing wakes, or not soon: sleeps, TCP; and those that "all" leaves out."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize("under", UNDER)
def test_no_eintr_over_hundreds_of_checkpoints(under: str, tmp_path: Path) -> None:
    """One process with a thread blocked in each call; every checkpoint interrupts all of them."""
    # Above clone's way: one generation, so that the cost is the freeze and not the bookkeeping.
    with Victim(f"{under}eintr all 0", tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        taken = 0
        while taken < CHECKPOINTS:
            # Some may miss their deadline on a busy machine.
            taken += guard.burst(CHECKPOINTS - taken, timeout_s=360)["taken"]
        calls = victim.see().counter[KINDS_AT : KINDS_AT + KINDS]
        victim.wait_beats(20)
        victim.check()
        assert victim.see().counter[1] == 0
        # None is stuck in a call whose wake-up was lost: each comes back once more.
        later = victim.see().counter[KINDS_AT : KINDS_AT + KINDS]
        stuck = [n for n in range(KINDS) if n not in UNWOKEN and later[n] == calls[n]]
        assert stuck == [], f"of {victim.command}, as listed in eintr.c: {stuck}"


def test_a_signal_ends_a_call_whenever_it_comes(tmp_path: Path) -> None:
    """Also while the guard holds the thread that it is for, or has sent it back into its call."""
    with Victim("roused", tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        assert guard.burst(ROUSING, timeout_s=100 * SLOWNESS)["taken"] >= ROUSING // 2
        ended = victim.see().counter[:2]
        victim.wait_beats(20)
        victim.check()
        assert min(ended) > ROUSING // 20, ended


@pytest.mark.usefixtures("huge_pages")
@pytest.mark.parametrize("where", WHERE)
def test_a_file_gets_its_room(where: str, tmp_path: Path) -> None:
    """fallocate(2) of huge pages waits for nobody, but looks for signals."""
    command = f"grows {HUGE_PAGES * 2048} {where}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(keep=1), [victim.pid]) as guard:
        assert guard.burst(200)["taken"] > 0
        victim.wait_beats(3)


@pytest.mark.parametrize("under", UNDER)
@pytest.mark.parametrize(("seconds", "interval_s", "late_s"), [(2.0, 0.1, 0.4), (3.0, 0.01, 0.4), (0.3, 0.02, 0.4)])
def test_timeouts_end_on_time(seconds: float, interval_s: float, late_s: float, under: str, tmp_path: Path) -> None:
    """A checkpoint does not restart a relative timeout, and none ends early (the victim checks that)."""
    # An interval, where the scheduler has moved a thread to another CPU and nobody knows how long it has been
    # waiting.  The rest is for a busy machine, and less than what a wait that forgets the time it was stopped
    # adds up to in the second case.
    command = f"{under}eintr all {seconds} --quiet --late {late_s * SLOWNESS}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(interval_s), [victim.pid]) as guard:
        guard.wait("checkpoint")
        victim.board.set_counter(PUNCTUAL, 1)  # what is begun from now on
        time.sleep(3.2 * seconds)
        seen = victim.see()
        victim.check()
        counts = seen.counter[KINDS_AT : KINDS_AT + KINDS]
        timed = [n for n in counts if n]
        assert len(timed) == TIMED, f"kinds that have come back at all: {counts}"
        assert min(timed) >= 2, counts
        assert seen.counter[1] == 0


@pytest.mark.parametrize("under", UNDER)
def test_a_timeout_survives_a_restore(under: str, tmp_path: Path) -> None:
    """It starts again with its full length at most: never early, and never without an end."""
    with (
        Victim(f"{under}eintr all 0.5 --quiet --late 2", tmp_path) as victim,
        GuardProcess(config(0.05), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=3)
        victim.board.set_counter(PUNCTUAL, 1)
        for _ in range(3):
            time.sleep(0.3)
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
        calls = victim.see().counter[KINDS_AT : KINDS_AT + KINDS]
        time.sleep(1.5)
        victim.check()
        later = victim.see().counter[KINDS_AT : KINDS_AT + KINDS]
        assert sum(after > before for before, after in zip(calls, later)) == TIMED, (calls, later)


@pytest.mark.skipif(not shutil.which("strace"), reason="strace is what slows the guard down; it is not installed")
def test_threads_wait_for_a_slow_guard_while_they_are_restored(tmp_path: Path) -> None:
    """Each time it takes long, the kernel could make a thread that is not its own yet continue its wait."""
    delay = f"inject=ptrace:delay_exit={2000 * SLOWNESS:.0f}"
    with Victim("under killing threads 6 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        command = ["strace", "-f", "-qq", "-o", "/dev/null", "-e", "trace=ptrace", "-e", delay, "-p", str(guard.pid)]
        with subprocess.Popen(command) as strace:
            traced = str(strace.pid)
            try:
                wait_until(lambda: status_of(guard.pid)["TracerPid"] == traced, 10 * SLOWNESS, "strace traces it")
                victim.kill_app()
                guard.wait("restored")
            finally:
                strace.send_signal(signal.SIGINT)
        victim.wait_beats()


@pytest.mark.parametrize("interval_s", [0.3, 1.0])
@pytest.mark.parametrize("elsewhere", [False, True], ids=["", "woken elsewhere"])
def test_the_wait_before_the_first_stop_counts(elsewhere: bool, interval_s: float, tmp_path: Path) -> None:
    """The time that a call had waited before it was stopped is subtracted: it ends when it would have ended.

    Holds for every call on an idle machine; on a busy one half of them may wait for the guard, or for a CPU.
    Not subtracted, it is 0.1 s and more.
    """
    seconds, n = 0.5, 9
    late = []
    command = f"eintr epoll_wait {seconds} --quiet"
    with Victim(command, tmp_path) as victim, GuardProcess(config(interval_s), [victim.pid]) as guard:
        cpus = itertools.cycle(os.sched_getaffinity(victim.app))
        os.sched_setaffinity(victim.app, {next(cpus)})
        guard.wait("checkpoint")
        for _ in range(n):
            victim.board.set_counter(LONGEST, 0)
            if elsewhere:  # where it sleeps it may not wake
                victim.wait_beats(1)
                os.sched_setaffinity(victim.app, {next(cpus)})
            guard.wait("checkpoint", since=guard.mark())
            victim.wait_beats(1)  # the call that was stopped ends
            late.append(victim.see().counter[LONGEST] / 1e9 - seconds)
    assert sorted(late)[n // 2] < 0.08 * SLOWNESS, late
