# SPDX-License-Identifier: Apache-2.0
"""The guard dies before its 1st, 2nd, 3rd ... system call or store that changes something, one run each.

No application notices: each checks its own registers, stacks, masks, options and signals all the
time.  All of it is `make sweep`; otherwise a part of it, another one each hour, or the one that
AVCKPT_SWEEP names.
"""

from __future__ import annotations

import mmap
import os
import re
import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from avckpt.guard import Images

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config
from testkit.harness import ROOT, wait_until
from testkit.procfs import below, state_of, status_of

MOST = 40000
"""System calls or stores of one checkpoint or restore; there are never so many."""
MISSES = 100
"""So often in a row a checkpoint may be missed: by a busy machine, or a thread on its way home."""
TIDY = 10
"""After so many guards that have died in their first checkpoint one may take two."""
SWEEP = os.environ.get("AVCKPT_SWEEP") or str(int(time.time()) // 3600)
"""Which part: "all", or a number."""
CELLS = "under harmless cells"
"""Seven processes, most of them under filters of their own, which take thousands of calls."""
COUNTING = ROOT / "native/build-steps/avckpt-guard"

pytestmark = [
    pytest.mark.timeout(7200 if SWEEP == "all" else 600),
    pytest.mark.shared_machine(
        "a guard is killed before each of its steps, hundreds of times, and each next one has to protect in time"
    ),
]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def numbers(step: int) -> Iterator[int]:
    """The numbers of the calls before which the guard is killed: all of them, or every `step`th."""
    if SWEEP == "all":
        return iter(range(1, MOST))
    return iter(range(1 + int(SWEEP) % step, MOST, step))


class Death:
    """Kills a guard before the `nth` thing that it does from arm() on: a system call that may change something, or a
    store to memory shared with the application and init.  Such a guard counts them (steps.c)."""

    def __init__(self, of: str, path: Path, patch: pytest.MonkeyPatch) -> None:
        subprocess.run(["make", "-s", "-C", str(ROOT / "native"), "STEPS=1"], check=True, timeout=300)
        path.write_bytes(bytes(16))
        with path.open("r+b") as file:
            self.left = mmap.mmap(file.fileno(), 16)
        self.of = of
        self.at = 8 * ["calls", "stores"].index(of)
        patch.setenv("AVCKPT_STEPS", str(path))
        patch.setenv("AVCKPT_TEST_GUARD", str(COUNTING))

    def arm(self, nth: int) -> None:
        struct.pack_into("q", self.left, self.at, nth)

    def disarm(self) -> None:
        self.arm(0)


@pytest.fixture(params=["calls", "stores"])
def death(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Death:
    return Death(request.param, tmp_path / "steps", monkeypatch)


def answer(guard: GuardProcess, death: Death, nth: int, command: str) -> dict[str, Any]:
    """The command's answer, or that the guard was killed before it had carried it out."""
    death.arm(nth)
    try:
        since = guard.mark()
        ticket = guard.say_command(command)
        return guard.wait_for(
            lambda event: event.get("ticket") == ticket or event.get("kind") == "guard_lost", command, since=since
        )
    finally:
        death.disarm()


BARREN = "under barren steady"
"""Its filter refuses what injected code calls without its guard."""
VICTIMS = ("steady", "steady --in-child", "peeker", "peeker --in-child", "signals 3", BARREN, CELLS)
RESTORED = ("steady", "steady --in-child", CELLS)
REFUSED = ("under no-sigprocmask idle 1 1", "sandbox --kill", "unsupported strict")
"""Under filters by which a dead guard could do harm."""
UNSEEN = 8
"""A guard's calls from the stop of a thread until it has seen its filter, which the kernel shows of no other: that may
kill for restart_syscall(2), as after each SIGSTOP (limits.md)."""
TREES = ("--in-child", "cells")
WAYS = {
    "first": (Images.FORK, 0),
    "next": (Images.FORK, 1),
    "dirty": (Images.DIRTY, 3),
}
"""How checkpoints are made, and how many there are before the one in which the guard dies: everything is brought in
for the first one; a template that is written to comes with the third."""


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("command", VICTIMS)
def test_checkpoint(tmp_path: Path, command: str, way: str, death: Death) -> None:
    """Wherever the guard was killed, the application runs on, and the next guard protects it."""
    images, before = WAYS[way]
    if images is Images.DIRTY and any(tree in command for tree in TREES):
        pytest.skip("trees are forked")
    runs = 0
    with (
        Victim(command, tmp_path) as victim,
        GuardProcess(config(images=images), [victim.pid]) as guard,
    ):
        guard.wait("attached")
        for nth in numbers(128 if command == CELLS else 8):
            for _ in range(MISSES):
                for _ in range(before):
                    protects(guard)
                kind = answer(guard, death, nth, "checkpoint")["kind"]
                victim.wait_beats(3)
                guard.start_another(victim.pid)
                if images is Images.DIRTY:
                    no_mark_is_left(victim)
                runs += 1
                if not before and runs % TIDY == 0:
                    tidy(guard, victim)
                if kind != "missed":
                    break
            else:
                raise AssertionError(f"all checkpoints are missed that have {nth} steps to go")
            if kind == "checkpoint":
                break
        else:
            raise AssertionError("it is not done after so many calls")
        protects(guard)
        # Which only the application could reap, and it does not know of it.
        assert [pid for pid in below(victim.app) if state_of(pid) == "Z"] == []
    print(f"{runs} runs, up to {nth}")


@pytest.mark.parametrize("command", REFUSED)
def test_refused(tmp_path: Path, command: str, death: Death) -> None:
    """What cannot be protected has been left as it was."""
    ended, calls = 0, numbers(8)
    while not refuse(tmp_path, command, death, calls):
        ended += 1
    assert ended <= (UNSEEN if death.of == "calls" and "--kill" in command else 0)


def refuse(tmp_path: Path, command: str, death: Death, calls: Iterator[int]) -> bool:
    """Until a guard refuses it; False: its own filter has ended it, because the guard died before it knew that."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.wait("attached")
        blocked = status_of(victim.app)["SigBlk"]
        for nth in calls:
            kind = answer(guard, death, nth, "checkpoint")["kind"]
            wait_goes_on_or_ends(victim)
            if victim.popen.poll() == 128 + signal.SIGSYS:
                assert victim.see().violations == 0, victim.said
                return False
            victim.check()
            guard.start_another(victim.pid)
            assert status_of(victim.app)["SigBlk"] == blocked
            if kind == "unprotected":
                return True
            assert kind in ("guard_lost", "missed")
    raise AssertionError("it is not done after so many calls")


def tidy(guard: GuardProcess, victim: Victim) -> None:
    """The next guard's second checkpoint removes what dead guards have mapped, once each process was looked at."""
    protects(guard)
    protects(guard)
    guard.start_another(victim.pid)


def no_mark_is_left(victim: Victim) -> None:
    """No memory is registered with userfaultfd or write-protected any more."""
    smaps = Path(f"/proc/{victim.app}/smaps")
    wait_until(lambda: not re.search(r"VmFlags:.* uw\b", smaps.read_text()), PATIENCE_S, "nothing is watched", 0.01)


def protects(guard: GuardProcess) -> None:
    """The next guard protects it: at once, or when a thread has returned from the dead guard's parasite."""
    answers: list[dict[str, object]] = []

    def taken() -> bool:
        answers.append(guard.command("checkpoint"))
        return answers[-1]["kind"] == "checkpoint"

    wait_until(taken, PATIENCE_S, "the next guard takes a checkpoint", 0.05)
    for missed in answers[:-1]:  # or it had no CPU
        assert missed["kind"] == "missed", missed


def wait_goes_on_or_ends(victim: Victim) -> None:
    """Either must happen soon."""
    beats = victim.see().beats
    wait_until(
        lambda: victim.popen.poll() is not None or victim.see().beats > beats + 3, PATIENCE_S, "it goes on, or ends"
    )


@pytest.mark.parametrize("way", ["next", "dirty"])
@pytest.mark.parametrize("command", RESTORED)
def test_restore(tmp_path: Path, command: str, way: str, death: Death) -> None:
    """Nobody can finish the restore: init ends at once, and nothing is left of the application."""
    images, before = WAYS[way]
    if images is Images.DIRTY and any(tree in command for tree in TREES):
        pytest.skip("trees are forked")
    with Victim(command, tmp_path) as first, GuardProcess(config(images=images), [first.pid]) as guard:
        for nth in numbers(256 if command == CELLS else 32):
            with Victim(command, tmp_path) as victim:
                guard.start_another(victim.pid)
                for _ in range(before):
                    protects(guard)
                kind = answer(guard, death, nth, "restore")["kind"]
                if kind != "guard_lost":
                    assert kind == "restored"
                    victim.wait_beats(3)
                    print(f"{nth} runs")
                    return
                # Its own application, or init's end: with what it died of, or restored just in time.
                wait_goes_on_or_ends(victim)
                if victim.popen.poll() is None:
                    victim.check()
                else:
                    assert victim.see().violations == 0, victim.said
    raise AssertionError("it is not done after so many calls")
