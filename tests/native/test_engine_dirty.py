# SPDX-License-Identifier: Apache-2.0
"""Checkpoints by copies of written pages: the restored application is equal to the byte."""

from __future__ import annotations

import contextlib
import os
import platform
import random
import re
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit.family import ours
from testkit.guarded import (
    PATIENCE_S,
    WHERE,
    GuardProcess,
    Json,
    Victim,
    config,
    injected,
    kill_at_random,
    since_linux,
    sleep_exactly,
)
from testkit.harness import wait_until
from testkit.procfs import children_of, figures

PAGE = 4096
DIRTY = config(images=Images.DIRTY)
BY_ITSELF = config(0.03, images=Images.DIRTY)
ALL_AUTO = config(3.0, interval_min_s=0.02, keep=3, images=Images.AUTO)
pytestmark = [
    since_linux(6, 7, "asynchronous write protection"),
    pytest.mark.shared_machine(
        "a checkpoint is missed when threads get no CPU to stop in time; kills come at random moments"
    ),
]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def checkpoint(guard: GuardProcess, tries: int = 20) -> Json:
    """Takes one; on a busy machine some are missed, and tried again."""
    for _ in range(tries):
        taken = guard.command("checkpoint")
        if taken["kind"] == "checkpoint":
            return taken
        time.sleep(0.05)
    raise AssertionError(f"all were missed: {guard.events[-1]}")


def until_copied(guard: GuardProcess, tries: int = 60) -> Json:
    """Takes checkpoints until one is made by copying pages; returns that one."""
    for _ in range(tries):
        taken = checkpoint(guard)
        if taken["images"] == "dirty":
            return taken
    raise AssertionError(f"all were forks: {[event.get('fork_reason') for event in guard.events]}")


@pytest.mark.parametrize(
    "command",
    [
        "dirt 30 4 --rate 20000",
        "dirt 32 2 --rate 30000 --maps",
        "dirt 8 2",
        "dirt 34 1 --rate 4000 --grows",
        "threads 20 16",
        "rseq 4",
        "signals 6 --pending",
        "mappings 0 --inherited",
        "dirt 24 2 --rate 20000 --maps --in-child",
        "prefork 3 40",
    ],
)
def test_killed_at_random_moments(command: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(BY_ITSELF, [victim.pid]) as guard:
        for seed in range(6):
            # Not before there is one again that a copy was made for.
            since = guard.mark()
            guard.wait("checkpoint", since=since, count=4)
            kill_at_random(guard, victim, 2, (0.0, 0.4), seed=seed)
        victim.wait_beats(20)


@pytest.fixture
def slow_file(tmp_path: Path, victims_built: Path) -> Iterator[Path]:
    """What is read from it arrives late, in pages that the kernel has looked up before."""
    command = [str(victims_built / "server"), str(tmp_path), "nobody", "--slow"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        if process.stdout.readline() != b"ready\n":
            pytest.skip("/dev/fuse is not available here")
        yield tmp_path / "mount/served"
        process.kill()
    subprocess.run(["umount", "-l", tmp_path / "mount"], check=True)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("how", ["", "--again"])
def test_what_a_file_server_writes_late(how: str, where: str, slow_file: Path, tmp_path: Path) -> None:
    with (
        Victim(f"served {slow_file} {how} {where}", tmp_path) as victim,
        GuardProcess(BY_ITSELF, [victim.pid]) as guard,
    ):
        for _ in range(6):
            guard.wait_for(lambda event: event.get("images") == "dirty", "copies", since=guard.mark(), count=3)
            kill_at_random(guard, victim, 1, (0.0, 0.0))
        victim.check()


@pytest.mark.parametrize("command", ["dirt 60 4 --rate 20000", "dirt 64 2 --rate 30000 --maps", "busy 4"])
def test_how_and_how_often_both_by_itself(command: str, tmp_path: Path) -> None:
    """avckpt.images=auto together with avckpt.interval=auto."""
    with Victim(command, tmp_path) as victim, GuardProcess(ALL_AUTO, [victim.pid]) as guard:
        for seed in range(4):
            guard.wait("checkpoint", since=guard.mark())
            kill_at_random(guard, victim, 3, (0.0, 0.5), seed=seed)
        victim.wait_beats(20)
        # How often depends on what a checkpoint costs here; that it is told of once a second, see test_pace.py.
        if command != "busy 4":
            guard.wait_for(lambda event: event.get("images") == "dirty", "a copy")


def how_made(guard: GuardProcess, count: int, victim: Victim | None = None) -> set[str]:
    """For each of the next checkpoints the reason for a fork, or that there was none.  The victim writes most of its
    pages before each.
    """
    made = set()
    for _ in range(count):
        if victim:
            victim.wait_beats(30)
        taken = checkpoint(guard)
        made.add(taken.get("fork_reason") or taken["images"])
    return made


def test_changes_over_as_it_writes_more_or_less_and_stays_there(tmp_path: Path) -> None:
    with (
        Victim("dirt 48 2", tmp_path) as victim,
        GuardProcess(config(images=Images.AUTO), [victim.pid]) as guard,
    ):
        for _ in range(2):
            how_made(guard, 10, victim)
            assert how_made(guard, 40, victim) == {"it writes too much"}
            os.kill(victim.app, signal.SIGSTOP)
            # It tries again after 64 forks at the latest.
            how_made(guard, 70)
            assert how_made(guard, 20) == {"dirty"}
            os.kill(victim.app, signal.SIGCONT)


def mappings_of(pid: int) -> list[tuple[int, int]]:
    """A process's private mappings; adjacent ones are merged."""
    found: list[tuple[int, int]] = []
    for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
        ends, mode = line.split()[:2]
        if mode[3] != "p" or "[v" in line:
            continue
        start, end = (int(text, 16) for text in ends.split("-"))
        if found and found[-1][1] == start:
            start = found.pop()[0]
        found.append((start, end))
    return found


def pages_that_differ(one: int, other: int) -> list[int]:
    """Addresses of private pages that differ.  Raises OSError when one of the processes has ended."""
    assert mappings_of(one) == mappings_of(other), (mappings_of(one), mappings_of(other))
    differ = []
    with Path(f"/proc/{one}/mem").open("rb", 0) as first, Path(f"/proc/{other}/mem").open("rb", 0) as second:
        for start, end in mappings_of(one):
            for at in range(start, end, 256 * PAGE):
                size = min(end - at, 256 * PAGE)
                a, b = (read_at(mem.fileno(), size, at) for mem in (first, second))
                if a != b:
                    differ += [at + i for i in range(0, size, PAGE) if a[i : i + PAGE] != b[i : i + PAGE]]
    return differ


def read_at(mem: int, size: int, at: int) -> bytes:
    """Reads page by page; guard pages read as nothing."""
    try:
        return os.pread(mem, size, at)
    except OSError:
        if size == PAGE:
            return b""
        return b"".join(read_at(mem, PAGE, at + i).ljust(PAGE, b"?") for i in range(0, size, PAGE))


def newest_template(guard: GuardProcess, victim: Victim) -> int:
    """The newest has a lower oom_score_adj than the others; waits until dropped ones are gone."""

    def fewest() -> list[int]:
        points: dict[int, list[int]] = {}
        for pid in victim.others():
            with contextlib.suppress(OSError):
                if Path(f"/proc/{pid}/comm").read_text() == "avckpt-tmpl\n":
                    points.setdefault(int(Path(f"/proc/{pid}/oom_score_adj").read_text()), []).append(pid)
        found = points[min(points)]
        return found if len(found) == 1 else []

    return wait_until(fewest, 5.0, "one newest template", every_s=0.001)[0]


@pytest.mark.parametrize("command", ["dirt 24 3 --rate 8000", "dirt 64 3 --rate 20000 --maps"])
def test_the_template_is_the_application(command: str, tmp_path: Path) -> None:
    """While it stands still, its newest template equals it in every byte that the kernel does not write."""
    with Victim(command, tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        copies, rounds = 0, 0
        while copies < 12:
            rounds += 1
            assert rounds < 100, [event.get("fork_reason") for event in guard.events]
            victim.wait_beats(10)
            os.kill(victim.app, signal.SIGSTOP)
            taken = checkpoint(guard)
            differ = pages_that_differ(victim.app, newest_template(guard, victim))
            # rseq(2): one area in a page of each thread's.
            assert len(differ) <= 4, (taken, [hex(at) for at in differ])
            copies += taken["images"] == "dirty"
            os.kill(victim.app, signal.SIGCONT)


def marked(pid: int) -> int:
    """Mappings that userfaultfd watches for writes."""
    return len(re.findall(r"^VmFlags:.* uw\b", Path(f"/proc/{pid}/smaps").read_text(), re.MULTILINE))


def test_no_mark_is_left_when_the_guard_dies(tmp_path: Path) -> None:
    with Victim("dirt 16 2 --rate 10000", tmp_path) as victim:
        for _ in range(5):
            with GuardProcess(BY_ITSELF, [victim.pid]) as guard:
                guard.wait_for(lambda event: event.get("images") == "dirty", "a copy")
                assert marked(victim.app) > 3
                assert not [fd for fd in Path(f"/proc/{victim.app}/fd").iterdir() if "userfault" in os.readlink(fd)]
            wait_until(lambda: not marked(victim.app), 10.0, "no mark is left")
            victim.wait_beats(5)


def test_the_same_one_is_restored_many_times(tmp_path: Path) -> None:
    with Victim("dirt 70 2 --rate 10000", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        until_copied(guard)
        for _ in range(5):
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats(5)
        until_copied(guard)
        victim.wait_beats(5)


def change(victim: Victim, times: int) -> None:
    """Makes it do once more what its counter 0 counts."""
    os.kill(victim.app, signal.SIGUSR1)
    wait_until(lambda: victim.see().counter[0] == times, PATIENCE_S, f"it has done so {times} times")


def test_a_template_is_in_the_applications_landlock_domain(tmp_path: Path) -> None:
    """Which it has entered since the template was forked."""
    with Victim("fenced 40", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        for domains in range(1, 4):
            until_copied(guard)
            change(victim, domains)
            taken = checkpoint(guard)
            since = guard.mark()
            victim.kill_app()
            assert guard.wait("restored", since=since)["generation"] == taken["generation"]
            victim.wait_beats(5)
            assert victim.see().counter[0] == domains


@since_linux(6, 10, "mseal")
def test_what_it_has_sealed_since_the_template_was_forked(tmp_path: Path) -> None:
    """Part of a mapping: the template, which lacks that, has not been split there."""
    with Victim("sealer 40", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        for pages in range(1, 9):
            until_copied(guard)
            change(victim, pages)
            checkpoint(guard)
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats(5)
            assert victim.see().counter[0] == pages
        victim.check()


def until_near(guard: GuardProcess) -> Json:
    """Until the last two checkpoints were copies: then an older template can take the newest one's place."""
    before = until_copied(guard)
    while (taken := until_copied(guard))["generation"] != before["generation"] + 1:
        before = taken
    return taken


@pytest.mark.parametrize("command", ["dirt 24 2 --rate 20000 --maps --in-child", "prefork 3 40"])
def test_trees_are_restored_twice_right_after_a_checkpoint(command: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        for _ in range(8):
            taken = until_near(guard)
            for _ in range(2):
                since = guard.mark()
                victim.kill_app()
                assert guard.wait("restored", since=since)["generation"] == taken["generation"]
                victim.wait_beats(3)
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


@pytest.mark.parametrize("command", ["dirt 60 2 --rate 4000", "dirt 32 2 --rate 20000 --maps"])
def test_a_restore_right_after_a_checkpoint_forks_nothing(command: str, tmp_path: Path) -> None:
    """The template gives its memory to the restored process, and the previous one stands in for it, repeatedly."""
    with Victim(command, tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        given = 0
        for number in range(12):
            taken = until_near(guard)
            template = os.pidfd_open(newest_template(guard, victim))
            time.sleep(number % 3 * 0.01)
            for _ in range(2):
                since = guard.mark()
                victim.kill_app()
                assert guard.wait("restored", since=since)["generation"] == taken["generation"]
                victim.wait_beats(3)
            given += select.select([template], [], [], 0.1)[0] != []
            os.close(template)
        # Not while it is just being brought up to date for the next checkpoint, say.
        assert given > 8, given
        assert not [event for event in guard.events if event.get("kind") == "dropped"]


def test_templates_are_killed_while_one_gives_its_memory_away(tmp_path: Path) -> None:
    """From inside the container: the application comes back, possibly in the state of the checkpoint before."""
    rng, killed = random.Random(5), 0
    with Victim("dirt 60 2 --rate 20000", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        for _ in range(40):
            until_near(guard)
            try:
                template = os.pidfd_open(rng.choice(ours(victim, "avckpt-tmpl")))
            except ProcessLookupError:  # the next checkpoint has replaced it
                continue
            killed += 1
            since, dead = guard.mark(), os.pidfd_open(victim.app)
            after_s = rng.uniform(0, 0.004)
            victim.kill_app()
            select.select([dead], [], [])
            sleep_exactly(after_s)
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(template, signal.SIGKILL)
            os.close(template)
            os.close(dead)
            guard.wait("restored", since=since)
            victim.wait_beats(5)
        assert killed > 20


LSEEK = 8 if platform.machine() == "x86_64" else 62


def test_one_that_gives_its_memory_away_is_killed_before_it_has(tmp_path: Path) -> None:
    """Another one has its place already, and not the last pages yet: nobody may be restored from that."""
    with Victim("dirt 60 2 --rate 20000", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        call, rounds = Path(f"/proc/{guard.pid}/syscall"), 0
        while rounds < 12:
            until_near(guard)
            victim.wait_beats(60)
            if checkpoint(guard)["images"] != "dirty":
                continue
            os.kill(guard.pid, signal.SIGSTOP)  # it would bring the one before up to date
            template = os.pidfd_open(newest_template(guard, victim))
            since = guard.mark()
            victim.kill_app()
            # It asks for positions of files when it has found who takes the place.
            with injected(guard, "lseek", "delay_enter=100000"):
                os.kill(guard.pid, signal.SIGCONT)
                wait_until(lambda: call.read_text().startswith(f"{LSEEK} "), PATIENCE_S, "it asks", 0.001)
                signal.pidfd_send_signal(template, signal.SIGKILL)
                guard.wait("restored", since=since)
            os.close(template)
            victim.wait_beats(20)
            rounds += 1


def test_each_process_of_a_tree_is_copied_by_itself(tmp_path: Path) -> None:
    with Victim("prefork 3 40", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        until_copied(guard)
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        until_copied(guard)
        processes = [victim.app, *children_of(victim.app)]
        assert len(processes) == 4
        assert all(marked(pid) > 3 for pid in processes)


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ("idle 1 1", "there is no older image yet"),
        ("sandbox", "it has a seccomp filter of its own, or is not dumpable"),
        ("unsupported received", "it has memory of a kind that cannot be watched"),
    ],
)
def test_says_why_it_forks(command: str, reason: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(BY_ITSELF, [victim.pid]) as guard:
        guard.wait_for(lambda event: event.get("fork_reason") == reason, reason)


def test_children_that_end_are_not_said_to_have_filters(tmp_path: Path) -> None:
    """Nor memory that cannot be watched: of one that ends just then nothing can be read."""
    with Victim("churn 3 --life-ms 60", tmp_path) as victim, GuardProcess(BY_ITSELF, [victim.pid]) as guard:
        guard.wait_for(lambda event: event["kind"] == "checkpoint", "checkpoints", count=60)
        told = {event.get("fork_reason", "") for event in guard.events}
        assert not [text for text in told if "filter" in text or "watch" in text or "device" in text]


def test_a_file_open_for_direct_access_now_and_then(tmp_path: Path) -> None:
    """A read of it that is under way is not always seen: there are forks also while none is open."""
    reason = "a device may write to its memory"
    with Victim("unsupported direct signal 0.3", tmp_path) as victim, GuardProcess(BY_ITSELF, [victim.pid]) as guard:
        guard.wait_for(lambda event: event.get("images") == "dirty", "a copy")
        victim.kill_app(signal.SIGUSR1)
        guard.wait_for(lambda event: event.get("fork_reason") == reason, reason)
        wait_until(lambda: victim.see().counter[0] == 0, PATIENCE_S, "it is closed")
        assert how_made(guard, 5) == {reason}


@pytest.mark.parametrize(("limit_mb", "how"), [(120, "memory for copies is short"), (300, "dirty"), (0, "dirty")])
def test_copies_only_where_the_container_has_memory_for_them(limit_mb: int, how: str, tmp_path: Path) -> None:
    settings = config(images=Images.AUTO, memory_limit_bytes=limit_mb * 1_000_000)
    with Victim("idle 64 1", tmp_path) as victim, GuardProcess(settings, [victim.pid]) as guard:
        how_made(guard, 6)
        assert how_made(guard, 3) == {how}


def test_where_memory_is_short_only_generations_are_held(tmp_path: Path) -> None:
    """The template that is kept beside them goes first, and there is no other until memory is there again."""
    settings = config(images=Images.DIRTY, keep=2)
    with Victim("dirt 64 2 --rate 1000", tmp_path) as victim, GuardProcess(settings, [victim.pid]) as guard:
        until_near(guard)
        wait_until(lambda: len(ours(victim, "avckpt-tmpl")) == 3, 5.0, "two generations' are there, and one more")
        assert guard.command("drop_oldest")["kind"] == "dropped"
        wait_until(lambda: len(ours(victim, "avckpt-tmpl")) == 1, 5.0, "only the newest generation's is there")
        for _ in range(3):
            assert checkpoint(guard)["fork_reason"] == "memory for copies is short"
            wait_until(lambda: len(ours(victim, "avckpt-tmpl")) == 1, 5.0, "only the newest generation's is there")
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        guard.say_command("refill")
        until_near(guard)
        victim.check()


def test_forks_where_more_of_them_are_affordable(tmp_path: Path) -> None:
    """It writes 120 MB/s, and has 64 MB: copies would come every 0.7 s."""
    with Victim("dirt 64 4 --rate 30000", tmp_path) as victim, GuardProcess(ALL_AUTO, [victim.pid]) as guard:
        guard.wait_for(lambda event: event.get("images") == "dirty", "a copy, to know its cost")
        guard.wait_for(lambda event: event.get("fork_reason") == "forks may be more frequent", "forks")
        kill_at_random(guard, victim, 5, (0.1, 0.5))


def test_copies_where_a_fork_takes_long(tmp_path: Path) -> None:
    """However much more CPU time of ours they take: a fork stops it for twenty times as long."""
    with Victim("dirt 600 2 --rate 500", tmp_path) as victim, GuardProcess(ALL_AUTO, [victim.pid]) as guard:
        copies = 0
        while copies < 40:
            since = guard.mark()
            taken = guard.wait_for(lambda event: event.get("images") == "dirty", "a copy", since=since)
            copies += taken["checkpoints"]
        assert "forks may be more frequent" not in {event.get("fork_reason") for event in guard.events}


def test_a_copy_needs_no_more_memory_than_was_written(tmp_path: Path) -> None:
    """An idle application: its templates have almost no memory of their own."""
    with Victim("idle 64 2", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        until_copied(guard)
        for _ in range(10):
            assert until_copied(guard)["copied"] < 64


def own_mb(victim: Victim) -> float:
    """Memory that only one template has, of all of them."""
    kb = 0
    for pid in ours(victim, "avckpt-tmpl"):
        with contextlib.suppress(OSError):  # dropped just now
            kb += figures(pid)["Private_Dirty"]
    return kb / 1024


def test_templates_share_what_was_copied_to_them(tmp_path: Path) -> None:
    """They are updated in turns, until more has been copied to them than the victim has."""
    pages = 32 * 256
    with Victim("dirt 32 2 --rate 8000", tmp_path) as victim, GuardProcess(DIRTY, [victim.pid]) as guard:
        copied = 0
        while copied < 4 * pages:
            victim.wait_beats(10)
            # What it writes meanwhile would count, too.
            os.kill(victim.app, signal.SIGSTOP)
            copied += checkpoint(guard).get("copied", 0)
            # Three templates, each with an eighth of the process and what was written since it was renewed.
            wait_until(lambda: own_mb(victim) < 32 * 0.9, 10.0, "they share their pages")
            os.kill(victim.app, signal.SIGCONT)
        checkpoint(guard)
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        victim.wait_beats(5)
        victim.check()
