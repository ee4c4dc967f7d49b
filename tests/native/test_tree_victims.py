# SPDX-License-Identifier: Apache-2.0
"""The victims of several processes by themselves: silent when nothing is wrong, loud when something is.

Below avckpt-init in a PID namespace of their own, so that none of them is left behind; without a guard.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from testkit.board import VIOLATION_STATUS
from testkit.family import Member, main_process, members
from testkit.guarded import Victim
from testkit.harness import SLOWNESS, wait_until
from testkit.meddle import get_fd, remote_syscall

SHARED = pytest.mark.shared_machine("a victim is given a time to find what is wrong")

CONTENT = [
    "tree 0",
    "tree 8",
    "tree 8 --reaper",
    "tree 16 --threads 3",
    "tree 9 --orphan",
    "churn 1",
    "churn 8",
    "churn 8 --vfork",
    "churn 3 --threads 4",
    "commands",
    "prefork 4 20",
    "prefork 2 1 --private 10",
    "terminal",
    "terminal --stopped",
    "terminal --heard",
]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("command", CONTENT)
def test_content_when_nothing_is_wrong(command: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim:
        before = victim.see().counter[0]
        victim.wait_beats(200)
        if not command.startswith("tree"):
            wait_until(lambda: victim.see().counter[0] > before, 10, f"progress of {command}")
        # Its main process ends: nobody may take the moment until all are gone for a fault.
        os.kill(main_process(victim), signal.SIGKILL)
        assert victim.end(10) == 128 + signal.SIGKILL
        assert victim.said == "ready\n"
        assert victim.see().violations == 0


@SHARED
def test_two_hundred_processes_and_a_thousand_threads(tmp_path: Path) -> None:
    with Victim("tree 125 --threads 7 --lap-us 200000", tmp_path) as victim:
        # Some workers have one below them, some have two zombies, and some wait for one.
        assert len(members(victim)) == 1 + 125 + 18 + 2 * 18 + 17
        victim.wait_beats(5, 30 * SLOWNESS)


def test_the_tree_is_what_it_says(tmp_path: Path) -> None:
    with Victim("tree 8 --reaper", tmp_path) as victim:
        by_name: dict[str, list[Member]] = {}
        for member in members(victim):
            by_name.setdefault(member.name, []).append(member)
        (tree,) = by_name["tree"][:1]
        assert tree.inside == victim.see().pid
        assert [m.session == m.inside for m in by_name["session"]] == [True]
        (group,) = by_name["group"]
        assert group.group == group.inside
        assert [m.group for m in by_name["member"]] == [group.inside]
        assert [m.parent for m in by_name["execed"]] == [tree.inside]
        assert [m.parent for m in by_name["adopted"]] == [by_name["reaper"][0].inside]
        assert sum(m.is_zombie for m in members(victim)) == 2


# --- loud when something is wrong ------------------------------------------


def fds(pid: int, kind: str) -> list[int]:
    """Descriptors of a process whose link contains that text."""
    found = []
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            if kind in os.readlink(link) and int(link.name) > 2:
                found.append(int(link.name))
    return found


def named(victim: Victim, name: str) -> int:
    return next(member.pid for member in members(victim) if member.name == name)


def quit_a_child(victim: Victim) -> None:
    """By a signal whose number stands for no child."""
    with contextlib.suppress(ProcessLookupError, StopIteration):
        os.kill(named(victim, "child"), signal.SIGQUIT)


def kill_a_worker(victim: Victim) -> None:
    os.kill(named(victim, "plain"), signal.SIGKILL)


def stop_a_worker(victim: Victim) -> None:
    os.kill(named(victim, "plain"), signal.SIGSTOP)


def kill_a_parent(victim: Victim) -> None:
    """Its child then has another parent."""
    os.kill(named(victim, "reaper"), signal.SIGKILL)


def read_from_a_pipe(victim: Victim) -> None:
    main = main_process(victim)
    for fd in fds(main, "pipe:"):
        info = Path(f"/proc/{main}/fdinfo/{fd}").read_text()
        if re.search(r"^flags:\s+0?0$", info, re.M):  # O_RDONLY
            mine = os.open(f"/proc/{main}/fd/{fd}", os.O_RDONLY | os.O_NONBLOCK)
            assert len(os.read(mine, 8)) == 8
            os.close(mine)
            return
    raise AssertionError("no pipe that is read")


def write_into_a_pipe(victim: Victim) -> None:
    main = main_process(victim)
    fd = os.open(f"/proc/{main}/fd/{fds(main, 'pipe:')[0]}", os.O_WRONLY | os.O_NONBLOCK)
    os.write(fd, bytes(8))
    os.close(fd)


def take_a_token(victim: Victim) -> None:
    main = main_process(victim)
    fd = get_fd(main, fds(main, "[eventfd]")[0])
    os.write(fd, (1).to_bytes(8, "little"))
    os.close(fd)


def move_the_offset(victim: Victim) -> None:
    main = main_process(victim)
    fd = get_fd(main, fds(main, "/tmp/tree-")[0])
    os.lseek(fd, 8, os.SEEK_CUR)
    os.close(fd)


def change_shared_memory(victim: Victim, at: int) -> None:
    main = main_process(victim)
    maps = Path(f"/proc/{main}/maps").read_text()
    found = re.search(r"^([0-9a-f]+)-\S+ rw-s .* /dev/zero \(deleted\)$", maps, re.M)
    assert found, maps
    with open(f"/proc/{main}/mem", "r+b", buffering=0) as memory:
        memory.seek(int(found[1], 16) + at)
        old = int.from_bytes(memory.read(8), "little")
        memory.seek(int(found[1], 16) + at)
        memory.write((old + 7).to_bytes(8, "little"))


# System calls that a process never makes by itself.
CLONE, WAIT4, SETPGID, SETSID, PRCTL, IOCTL = 56, 61, 109, 112, 157, 16
PR_SET_NAME, TIOCNOTTY = 15, 0x5422
NO_STACK = 16
"""What has this for a stack dies at once, and does not say so itself."""


def call(name: str, number: int, *args: int) -> Callable[[Victim], None]:
    """Has a process make a system call while it sleeps."""

    def deed(victim: Victim) -> None:
        pid = main_process(victim) if name == "main" else named(victim, name)
        for _ in range(500):
            try:
                result = remote_syscall(pid, number, *args)
            except BlockingIOError:
                continue
            except ProcessLookupError:
                return  # it was noticed at once, and that was its end
            assert result >= 0, os.strerror(-result)
            return
        raise AssertionError(f"{name} is never in a system call")

    return deed


def rename_a_worker(victim: Victim) -> None:
    """To the beginning of its program's file name."""
    maps = Path(f"/proc/{named(victim, 'member')}/maps").read_text()
    call("member", PRCTL, PR_SET_NAME, int(maps.split("-")[0], 16))(victim)


def kill_a_command(victim: Victim) -> None:
    while True:
        # There is none between two.
        for command in members(victim)[1:]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(command.pid, signal.SIGKILL)
                return


def take_the_terminal(victim: Victim) -> None:
    call("leader", IOCTL, fds(named(victim, "leader"), "/dev/pts")[0], TIOCNOTTY)(victim)


DEEDS: dict[str, tuple[str, Callable[[Victim], None], str]] = {
    "killed worker": ("tree 8", kill_a_worker, r"child \d+: code 2, status 9|child \d+, status 9|SIGCHLD|channel"),
    "stopped worker": ("tree 8", stop_a_worker, r"child \d+: code 5|status 137f|SIGCHLD with code 5"),
    "killed parent": ("tree 8 --reaper", kill_a_parent, "child|SIGCHLD|channel"),
    "bytes lost from a pipe": ("tree 8", read_from_a_pipe, r"channel \d+: record \d+ is"),
    "bytes too many in a pipe": ("tree 8", write_into_a_pipe, r"channel \d+: record \d+ is 0"),
    "a token too many": ("tree 8", take_a_token, r"tokens are out"),
    "file offset": ("tree 8", move_the_offset, "the file's offset|the file's word"),
    "counter behind the lock": ("tree 8", lambda v: change_shared_memory(v, 40), "kept nobody out"),
    "sum of laps": ("tree 8", lambda v: change_shared_memory(v, 56), "the slots hold"),
    "one slot": ("tree 8", lambda v: change_shared_memory(v, 80), "slot 0 holds|the slots hold"),
    "reaped zombie": ("tree 8", call("zombies", WAIT4, -1, 0, 0, 0), "zombie|children"),
    "foreign child": (
        "tree 8",
        call("main", CLONE, signal.SIGCHLD, NO_STACK),
        "no child of mine|not my child|SIGCHLD|waitpid: child",
    ),
    "foreign clone": (
        "tree 8",
        # No signal at its end: only a wait for clones finds it.
        call("main", CLONE, 0, NO_STACK),
        "wait for clones|no child of mine|not my child",
    ),
    "process group": ("tree 8", call("plain", SETPGID, 0, 0), "my process group was|: group"),
    "session": ("tree 8", call("plain", SETSID), "my process group was|my session was|: group"),
    "name": ("tree 8", rename_a_worker, "my name was"),
    "status of a child": (
        "churn 4 --life-ms 2000",
        quit_a_child,
        "code [23], status 3",
    ),
    "child nobody knows": ("churn 2", call("main", CLONE, signal.SIGCHLD, NO_STACK), "no child of mine|not my child"),
    "killed command": (
        "commands --gate",
        kill_a_command,
        "was killed by signal 9",
    ),
    "no terminal": (
        "terminal",
        take_the_terminal,
        "the group in the foreground|the terminal's session|tcsetpgrp|status 1$",
    ),
    "continued": (
        "terminal --stopped",
        lambda v: os.kill(next(m.pid for m in members(v) if m.state == "T"), signal.SIGCONT),
        "somebody has continued",
    ),
}


@SHARED
@pytest.mark.parametrize(("command", "deed", "complaint"), DEEDS.values(), ids=DEEDS.keys())
def test_a_fault_is_noticed(command: str, deed: Callable[[Victim], None], complaint: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim:
        victim.wait_beats(1 if "--gate" not in command else 0)
        deed(victim)
        deadline = time.monotonic() + 30
        again = time.monotonic() + 10
        while not victim.see().violations:
            assert time.monotonic() < deadline, f"no violation; it says {victim.said}"
            time.sleep(0.02)
            if time.monotonic() > again and not victim.see().violations:
                # It came at a moment at which it changed nothing.
                again = time.monotonic() + 10
                with contextlib.suppress(OSError, AssertionError):
                    deed(victim)
            if deed is quit_a_child and not victim.see().violations:
                deed(victim)  # the last one may have been at its end anyway
        assert re.search(rf"VIOLATION: .*({complaint})", victim.said, re.M), victim.said


def test_a_worker_with_foreign_memory_says_so(tmp_path: Path) -> None:
    with Victim("prefork 2 20", tmp_path) as victim:
        worker = named(victim, "worker")
        maps = Path(f"/proc/{worker}/smaps").read_text()
        found = re.search(r"^([0-9a-f]+)-\S+ rw-p 00000000 00:00 0 *\nSize: +204\d\d kB", maps, re.M)
        assert found, maps
        with open(f"/proc/{worker}/mem", "r+b", buffering=0) as memory:
            for page in range(0, 5120, 2):
                memory.seek(int(found[1], 16) + 4096 * page)
                memory.write(b"\x5a" * 8)
        wait_until(lambda: "holds 5a5a" in victim.said, 30, "a violation")


def test_the_end_of_a_pipe_that_somebody_holds_open(tmp_path: Path) -> None:
    """As a template with an ended command's descriptors would do to a shell."""
    with Victim("commands --gate", tmp_path) as victim:
        wait_until(lambda: victim.see().counter[3] == 1, 10, "a command")
        command = wait_until(lambda: members(victim)[1:], 10, "its process")[0]
        stdout = os.readlink(f"/proc/{victim.app}/fd/1")
        wait_until(lambda: os.readlink(f"/proc/{command.pid}/fd/1") != stdout, 10, "the pipe in its place")
        held = os.open(f"/proc/{command.pid}/fd/1", os.O_WRONLY)
        victim.board.set_counter(8, 1)
        wait_until(lambda: not Path(f"/proc/{command.pid}/exe").exists(), 10, "its end")
        time.sleep(0.3)
        assert victim.see().counter[0] == 0
        os.close(held)
        wait_until(lambda: victim.see().counter[0] == 1, 10, "the end of the pipe")
        assert victim.see().violations == 0


def test_status_of_a_violation(tmp_path: Path) -> None:
    """A main process's is the container's status; a child's is on the board."""
    with Victim("tree 8", tmp_path) as victim:
        move_the_offset(victim)
        wait_until(lambda: victim.see().violations > 0, 10, "a violation")
        assert victim.end(40) == VIOLATION_STATUS
