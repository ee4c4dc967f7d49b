# SPDX-License-Identifier: Apache-2.0
"""An application that leaks until the kernel kills it is restored; and none is killed because of our copies."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit.cgroups import MemoryGroup
from testkit.guarded import GuardProcess, Json, Victim, config
from testkit.harness import wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "the kernel's OOM killer takes whom it finds at that moment"
)

LIMIT_BYTES = 256 << 20
BASE_MB = 40
TRIALS = int(os.environ.get("AVCKPT_OOM_TRIALS", "1"))


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.fixture
def group() -> Iterator[MemoryGroup]:
    """A memory cgroup with a limit of 256 MB for what the test starts."""
    with MemoryGroup(LIMIT_BYTES) as made:
        yield made


@pytest.mark.parametrize("trial", range(TRIALS))
@pytest.mark.parametrize("rate", [10, 50, 200])
def test_a_leak_is_restored(rate: int, trial: int, group: MemoryGroup, tmp_path: Path) -> None:
    with (
        Victim(f"leak {rate} {BASE_MB}", tmp_path, preexec=group.enter) as victim,
        GuardProcess(config(0.5, memory_limit_bytes=LIMIT_BYTES), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        os.kill(victim.app, signal.SIGUSR1)
        died = guard.wait("died", timeout_s=60)
        assert died["wait_status"] == signal.SIGKILL
        assert guard.wait("restored", timeout_s=20)["reason"] == "signal"
        victim.wait_beats(5)


def test_a_leak_is_restored_where_no_limit_is_known(group: MemoryGroup, tmp_path: Path) -> None:
    """The limit is that of a parent cgroup, or the host's memory."""
    with (
        Victim(f"leak 100 {BASE_MB}", tmp_path, preexec=group.enter) as victim,
        GuardProcess(config(0.5), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint", count=2)
        os.kill(victim.app, signal.SIGUSR1)
        guard.wait("restored", timeout_s=60)
        victim.wait_beats(5)


def test_nobody_is_killed_for_what_a_template_holds(group: MemoryGroup, tmp_path: Path) -> None:
    """140 MB, all written again after a checkpoint: 280 of 256 MB; without the template it fits."""
    with (
        Victim("hoard 140", tmp_path, preexec=group.enter) as victim,
        GuardProcess(config(memory_limit_bytes=LIMIT_BYTES), [victim.pid]) as guard,
    ):
        app = victim.app
        for n in range(1, 4):
            assert guard.checkpoint()["kind"] == "checkpoint"
            os.kill(app, signal.SIGUSR1)
            assert guard.wait("dropped", count=n)["reason"] == "killed"
            wait_until(lambda n=n: victim.see().counter[0] == 140 * n, 10, "it has written all of it")  # type: ignore[misc]
            victim.wait_beats()
        assert victim.app == app


def spared_s(event: Json) -> int:
    """So long no other template is made, it says; 0: it is not about that."""
    words = event["error"]["message"] if event.get("kind") == "dropped" and event.get("error") else ""
    return int(words.split()[5]) if words.startswith("no other is made for") else 0


@pytest.mark.parametrize(("interval_min_s", "images"), [(0.0, Images.FORK), (0.02, Images.AUTO)])
def test_templates_that_are_killed_at_once_become_rare(
    interval_min_s: float, images: Images, group: MemoryGroup, tmp_path: Path
) -> None:
    """140 of 256 MB, all written all the time."""
    settings = config(0.5, memory_limit_bytes=LIMIT_BYTES, images=images, interval_min_s=interval_min_s)
    with (
        Victim("hoard 140 always", tmp_path, preexec=group.enter) as victim,
        GuardProcess(settings, [victim.pid]) as guard,
    ):
        app, since = victim.app, 0
        for expected_s in (1, 2, 4, 8, 16):
            killed = guard.wait_for(lambda event: spared_s(event) > 0, "a pause", since=since)
            assert spared_s(killed) == expected_s
            since = guard.events.index(killed) + 1
            if expected_s == 16:  # there is memory again
                group.limit(4 * LIMIT_BYTES)
                guard.say_memory(4 * LIMIT_BYTES)
            taken = guard.wait("checkpoint", since=since)
            assert (taken["at_ns"] - killed["at_ns"] >= expected_s * 1e9) == (expected_s < 16)
        guard.wait("checkpoint", since=since, count=3)
        assert not [event for event in guard.events[since:] if event.get("kind") == "dropped"]
        victim.wait_beats()
        assert victim.app == app


def test_older_generations_go_first(group: MemoryGroup, tmp_path: Path) -> None:
    """Three times 80 MB are 240; a leak from there kills the application, but the newest generation is restored."""
    with (
        Victim("hoard 80", tmp_path, preexec=group.enter) as victim,
        GuardProcess(config(memory_limit_bytes=LIMIT_BYTES, keep=3), [victim.pid]) as guard,
    ):
        app = victim.app
        for n in range(1, 4):
            assert guard.checkpoint()["kind"] == "checkpoint"
            os.kill(app, signal.SIGUSR1)
            wait_until(lambda n=n: victim.see().counter[0] == 80 * n, 10, "it has written all of it")  # type: ignore[misc]
        dropped = guard.wait("dropped")
        assert (dropped["generation"], dropped["reason"]) == (1, "killed")
        victim.wait_beats()
        assert victim.app == app


def test_what_fills_its_container_is_not_gone_back_to(group: MemoryGroup, tmp_path: Path) -> None:
    with (
        Victim("hoard 235", tmp_path, preexec=group.enter) as victim,
        GuardProcess(config(memory_limit_bytes=LIMIT_BYTES), [victim.pid]) as guard,
    ):
        missed = guard.command("checkpoint")
        assert missed["kind"] == "missed"
        assert "it fills the memory of its container" in missed["error"]["message"]
        victim.wait_beats()
