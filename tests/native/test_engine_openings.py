# SPDX-License-Identifier: Apache-2.0
"""What an application has opened since its checkpoint is closed by a restore, thousands of connections late."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, WHERE, GuardProcess, Victim, config
from testkit.harness import wait_until

THOUSANDS = 5000
"""More than LATE_LEAST of files_late.c."""
WAITS_S = 25.0
"""Less than a restore waits for what does not come: it goes on without it."""
LISTENER = 99
"""The descriptor in openings.c."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def open_and_die(guard: GuardProcess, victim: Victim) -> int:
    """Returns who has the memory of the dead, when the victim runs again; 0: nobody."""
    since, before = guard.mark(), victim.see().counter[0]
    os.kill(victim.player, signal.SIGUSR1)
    wait_until(lambda: victim.see().counter[0] > before, PATIENCE_S, "they are open", 0.001)
    victim.kill_app()
    restored = guard.wait("restored", since=since)
    assert "error" not in restored, restored
    victim.wait_beats(3)
    return int(guard.wait("died", since=since).get("remains_pid", 0))


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("closes", ["", "--closes"])
@pytest.mark.parametrize("kind", ["pair", "pipe", "peers", "tcp", "eventfd", "file"])
def test_nobody_else_has_what_only_one_can_have(kind: str, closes: str, where: str, tmp_path: Path) -> None:
    """The restored process takes a port, a name and a lock again at once, and finds nothing else open."""
    command = f"openings {THOUSANDS} {kind} --claims {closes} {where}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        for _ in range(4):
            open_and_die(guard, victim)


@pytest.mark.parametrize("opened", [1300, 3000, 15_000], ids=["before", "at-once", "after"])
def test_children_are_restored_while_the_rest_is_closed(opened: int, tmp_path: Path) -> None:
    """That is done before their turn, meanwhile, or after.

    The lists of calls with which they begin lie in their parent's parasite, where its holder has its own.
    """
    command = f"openings {opened} pair --parent"
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(4):
            assert guard.checkpoint()["kind"] == "checkpoint"
            since = guard.mark()
            open_and_die(guard, victim)
            assert guard.wait("restored", since=since)["restore_s"] < WAITS_S


def tcp_with_port_of(listener: str) -> int:
    """How many TCP sockets have, at either end, the port of that link in /proc/PID/fd."""
    inode = os.readlink(listener)[len("socket:[") : -1]
    lines = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    port = next(line[1].split(":")[1] for line in lines if line[9] == inode)
    return sum(port in (line[1].split(":")[1], line[2].split(":")[1]) for line in lines)


@pytest.mark.parametrize("where", WHERE)
def test_connections_end_for_their_peers(where: str, tmp_path: Path) -> None:
    with (
        Victim(f"openings {THOUSANDS} peers {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        assert guard.checkpoint()["kind"] == "checkpoint"
        open_and_die(guard, victim)
        wait_until(lambda: tcp_with_port_of(f"/proc/{victim.player}/fd/{LISTENER}") == 1, PATIENCE_S, "they end", 0.01)


def is_closed(pid: int) -> bool:
    """It has nothing open, or is gone."""
    try:
        return not os.listdir(f"/proc/{pid}/fd")
    except FileNotFoundError:
        return True


@pytest.mark.parametrize("kind", ["pair", "peers"])
def test_the_dead_have_nothing_open(kind: str, tmp_path: Path) -> None:
    """Also where their memory is kept for whoever reads it."""
    with (
        Victim(f"openings {THOUSANDS} {kind}", tmp_path) as victim,
        GuardProcess(config(remains_s=600.0), [victim.pid]) as guard,
    ):
        assert guard.checkpoint()["kind"] == "checkpoint"
        dead = open_and_die(guard, victim)
        wait_until(partial(is_closed, dead), PATIENCE_S, "all is closed", 0.001)
        assert os.path.exists(f"/proc/{dead}/mem")
