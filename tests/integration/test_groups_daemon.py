# SPDX-License-Identifier: Apache-2.0
"""avckpt.group.recovery=together: lines of one instant, and returns of all members or none."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from avckpt.artifacts import init_binary
from avckpt.cli.client import Client

from testkit.harness import ROOT, SLOWNESS, wait_until
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
    """The first of a number of consecutive free ports."""
    for _ in range(100):
        first = random.randrange(20000, 30000)
        try:
            for port in range(first, first + count):
                socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return first
    raise AssertionError("no free ports")


@pytest.fixture(params=["tcp"])
def ring(local: LocalSidecar, tmp_path: Path, request: pytest.FixtureRequest) -> list[Container]:
    """Members that pass numbered tokens at full rate (testkit/programs/ring.py), once all have a common line."""
    where = str(free_ports(MEMBERS)) if request.param == "tcp" else str(tmp_path)
    program = [sys.executable, "-u", str(ROOT / "testkit/programs/ring.py")]
    members = [
        local.protected(f"member{index}", [*program, str(index), str(MEMBERS), where], TOGETHER)
        for index in range(MEMBERS)
    ]
    wait_for_line(local, members)
    return members


def wait_for_line(local: LocalSidecar, members: list[Container], after: int = 0) -> int:
    """Waits until all members hold the line of the same number; that number."""

    def line() -> int:
        ids = {member.id for member in members}
        lines = {each["line"] for each in Client(local.run_dir).containers() if each["id"] in ids}
        return lines.pop() if len(lines) == 1 and min(lines) > after else 0

    number: int = wait_until(line, 20 * SLOWNESS, f"a line after {after}; log:\n{local.log}")
    return number


def row(local: LocalSidecar, container: Container) -> dict[str, Any]:
    """The member as the API shows it."""
    return next(each for each in Client(local.run_dir).containers(ended=True) if each["id"] == container.id)


def wait_for_restores(local: LocalSidecar, members: list[Container], restores: int) -> None:
    def all_back() -> bool:
        rows = [row(local, member) for member in members]
        return all(each["restores"] == restores and each["state"] == "protected" for each in rows)

    wait_until(all_back, 10 * SLOWNESS, f"restore {restores}; log:\n{local.log}")


def kill_templates(container: Container) -> int:
    """Kills a member's templates; how many there were."""
    found = [pid for pid in children_of(container.init_pid) if Path(f"/proc/{pid}/comm").read_text() == "avckpt-tmpl\n"]
    for pid in found:
        os.kill(pid, signal.SIGKILL)
    return len(found)


def said(member: Container) -> list[str]:
    return member.output.read_text().splitlines()


def tokens(member: Container) -> int:
    """How many tokens the member has received, by its last report."""
    lines = [line.split() for line in said(member)[:-1]]
    return next((int(words[0]) for words in reversed(lines) if len(words) == 3 and words[0].isdigit()), 0)


def lost_connections(member: Container) -> int:
    """How many connections the member has lost, by its last report."""
    lines = [line.split() for line in said(member)[:-1]]
    return next(int(words[2]) for words in reversed(lines) if len(words) == 3 and words[2].isdigit())


def check_ledgers(ring: list[Container]) -> None:
    """The members' ledgers agree, and keep agreeing as tokens go on."""
    wrong = [line for member in ring for line in said(member) if "WRONG" in line or "Traceback" in line]
    assert wrong == []
    before = [tokens(member) for member in ring]
    wait_until(
        lambda: all(tokens(each) > had for each, had in zip(ring, before)), 10 * SLOWNESS, f"tokens after {before}"
    )


def told(local: LocalSidecar, kind: str) -> list[dict[str, Any]]:
    return [event for event in Client(local.run_dir).history() if event["kind"] == kind]


@pytest.mark.parametrize("ring", ["tcp", "unix"], indirect=True)
def test_ledgers_agree_after_any_death(local: LocalSidecar, ring: list[Container]) -> None:
    for death in range(1, 6):
        victim = ring[death % MEMBERS]
        os.kill(victim.app_pid, signal.SIGKILL)
        wait_for_restores(local, ring, death)
        wait_for_line(local, ring, row(local, victim)["line"])
    check_ledgers(ring)
    assert [lost_connections(member) for member in ring] == [0] * MEMBERS
    restored = told(local, "restored")
    assert len(restored) == 5 * MEMBERS
    for death in range(5):
        these = restored[death * MEMBERS : (death + 1) * MEMBERS]
        assert len({event["line"] for event in these}) == 1
        assert sorted(event["reason"] for event in these) == ["group"] * (MEMBERS - 1) + ["signal"]
    for member in ring:
        assert row(local, member)["attempt"] <= 2  # those of others do not count


def unit(local: LocalSidecar, name: str, argv: list[str]) -> Container:
    """A unit of the host: as a node below a launcher, it shares its PID namespace with others."""
    output = local.run_dir.parent / f"{name}.out"
    labels = [word for key, value in TOGETHER.items() for word in ("--label", f"{key}={value}")]
    with output.open("wb") as out:
        process = subprocess.Popen(
            [str(init_binary()), "--name", name, *labels, "--", *argv],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
            env={**os.environ, **local.env},
            start_new_session=True,
        )

    def known() -> list[str]:
        return [each["id"] for each in Client(local.run_dir).containers() if each["init_pid"] == process.pid]

    [identity] = wait_until(known, 20 * SLOWNESS, f"{name} is registered; log:\n{local.log}")
    member = Container(identity, name, local.env, process, process.pid, os.pidfd_open(process.pid), output)
    local.containers.append(member)
    return member


def test_units_of_one_pid_namespace_go_back_together(local: LocalSidecar) -> None:
    program = [sys.executable, "-u", str(ROOT / "testkit/programs/ring.py")]
    port = str(free_ports(MEMBERS))
    members = [unit(local, f"unit{i}", [*program, str(i), str(MEMBERS), port]) for i in range(MEMBERS)]
    wait_for_line(local, members)
    pids = [row(local, member)["app_pid"] for member in members]
    for death in range(1, 4):
        os.kill(pids[death % MEMBERS], signal.SIGKILL)
        wait_for_restores(local, members, death)
        wait_for_line(local, members, row(local, members[0])["line"])
    check_ledgers(members)
    assert [row(local, member)["app_pid"] for member in members] == pids
    assert {event["line"] for event in told(local, "restored")} - {0} != set()


def test_all_hurry_until_they_are_back_and_no_longer(local: LocalSidecar, ring: list[Container]) -> None:
    assert local.process is not None
    lent = os.SCHED_RR | os.SCHED_RESET_ON_FORK
    daemon = local.process.pid
    everybody = [daemon, *(row(local, member)["guard_pid"] for member in ring), *(member.init_pid for member in ring)]
    for restores in (1, 2):
        os.kill(daemon, signal.SIGSTOP)
        try:
            os.kill(ring[restores].app_pid, signal.SIGKILL)
            wait_until(lambda: os.sched_getscheduler(daemon) == lent, 4, "the daemon is to hurry")
        finally:
            os.kill(daemon, signal.SIGCONT)
        wait_for_restores(local, ring, restores)
        wait_for_line(local, ring, row(local, ring[0])["line"])
        wait_until(
            lambda: {os.sched_getscheduler(pid) for pid in everybody} == {os.SCHED_OTHER},
            5 * SLOWNESS,
            "nobody hurries any more",
        )


def test_all_hurry_from_the_meeting_before_a_freeze_on(local: LocalSidecar, ring: list[Container]) -> None:
    """Who has no CPU when the others stop keeps them stopped."""
    wait_for_line(local, ring)
    held, waiting = (row(local, member)["guard_pid"] for member in ring[:2])
    os.kill(held, signal.SIGSTOP)
    try:
        # They wait a second for it, with their applications running: longer than any freeze.
        for _ in range(10):
            wait_until(
                lambda: os.sched_getscheduler(waiting) == os.SCHED_RR, 5 * SLOWNESS, "a guard waits for another one"
            )
            hurries = set()
            for _ in range(10):
                time.sleep(0.02)
                hurries.add(os.sched_getscheduler(waiting))
            if hurries == {os.SCHED_RR}:
                break
    finally:
        os.kill(held, signal.SIGCONT)
    assert hurries == {os.SCHED_RR}
    wait_for_line(local, ring, row(local, ring[1])["line"])


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
    wait_until(lambda: ended(ring[2]), 10 * SLOWNESS, "it ends")
    line = row(local, ring[0])["line"]
    left = ring[:2]
    wait_for_line(local, left, line)
    assert [row(local, member)["restores"] for member in left] == [0, 0]
    os.kill(left[0].app_pid, signal.SIGKILL)
    wait_for_restores(local, left, 1)


def test_on_command_all_go_back(local: LocalSidecar, ring: list[Container]) -> None:
    line = wait_for_line(local, ring)
    # On a busy machine somebody may not stop in time.
    wait_until(
        lambda: local.avckpt("checkpoint", "member0", check=False).status == 0, 20 * SLOWNESS, "a line on command"
    )
    assert all(row(local, member)["line"] > line for member in ring)
    local.avckpt("restore", "member1")
    wait_for_restores(local, ring, 1)
    check_ledgers(ring)


def test_without_a_line_nobody_is_killed(local: LocalSidecar) -> None:
    members = [local.protected(f"m{i}", ["sleep", "1000"], {**TOGETHER, "avckpt.interval": "1h"}) for i in range(2)]
    wait_for_line(local, members)
    time.sleep(1.0)  # each of them had a line taken when it came
    # The templates of one member are gone: there is no line that all have.
    wait_until(
        lambda: not kill_templates(members[1]) and row(local, members[1])["generations"] == 0,
        10 * SLOWNESS,
        "it is empty",
    )
    survivor = members[1].app_pid
    os.kill(members[0].app_pid, signal.SIGKILL)
    assert members[0].status() == 128 + signal.SIGKILL
    assert (members[1].app_pid, row(local, members[1])["restores"]) == (survivor, 0)


def newest_template(container: Container) -> int:
    """By the time of its start."""
    pids = [pid for pid in children_of(container.init_pid) if Path(f"/proc/{pid}/comm").read_text() == "avckpt-tmpl\n"]
    return max(pids, key=lambda pid: int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[19]))


def take_line(local: LocalSidecar, members: list[Container]) -> int:
    """On command; on a busy machine somebody may not stop in time."""
    before = row(local, members[0])["line"]
    wait_until(
        lambda: local.avckpt("checkpoint", members[0].name, check=False).status == 0, 20 * SLOWNESS, "a line on command"
    )
    return wait_for_line(local, members, before)


def test_after_a_death_all_keep_the_same_older_line(local: LocalSidecar) -> None:
    """What was restored may crash again: its guard keeps the line before, and so must the others."""
    labels = {**TOGETHER, "avckpt.interval": "1h", "avckpt.keep": "2", "avckpt.restore.max": "5/600s"}
    members = [local.protected(f"m{i}", ["sleep", "1000"], labels) for i in range(3)]
    wait_for_line(local, members)
    time.sleep(1.0)  # each of them had a line taken when it came
    older = take_line(local, members)
    take_line(local, members)
    os.kill(members[0].app_pid, signal.SIGKILL)
    wait_for_restores(local, members, 1)
    for _ in range(3):
        take_line(local, members)
    # One has lost the newest: there has to be another that all have.
    os.kill(newest_template(members[2]), signal.SIGKILL)
    wait_until(lambda: row(local, members[2])["generations"] == 1, 10 * SLOWNESS, "it is dropped")
    os.kill(members[1].app_pid, signal.SIGKILL)
    wait_for_restores(local, members, 2)
    assert {row(local, member)["line"] for member in members} == {older}


# What both do after the line, when there is a file that is not rolled back.
SENDER = """
import os, socket, sys, time
to = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
to.sendall(b"0123456789" * 50)
print("SENT", flush=True)
while not os.path.exists(sys.argv[2]):
    time.sleep(0.01)
for _ in range(100):
    to.sendall(b"later")
    time.sleep(0.005)
print("ENDED", to.recv(1), flush=True)
time.sleep(1000)
"""
RECEIVER = """
import os, socket, sys, time
end, _ = socket.create_server(("127.0.0.1", int(sys.argv[1]))).accept()
while not os.path.exists(sys.argv[2]):
    time.sleep(0.01)
got = b""
while len(got) < 1000 and (data := end.recv(4096)):
    got += data
print("GOT", got == b"0123456789" * 50 + b"later" * 100, flush=True)
end.sendall(b"!")
time.sleep(1000)
"""
RARELY = {**TOGETHER, "avckpt.interval": "1h"}


def pair(local: LocalSidecar, programs: list[str], go: Path) -> list[Container]:
    """A listening member and its connected peer, both in one line; then the file `go` lets them go on."""
    arguments = [str(free_ports(1)), str(go)]
    members = [local.protected("server", [sys.executable, "-uc", programs[0], *arguments], RARELY)]
    members.append(
        local.protected(
            "client", ["sh", "-c", 'sleep 1; exec "$@"', "sh", sys.executable, "-uc", programs[1], *arguments], RARELY
        )
    )
    wait_until(lambda: "SENT" in said(members[1]), 10 * SLOWNESS, "it has sent")
    wait_until(lambda: local.avckpt("checkpoint", "client", check=False).status == 0, 20 * SLOWNESS, "a line")
    wait_for_line(local, members)
    go.touch()
    return members


@pytest.mark.parametrize("victim", [0, 1])
def test_what_was_on_its_way_is_so_again(local: LocalSidecar, tmp_path: Path, victim: int) -> None:
    """What was unread at the line and read since is unread again; what was sent later was never sent."""
    members = pair(local, [RECEIVER, SENDER], tmp_path / "go")
    time.sleep(0.2)
    before = said(members[1]).count("ENDED b'!'")
    os.kill(members[victim].app_pid, signal.SIGKILL)
    wait_for_restores(local, members, 1)
    wait_until(lambda: said(members[1]).count("ENDED b'!'") > before, 20 * SLOWNESS, "it was answered")
    assert set(said(members[0])) == {"GOT True"}


CANNOT = {
    "full": "to.setblocking(False)\ntry:\n    while to.send(b'x' * 65536): pass\nexcept OSError: pass",
    "urgent": "to.send(b'x', socket.MSG_OOB)",
}


TOLD = {
    "full": "1 of its connections have ended: some bytes had not arrived at the line",
    "urgent": "1 of its connections have ended: it has urgent data (127.0.0.1:",
}


@pytest.mark.parametrize("state", ["full", "urgent"])
def test_a_connection_that_cannot_go_on_is_reset_and_told(local: LocalSidecar, tmp_path: Path, state: str) -> None:
    server = """
import os, socket, sys, time
end, _ = socket.create_server(("127.0.0.1", int(sys.argv[1]))).accept()
while not os.path.exists(sys.argv[2]):
    time.sleep(0.01)
while end.recv(65536):
    pass
"""
    client = f"""
import os, socket, sys, time
to = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
{CANNOT[state]}
print("SENT")
while not os.path.exists(sys.argv[2]):
    time.sleep(0.01)
to.setblocking(True)
try:
    while True:
        to.send(b"y")
        time.sleep(0.01)
except OSError as error:
    print("RESET", error)
time.sleep(1000)
"""
    members = pair(local, [server, client], tmp_path / "go")
    time.sleep(0.5)
    os.kill(members[1].app_pid, signal.SIGKILL)
    wait_until(lambda: any(line.startswith("RESET") for line in said(members[1])), 20 * SLOWNESS, f"{said(members[1])}")
    wait_until(lambda: any(TOLD[state] in json.dumps(event) for event in told(local, "restored")), 10, TOLD[state])
