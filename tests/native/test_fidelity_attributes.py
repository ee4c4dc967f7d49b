# SPDX-License-Identifier: Apache-2.0
"""A restored process and its threads have all their attributes in the kernel."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from avckpt.guard import Images

from testkit.guarded import BUILD, WHERE, GuardProcess, Victim, config, kill_at_random
from testkit.harness import wait_until
from testkit.procfs import KCMP_SYSVSEM, share


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("command", ["attributes --inherited", "attributes"])
def test_attributes(command: str, where: str, tmp_path: Path) -> None:
    """Scheduling, I/O priority, credentials, prctl settings; limits, umask, directories."""
    with Victim(f"{command} {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 40, (0.01, 0.12))


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    "kind", ["exit-signal", "zombie-group", "vdso", "proc", "limits", "hard-limits", "barriers", "retired"]
)
def test_traits(kind: str, where: str, tmp_path: Path) -> None:
    """Of children: exit signals, the group of an ended one, limits; membarrier(2)."""
    with Victim(f"traits {kind} {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 10, (0.01, 0.12))


@pytest.mark.parametrize("images", list(Images))
@pytest.mark.parametrize("where", WHERE)
def test_where_it_is(where: str, images: Images, tmp_path: Path) -> None:
    """Directory and umask change all the time, also between a look at them and the freeze."""
    with (
        Victim(f"wanders {where}", tmp_path) as victim,
        GuardProcess(config(0.01, images=images), [victim.pid]) as guard,
    ):
        kill_at_random(guard, victim, 15, (0.0, 0.1))


def test_thousands_of_groups(tmp_path: Path) -> None:
    """They make /proc/PID/status very long; the lines behind them must be read nevertheless."""
    groups = range(10**9, 10**9 + 3000)
    with (
        Victim("threads 4 1", tmp_path, preexec=lambda: os.setgroups(groups)) as victim,
        GuardProcess(config(0.03), [victim.pid]) as guard,
    ):
        before = credentials(victim)
        kill_at_random(guard, victim, 3, (0.01, 0.12))
        assert credentials(victim) == before
        assert len(before["Groups"].split()) == len(groups)


def credentials(victim: Victim) -> dict[str, str]:
    """The main process's credentials, as /proc shows them."""
    lines = Path(f"/proc/{victim.app}/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    names = [name for name in fields if name in ("Uid", "Gid", "Groups", "NoNewPrivs") or name.startswith("Cap")]
    return {name: fields[name] for name in names}


@pytest.mark.parametrize("where", WHERE)
def test_a_personality_that_changes(where: str, tmp_path: Path) -> None:
    """Also that of a process whose holder was made before the change."""
    with Victim(f"traits personality {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        wait_until(lambda: victim.see().counter[0] == 1, 5, "it changes")
        assert guard.checkpoint()["kind"] == "checkpoint"
        kill(guard, victim)


@pytest.mark.parametrize("kind", ["setup", "disarmed"])
def test_a_thread_that_changes(kind: str, tmp_path: Path) -> None:
    """One that sets itself up when it is first seen; one in a handler, whose alternate stack is hidden then."""
    with Victim(f"traits {kind}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(1 if kind == "setup" else 4):
            assert guard.checkpoint()["kind"] == "checkpoint"
        lead(victim, 1)
        victim.wait_beats()
        assert guard.checkpoint()["kind"] == "checkpoint"
        kill(guard, victim)


def test_a_thread_that_leaves_a_handler(tmp_path: Path) -> None:
    """It has its alternate stack again, which was hidden when it was asked inside the handler."""
    with Victim("traits rearmed", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for step in (0, 1, 2):
            lead(victim, step)
            for _ in range(4):
                assert guard.checkpoint()["kind"] == "checkpoint"
        victim.wait_beats()
        kill(guard, victim)


@pytest.mark.parametrize("where", WHERE)
def test_all_threads_change_users(where: str, tmp_path: Path) -> None:
    """The next checkpoint asks only some threads after many quiet ones; all must be restored with the new user."""
    with Victim(f"traits users {where}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for change in range(1, 13):
            for _ in range(change):
                assert guard.checkpoint()["kind"] == "checkpoint"
            lead(victim, change)
            answer = guard.checkpoint()
            assert answer["kind"] == "checkpoint", answer
            kill(guard, victim)


def lead(victim: Victim, step: int) -> None:
    """Lets the victim take the next step, and waits until its board says so."""
    victim.board.set_counter(1, step)
    wait_until(lambda: victim.see().counter[0] == step, 5, f"it has come to step {step}")


def kill(guard: GuardProcess, victim: Victim) -> None:
    """Kills the victim once; it goes on."""
    since = guard.mark()
    victim.kill_app()
    guard.wait("restored", since=since)
    victim.wait_beats(20)


@pytest.mark.shared_machine("how long checkpoints stop the application is looked at")
def test_one_that_may_not_have_another_process(tmp_path: Path) -> None:
    """At its limit of processes it runs on unharmed, and the reason for the missing checkpoint is reported."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # the victim is not root
        user = "/usr/bin/setpriv --reuid 54321 --regid 54321 --clear-groups --bounding-set -all --inh-caps -all"
        command = f"{user} /usr/bin/prlimit --nproc=4:4 {BUILD / 'idle'} 0 4"
        with Victim(command, Path(folder)) as victim, GuardProcess(config(), [victim.pid]) as guard:
            guard.wait("attached")
            victim.wait_beats(5)
            victim.board.forget_gap()
            for _ in range(5):
                answer = guard.command("checkpoint")
                assert answer["kind"] == "missed"
                assert "may not have another process" in answer["error"]["message"]
            victim.wait_beats(5)
            assert victim.see().gap_ns < 60e6


def test_a_seccomp_filter_of_its_own(tmp_path: Path) -> None:
    """It does not prevent a restore, and is in force after it."""
    with Victim("sandbox", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 30, (0.01, 0.12))
        for task in Path(f"/proc/{victim.app}/task").iterdir():
            assert "Seccomp:\t2\nSeccomp_filters:\t1\n" in (task / "status").read_text()


def test_a_child_has_no_list_of_semaphores(tmp_path: Path) -> None:
    """Neither it nor its parent has one to be undone, which kcmp(2) shows as the same; so it stays."""
    with Victim("traits personality --in-child", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert share(KCMP_SYSVSEM, victim.app, victim.player)
        assert guard.checkpoint()["kind"] == "checkpoint"
        assert share(KCMP_SYSVSEM, victim.app, victim.player)
