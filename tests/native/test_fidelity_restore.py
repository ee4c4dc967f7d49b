# SPDX-License-Identifier: Apache-2.0
"""A restored application is the same process to itself, to its peers, and to observers."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from avckpt.guard import Images, Tcp

from testkit.family import look
from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config, parasites
from testkit.harness import wait_until
from testkit.procfs import children_of, inside, state_of, threads

SHARED = pytest.mark.shared_machine("how far the application has come is taken for how long it has run")


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@SHARED
def test_one_generation_restored_many_times(tmp_path: Path) -> None:
    """Each time from the same image: no state leaks from one life into the next."""
    with Victim("threads 8 4", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        taken = guard.checkpoint()
        assert taken["kind"] == "checkpoint", taken
        names = threads(victim.app)
        laps = []
        for n in range(20):
            since = guard.mark()
            victim.kill_app(signal.SIGSEGV if n % 2 else signal.SIGKILL)
            restored = guard.wait("restored", since=since)
            assert restored["generation"] == taken["generation"]
            victim.wait_beats(1)
            laps.append(victim.see().counter[0])
            # The workers; who lives shortly may be there or not.
            assert {tid: name for tid, name in threads(victim.app).items() if tid <= 10} == {
                tid: name for tid, name in names.items() if tid <= 10
            }
            time.sleep(0.02)
        # Counted on, it would have grown twentyfold.
        assert max(laps[-5:]) < 2 * max(laps[:5]) + 200, laps
        victim.wait_beats(50)


@SHARED
def test_restore_on_command(tmp_path: Path) -> None:
    """A live application is rolled back, its counters included."""
    with Victim("busy 4", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.command("restore")["kind"] == "refused"
        guard.checkpoint()
        pid = inside(victim.app)
        # So long that the test looks again before it has counted as far once more.
        time.sleep(2)
        before = victim.see().counter[1]
        answer = guard.command("restore")
        assert (answer["kind"], answer["reason"]) == ("restored", "manual")
        wait_until(lambda: victim.see().counter[1] < before, 5, "it has gone back")
        assert inside(victim.app) == pid
        victim.wait_beats(20)


def test_names_in_the_process_list(tmp_path: Path) -> None:
    """Templates, spare and holder are named as such; the restored application has its own name."""
    forks = config(images=Images.FORK)
    with Victim("idle 1 5", tmp_path) as victim, GuardProcess(forks, [victim.pid]) as guard:
        before = threads(victim.app)
        command_line = Path(f"/proc/{victim.app}/cmdline").read_bytes()
        for _ in range(3):
            guard.checkpoint()

        def names() -> list[str]:
            # None: an old template, gone by now.
            return sorted(member.name for member in map(look, victim.others()) if member is not None)

        wanted = ["avckpt-hold", "avckpt-spare", "avckpt-tmpl", "avckpt-tmpl"]
        wait_until(lambda: names() == wanted, 5, "the first template has gone, and the last one has a spare")
        scores = [int(Path(f"/proc/{pid}/oom_score_adj").read_text()) for pid in victim.others()]
        # The oldest goes first; the newest one and its spare have the application's own.
        assert sorted(scores) == [0, 0, 0, 1000]
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        victim.wait_beats()
        assert threads(victim.app) == before
        assert Path(f"/proc/{victim.app}/cmdline").read_bytes() == command_line
        assert Path(f"/proc/{victim.app}/comm").read_text() == "idle\n"
        assert int(Path(f"/proc/{victim.app}/oom_score_adj").read_text()) == int(
            Path(f"/proc/{victim.pid}/oom_score_adj").read_text()
        )


def test_process_group_and_session_stay(tmp_path: Path) -> None:
    with Victim("idle 1 2", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:

        def groups() -> tuple[int, int]:
            status = Path(f"/proc/{victim.app}/status").read_text()
            lines = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
            return int(lines["NSpgid"].split()[-1]), int(lines["NSsid"].split()[-1])

        before = groups()
        guard.checkpoint()
        for _ in range(2):
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats()
            assert groups() == before


def test_a_template_that_is_killed_is_a_lost_generation(tmp_path: Path) -> None:
    """From inside the container, for example by a script that kills unknown processes."""
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        first = guard.checkpoint()
        guard.checkpoint()
        for pid in victim.others():
            os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not victim.others(), 5, "they are gone, and reaped")
        victim.wait_beats(20)
        third = guard.checkpoint()
        assert third["generation"] == first["generation"] + 2
        assert third["generations"] == 1
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since)
        victim.wait_beats(20)


def test_nothing_is_left_behind(tmp_path: Path) -> None:
    """No additional process, zombie, mapping or descriptor after many checkpoints and restores, and none at the end."""
    forks = config(images=Images.FORK)
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(forks, [victim.pid]) as guard:

        def counts() -> tuple[int, int, int]:
            return guard.fds().total(), parasites(victim.app), len(children_of(victim.pid))

        def cycle(restores: int) -> None:
            guard.burst(30)
            wait_until(lambda: len(victim.others()) == 4, 5, "two templates, a spare and the holder")
            for _ in range(restores):
                since = guard.mark()
                victim.kill_app()
                guard.wait("restored", since=since)
                victim.wait_beats(2)
                guard.burst(5)

        cycle(3)
        same = 0
        first = counts()
        while same < 50:  # the last spare is being made
            time.sleep(0.01)
            now = counts()
            same = same + 1 if now == first else 0
            first = now
        before = mappings(guard.pid)
        cycle(20)
        what = f"{first}: descriptors of the guard, parasites in the application, children of init"
        wait_until(lambda: counts() == first, PATIENCE_S, what)
        assert mappings(guard.pid) <= before + 2
        assert [state_of(pid) for pid in children_of(victim.pid)].count("Z") == 0
        guard.stop()
        wait_until(lambda: children_of(victim.pid) == [victim.app], 5, "templates and holder are gone")
        victim.wait_beats(20)


def mappings(pid: int) -> int:
    return len(Path(f"/proc/{pid}/maps").read_text().splitlines())


@pytest.fixture
def echo(tmp_path: Path) -> Iterator[tuple[Victim, GuardProcess, socket.socket]]:
    """tcpecho, its guard, and a connection to it."""
    with (
        Victim("tcpecho 0", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.KEEP), [victim.pid]) as guard,
    ):
        peer = socket.create_connection(("127.0.0.1", victim.see().counter[1]), PATIENCE_S)
        with contextlib.closing(peer):
            yield victim, guard, peer


def ask(peer: socket.socket, line: str) -> str:
    peer.sendall(line.encode() + b"\n")
    answer = b""
    while not answer.endswith(b"\n"):
        data = peer.recv(4096)
        assert data, "the connection is over"
        answer += data
    return answer.decode().rstrip()


def test_a_connection_goes_on(echo: tuple[Victim, GuardProcess, socket.socket]) -> None:
    victim, guard, peer = echo
    assert ask(peer, "one") == "1 one"
    guard.checkpoint()
    assert ask(peer, "two") == "2 two"
    for _ in range(10):
        since = guard.mark()
        victim.kill_app()
        # Asked while nobody is there: the kernel keeps the question.
        assert ask(peer, "again") == "2 again"  # it knows of one line, as of the checkpoint
        guard.wait("restored", since=since)
    assert ask(peer, "pid").endswith(f"pid {inside(victim.app)}")


def test_what_is_closed_after_a_checkpoint_is_closed(echo: tuple[Victim, GuardProcess, socket.socket]) -> None:
    """Although templates were made while it was open: the peer sees the end, and the port is free."""
    victim, guard, peer = echo
    port = victim.see().counter[1]
    for _ in range(3):
        assert guard.checkpoint()["kind"] == "checkpoint"
    assert ask(peer, "close") == "1 close"
    peer.settimeout(PATIENCE_S)
    assert peer.recv(1) == b""
    with socket.create_connection(("127.0.0.1", port), 5) as second:
        guard.checkpoint()
        assert ask(second, "listenclose") == "1 listenclose"
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), 1)
        with socket.socket() as taker:
            # Of connections that were accepted there the port is not free; for a listener it is.
            taker.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            taker.bind(("127.0.0.1", port))
            taker.listen()


def test_a_peer_sees_the_end_of_an_app_that_is_not_restored(tmp_path: Path) -> None:
    """Templates must not keep its connections open."""
    unsaved = config(restore_on_signal=False)
    with (
        Victim("tcpecho 0", tmp_path) as victim,
        GuardProcess(unsaved, [victim.pid]) as guard,
        socket.create_connection(("127.0.0.1", victim.see().counter[1]), 5) as peer,
    ):
        guard.checkpoint()
        victim.kill_app()
        assert guard.wait("gave_up")["reason"] == "policy"
        with contextlib.suppress(ConnectionResetError):
            assert peer.recv(1) == b""
        assert victim.end() == 128 + signal.SIGKILL


def test_an_exit_status_that_is_not_restored_is_inits(tmp_path: Path) -> None:
    only_signals = config(restore_on_exit=False)
    with Victim("crash", tmp_path) as victim, GuardProcess(only_signals, [victim.pid]) as guard:
        guard.checkpoint()
        victim.kill_app(signal.SIGUSR2)  # abort()
        assert guard.wait("restored")["wait_status"] & 0x7F == signal.SIGABRT
        victim.wait_beats()
        victim.kill_app(signal.SIGHUP)  # exit(3)
        assert guard.wait("gave_up")["reason"] == "policy"
        assert victim.end() == 3


def test_a_command_that_came_too_late_is_not_carried_out(tmp_path: Path) -> None:
    """Its sender was told that it failed."""
    with Victim("idle 1 1", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.checkpoint()
        app = victim.app
        os.kill(guard.pid, signal.SIGSTOP)
        begun = time.monotonic()
        tickets = [guard.say_command(name, within_s=0.1) for name in ("restore", "checkpoint")]
        wait_until(lambda: time.monotonic() > begun + 0.3, 5, "they are too late")
        os.kill(guard.pid, signal.SIGCONT)
        for ticket in tickets:
            answer = guard.wait_for(lambda event, ticket=ticket: event.get("ticket") == ticket, "an answer")  # type: ignore[misc]
            assert (answer["kind"], answer["error"]["kind"]) == ("refused", "deadline")
        assert guard.checkpoint()["generation"] == 2
        assert victim.app == app


def test_restores_are_used_up(tmp_path: Path) -> None:
    """The newest generation keeps crashing, then the one before it; then the application ends with its own status."""
    few = config(restore_max=2, restore_window_s=60.0)
    with Victim("crash", tmp_path) as victim, GuardProcess(few, [victim.pid]) as guard:
        first = guard.checkpoint()["generation"]
        second = guard.checkpoint()["generation"]
        used = []
        for _ in range(2):
            since = guard.mark()
            victim.kill_app()
            used.append(guard.wait("restored", since=since)["generation"])
            victim.wait_beats()
        assert used == [second, first]
        victim.kill_app()
        assert guard.wait("gave_up")["reason"] == "limit"
        assert victim.end() == 128 + signal.SIGKILL


def fork_beside(init: int) -> int:
    """The number that a process gets now in the PID namespace of `init`."""
    command = ["nsenter", "--pid", f"--target={init}", "sh", "-c", "echo $$"]
    return int(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)


@pytest.mark.shared_machine("init waits two seconds for its guard, which is stopped until somebody else has forked")
@pytest.mark.parametrize(("command", "of_child"), [("idle 1 4", False), ("tree 3", False), ("tree 3", True)])
def test_who_has_the_pid_is_told(command: str, of_child: bool, tmp_path: Path) -> None:
    """Somebody who takes it before the guard does."""
    # Again, while it is still the group of the others of the tree, which end by themselves.
    take = (
        "read number; until [ $! = $number ]; do kill $!; echo $((number - 1)) >/proc/sys/kernel/ns_last_pid; "
        "sleep 60 & done 2>/dev/null; echo $!; wait"
    )
    with Victim(command, tmp_path) as victim, GuardProcess(config(60), [victim.pid]) as guard:
        guard.checkpoint()
        dead = psutil.Process(children_of(victim.app)[-1] if of_child else victim.app)
        number = inside(dead.pid)
        thief = subprocess.Popen(
            ["nsenter", "--pid", f"--target={victim.pid}", "sh", "-c", take],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        assert thief.stdin is not None
        assert thief.stdout is not None
        try:
            os.kill(guard.pid, signal.SIGSTOP)
            victim.kill_app()
            wait_until(lambda: not dead.is_running(), 10, "init has reaped it")
            print(number, file=thief.stdin, flush=True)
            assert int(thief.stdout.readline()) == number
            (sleeping,) = (child for child in psutil.Process(thief.pid).children(True) if inside(child.pid) == number)
            wait_until(lambda: sleeping.name() == "sleep", 10, "the shell's child has called exec")
            os.kill(guard.pid, signal.SIGCONT)
            others = [fork_beside(victim.pid) for _ in range(20)]
            error = guard.wait("gave_up")["error"]["detail"]
        finally:
            os.kill(guard.pid, signal.SIGCONT)
            os.killpg(thief.pid, signal.SIGKILL)
            thief.wait()
        assert re.fullmatch(rf"PID {number} is taken by process \d+ \(sleep, state \w\)", error)
        # The guard tries again and again.  Between two tries the namespace's numbers continue from where they were:
        # those right after this one may be needed for others that are dead.
        assert len(set(others)) > len(others) / 2, others
