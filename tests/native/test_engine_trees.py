# SPDX-License-Identifier: Apache-2.0
"""Applications of several processes under a real guard: unnoticed by them, and restored completely.

`make test-trees` runs the long form: more kills, and as many processes as are supported.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import random
import signal
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from avckpt.guard import GuardConfig

from testkit.family import kill_main, look, main_process, members, ours, places, progress, wait_whole
from testkit.guarded import GuardProcess, Victim, config, forks_beside, meanwhile, since_linux, storm
from testkit.harness import wait_until
from testkit.procfs import children_of, figures, status_of
from testkit.scenario import checkpoint

SHARED = pytest.mark.shared_machine("others take the CPU here already, and what is left must suffice")

LONG = os.environ.get("AVCKPT_LONG") == "1"
KILLS = 100 if LONG else 5
CHECKPOINTS = 1000 if LONG else 20
STORM = 500 if LONG else 60

STATIC = [
    "tree 1",
    "tree 8",
    "tree 16 --threads 3",
    "tree 8 --reaper",
    "prefork 4 20",
    "prefork 2 1 --private 20",
    "prefork 2 100 --sparse",
    "terminal",
]
"""The processes stay the same."""
CHANGING = ["churn 1", "churn 8", "churn 6 --vfork", "churn 3 --threads 4", "commands"]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def steady(interval_s: float = 0.0, keep: int = 2) -> GuardConfig:
    """A freeze may take a second here: on a busy machine the default of 50 ms would miss most of them."""
    return config(interval_s, keep=keep, freeze_deadline_s=1.0)


def kill_again_and_again(guard: GuardProcess, victim: Victim, kills: int, pause_s: float, orphans: int = 0) -> None:
    """Kills the main process at random moments; each time the whole tree comes back and goes on."""
    rng = random.Random(victim.command)
    guard.wait("checkpoint")
    changes = bool({"churn", "commands"} & set(victim.command.split()))
    before = places(victim)
    for _ in range(kills):
        time.sleep(rng.uniform(0, pause_s))
        since = guard.mark()
        kill_main(victim)
        guard.wait("restored", since=since)
        progress(victim)
        wait_whole(victim, orphans)
        if not changes:
            # A template that is just being made has the application's name for a moment.
            wait_until(lambda: places(victim) == before, 5, "everybody is in his place")
    victim.wait_beats(50)


def wait_counter(victim: Victim, which: int, value: int) -> None:
    """Waits until a counter on the board has reached a value."""
    wait_until(
        lambda: victim.see().counter[which] >= value or victim.see().violations,
        10,
        f"counter {which} of {victim.command} comes to {value}",
    )
    victim.check()


@pytest.mark.parametrize("command", [*STATIC, *CHANGING, "terminal --stopped", "terminal --heard", "tree 9 --orphan"])
def test_nobody_sees_checkpoints(command: str, tmp_path: Path) -> None:
    """Every few milliseconds, also in the middle of fork, exec, vfork and exit."""
    with Victim(command, tmp_path) as victim, GuardProcess(steady(0.005), [victim.pid]) as guard:
        guard.wait("checkpoint", count=CHECKPOINTS, timeout_s=100)
        progress(victim)
        assert not [event for event in guard.events if event.get("kind") in ("unprotected", "died")]
        since = guard.mark()
        guard.stop()
        assert not [event for event in guard.events[since:] if event.get("kind") == "gave_up"]
        # Without it everything goes on, and nothing of it is left.
        progress(victim)
        wait_until(lambda: not ours(victim), 10, "no template is left")
        wait_whole(victim, allowed=command.count("--orphan"))


@pytest.mark.parametrize("command", ["tree 8", "tree 5 --threads 3", "prefork 4 20", "churn 3 --threads 4"])
def test_under_a_seccomp_filter_that_all_have_inherited(command: str, tmp_path: Path) -> None:
    """As every process of a server has that starts under one."""
    with Victim(f"under harmless {command}", tmp_path) as victim, GuardProcess(steady(0.05), [victim.pid]) as guard:
        kill_again_and_again(guard, victim, KILLS, 0.15)
        if not command.startswith("churn"):  # whose children end at any moment, and have none then
            main = main_process(victim)
            assert {status_of(pid)["Seccomp_filters"] for pid in (main, *children_of(main))} == {"1"}


@pytest.mark.parametrize("command", [*STATIC, *CHANGING])
def test_killed_at_random_moments(command: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(steady(0.05), [victim.pid]) as guard:
        kill_again_and_again(guard, victim, KILLS, 0.15)


HEARD = pytest.param("heard", marks=since_linux(5, 17, "whether a stop has been waited for"))


@pytest.mark.parametrize("which", ["stopped", HEARD])
def test_a_stopped_job_is_stopped_again(which: str, tmp_path: Path) -> None:
    """Its parent waits for it, or has done so and cannot do it again."""
    with Victim(f"terminal --{which}", tmp_path) as victim, GuardProcess(steady(0.05), [victim.pid]) as guard:
        kill_again_and_again(guard, victim, KILLS, 0.15)


def busy_cpus() -> contextlib.AbstractContextManager[None]:
    """Runs more busy loops than there are CPUs."""
    return meanwhile([sys.executable, "-c", "while True: pass"], len(os.sched_getaffinity(0)) + 1)


@SHARED
@pytest.mark.parametrize("command", ["prefork 6 100", "tree 9 --orphan"])
def test_numbers_are_taken_by_others(command: str, tmp_path: Path) -> None:
    """By `podman exec`, for example; also PIDs of children that take long to fork, or are init's."""
    with (
        Victim(command, tmp_path) as victim,
        forks_beside(victim),
        GuardProcess(steady(0.05), [victim.pid]) as guard,
    ):
        kill_again_and_again(guard, victim, 2 * KILLS, 0.15, orphans=command.count("--orphan"))


def kill_others(victim: Victim, family: set[int], over: threading.Event) -> None:
    """Kills children of the main process whose PIDs are not those of the family."""
    while not over.is_set():
        for main in children_of(victim.pid):
            for child in children_of(main):
                member = look(child)
                if member and not member.is_zombie and member.inside not in family:
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(child, signal.SIGKILL)


@SHARED
def test_copies_are_killed(tmp_path: Path) -> None:
    """Those whose PID another process has taken; by the OOM killer, for example."""
    over = threading.Event()
    with (
        Victim("prefork 6 100", tmp_path) as victim,
        forks_beside(victim),
        GuardProcess(steady(), [victim.pid]) as guard,
    ):
        main = victim.app
        family = {member.inside for member in map(look, [main, *children_of(main)]) if member}
        killer = threading.Thread(target=kill_others, args=(victim, family, over))
        killer.start()
        try:
            for _ in range(4 * KILLS):
                checkpoint(guard)
                since = guard.mark()
                kill_main(victim)
                guard.wait("restored", since=since)
                progress(victim)
        finally:
            over.set()
            killer.join()
        assert not [event for event in guard.events if event["kind"] == "dropped"]


@SHARED
def test_killed_before_a_checkpoint_is_complete(tmp_path: Path) -> None:
    """A group's leader may have ended when the freeze is over, and is in the checkpoint nevertheless."""
    with (
        busy_cpus(),
        Victim("terminal --stopped", tmp_path) as victim,
        GuardProcess(steady(0.05), [victim.pid]) as guard,
    ):
        kill_again_and_again(guard, victim, 6 * KILLS, 0.15)


def test_a_daemon_of_the_application_goes_back_with_it(tmp_path: Path) -> None:
    """It is init's child, since its parent has ended, and shares memory with the others."""
    with Victim("tree 9 --orphan", tmp_path) as victim, GuardProcess(steady(0.05), [victim.pid]) as guard:
        kill_again_and_again(guard, victim, KILLS, 0.15, orphans=1)


@pytest.mark.parametrize("command", ["tree 8", "tree 9 --orphan"])
def test_dies_again_at_once(command: str, tmp_path: Path) -> None:
    """Some processes have holders again and some have not yet, so that only one end of a pair may be held."""
    rng = random.Random(command)
    with Victim(command, tmp_path) as victim, GuardProcess(steady(), [victim.pid]) as guard:
        before = places(victim)
        for _ in range(KILLS):
            checkpoint(guard)
            for _ in range(3):
                since = guard.mark()
                kill_main(victim)
                guard.wait("restored", since=since)
                time.sleep(rng.uniform(0, 0.02))
            progress(victim)
            assert places(victim) == before


@SHARED
@pytest.mark.parametrize("command", ["tree 8 --threads 2", "churn 6"])
def test_killed_while_it_can_not_be_stopped_in_time(command: str, tmp_path: Path) -> None:
    """Freezes and holders keep failing, in every state: no death is final, and checkpoints are taken again."""
    rng = random.Random(command)
    hurried = dataclasses.replace(steady(0.01), freeze_deadline_s=0.0003)
    with Victim(command, tmp_path) as victim, GuardProcess(hurried, [victim.pid]) as guard:
        guard.wait("checkpoint")
        for _ in range(30):
            time.sleep(rng.uniform(0.02, 0.12))
            since = guard.mark()
            kill_main(victim)
            guard.wait("restored", since=since)
        progress(victim)
        guard.wait("checkpoint", since=guard.mark())
        assert not [event for event in guard.events if event["kind"] == "unprotected"]


@pytest.mark.parametrize("signum", [signal.SIGSEGV, signal.SIGABRT, signal.SIGTERM])
def test_killed_in_other_ways(signum: int, tmp_path: Path) -> None:
    with Victim("tree 8", tmp_path) as victim, GuardProcess(steady(), [victim.pid]) as guard:
        before = places(victim)
        for n in range(1, 4):
            checkpoint(guard)  # or it would look like a death that comes of the image
            kill_main(victim, signum)
            assert guard.wait("restored", count=n)["wait_status"] & 0x7F == signum
            progress(victim)
        assert places(victim) == before


def test_none_of_ours_keeps_a_cpu_from_its_equals(tmp_path: Path) -> None:
    """The kernel spins in /proc until another task of ours has run, which with SCHED_FIFO it never would."""
    seen = set()
    with Victim("tree 8", tmp_path) as victim, GuardProcess(steady(0.01), [victim.pid]) as guard:
        for _ in range(5):
            checkpoint(guard)
            since = guard.mark()
            kill_main(victim)
            while not [event for event in guard.events[since:] if event["kind"] == "restored"]:
                for pid in [*guard.guards, victim.pid, *ours(victim, "avckpt-hold")]:
                    with contextlib.suppress(ProcessLookupError):
                        seen.add(os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK)
    assert seen == {os.SCHED_OTHER, os.SCHED_RR}


def test_rolled_back_on_command(tmp_path: Path) -> None:
    with Victim("tree 8", tmp_path) as victim, GuardProcess(steady(), [victim.pid]) as guard:
        before = places(victim)
        for _ in range(3):
            checkpoint(guard)
            assert guard.command("restore")["kind"] == "restored"
            progress(victim)
        assert places(victim) == before


def test_started_since_is_gone_and_ended_since_is_back(tmp_path: Path) -> None:
    """Command 1 runs at the checkpoint; at the kill it has long ended, and command 2 runs."""
    with Victim("commands --gate", tmp_path) as victim, GuardProcess(steady(), [victim.pid]) as guard:
        wait_until(lambda: len(members(victim)) == 2 and victim.see().counter[3] == 1, 10, "command 1")
        time.sleep(0.1)  # for it to have executed its program
        before = places(victim)
        checkpoint(guard)
        victim.board.set_counter(8, 1)
        wait_until(lambda: victim.see().counter[3] == 2 and len(members(victim)) == 2, 10, "command 2")
        assert places(victim) != before
        victim.board.set_counter(8, 0)
        for n in range(1, 4):
            kill_main(victim)
            guard.wait("restored", count=n)
            wait_until(lambda: len(members(victim)) == 2, 10, "the two are there")
            wait_whole(victim)
            assert places(victim) == before
        # It ends once more, is reaped, and everything takes its course.
        victim.board.set_counter(8, 10)
        wait_counter(victim, 3, 11)
        assert victim.see().counter[0] == 1 + 10


def test_a_dead_child_holds_no_pipe_open(tmp_path: Path) -> None:
    """$(cmd) sees end of file when cmd ends, not when its template does."""
    with Victim("commands --gate", tmp_path) as victim, GuardProcess(steady(), [victim.pid]) as guard:
        for n in range(1, 6):
            wait_counter(victim, 3, n)
            time.sleep(0.05)
            checkpoint(guard)
            assert victim.see().counter[0] == n - 1
            victim.board.set_counter(8, n)
            # No other checkpoint comes.
            wait_counter(victim, 0, n)


@pytest.mark.parametrize("command", ["churn 6 --life-ms 300", "churn 6 --vfork --life-ms 300"])
def test_a_child_that_is_killed_is_the_applications_business(command: str, tmp_path: Path) -> None:
    rng = random.Random(command)
    with Victim(command, tmp_path) as victim, GuardProcess(steady(0.02), [victim.pid]) as guard:
        guard.wait("checkpoint", count=3)
        for _ in range(20):
            main = main_process(victim)
            children = [m.pid for m in members(victim) if m.name in ("child", "exe") and m.pid != main]
            if children:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(rng.choice(children), signal.SIGKILL)
            victim.wait_beats(5)
        wait_until(lambda: victim.see().counter[3] > 0 or victim.see().violations, 10, "it has noticed")
        guard.wait("checkpoint", since=guard.mark(), count=3)
        progress(victim)
        assert not [event for event in guard.events if event.get("kind") in ("died", "restored", "unprotected")]


@pytest.mark.parametrize("thp", [False, True], ids=["small pages", "huge pages"])
def test_pages_stay_shared(thp: bool, tmp_path: Path) -> None:
    """Prefork workers share pages after a restore as before it, measured by proportional set sizes.

    Workers keep the transparent huge pages to which they have not written.
    """
    megabytes, workers = 60, 6

    def held_kb() -> int:
        # A holder has the application's memory itself, and would count it twice.
        held = sum(figures(m.pid)["Pss"] for m in members(victim))
        for template in ours(victim, "avckpt-tmpl"):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # an old one, just ending
                held += figures(template)["Pss"]
        return held

    with (
        Victim(f"prefork {workers} {megabytes} --touch 256{' --thp' * thp}", tmp_path) as victim,
        GuardProcess(steady(keep=1), [victim.pid]) as guard,
    ):
        alone = held_kb()
        assert alone < (megabytes + 20) * 1024
        huge = (megabytes - 6) * 1024 if thp else 0
        for n in range(1, 4):
            checkpoint(guard)
            with_templates = held_kb()
            kill_main(victim)
            guard.wait("restored", count=n)
            progress(victim)
            wait_whole(victim)
            victim.wait_beats(300)  # its workers read all of it, which must not unshare it
            assert len(members(victim)) == workers + 1
            assert held_kb() < with_templates + workers * 2048, (alone, with_templates)
            assert all(figures(m.pid)["AnonHugePages"] >= huge for m in members(victim))


def test_a_template_killed_from_inside_costs_a_generation(tmp_path: Path) -> None:
    with Victim("tree 8", tmp_path) as victim, GuardProcess(steady(), [victim.pid]) as guard:
        checkpoint(guard)
        templates = ours(victim, "avckpt-tmpl")
        assert len(templates) > 8
        os.kill(templates[-1], signal.SIGKILL)
        guard.wait("dropped")
        progress(victim)
        checkpoint(guard)
        kill_main(victim)
        guard.wait("restored")
        progress(victim)


def test_it_ends_as_its_main_process_does(tmp_path: Path) -> None:
    """A clean exit of the main process ends the container with all its processes."""
    with Victim("tree 8 --seconds 3", tmp_path) as victim, GuardProcess(steady(0.05), [victim.pid]) as guard:
        guard.wait("checkpoint")
        assert guard.wait("gave_up")["reason"] == "clean_exit"
        assert victim.end(10) == 0
        guard.wait("ended")
        assert victim.see().violations == 0


@SHARED
@pytest.mark.timeout(700)  # storm() has its own
def test_no_process_notices_that_its_tracer_was_killed(tmp_path: Path) -> None:
    """The guard dies before, during and after checkpoints; no process is left stopped, no template ever runs."""
    with contextlib.ExitStack() as stack:
        # --usual-waits: limits.md, "A thread that waits for children of every kind"
        commands = ("tree 8 --threads 2 --usual-waits", "churn 4", "churn 3 --vfork", "terminal")
        victims = [stack.enter_context(Victim(command, tmp_path)) for command in commands]
        before = [places(victim) for victim in victims]
        said = storm(config(0.002), STORM, 2, 1, *victims)
        assert said["left"] == []
        assert said["unprotected"] == 0
        for victim in victims:
            progress(victim)
            wait_whole(victim)
        for n in (0, 3):
            assert places(victims[n]) == before[n]
        # And the next guard protects as if nothing had been.
        with GuardProcess(steady(0.05), [victim.pid for victim in victims]) as guard:
            for cookie, victim in enumerate(victims, 1):
                guard.wait("checkpoint", cookie=cookie, count=3)
                since = guard.mark()
                kill_main(victim)
                guard.wait("restored", since=since, cookie=cookie)
                progress(victim)


def test_the_tracer_is_killed_after_restores(tmp_path: Path) -> None:
    """What was restored is the application itself, and does not need the guard that restored it."""
    with Victim("tree 8", tmp_path) as victim:
        before = places(victim)
        for _ in range(KILLS):
            with GuardProcess(steady(0.02), [victim.pid]) as guard:
                guard.wait("checkpoint")
                kill_main(victim)
                guard.wait("restored")
                guard.kill()
            progress(victim)
            wait_whole(victim)
            assert places(victim) == before


@SHARED
@pytest.mark.skipif(psutil.virtual_memory().available < 12e9, reason="it takes 6 GB, and twice that to be at ease")
def test_children_wait_as_long_as_a_big_process_takes(tmp_path: Path) -> None:
    """They were stopped first, and must not run before the last one was cloned."""
    with Victim("prefork 2 6000", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(4):
            assert guard.checkpoint()["kind"] == "checkpoint"
            victim.wait_beats(20)
        since = guard.mark()
        kill_main(victim)
        guard.wait("restored", since=since)
        victim.wait_beats(20)


@pytest.mark.skipif(not LONG, reason="long: `make test-trees`")
@pytest.mark.timeout(600)
@pytest.mark.parametrize("command", ["tree 125 --threads 7 --lap-us 200000", "tree 120 --lap-us 100000"])
def test_many(command: str, tmp_path: Path) -> None:
    """Two hundred processes, a thousand threads."""
    again = steady(2.0)
    with Victim(command, tmp_path) as victim, GuardProcess(again, [victim.pid]) as guard:
        kill_again_and_again(guard, victim, 10, 3.0)
