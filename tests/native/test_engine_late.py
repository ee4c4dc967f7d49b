# SPDX-License-Identifier: Apache-2.0
"""A guard that gets no CPU while a thread waits for it in the parasite: the thread goes home by itself.

That costs a checkpoint at most: the generations are as good as before.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, WHERE, GuardProcess, Json, Victim, config, injected
from testkit.harness import wait_until
from testkit.procfs import state_of

pytestmark = pytest.mark.shared_machine("where others take the CPU, a thread waits for its guard everywhere")

MOST = 30
"""Calls of ptrace(2) before the main thread was asked, which it is in the second checkpoint, if that is not put off."""
ROUNDS = 6
LATE_MS = 250
"""A thread waits for 100 ms."""
STOPS = 20
ARRIVED = {"x86_64": 168, "aarch64": 1152}[os.uname().machine]
"""HOME_ARRIVED of native/parasite/ARCH/home.h."""
PARKED_S = 0.05
"""Nobody is in the parasite for so long whose guard runs."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def waits_in_parasite(pid: int) -> bool:
    """Whether it is not stopped there: number, arguments, stack pointer and program counter of its call."""
    words = Path(f"/proc/{pid}/syscall").read_text().split()
    if len(words) != 9 or state_of(pid) != "S":
        return False
    pc = int(words[8], 16)
    maps = [line.split(maxsplit=5) for line in Path(f"/proc/{pid}/maps").read_text().splitlines()]
    ours = [line[0].split("-") for line in maps if line[-1].startswith("/memfd:avckpt-parasite")]
    return any(int(start, 16) <= pc < int(end, 16) for start, end in ours)


def late_at(guard: GuardProcess, victim: Victim, nth: int, parked: Callable[[], None]) -> tuple[Json, bool]:
    """The answer to a command whose `nth` ptrace(2) comes late, and whether the thread went home meanwhile."""
    since, stays = guard.mark(), 0.0
    with injected(guard, "ptrace", f"delay_enter={LATE_MS * 1000}:when={nth}"):
        ticket = guard.say_command("checkpoint")
        while not any(event.get("ticket") == ticket for event in guard.events[since:]):
            begun = time.monotonic()
            while waits_in_parasite(victim.app):
                if not stays and time.monotonic() - begun > PARKED_S:
                    stays = time.monotonic() - begun
                    parked()
            time.sleep(0.001)
    return guard.wait_for(lambda event: event.get("ticket") == ticket, "answer", since=since), stays > 0


def be_late(guard: GuardProcess, victim: Victim, parked: Callable[[], None]) -> Json:
    """The answer to the second command to a guard, during which the thread went home."""
    for nth in [*range(1, MOST)] * ROUNDS:
        guard.start_another(victim.pid)
        wait_until(lambda: guard.command("checkpoint")["kind"] == "checkpoint", PATIENCE_S, "a first checkpoint")
        answer, left = late_at(guard, victim, nth, parked)
        if left:
            return answer
        victim.wait_beats(3)
    raise AssertionError("it never had to wait in the parasite")


def is_restored(guard: GuardProcess, victim: Victim) -> None:
    """And is what it was."""
    since = guard.mark()
    guard.command("restore")
    guard.wait("restored", since=since)
    victim.wait_beats(3)


@pytest.mark.parametrize("where", WHERE)
def test_generations_stay(where: str, tmp_path: Path) -> None:
    """The next checkpoint is no first one."""
    with Victim(f"steady {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        answer = be_late(guard, victim, lambda: None)
        assert answer["generations"] == (2 if answer["kind"] == "checkpoint" else 1), answer
        is_restored(guard, victim)


@pytest.mark.parametrize("where", WHERE)
def test_naps_are_not_cut_short(where: str, tmp_path: Path) -> None:
    """They are continued or, where the way home makes the kernel forget them (aarch64), begin again."""
    rng = random.Random(1)
    with (
        Victim(f"idle 1 2 --beat-us 20000 {where}", tmp_path) as victim,
        GuardProcess(config(0.001), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint")
        for _ in range(STOPS):
            time.sleep(rng.uniform(0.01, 0.05))
            os.kill(guard.pid, signal.SIGSTOP)
            time.sleep(LATE_MS / 1000)
            os.kill(guard.pid, signal.SIGCONT)
            victim.wait_beats(3)


def say_home(pid: int) -> None:
    """What it says one instruction before it is there (`arrived`), where a signal may still come."""
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        if "/memfd:avckpt-parasite" in line and " rw-s " in line:
            with Path(f"/proc/{pid}/mem").open("r+b", buffering=0) as memory:
                os.pwrite(memory.fileno(), (1).to_bytes(4, sys.byteorder), int(line.split("-")[0], 16) + ARRIVED)


@pytest.mark.parametrize("early", [False, True])
def test_the_handler_of_a_signal_on_the_way_returns_to_it(early: bool, tmp_path: Path) -> None:
    """Until then there is no checkpoint, for a thread that is borrowed meanwhile would not find home."""

    with Victim("steady", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        answers = [be_late(guard, victim, lambda: os.kill(victim.app, signal.SIGUSR2))]
        if early:
            say_home(victim.app)
        while answers[-1]["kind"] != "checkpoint":
            assert answers[-1]["kind"] == "missed", answers
            assert answers[-1]["generations"] == 1, answers
            answers.append(guard.command("checkpoint"))
        assert answers[-1]["generations"] == 2, answers
        assert any("on its way home" in str(answer["error"]) for answer in answers[:-1]), answers
        assert victim.see().counter[2] == 1
        is_restored(guard, victim)
