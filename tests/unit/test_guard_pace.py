# SPDX-License-Identifier: Apache-2.0
"""avckpt.interval=auto (native/engine/guard/policy.c, docs/policy.md): how often, and which ones stay."""

from __future__ import annotations

from typing import Any, cast

import pytest

from testkit.policy_library import Library

MS = 1_000_000
SECOND = 1000 * MS
START = 1000 * SECOND


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Library:
    return Library(tmp_path_factory.mktemp("policy"))


class Pace:
    """A clock, and checkpoints that cost what a test says."""

    def __init__(self, library: Library, freeze: float = 0.03, cpu: float = 0.05, keep: int = 3) -> None:
        self.ffi, self.c = library.ffi, library.calls
        self.config: Any = cast(Any, self.ffi.new("struct avc_config *"))
        self.config.interval_ns = 3 * SECOND
        self.config.interval_min_ns = 20 * MS
        self.config.budget_freeze_ppm = round(freeze * 1e6)
        self.config.budget_cpu_ppm = round(cpu * 1e6)
        self.config.keep = keep
        self.config.restore_window_ns = 60 * SECOND
        self.config.restore_max = 5
        self.pace: Any = cast(Any, self.ffi.new("struct policy_pace *"))
        self.policy: Any = cast(Any, self.ffi.new("struct policy *"))
        self.policy.room = keep
        self.now = START

    def take(self, held_ms: float = 0.3, cpu_ms: float = 1.0, method: str = "FORKS") -> None:
        cost = self.ffi.new("struct policy_cost *", {"held_ns": int(held_ms * MS), "cpu_ns": int(cpu_ms * MS)})
        self.c.policy_pay(self.pace, self.config, getattr(self.c, f"POLICY_{method}"), cost[0], self.now)

    def wants(self, *, used_ms: float = 0, sent: bool = False, sends: bool = False) -> bool:
        activity = self.ffi.new("struct policy_activity *", {"cpu_ns": int(used_ms * MS), "sent": sent, "sends": sends})
        return bool(self.c.policy_wants(self.pace, self.config, activity[0], self.now))

    @property
    def interval_ms(self) -> float:
        return float(self.c.policy_interval(self.pace, self.config)) / MS

    def hold(self) -> None:
        """What is held after one more, by policy_replaced()."""
        fresh = self.c.policy_new_generation(self.policy, self.config, self.policy.count + 1, self.now)
        while self.policy.count >= self.policy.room:
            self.c.policy_drop(self.policy, self.c.policy_replaced(self.policy, self.config, self.now))
        self.c.policy_hold(self.policy, fresh)

    @property
    def ages_s(self) -> list[float]:
        return [(self.now - self.policy.held[i].taken_ns) / SECOND for i in range(self.policy.count)]


@pytest.mark.parametrize(
    ("held_ms", "cpu_ms", "interval_ms"),
    [
        (0.1, 0.1, 20),  # never more often than that
        (0.3, 5, 100),  # 5 % of a core
        (3, 1, 100),  # 3 % of the application's time
        (300, 1, 3000),  # never less often than without a look at what it costs
    ],
)
def test_the_interval_is_what_the_budgets_allow(
    library: Library, held_ms: float, cpu_ms: float, interval_ms: float
) -> None:
    pace = Pace(library)
    assert pace.interval_ms == 3000  # nothing is known yet
    for _ in range(3):
        pace.take(held_ms, cpu_ms)
    assert pace.interval_ms == pytest.approx(interval_ms)


def test_the_first_one_says_little_and_a_single_slow_one_not_much(library: Library) -> None:
    pace = Pace(library)
    pace.take(cpu_ms=40)
    assert pace.interval_ms == 800
    pace.take(cpu_ms=5)
    assert pace.interval_ms == 100
    pace.take(cpu_ms=13)
    assert pace.interval_ms == 100
    pace.take(cpu_ms=13)
    assert pace.interval_ms == pytest.approx(120, abs=1)


def methods(pace: Pace, forks_ms: float, copies_ms: float, count: int) -> str:
    """The methods of so many, in the order in which they are taken, at this cost."""
    chosen = ""
    for _ in range(count):
        forks = bool(pace.c.policy_prefers_forks(pace.pace, pace.config))
        chosen += "f" if forks else "c"
        pace.take(cpu_ms=forks_ms if forks else copies_ms, method="FORKS" if forks else "COPIES")
    return chosen


@pytest.mark.parametrize("copies_ms", [0.1, 5, 6])
def test_copies_are_made_where_as_many_are_affordable(library: Library, copies_ms: float) -> None:
    pace = Pace(library)
    # The first fork says little, and the second may have met a slow moment.
    assert methods(pace, 5, copies_ms, 50) == "fff" + 47 * "c"


def test_forks_are_where_they_may_be_more_frequent(library: Library) -> None:
    pace = Pace(library)
    assert methods(pace, 5, 7, 140) == "fffccc" + 64 * "f" + "ccc" + 64 * "f" + "ccc"
    # Unless both may be as frequent as anything may.
    pace = Pace(library)
    assert methods(pace, 0.1, 0.9, 50) == "fff" + 47 * "c"


def test_the_method_changes_with_what_both_cost(library: Library) -> None:
    pace = Pace(library)
    assert methods(pace, 5, 7, 10) == "fffcccffff"
    # It has grown: a fork takes longer than what copies took.
    assert methods(pace, 50, 7, 20) == "f" + 19 * "c"
    assert pace.interval_ms == pytest.approx(140)
    # It writes more.
    assert "cf" in methods(pace, 50, 80, 30)


def test_over_time_they_cost_what_the_budget_says(library: Library) -> None:
    """An application that always has something to save, and sends every 7 ms."""
    pace = Pace(library)
    taken, since_ms = 0, 0.0
    for ms in range(20_000):
        pace.now += MS
        since_ms += 1
        if pace.wants(used_ms=since_ms, sent=ms % 7 == 0, sends=True):
            pace.take(held_ms=0.1, cpu_ms=2.5)
            taken, since_ms = taken + 1, 0
    assert 380 < taken < 410  # 50 ms apart: 5 % of a core


def test_one_right_after_output_does_not_wait_for_its_turn(library: Library) -> None:
    pace = Pace(library)
    for _ in range(3):
        pace.now += 10 * SECOND
        pace.take(cpu_ms=10)  # 200 ms
    pace.now += 19 * MS
    assert not pace.wants(used_ms=5, sent=True)
    pace.now += 2 * MS
    assert pace.wants(used_ms=5, sent=True)
    assert not pace.wants(used_ms=5, sends=True)
    pace.take(cpu_ms=10)
    pace.now += 170 * MS
    assert not pace.wants(used_ms=5, sent=True)  # one more is all it may be ahead
    pace.now += 30 * MS
    assert pace.wants(used_ms=5, sent=True)


def test_what_does_nothing_needs_no_new_one(library: Library) -> None:
    pace = Pace(library)
    for _ in range(3):
        pace.take()  # 20 ms, 1 ms of CPU time
    pace.now += 100 * MS
    assert not pace.wants(used_ms=0.1, sends=True)
    assert not pace.wants(used_ms=0.5)  # less than it would cost
    assert pace.wants(used_ms=0.5, sends=True)
    assert pace.wants(used_ms=1.5)
    pace.now += 3 * SECOND
    assert pace.wants(used_ms=0.5)  # the longest that anything waits
    assert not pace.wants(used_ms=0.1)
    pace.now += 3600 * SECOND
    assert not pace.wants(used_ms=0.1)


def test_looks_at_what_does_nothing_become_rare(library: Library) -> None:
    pace = Pace(library)
    pace.take()
    looks = []
    for _ in range(100):
        pace.now = pace.c.policy_look_again(pace.pace, pace.config, pace.now)
        looks.append((pace.now - START) / SECOND)
    assert looks[2] < 0.1
    assert looks[-1] - looks[-2] == pytest.approx(0.75)


def test_what_fails_is_tried_again_less_and_less_often(library: Library) -> None:
    pace = Pace(library)
    pauses = [pace.c.policy_try_again(pace.pace, pace.config, 0) / SECOND for _ in range(8)]
    assert pauses[:3] == [0.05, 0.1, 0.2]
    assert pauses[-1] == 3


def test_older_ones_are_older_by_seconds(library: Library) -> None:
    """With fifty a second three would all be 60 ms old, and a state that is noticed late to be corrupt in each."""
    pace = Pace(library)
    for n in range(1000):
        pace.now += 20 * MS
        pace.hold()
        if n > 400:
            oldest, middle, newest = pace.ages_s
            assert newest == 0
            assert 0 < middle <= 3.1
            assert 3 <= oldest <= 6.1


def test_a_checkpoint_at_once_is_no_proof_that_it_got_somewhere(library: Library) -> None:
    pace = Pace(library)
    pace.hold()
    pace.c.policy_restored(pace.policy, 0, True, pace.now)
    pace.now += 60 * MS
    pace.hold()
    assert not pace.policy.proved
    pace.now += SECOND
    pace.hold()
    assert pace.policy.proved


@pytest.mark.parametrize(("automatic", "apart_s", "oldest_s"), [(False, 0, 0.4), (False, 10, 10), (True, 10, 10)])
def test_those_of_any_interval_can_be_apart(library: Library, automatic: bool, apart_s: float, oldest_s: float) -> None:
    pace = Pace(library, keep=3)
    pace.config.apart_ns = int(apart_s * SECOND)
    if not automatic:
        pace.config.interval_min_ns = 0
    for _ in range(1000):
        pace.now += 200 * MS
        pace.hold()
    oldest, middle, newest = pace.ages_s
    assert newest == 0
    assert oldest - middle >= apart_s
    assert oldest_s <= oldest <= 2 * oldest_s + 0.2
