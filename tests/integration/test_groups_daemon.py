# SPDX-License-Identifier: Apache-2.0
"""avckpt.group.recovery=together: lines of one instant, and returns of all members or none."""

from __future__ import annotations

import os
import random
import signal
import socket
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from avckpt.cli.client import Client

from testkit.harness import ROOT, wait_until
from testkit.local_sidecar import Container, LocalSidecar, ended
from testkit.procfs import children_of

TOGETHER = {
    "avckpt.enable": "true",
    "avckpt.interval": "200ms",
    "avckpt.group": "ring",
    "avckpt.group.recovery": "together",
    "avckpt.restore.max": "64/1s",
}
MEMBERS = 3
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine("init waits two seconds for its guard, and members for each other, for 50 ms at least"),
]


def free_ports(count: int) -> int:
    """The first of so many that nobody has at this moment."""
    for _ in range(100):
        first = random.randrange(20000, 30000)
        try:
            for port in range(first, first + count):
                socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return first
    raise AssertionError("no free ports")


@pytest.fixture
def ring(local: LocalSidecar) -> list[Container]:
    """Members that pass numbered tokens at full rate (testkit/programs/ring.py), in a line of all."""
    port = str(free_ports(MEMBERS))
    program = [sys.executable, "-u", str(ROOT / "testkit/programs/ring.py")]
    members = [
        local.protected(f"member{index}", [*program, str(index), str(MEMBERS), port], TOGETHER)
        for index in range(MEMBERS)
    ]
    wait_for_line(local, members)
    return members


def wait_for_line(local: LocalSidecar, members: list[Container], after: int = 0) -> int:
    """Until all have one of the same number; that number."""

    def line() -> int:
        ids = {member.id for member in members}
        lines = {each["line"] for each in Client(local.run_dir).containers() if each["id"] in ids}
        return lines.pop() if len(lines) == 1 and min(lines) > after else 0

    number: int = wait_until(line, 20, f"a line after {after}; log:\n{local.log}")
    return number


def row(local: LocalSidecar, container: Container) -> dict[str, Any]:
    """What the API knows of it."""
    return next(each for each in Client(local.run_dir).containers(ended=True) if each["id"] == container.id)


def wait_for_restores(local: LocalSidecar, members: list[Container], restores: int) -> None:
    def all_back() -> bool:
        rows = [row(local, member) for member in members]
        return all(each["restores"] == restores and each["state"] == "protected" for each in rows)

    wait_until(all_back, 10, f"restore {restores}; log:\n{local.log}")


def kill_templates(container: Container) -> int:
    """How many there were."""
    found = [pid for pid in children_of(container.init_pid) if Path(f"/proc/{pid}/comm").read_text() == "avckpt-tmpl\n"]
    for pid in found:
        os.kill(pid, signal.SIGKILL)
    return len(found)


def said(member: Container) -> list[str]:
    return member.output.read_text().splitlines()


def tokens(member: Container) -> int:
    """How many it has got, as it has said last."""
    lines = [line.split() for line in said(member)[:-1]]
    return next((int(words[0]) for words in reversed(lines) if len(words) == 3 and words[0].isdigit()), 0)


def check_ledgers(ring: list[Container]) -> None:
    """They agree, and go on to."""
    wrong = [line for member in ring for line in said(member) if "WRONG" in line or "Traceback" in line]
    assert wrong == []
    before = [tokens(member) for member in ring]
    wait_until(lambda: all(tokens(each) > had for each, had in zip(ring, before)), 10, f"tokens after {before}")


def told(local: LocalSidecar, kind: str) -> list[dict[str, Any]]:
    return [event for event in Client(local.run_dir).history() if event["kind"] == kind]


def test_ledgers_agree_after_any_death(local: LocalSidecar, ring: list[Container]) -> None:
    for death in range(1, 6):
        victim = ring[death % MEMBERS]
        os.kill(victim.app_pid, signal.SIGKILL)
        wait_for_restores(local, ring, death)
        wait_for_line(local, ring, row(local, victim)["line"])
    check_ledgers(ring)
    restored = told(local, "restored")
    assert len(restored) == 5 * MEMBERS
    for death in range(5):
        these = restored[death * MEMBERS : (death + 1) * MEMBERS]
        assert len({event["line"] for event in these}) == 1
        assert sorted(event["reason"] for event in these) == ["group"] * (MEMBERS - 1) + ["signal"]
    for member in ring:
        assert row(local, member)["attempt"] <= 2  # those of others do not count


def test_a_guard_that_stops_or_dies_leaves_nobody_stopped(local: LocalSidecar, ring: list[Container]) -> None:
    for signum in (signal.SIGSTOP, signal.SIGKILL):
        guard_pid = row(local, ring[1])["guard_pid"]
        line = wait_for_line(local, ring)
        os.kill(guard_pid, signum)
        # A line is under way all the time.
        time.sleep(0.5)
        if signum == signal.SIGSTOP:
            os.kill(guard_pid, signal.SIGCONT)
        check_ledgers(ring)
        wait_for_line(local, ring, line)
    assert row(local, ring[1])["restores"] == 0
    assert [event["container"] for event in told(local, "guard_lost")] == ["member1"]


def test_who_ends_by_itself_is_no_member_any_more(local: LocalSidecar, ring: list[Container]) -> None:
    signal.pidfd_send_signal(ring[2].pidfd, signal.SIGTERM)
    wait_until(lambda: ended(ring[2]), 10, "it ends")
    line = row(local, ring[0])["line"]
    left = ring[:2]
    wait_for_line(local, left, line)
    assert [row(local, member)["restores"] for member in left] == [0, 0]
    os.kill(left[0].app_pid, signal.SIGKILL)
    wait_for_restores(local, left, 1)


def test_on_command_all_go_back(local: LocalSidecar, ring: list[Container]) -> None:
    line = wait_for_line(local, ring)
    # On a busy machine somebody may not stop in time.
    wait_until(lambda: local.avckpt("checkpoint", "member0", check=False).status == 0, 20, "a line on command")
    assert all(row(local, member)["line"] > line for member in ring)
    local.avckpt("restore", "member1")
    wait_for_restores(local, ring, 1)
    check_ledgers(ring)


def test_without_a_line_nobody_is_killed(local: LocalSidecar) -> None:
    members = [local.protected(f"m{i}", ["sleep", "1000"], {**TOGETHER, "avckpt.interval": "1h"}) for i in range(2)]
    wait_for_line(local, members)
    time.sleep(1.0)  # each of them had a line taken when it came
    # The templates of one member are gone: there is no line that all have.
    wait_until(lambda: not kill_templates(members[1]) and row(local, members[1])["generations"] == 0, 10, "it is empty")
    survivor = members[1].app_pid
    os.kill(members[0].app_pid, signal.SIGKILL)
    assert members[0].status() == 128 + signal.SIGKILL
    assert (members[1].app_pid, row(local, members[1])["restores"]) == (survivor, 0)
