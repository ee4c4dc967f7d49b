# SPDX-License-Identifier: Apache-2.0
"""What the guard decides (native/engine/guard/policy.c, docs/policy.md): no process, no clock, no root."""

from __future__ import annotations

import random
import signal
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from testkit.policy_library import Library

SECOND = 1_000_000_000
MS = 1_000_000
NEVER = 2**64 - 1
WINDOW_S = 60
START_S = 1000
"""Of the clock.  A machine that has just been started has small numbers, but never 0."""

_library: list[Library] = []


@pytest.fixture(scope="module", autouse=True)
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    _library[:] = [Library(tmp_path_factory.mktemp("policy"))]
    return _library[0]


class Guarded:
    """A guard without a container: it asks policy.c, and does what it is told, to a list of numbers."""

    def __init__(self, keep: int = 3, restore_max: int = 4, interval_s: float = 1, window_s: float = WINDOW_S) -> None:
        ffi = _library[0].ffi
        self.c = _library[0].calls
        self.config: Any = cast(Any, ffi.new("struct avc_config *"))
        self.config.keep = keep
        self.config.restore_max = restore_max
        self.config.interval_ns = int(interval_s * SECOND)
        self.config.restore_window_ns = int(window_s * SECOND)
        self.policy: Any = cast(Any, ffi.new("struct policy *"))
        self.policy.room = keep
        self.now = START_S * SECOND
        self.number = 0
        self.restores: list[int] = []
        """When each crash was undone."""
        self.over = False

    def wait(self, seconds: float) -> None:
        self.now += int(seconds * SECOND)

    @property
    def held(self) -> list[int]:
        """The numbers of the generations, oldest first."""
        return [self.policy.held[i].number for i in range(self.policy.count)]

    def record(self, number: int) -> Any:
        return self.policy.held[self.held.index(number)]

    def take(self) -> int:
        """A checkpoint; what made way for it is in `self.gone`."""
        self.number += 1
        fresh = self.c.policy_new_generation(self.policy, self.config, self.number, self.now)
        self.gone = []
        while self.policy.count >= self.policy.room:
            i = self.c.policy_replaced(self.policy, self.config, self.now)
            self.gone.append(self.held[i])
            self.c.policy_drop(self.policy, i)
        self.c.policy_hold(self.policy, fresh)
        return self.number

    def crash(self, hung: bool = False, status: int = signal.SIGKILL) -> int:
        """The generation that is restored, 0: it is over.  What is given up is in `unhealthy` and `crashed`."""
        before = self.held
        left = self.c.policy_crashed(self.policy, self.config, status, hung, self.now)
        assert left.trusted <= left.healthy <= self.policy.count
        self.looping = bool(left.looping)
        self.unhealthy, self.crashed = before[left.healthy :], before[left.trusted : left.healthy]
        while self.policy.count > left.trusted:
            self.c.policy_drop(self.policy, self.policy.count - 1)
        if not left.trusted:
            self.over = True
            return 0
        self.c.policy_restored(self.policy, self.policy.count - 1, True, self.now)
        self.restores.append(self.now)
        return self.held[-1]

    def roll_back(self) -> int:
        """On command."""
        self.c.policy_restored(self.policy, self.policy.count - 1, False, self.now)
        return self.held[-1]

    def lose_one(self) -> int:
        i = self.c.policy_dispensable(self.policy)
        lost = self.held[int(i)]
        self.c.policy_drop(self.policy, i)
        return lost

    def lose(self, number: int) -> None:
        """Somebody has killed its template."""
        self.c.policy_drop(self.policy, self.held.index(number))

    def vouch(self, times: int = 1) -> None:
        for _ in range(times):
            self.c.policy_vouch(self.policy)


class Together:
    """Guards of a group: their checkpoints are lines, and all go back when one of them crashes."""

    def __init__(self, members: int, keep: int) -> None:
        self.members = [Guarded(keep=keep) for _ in range(members)]
        self.c = self.members[0].c
        self.line = 0

    def wait(self, seconds: float) -> None:
        for member in self.members:
            member.wait(seconds)

    def take(self) -> None:
        """A line; each replaces what all of them have said can go, as in guard_group.c."""
        self.line += 1
        said = [
            {member.held[i]: self.c.policy_line(member.policy, member.config, i, member.now) for i in range(n)}
            for member, n in ((member, member.policy.count) for member in self.members)
        ]
        for member in self.members:
            fresh = self.c.policy_new_generation(member.policy, member.config, self.line, member.now)
            fresh.line = self.line
            while member.policy.count >= member.policy.room:
                all_say: Any = cast(Any, _library[0].ffi.new("struct policy_line[]", member.policy.count))
                for i, line in enumerate(member.held):
                    all_say[i].held = all(line in each for each in said)
                    all_say[i].kept = any(each[line].kept for each in said if line in each)
                    all_say[i].suspect = any(each[line].suspect for each in said if line in each)
                self.c.policy_drop(member.policy, self.c.policy_line_replaced(member.policy, all_say))
            self.c.policy_hold(member.policy, fresh)

    def crash(self, which: int) -> int:
        """The line that all go back to."""
        line = self.members[which].crash()
        for member in self.members:
            while member.held and member.held[-1] > line:
                self.c.policy_drop(member.policy, member.policy.count - 1)
            if member is not self.members[which]:
                assert member.held[-1:] == [line]
                member.roll_back()
        return line

    @property
    def held(self) -> list[int]:
        """By all."""
        assert len({tuple(member.held) for member in self.members}) == 1
        return self.members[0].held


def test_it_has_no_side_effects(library: Library) -> None:
    """It calls nobody but what the compiler copies structs with, and has no variable of its own."""
    listing = subprocess.run(["nm", str(library.object)], capture_output=True, text=True, check=True).stdout
    kinds: dict[str, set[str]] = {}
    for line in listing.splitlines():
        *_, kind, name = line.split()
        kinds.setdefault(kind.upper(), set()).add(name)
    called = kinds.pop("U", set())
    assert called <= {"memcpy", "memmove", "memset", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}
    assert set(kinds) <= {"T", "R"}


# --- when the next checkpoint is due ------------------------------------------


@pytest.mark.parametrize(
    ("interval_s", "due_s", "again_s"),
    [
        (3, 13, 13),  # as far away as it was
        (1, 13, 11),  # sooner, by the new interval
        (60, 13, 13),  # no later than was promised
        (0, 13, None),  # on command only
        (3, None, 13),  # no longer on command only
        (0, None, None),
    ],
)
def test_when_it_is_due(interval_s: float, due_s: float | None, again_s: float | None) -> None:
    guard = Guarded(interval_s=interval_s)
    due, again = (NEVER if s is None else s * SECOND for s in (due_s, again_s))
    assert guard.c.policy_due(guard.config, 10 * SECOND) == (10 + interval_s) * SECOND if interval_s else NEVER
    assert guard.c.policy_due_again(guard.config, due, 10 * SECOND) == again


@pytest.mark.parametrize(("due_s", "pause_s", "then_s"), [(13, 1, 13), (11, 2, 12), (None, 2, None)])
def test_the_application_runs_before_the_next_one(due_s: float | None, pause_s: int, then_s: float | None) -> None:
    due, then = (NEVER if s is None else s * SECOND for s in (due_s, then_s))
    assert Guarded().c.policy_due_after(due, pause_s * SECOND, 10 * SECOND) == then


@pytest.mark.parametrize(
    ("run", "writes_ms"),
    [
        ({"passed_ns": 50 * MS, "cpu_ns": 45 * MS, "ran_ns": 45 * MS}, 20),
        # Four threads side by side.
        ({"passed_ns": 50 * MS, "cpu_ns": 190 * MS, "ran_ns": 45 * MS}, 5),
        # Whoever gets half of a CPU takes twice as long, but not longer than it has been.
        ({"passed_ns": 50 * MS, "cpu_ns": 25 * MS, "ran_ns": 25 * MS, "waited_ns": 25 * MS}, 40),
        ({"passed_ns": 50 * MS, "cpu_ns": 10 * MS, "ran_ns": 10 * MS, "waited_ns": 40 * MS}, 50),
        # The first checkpoint, and one of an application whose main thread sleeps.
        ({}, 0),
        ({"passed_ns": 50 * MS, "cpu_ns": 45 * MS}, 20),
    ],
)
def test_first_writes_after_a_clone_hold_the_application_up(run: dict[str, int], writes_ms: int) -> None:
    guard = Guarded()
    assert guard.c.policy_writes(20 * MS, _library[0].ffi.new("struct policy_run *", run)) == writes_ms * MS


@pytest.mark.parametrize(("held_ms", "writes_ms", "rest_ms"), [(10, 0, 10), (10, 100, 210), (10, 9000, 3010)])
def test_stops_and_first_writes_take_at_most_half_of_its_time(held_ms: int, writes_ms: int, rest_ms: int) -> None:
    assert Guarded().c.policy_rest(held_ms * MS, writes_ms * MS) == rest_ms * MS


def test_a_failed_checkpoint_leaves_what_is_held_unless_nothing_is_any_good() -> None:
    guard = Guarded()
    c, policy = guard.c, guard.policy
    hopeless = (c.AVC_UNSUPPORTED, c.AVC_DENIED, c.AVC_BUSY)

    def missed(code: int, of_main: bool, at_s: float) -> bool:
        return bool(c.policy_missed(policy, code, of_main, int(at_s * SECOND)))

    for code in range(c.AVC_RETRY + 1):
        assert missed(code, True, 1) == (code in hopeless)
        assert missed(code, False, 1) == (code in hopeless)  # nothing is held yet
    guard.take()
    # A child process may be gone at the next look: three times in a row, in more than a moment, and then it is not.
    assert [missed(c.AVC_UNSUPPORTED, False, at_s) for at_s in (10, 13, 16)] == [False, False, True]
    guard.take()
    assert [missed(c.AVC_UNSUPPORTED, False, 20 + at_s) for at_s in (0, 0.02, 0.04, 0.9, 1.0)] == [False] * 4 + [True]
    # A debugger leaves some day.
    assert not any(missed(c.AVC_BUSY, of_main, 30 + s) for of_main in (True, False) for s in range(5))
    guard.take()
    assert missed(c.AVC_DENIED, True, 40)
    assert [missed(c.AVC_DENIED, False, at_s) for at_s in (41, 42)] == [False, False]
    assert not missed(c.AVC_DEADLINE, False, 43)
    assert missed(c.AVC_UNSUPPORTED, False, 44)


def pauses(guard: Guarded, next_try: Callable[[Any, int, int], int], count: int) -> list[float]:
    """Before each of so many tries, none of which succeeds, or takes time."""
    found = []
    for _ in range(count):
        due = next_try(guard.policy, guard.c.policy_due(guard.config, guard.now), guard.now)
        found.append((due - guard.now) / SECOND)
        guard.now = due
    return found


def test_what_cannot_be_protected_is_tried_less_and_less_often() -> None:
    guard = Guarded(interval_s=1)
    c, policy = guard.c, guard.policy

    tries = partial(pauses, guard, c.policy_refused)

    assert tries(10) == [1, 1, 2, 4, 8, 16, 32, 60, 60, 60]
    c.policy_retry(policy)  # on command
    assert tries(4) == [1, 1, 2, 4]
    guard.take()  # the reason has gone
    assert tries(4) == [1, 1, 2, 4]
    guard.config.interval_ns = 0
    assert c.policy_refused(policy, c.policy_due(guard.config, guard.now), guard.now) == NEVER
    # However long the interval is.
    for interval_s in (3, 300, 3600):
        c.policy_retry(policy)
        guard.config.interval_ns = interval_s * SECOND
        assert tries(10) == [1, 1, 2, 4, 8, 16, 32, 60, 60, 60]
    c.policy_retry(policy)
    guard.config.interval_ns = SECOND // 20
    assert tries(6) == [0.05, 0.05, 0.1, 0.2, 0.4, 0.8]


def test_one_that_holds_nothing_is_tried_soon() -> None:
    """The machine stood still for a moment, and the next checkpoint is due in an hour."""
    guard = Guarded(interval_s=3600)
    c, policy = guard.c, guard.policy

    tries = partial(pauses, guard, c.policy_without)

    # Longer and longer: there may be a reason that stays.
    assert tries(13) == [0.1, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 60, 60]
    guard.config.interval_ns = SECOND
    assert tries(2) == [1, 1]  # and no later than it is due
    c.policy_retry(policy)  # on command, or another application
    assert tries(6) == [0.1, 0.1, 0.2, 0.4, 0.8, 1]
    guard.take()
    assert tries(3) == [1, 1, 1]  # there is something to go back to
    guard.lose_one()
    assert tries(2) == [0.1, 0.1]
    guard.wait(1.5)  # missing one may take a while
    guard.config.interval_ns = 3600 * SECOND
    assert tries(1) == [1.7]
    guard.config.interval_ns = 0
    assert c.policy_without(policy, c.policy_due(guard.config, guard.now), guard.now) == NEVER


def test_another_program_is_not_refused_yet() -> None:
    """It is tried as the first one was, and not when the one before it would have been."""
    guard = Guarded(interval_s=1)
    c, policy, config = guard.c, guard.policy, guard.config
    due = guard.now + 5 * SECOND
    assert c.policy_executed(policy, config, due, guard.now) == due  # it was not refused
    for _ in range(8):
        due = c.policy_refused(policy, c.policy_due(config, guard.now), guard.now)
        guard.now = due
    due = c.policy_refused(policy, c.policy_due(config, guard.now), guard.now)
    assert due - guard.now == 60 * SECOND
    guard.now += SECOND
    due = c.policy_executed(policy, config, due, guard.now)
    assert due == c.policy_first_due(config, guard.now) == guard.now + SECOND
    # One that executes itself again and again is tried no later for that.
    assert c.policy_executed(policy, config, due, guard.now + SECOND // 2) == due
    assert c.policy_refused(policy, c.policy_due(config, guard.now), guard.now) == guard.now + SECOND
    # Nor if the interval is an hour.
    config.interval_ns = 3600 * SECOND
    assert c.policy_executed(policy, config, c.policy_due(config, guard.now), guard.now) == guard.now + SECOND
    assert c.policy_executed(policy, config, guard.now + SECOND // 2, guard.now) == guard.now + SECOND // 2
    config.interval_ns = 0
    assert c.policy_executed(policy, config, NEVER, guard.now) == NEVER


# --- which deaths are undone ----------------------------------------------------


def test_how_long_a_restore_waits_for_room() -> None:
    """For what the guard itself lacks, descriptors or memory: init is not kept waiting for long."""
    guard = Guarded()
    died = guard.now
    assert guard.c.policy_awaits_room(died, died)
    assert guard.c.policy_awaits_room(died, died + SECOND - 1)
    assert not guard.c.policy_awaits_room(died, died + SECOND)


def judged(status: int, on: Sequence[int | str], stop_asked: bool = False, asked: str = "NONE") -> tuple[bool, str]:
    guard = Guarded()
    guard.config.restore_on_signal = "signal" in on
    guard.config.restore_on_exit = "exit" in on
    for number in on:
        if isinstance(number, int):
            guard.config.restore_on_status[number] = 1
    verdict = guard.c.policy_judge(guard.config, status, stop_asked, getattr(guard.c, f"AVC_REASON_{asked}"))
    name = _library[0].ffi.typeof("enum avc_reason").elements[verdict.reason]
    return verdict.restore, name.removeprefix("AVC_REASON_").lower()


SEGV, CORE = 11, 0x80


@pytest.mark.parametrize(
    ("status", "on", "verdict"),
    [
        (SEGV, ["signal"], (True, "signal")),
        (SEGV | CORE, ["signal"], (True, "signal")),
        (SEGV, ["exit", 11], (False, "policy")),
        (0, ["signal", "exit", 0], (False, "clean_exit")),
        (3 << 8, ["exit"], (True, "exit")),
        (3 << 8, [3], (True, "exit")),
        (255 << 8, [255], (True, "exit")),
        (4 << 8, ["signal", 3], (False, "policy")),
        (3 << 8, ["signal"], (False, "policy")),
    ],
)
def test_which_deaths_are_undone(status: int, on: list[int | str], verdict: tuple[bool, str]) -> None:
    assert judged(status, on) == verdict
    assert judged(status, on, stop_asked=True) == (False, "stopped")
    # Whom we have killed ourselves comes back however it died, unless it is to stop.
    assert judged(status, on, asked="COMMAND") == (True, "command")
    assert judged(status, on, asked="UNHEALTHY") == (True, "unhealthy")
    assert judged(status, on, stop_asked=True, asked="UNHEALTHY") == (False, "stopped")


# --- probation ------------------------------------------------------------------


def test_the_oldest_makes_way() -> None:
    guard = Guarded(keep=3)
    for _ in range(5):
        guard.take()
    assert guard.held == [3, 4, 5]


def test_on_probation_checkpoints_take_the_place_of_their_own_kind() -> None:
    guard = Guarded(keep=3)
    for _ in range(3):
        guard.take()
    assert guard.crash() == 3
    for number in (4, 5, 6):
        guard.wait(10)
        assert guard.take() == number
        assert guard.held == [1, 2, number]
        assert (guard.record(number).crashes, guard.record(number).lineage) == (0, 3)
    guard.wait(WINDOW_S)
    guard.take()
    assert guard.held == [2, 6, 7]
    assert guard.record(7).lineage == 4


def test_what_is_taken_on_probation_carries_the_crashes() -> None:
    guard = Guarded(keep=1)
    guard.take()
    guard.crash()
    guard.take()
    guard.crash()
    guard.take()
    assert (guard.gone, guard.record(3).crashes) == ([2], 1)
    guard.policy.room = guard.config.keep = 2
    guard.wait(WINDOW_S)
    guard.take()
    assert [guard.record(number).crashes for number in guard.held] == [1, 0]


@pytest.mark.parametrize(("after_s", "crashes"), [(WINDOW_S - 0.001, 2), (WINDOW_S, 0)])
def test_who_lives_for_the_time_has_proved_itself(after_s: float, crashes: int) -> None:
    guard = Guarded()
    guard.take()
    guard.crash()
    guard.wait(1)
    guard.crash()
    assert (guard.record(1).crashes, guard.record(1).lost) == (1, 1)
    guard.wait(after_s)
    guard.crash()
    assert (guard.record(1).crashes, guard.record(1).lost) == (crashes, crashes)


def test_a_new_configuration_judges_what_was() -> None:
    guard = Guarded(keep=2, restore_max=2)
    guard.take()
    guard.take()
    guard.crash()
    guard.wait(5)
    guard.config.restore_window_ns = 5 * SECOND
    guard.take()
    assert (guard.held, guard.record(3).lineage) == ([2, 3], 3)
    # What is over is over.
    guard.config.restore_window_ns = WINDOW_S * SECOND
    guard.take()
    assert guard.record(4).lineage == 4


def test_on_a_machine_that_was_just_started_nobody_is_on_probation() -> None:
    guard = Guarded()
    guard.now = SECOND
    guard.take()
    guard.take()
    guard.crash()
    assert [guard.record(number).lineage for number in (1, 2)] == [1, 2]
    assert guard.record(2).crashes == 0
    assert guard.c.policy_restores_within(guard.policy, guard.config, guard.now) == 1


# --- lines of a group ---------------------------------------------------------------


def test_on_probation_the_others_keep_what_it_keeps() -> None:
    group = Together(members=3, keep=3)
    for _ in range(4):
        group.take()
    assert group.held == [2, 3, 4]
    assert group.crash(1) == 4
    for line in (5, 6, 7):
        group.wait(1)
        group.take()
        assert group.held == [2, 3, line]
    assert group.crash(0) == 7
    group.wait(WINDOW_S)
    group.take()
    assert group.held == [3, 7, 8]


def test_who_keeps_crashing_finds_an_older_line_with_all() -> None:
    group = Together(members=2, keep=2)
    group.take()
    group.take()
    assert group.crash(0) == 2
    for _ in range(5):
        group.take()
    assert [group.crash(0) for _ in range(3)] == [7, 7, 1]


def test_what_a_health_check_of_one_needs_all_keep() -> None:
    group = Together(members=3, keep=3)
    group.take()
    group.members[2].vouch(2)
    for _ in range(5):
        group.take()
    assert group.held == [1, 5, 6]


def test_what_one_has_lost_goes_first() -> None:
    group = Together(members=3, keep=3)
    for _ in range(3):
        group.take()
    group.members[1].lose(2)
    group.take()
    assert [member.held for member in group.members] == [[1, 3, 4]] * 3


@pytest.mark.parametrize("seed", range(20))
def test_all_hold_the_same_lines_whoever_crashes(seed: int) -> None:
    dice = random.Random(seed)
    group = Together(members=4, keep=dice.randint(1, 4))
    group.take()
    for _ in range(100):
        what = dice.random()
        group.wait(dice.choice([0.5, 20, 70]))
        if what < 0.7:
            group.take()
        elif what < 0.8:
            dice.choice(group.members).vouch()
        elif not group.crash(dice.randrange(4)):
            return
        assert group.held


# --- when it keeps crashing -------------------------------------------------------


@pytest.mark.parametrize(("restore_max", "tries"), [(1, 1), (2, 1), (3, 2), (4, 2), (5, 3), (64, 32)])
def test_what_crashes_before_the_next_checkpoint_gets_half(restore_max: int, tries: int) -> None:
    guard = Guarded(keep=2, restore_max=restore_max)
    guard.take()
    guard.take()
    assert [guard.crash() for _ in range(tries + 1)] == [2] * tries + [1]
    assert (guard.crashed, guard.unhealthy, guard.held) == ([2], [], [1])


def test_a_checkpoint_in_between_is_somewhere_to_have_got() -> None:
    guard = Guarded(keep=2, restore_max=6)
    guard.take()
    guard.take()
    for number in range(2, 8):
        assert guard.crash() == number
        guard.take()
        assert guard.record(number + 1).lost == 0
        assert guard.record(number + 1).crashes == number - 2
    # The six are used up; the whole line is left, and the old one is tried once.
    assert guard.crash() == 1
    assert guard.crashed == [8]
    assert guard.crash() == 0


def test_who_got_as_far_as_a_checkpoint_has_not_lost_its_restore() -> None:
    guard = Guarded(keep=3)
    guard.take()
    guard.crash()
    guard.crash()
    assert guard.record(1).lost == 1
    guard.take()
    guard.crash()
    assert (guard.record(1).lost, guard.record(1).crashes) == (0, 2)


def test_the_only_generation_gets_all_restores() -> None:
    guard = Guarded(keep=2, restore_max=5)
    guard.take()
    assert [guard.crash() for _ in range(6)] == [1] * 5 + [0]
    assert guard.crashed == [1]


EXIT_3 = 3 << 8
CORE = 0x80


@pytest.mark.parametrize("status", [EXIT_3, signal.SIGSEGV, signal.SIGABRT | CORE, signal.SIGSYS])
def test_the_same_death_at_once_twice_is_the_images(status: int) -> None:
    """The first one led to the first restore, and says nothing of it."""
    guard = Guarded(keep=2, restore_max=64)
    guard.take()
    guard.take()
    chosen = []
    for _ in range(5):
        chosen.append(guard.crash(status=status))
        guard.wait(0.9)
    assert chosen == [2, 2, 1, 1, 0]
    assert guard.looping


@pytest.mark.parametrize(
    ("statuses", "pause_s"),
    [
        ((signal.SIGSEGV, signal.SIGABRT), 0.5),  # two kinds
        ((signal.SIGSEGV, signal.SIGKILL), 0.5),  # never twice in a row
        ((signal.SIGSEGV,), 1.0),  # not at once
        ((signal.SIGKILL,), 0.1),  # somebody else's
        ((signal.SIGTERM,), 0.1),
    ],
)
def test_other_deaths_in_quick_succession_are_not(statuses: tuple[int, ...], pause_s: float) -> None:
    guard = Guarded(keep=2, restore_max=64)
    guard.take()
    guard.take()
    for n in range(20):
        assert guard.crash(status=statuses[n % len(statuses)]) == 2
        guard.wait(pause_s)


def test_who_sends_a_signal_after_each_checkpoint_ends_nothing() -> None:
    guard = Guarded(keep=2, restore_max=64)
    guard.take()
    for number in range(1, 20):
        assert guard.crash(status=signal.SIGSEGV) == number
        guard.wait(0.1)
        guard.take()


def test_an_exit_at_once_is_its_own_whatever_was_taken_in_between() -> None:
    guard = Guarded(keep=3, restore_max=64)
    guard.take()
    guard.take()
    restored = []
    while not guard.over:
        restored.append(guard.crash(status=EXIT_3))
        guard.wait(0.1)
        guard.take()
    assert restored[-1] == 0
    assert len(restored) == 5


def test_when_they_are_used_up_each_older_one_is_tried_once() -> None:
    guard = Guarded(keep=4, restore_max=2)
    for _ in range(4):
        guard.take()
        guard.wait(1)
    assert [guard.crash() for _ in range(6)] == [4, 3, 2, 1, 0, 0]
    assert len(guard.restores) == 2 + 4 - 2


def test_checkpoints_on_probation_do_not_keep_a_crash_loop_alive() -> None:
    guard = Guarded(keep=2, restore_max=4)
    guard.take()
    guard.take()
    restored = []
    while not guard.over:
        restored.append(guard.crash())
        guard.wait(0.3)
        for _ in range(5):
            guard.take()
    assert len([number for number in restored if number]) == 5
    assert restored[-2:] == [1, 0]


@pytest.mark.parametrize(("lost", "crashes", "chosen"), [(0, 0, 2), (1, 0, 1), (0, 1, 1)])
def test_that_is_one_that_has_neither_crashed_nor_come_to_nothing(lost: int, crashes: int, chosen: int) -> None:
    guard = Guarded(keep=4, restore_max=3)
    for _ in range(3):
        guard.take()
    for newest in (3, 4, 5):
        assert guard.crash() == newest
        guard.take()
        guard.lose(newest)
    guard.record(2).lost, guard.record(2).crashes = lost, crashes
    assert guard.crash() == chosen


def test_crashes_that_are_far_apart_go_on_being_restored() -> None:
    guard = Guarded(keep=2, restore_max=2, window_s=1)
    guard.take()
    for _ in range(100):
        newest = guard.take()
        guard.wait(1)
        assert guard.crash() == newest
        assert not guard.crashed
        guard.wait(1)
        guard.take()
        assert guard.policy.count == 2


def test_only_a_death_soon_after_a_restore_repeats_one() -> None:
    guard = Guarded(window_s=60)

    def repeats() -> bool:
        return bool(guard.c.policy_on_probation(guard.policy, guard.config, guard.now))

    guard.take()
    guard.roll_back()
    assert not repeats()
    guard.crash()
    guard.wait(59)
    assert repeats()
    guard.wait(1)
    assert not repeats()


def test_restores_are_counted_within_the_time() -> None:
    guard = Guarded(restore_max=64)
    guard.take()
    count = guard.c.policy_restores_within
    for n in range(64):
        assert count(guard.policy, guard.config, guard.now) == n
        guard.crash()
        guard.take()
        guard.wait(0.5)
    guard.wait(28)  # the first was 60 s ago
    assert count(guard.policy, guard.config, guard.now) == 63
    # More of them than are remembered; the oldest do not matter any more.
    guard.crash()
    assert count(guard.policy, guard.config, guard.now) == 64
    guard.wait(WINDOW_S)
    assert count(guard.policy, guard.config, guard.now) == 0


def test_roll_backs_on_command_do_not_count() -> None:
    guard = Guarded(keep=2, restore_max=2)
    guard.take()
    guard.take()
    assert [guard.roll_back() for _ in range(10)] == [2] * 10
    assert guard.c.policy_restores_within(guard.policy, guard.config, guard.now) == 0
    assert guard.crash() == 2  # nor is it on probation
    assert (guard.record(2).crashes, guard.record(2).lost) == (0, 0)
    guard.roll_back()
    assert guard.crash() == 1  # of a crash it still is


# --- hangs ------------------------------------------------------------------------


def test_a_hung_process_goes_back_to_what_is_vouched_for() -> None:
    guard = Guarded(keep=4)
    guard.take()
    guard.vouch()
    guard.take()
    guard.vouch()  # for 1; 2 waits for the next
    guard.take()
    guard.take()
    assert [guard.record(n).vouched for n in guard.held] == [True, False, False, False]
    assert guard.crash(hung=True) == 1
    assert (guard.unhealthy, guard.crashed) == ([2, 3, 4], [])


def test_a_hung_process_goes_back_to_the_oldest_if_nobody_has_vouched() -> None:
    guard = Guarded(keep=3)
    for _ in range(3):
        guard.take()
    guard.vouch()
    assert guard.crash(hung=True) == 1
    assert guard.unhealthy == [2, 3]


def test_a_crash_goes_back_to_the_newest_whoever_has_vouched() -> None:
    guard = Guarded(keep=3)
    guard.take()
    guard.vouch(2)
    guard.take()
    assert guard.crash() == 2


def test_who_is_never_healthy_is_on_probation_for_ever() -> None:
    guard = Guarded(keep=2, restore_max=2, window_s=1)
    guard.take()
    guard.vouch(2)
    assert [guard.crash(hung=True)] == [1]
    for _ in range(2):
        guard.wait(100)
        guard.take()
        result = guard.crash(hung=True)
    assert (result, guard.unhealthy, guard.crashed) == (0, [3], [1])


def test_who_was_healthy_once_is_not() -> None:
    guard = Guarded(keep=2, restore_max=2, window_s=1)
    guard.take()
    guard.vouch(2)
    for _ in range(10):
        assert guard.crash(hung=True) == 1
        guard.wait(100)
        guard.vouch()
    assert (guard.record(1).lost, guard.record(1).crashes) == (0, 0)


def test_the_first_hang_is_nobodys_fault() -> None:
    guard = Guarded()
    guard.take()
    guard.vouch()
    guard.take()
    assert guard.crash(hung=True) == 1
    assert guard.record(1).crashes == 0


def test_without_health_checks_a_checkpoint_is_proof_again() -> None:
    guard = Guarded()
    guard.take()
    guard.vouch()
    guard.crash()
    guard.c.policy_unvouch(guard.policy)
    guard.take()
    guard.crash()
    assert (guard.record(1).lost, guard.record(1).crashes) == (0, 1)


def test_what_is_vouched_for_and_what_waits_for_it_are_kept() -> None:
    guard = Guarded(keep=3)
    guard.take()
    guard.vouch(2)
    guard.take()
    guard.vouch()  # 2 waits
    for number in range(3, 8):
        guard.take()
        assert guard.held == [1, 2, number] or number == 3
    guard.vouch()  # 2 is vouched for, 7 waits
    guard.take()
    assert guard.held == [2, 7, 8]
    guard.c.policy_unvouch(guard.policy)
    for _ in range(3):
        guard.take()
    assert guard.held == [9, 10, 11]


def test_on_probation_they_are_kept_as_well() -> None:
    guard = Guarded(keep=3)
    guard.take()
    guard.take()
    guard.vouch(2)
    guard.take()
    assert guard.crash() == 3
    guard.vouch()  # 3 waits
    guard.take()
    assert guard.held == [2, 3, 4]
    guard.take()  # none but the two is of its own kind, so the newest of these goes
    assert guard.held == [2, 3, 5]


@pytest.mark.parametrize(
    ("seen", "vouched", "first"),
    [
        ((), (), 1),
        ((1,), (1,), 2),  # vouched for: last
        ((1, 2, 3), (1, 2, 3), 1),  # but only the newest of them
        ((1, 2, 3), (1,), 2),
        ((3,), (), 1),
        ((1,), (), 2),
        ((1, 2), (1,), 3),
    ],
)
def test_the_oldest_is_given_up_first(seen: tuple[int, ...], vouched: tuple[int, ...], first: int) -> None:
    guard = Guarded(keep=3)
    for number in (1, 2, 3):
        guard.take()
        guard.record(number).seen, guard.record(number).vouched = number in seen, number in vouched
    assert guard.lose_one() == first


def test_of_two_the_one_that_is_vouched_for_goes_last() -> None:
    guard = Guarded(keep=2)
    guard.take()
    guard.vouch(2)
    guard.take()
    guard.vouch()
    assert [guard.lose_one(), guard.lose_one()] == [2, 1]
    guard.take()
    guard.vouch()
    guard.take()
    guard.record(4).seen = guard.record(4).vouched = True
    assert [guard.lose_one(), guard.lose_one()] == [3, 4]


# --- memory -------------------------------------------------------------------------


def test_when_memory_is_short_fewer_are_held() -> None:
    guard = Guarded(keep=3)
    for _ in range(3):
        guard.take()
    guard.c.policy_shrink(guard.policy)
    assert guard.lose_one() == 1
    guard.take()
    assert (guard.held, guard.policy.room) == ([3, 4], 2)
    assert not guard.c.policy_refill(guard.policy, guard.config)  # there is no hurry
    guard.take()
    assert guard.held == [3, 4, 5]


@pytest.mark.parametrize("interval_s", [0, 1])
def test_with_none_left_a_checkpoint_is_due_as_soon_as_there_is_memory(interval_s: float) -> None:
    guard = Guarded(keep=1, interval_s=interval_s)
    assert not guard.c.policy_refill(guard.policy, guard.config)  # memory was not short
    guard.take()
    guard.c.policy_shrink(guard.policy)
    guard.lose_one()
    guard.c.policy_shrink(guard.policy)
    assert guard.policy.room == 0
    assert guard.c.policy_refill(guard.policy, guard.config) == (interval_s > 0)
    assert guard.policy.room == 1


def test_a_spare_that_had_to_make_way_comes_back_later_and_later() -> None:
    guard = Guarded()
    c, policy = guard.c, guard.policy

    def pauses_s(count: int) -> list[float]:
        return [(c.policy_crowded(policy, guard.now) - guard.now) / SECOND for _ in range(count)]

    assert pauses_s(11) == [10, 20, 40, 80, 160, 320, 640, 1280, 2560, 3600, 3600]
    c.policy_roomier(policy)
    assert policy.spares_ns == 0
    assert pauses_s(2) == [10, 20]


def test_what_is_killed_at_once_is_made_less_and_less_often() -> None:
    guard = Guarded(keep=1)
    c, policy = guard.c, guard.policy

    def killed(lived_s: float, count: int = 1) -> list[float]:
        pauses_s = []
        for _ in range(count):
            guard.take()
            guard.wait(lived_s)
            guard.lose_one()
            pauses_s.append(c.policy_killed(policy, guard.now) / SECOND)
            assert policy.resumes_ns == guard.now + pauses_s[-1] * SECOND
            guard.now = policy.resumes_ns
        return pauses_s

    assert killed(0.2, 9) == [1, 2, 4, 8, 16, 32, 60, 60, 60]
    assert killed(9.9) == [60]
    assert killed(10) == [0]  # it was good for something
    assert killed(9, 3) == [1, 2, 4]
    c.policy_refill(policy, guard.config)  # there is memory
    assert killed(1, 2) == [1, 2]
    c.policy_roomier(policy)  # its limit was raised, or it is another program
    assert policy.resumes_ns == 0
    assert killed(1, 2) == [1, 2]
    # Replaced by others, so that one was held all the time.
    guard.take()
    for _ in range(9):
        guard.wait(1)
        guard.take()
    assert killed(1) == [0]


@pytest.mark.parametrize(
    ("room", "was", "keep", "result"),
    [(3, 3, 5, 5), (3, 3, 2, 2), (2, 3, 5, 2), (2, 3, 1, 1), (0, 3, 5, 0)],
)
def test_another_number_to_keep(room: int, was: int, keep: int, result: int) -> None:
    guard = Guarded(keep=room)
    guard.c.policy_resize(guard.policy, was, keep)
    assert guard.policy.room == result


# --- whatever happens -----------------------------------------------------------------


class AnyLife(RuleBasedStateMachine):
    """Checkpoints, crashes, hangs, health checks and short memory in any order."""

    @initialize(keep=st.integers(1, 5), restore_max=st.integers(1, 6))
    def begin(self, keep: int, restore_max: int) -> None:
        self.guard = Guarded(keep=keep, restore_max=restore_max)
        self.guard.take()

    @rule(seconds=st.sampled_from([0, 1, 20, WINDOW_S - 1, WINDOW_S, 3 * WINDOW_S]))
    def wait(self, seconds: int) -> None:
        self.guard.wait(seconds)

    @rule()
    @precondition(lambda self: not self.guard.over and self.guard.policy.room)
    def take(self) -> None:
        guard = self.guard
        before = {number: (guard.record(number).seen, guard.record(number).vouched) for number in guard.held}
        guard.take()
        assert len(guard.gone) <= 1
        for gone in guard.gone:
            seen = [n for n in before if before[n] == (True, False)]
            vouched = [n for n in before if before[n][1]]
            kept = {*seen[-1:], *vouched[-1:]}
            # What a roll back of a hung process needs goes only where there is nothing else.
            assert gone not in kept or kept == set(before)
            if gone in kept and len(before) > 1:
                assert gone not in vouched[-1:]

    @rule(hung=st.booleans())
    @precondition(lambda self: not self.guard.over and self.guard.policy.count)
    def crash(self, hung: bool) -> None:
        guard, most = self.guard, self.guard.config.restore_max
        before, vouched = guard.held, [n for n in guard.held if guard.record(n).vouched]
        used_up = sum(guard.now - at < WINDOW_S * SECOND for at in guard.restores) >= most
        chosen = guard.crash(hung)
        healthy = [n for n in before if not hung or n <= (vouched[-1] if vouched else before[0])]
        good = []
        for i, number in enumerate(healthy):
            record = guard.policy.held[i]
            has_crashed = record.crashes or record.lost
            if not (used_up and has_crashed) and record.lost < (most if i == 0 else (most + 1) // 2):
                good.append(number)
        # The newest that is any good, if there is one.
        assert chosen == (good[-1] if good else 0)
        assert guard.unhealthy == [n for n in before if n not in healthy]
        assert guard.crashed == [n for n in healthy if n > chosen]

    @rule()
    @precondition(lambda self: not self.guard.over and self.guard.policy.count)
    def roll_back(self) -> None:
        self.guard.roll_back()

    @rule(times=st.integers(1, 2))
    def vouch(self, times: int) -> None:
        self.guard.vouch(times)

    @rule()
    def unvouch(self) -> None:
        self.guard.c.policy_unvouch(self.guard.policy)

    @rule()
    @precondition(lambda self: self.guard.policy.count)
    def memory_is_short(self) -> None:
        guard = self.guard
        vouched = [n for n in guard.held if guard.record(n).vouched]
        guard.c.policy_shrink(guard.policy)
        lost = guard.lose_one()
        assert lost not in vouched[-1:] or not guard.held

    @rule()
    def memory_is_not_short(self) -> None:
        self.guard.c.policy_refill(self.guard.policy, self.guard.config)

    @invariant()
    def as_many_as_may_be(self) -> None:
        guard = self.guard
        assert guard.policy.count <= guard.policy.room <= guard.config.keep
        assert guard.held == sorted(set(guard.held))

    @invariant()
    def never_more_restores_than_allowed(self) -> None:
        guard = self.guard
        lately = [at for at in guard.restores if guard.now - at < WINDOW_S * SECOND]
        assert len(lately) <= guard.config.restore_max + guard.config.keep - 1


AnyLife.TestCase.settings = settings(
    max_examples=50,
    stateful_step_count=40,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)
test_whatever_happens = AnyLife.TestCase
