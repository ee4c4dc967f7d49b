# SPDX-License-Identifier: Apache-2.0
"""Descriptors after a restore: those of the checkpoint, whatever was done to them since."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from avckpt.guard import Files, Tcp

from testkit.family import ours
from testkit.guarded import (
    PATIENCE_S,
    WHERE,
    GuardProcess,
    Victim,
    config,
    injected,
    kill_at_random,
    since_linux,
)
from testkit.harness import SLOWNESS, wait_until
from testkit.meddle import get_fd
from testkit.procfs import below
from testkit.scenario import KILLS, checkpoint, disturb, disturb_and_restore, restore_twice, restored, wait_looked


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    "scenario",
    [
        *("opened", "closed", "replaced", "deleted", "unnamed", "offset", "lost", "full"),
        *("content", "events", "semaphores", "timer", "epoll", "watched", "flags", "locks"),
    ],
)
def test_as_at_the_checkpoint(scenario: str, where: str, tmp_path: Path) -> None:
    """Many times from one generation, then from a later one: nothing is missing, and nothing is left over."""
    with (
        Victim(f"descriptors {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        for _ in range(2):
            checkpoint(guard)
            for _kill in range(KILLS):
                disturb(victim)
                event = restored(victim, guard)
                assert "error" not in event, event
            victim.wait_beats()
            if scenario == "timer":
                break  # it goes off once


@pytest.mark.parametrize("command", ["descriptors content", "sockets shut", "sockets messages"])
def test_a_question_that_a_signal_cuts_short_is_asked_again(command: str, tmp_path: Path) -> None:
    """The timer of the guard's deadline ticks: with a signal pending, poll(2) fails even if it is not to wait."""
    with Victim(f"{command} {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        guard.wait("attached")
        with injected(guard, "?poll,ppoll", "error=EINTR:when=1+2"):
            assert guard.checkpoint()["kind"] == "checkpoint"
            disturb(victim)
            assert "error" not in restored(victim, guard)


@pytest.mark.parametrize("where", WHERE)
def test_what_was_watched_since_is_forgotten_though_others_have_it(where: str, tmp_path: Path) -> None:
    """epoll forgets a description once no process has it open; here another process still has."""
    with (
        Victim(f"descriptors watched {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        for _kill in range(KILLS):
            disturb(victim)
            ours = get_fd(victim.player, victim.see().counter[3])
            event = restored(victim, guard)
            os.close(ours)
            assert "error" not in event, event


def test_a_device_that_is_opened_anew_is_told(tmp_path: Path) -> None:
    with Victim(f"descriptors device {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        error = restored(victim, guard)["error"]["detail"]
        assert "ptmx" in error
        assert "opened anew" in error
        assert "more)" not in error, "/dev/null is the same for everybody"


def test_a_file_that_is_gone_reads_as_empty_and_is_told(tmp_path: Path) -> None:
    with Victim(f"descriptors gone {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        event = restored(victim, guard)
        error = event["error"]["detail"]
        assert "gone (deleted)" in error
        assert "is not there any more" in error


def test_only_what_the_application_may_open_is_opened_again(tmp_path: Path) -> None:
    """The application's user is nobody, the guard's is root."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o755)
        with (
            Victim(f"descriptors revoked {folder}", tmp_path) as victim,
            GuardProcess(config(), [victim.pid]) as guard,
        ):
            checkpoint(guard)
            os.chmod(f"{folder}/revoked", 0o600)
            disturb(victim)
            error = restored(victim, guard)["error"]["detail"]
            assert "revoked" in error
            assert "cannot be opened again" in error or "is not there any more" in error
            assert "more)" not in error


@pytest.mark.shared_machine("how long a restore takes is looked at")
@pytest.mark.parametrize("where", WHERE)
def test_thousands_opened_since_are_closed(where: str, tmp_path: Path) -> None:
    """Without looking at each of them, which would take a second."""
    with (
        Victim(f"descriptors many {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        took_s = []
        for _ in range(KILLS):
            disturb(victim)
            event = restored(victim, guard)
            assert "error" not in event, event
            took_s.append(event["restore_s"])
        assert min(took_s) < 0.3 * SLOWNESS


def test_offsets_stay_with_keep(tmp_path: Path) -> None:
    with (
        Victim(f"descriptors keep {tmp_path}", tmp_path) as victim,
        GuardProcess(config(files=Files.KEEP), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        for _ in range(3):
            disturb(victim)
            restored(victim, guard)


def test_strict_does_not_restore_over_a_written_file(tmp_path: Path, memory: Path) -> None:
    with (
        Victim(f"descriptors strict {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        time.sleep(0.05)
        checkpoint(guard)
        victim.kill_app(signal.SIGUSR1)
        time.sleep(0.1)
        answer = guard.command("restore")
        assert answer["kind"] == "refused", answer
        assert "data was written since the checkpoint" in str(answer["error"])
        assert victim.popen.poll() is None
        victim.kill_app()
        gave_up = guard.wait("gave_up")
        assert "avckpt.files=strict" in str(gave_up["error"])
        assert "data was written since the checkpoint" in str(gave_up["error"])
        assert victim.end() == 128 + signal.SIGKILL


def test_strict_restores_when_nothing_was_written(tmp_path: Path, memory: Path) -> None:
    with (
        Victim(f"descriptors quiet {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        time.sleep(0.05)
        for n in range(1, 4):
            # Where there was no time for a holder after a restore, what is mapped is not known.
            checkpoint(guard)
            victim.kill_app()
            guard.wait("restored", count=n)
            time.sleep(0.05)
        assert victim.popen.poll() is None


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ("closed", "was written since the checkpoint"),
        ("child", "was written since the checkpoint"),
        ("mapped", "mapped for writing was written"),
        ("late", "is mapped for writing"),
        ("read", ""),
        ("same", ""),
    ],
)
def test_strict_sees_files_that_are_not_open(how: str, why: str, tmp_path: Path, memory: Path) -> None:
    """A file that is opened, written and closed, and one that is written through a mapping."""
    with (
        Victim(f"scribe {how} {tmp_path}/data", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        time.sleep(0.05)
        # The older of two knows as little of it as the newer.
        checkpoint(guard)
        checkpoint(guard)
        # Nothing was written yet.
        victim.kill_app()
        guard.wait("restored")
        wait_until(lambda: ours(victim, "avckpt-hold"), PATIENCE_S, "without a holder what is mapped is not known")
        victim.kill_app(signal.SIGUSR1)
        wait_until(lambda: victim.see().counter[0] == 1, 10, "it has done it")
        since = guard.mark()
        victim.kill_app()
        if why:
            gave_up = guard.wait("gave_up", since=since)
            assert "avckpt.files=strict" in str(gave_up["error"])
            assert why in str(gave_up["error"])
        else:
            guard.wait("restored", since=since)
            victim.wait_beats()


@pytest.mark.parametrize("name", ["developer", "system", "processed"])
def test_a_volume_whose_name_begins_like_that_of_devices(name: str, memory: Path) -> None:
    with tempfile.TemporaryDirectory(prefix=f"{name}-", dir="/") as folder:
        subprocess.run(["mount", "-t", "tmpfs", "avckpt-test", folder], check=True)
        try:
            with (
                Victim(f"scribe closed {folder}/data", memory) as victim,
                GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
            ):
                checkpoint(guard)
                victim.kill_app(signal.SIGUSR1)
                wait_until(lambda: victim.see().counter[0] == 1, 10, "it has done it")
                victim.kill_app()
                assert "was written since the checkpoint" in str(guard.wait("gave_up")["error"])
        finally:
            subprocess.run(["umount", "-l", folder], check=True)


class Client:
    """One connection to tests/victims/tcpecho."""

    def __init__(self, victim: Victim) -> None:
        self.socket = socket.create_connection(("127.0.0.1", victim.see().counter[1]), 5)
        self.stream = self.socket.makefile("rw")

    def ask(self, line: str) -> str:
        """The answer, without the newline."""
        self.stream.write(line + "\n")
        self.stream.flush()
        return self.stream.readline().rstrip("\n")

    def is_reset(self, patience_s: float = PATIENCE_S) -> bool:
        """True once the other side has reset it; False if nothing of the kind comes."""
        self.socket.settimeout(patience_s)
        try:
            return self.socket.recv(1) == b""
        except ConnectionResetError:
            return True
        except TimeoutError:
            return False


def test_connections_are_reset_on_demand(tmp_path: Path) -> None:
    with (
        Victim("tcpecho 0", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.RESET), [victim.pid]) as guard,
    ):
        client = Client(victim)
        assert client.ask("hello") == "1 hello"
        checkpoint(guard)
        for n in range(1, 4):
            victim.kill_app()
            guard.wait("restored", count=n)
            assert n > 1 or client.is_reset()
            assert Client(victim).ask("again") == "1 again"
        victim.check()


def test_only_connections_that_moved_are_reset(tmp_path: Path) -> None:
    with (
        Victim("tcpecho 0", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        still, moved = Client(victim), Client(victim)
        assert (still.ask("a"), moved.ask("b")) == ("1 a", "1 b")
        checkpoint(guard)
        late = Client(victim)
        assert (moved.ask("c"), late.ask("d")) == ("2 c", "1 d")
        victim.kill_app()
        guard.wait("restored")
        assert moved.is_reset()
        assert late.is_reset()
        assert still.ask("e") == "2 e"
        assert not still.is_reset(0.5)


def test_connections_go_on_on_demand(tmp_path: Path) -> None:
    with (
        Victim("tcpecho 0", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.KEEP), [victim.pid]) as guard,
    ):
        client = Client(victim)
        assert client.ask("a") == "1 a"
        checkpoint(guard)
        assert client.ask("b") == "2 b"
        victim.kill_app()
        guard.wait("restored")
        assert client.ask("c") == "2 c"


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["opened", "closed", "replaced", "content", "events", "epoll", "flags", "locks"])
def test_killed_at_random_moments(scenario: str, where: str, tmp_path: Path) -> None:
    """Before, during and after its changes and its checks; the guard keeps no descriptor of the application's."""
    rng = random.Random(scenario)
    with (
        Victim(f"descriptors {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        restored(victim, guard, looks=False)
        # All holders are there again, and the second generation.
        assert guard.checkpoint()["kind"] == "checkpoint"
        before = guard.fds()
        for n in range(40):
            if n % 10 == 9:
                disturb(victim)
                restored(victim, guard)
                assert guard.checkpoint()["kind"] == "checkpoint"
            victim.kill_app(signal.SIGUSR1)
            time.sleep(rng.choice((0.0, rng.uniform(0.0, 0.003))))
            event = restored(victim, guard, looks=False)
            assert "error" not in event, event
        disturb(victim)
        restored(victim, guard)
        # What is open for a moment, while the next holder is made; and what is made ahead when there is
        # time: the helper that will choose PIDs (a socket and a pidfd), and the spare (a pidfd).
        most = before.total() + 2 * (1 + len(below(victim.app))) + 3
        try:
            wait_until(lambda: guard.fds().total() <= most, 5, "no descriptor is left open")
        except TimeoutError as late:
            raise AssertionError(f"left open: {guard.fds() - before}") from late


@pytest.fixture
def other(memory: Path, tmp_path: Path) -> None:
    """A folder on another file system, where tests/victims/inotify looks for it."""
    (tmp_path / "other").symlink_to(memory)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["changed", "closed", "reused"])
@pytest.mark.usefixtures("other")
def test_watches(scenario: str, where: str, tmp_path: Path) -> None:
    """The watches of the checkpoint under the same numbers, without events caused by putting them back."""
    with (
        Victim(f"inotify {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


@pytest.fixture
def overlay(memory: Path, tmp_path: Path) -> Iterator[Path]:
    """A folder on an overlay, like a container's root; its upper folder is on a disk."""
    for name in ("lower", "upper", "work", "merged"):
        (tmp_path / name).mkdir()
    layers = f"lowerdir={tmp_path}/lower,upperdir={tmp_path}/upper,workdir={tmp_path}/work"
    subprocess.run(["mount", "-t", "overlay", "overlay", "-o", layers, tmp_path / "merged"], check=True)
    (tmp_path / "merged/other").symlink_to(memory)
    yield tmp_path / "merged"
    subprocess.run(["umount", tmp_path / "merged"], check=True)


@since_linux(6, 6, "an overlay says what is watched")
def test_watches_on_an_overlay(overlay: Path, memory: Path) -> None:
    """Its file handles cannot be opened."""
    with (
        Victim(f"inotify closed {overlay}", memory) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        for _kill in range(KILLS):
            disturb(victim)
            event = restored(victim, guard)
            assert "error" not in event, event


@pytest.mark.usefixtures("other")
def test_a_watched_file_that_is_gone_is_told(tmp_path: Path) -> None:
    with Victim(f"inotify gone {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        assert "not all of what it watched" in restored(victim, guard)["error"]["detail"]


@pytest.mark.shared_machine("once the PID was taken for seconds on a busy one, nobody knows by whom: the message tells")
@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["messages", "flight", "taken", "shut", "user", "pidfds", "child", "full"])
def test_sockets(scenario: str, where: str, tmp_path: Path) -> None:
    """Datagrams and records are queued again with their boundaries; a pidfd refers to the same process; a peer is of
    the user that it was, and not of the guard's."""
    with (
        Victim(f"sockets {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        disturb_and_restore(victim, guard)


def test_descriptors_on_their_way_are_told(tmp_path: Path) -> None:
    with Victim(f"sockets rights {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        victim.kill_app()
        assert "descriptors in flight" in guard.wait("restored")["error"]["detail"]


def test_what_is_put_back_is_not_sent_by_root(tmp_path: Path) -> None:
    with Victim(f"sockets senders {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        assert "senders of its contents are not known" in restored(victim, guard)["error"]["detail"]


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["unix", "datagrams", "rebound", "early", "options", "dropped", "family"])
def test_sockets_made_again(scenario: str, where: str, tmp_path: Path) -> None:
    """With their names and options; also sockets that the previous restore had made."""
    with (
        Victim(f"listeners {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        for _ in range(2):
            checkpoint(guard)
            for _kill in range(KILLS):
                disturb(victim)
                for _again in range(2):
                    event = restored(victim, guard)
                    assert "error" not in event, event


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    "scenario",
    [
        "connecting",
        "connecting-closed",
        "polled",
        "polled-closed",
        "unseen",
        "unseen-closed",
        "refused",
        "refused-closed",
    ],
)
def test_a_connect_under_way_comes_to_an_end(scenario: str, where: str, tmp_path: Path) -> None:
    """Also if its socket was connected since, or closed.  One that blocks is begun anew, with the same options; one
    that does not block ends with an error, or with a peer."""
    with (
        Victim(f"listeners {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        restore_twice(victim, guard)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("scenario", ["received", "received-half", "received-closed", "unread", "unread-half"])
def test_what_a_peer_sent_last(scenario: str, where: str, tmp_path: Path) -> None:
    """If some of it was read since, the connection ends with an error: without one, what was received before would
    count as all.  If nothing was read, all of it is there."""
    with (
        Victim(f"listeners {scenario} {tmp_path} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        restore_twice(victim, guard)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(("scenario", "name"), [("outside", "server"), ("outside-open", "server"), ("bus", "bus")])
def test_a_unix_server_outside(scenario: str, name: str, where: str, tmp_path: Path) -> None:
    """Its client hears that it may have more to say, also where it had closed the connection; a D-Bus is kept."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(tmp_path / name))
        server.listen()
        server.settimeout(5)
        with ThreadPoolExecutor() as pool:
            accepted = pool.submit(server.accept)
            accepted.add_done_callback(lambda accepted: accepted.result()[0].send(b"one "))
            with (
                Victim(f"listeners {scenario} {tmp_path} {where}", tmp_path) as victim,
                GuardProcess(config(), [victim.pid]) as guard,
            ):
                restore_twice(victim, guard)
            accepted.result()[0].close()


def test_a_message_whose_sender_has_ended_is_not_continued(tmp_path: Path) -> None:
    """One that was half read at the checkpoint, and more of it since."""
    with (
        Victim(f"listeners received-part {tmp_path}", tmp_path) as victim,
        GuardProcess(config(tcp=Tcp.MESSAGES), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        disturb(victim)
        event = restored(victim, guard)
        assert "error" not in event, event


def test_a_socket_that_is_just_being_bound(tmp_path: Path) -> None:
    """It has a name after the restore if and only if bind(2) had returned at the checkpoint."""
    with (
        Victim(f"listeners brief {tmp_path}", tmp_path) as victim,
        GuardProcess(config(0.005), [victim.pid]) as guard,
    ):
        kill_at_random(guard, victim, 100, (0.0, 0.02))
        victim.check()


def test_closed_by_workers_while_a_checkpoint_is_looked_through(tmp_path: Path) -> None:
    """The main process dies right after a freeze; its workers see this and close what they shared with it."""
    with (
        Victim(f"listeners deserted {tmp_path}", tmp_path) as victim,
        GuardProcess(config(0.005), [victim.pid]) as guard,
    ):
        kill_at_random(guard, victim, 100, (0.0, 0.02))
        victim.check()


def test_what_a_newer_generation_has_open_is_in_nobodys_way(tmp_path: Path) -> None:
    """A new worker took a port over between two checkpoints, and the older one is restored."""
    with Victim(f"listeners handed-over {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        older = checkpoint(guard)["generation"]
        for _ in range(3):
            before = victim.see().counter[1]
            disturb(victim)
            checkpoint(guard)
            event = guard.command("unhealthy")
            assert (event["kind"], event["generation"]) == ("restored", older), event
            assert "error" not in event, event
            wait_looked(victim, before)


def test_a_name_that_somebody_else_has_is_told(tmp_path: Path) -> None:
    """The other process keeps it."""
    with Victim(f"listeners taken {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        disturb(victim)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
            other.bind(str(tmp_path / "server"))
            other.listen()
            assert "its address is taken now" in restored(victim, guard)["error"]["detail"]
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
                client.connect(str(tmp_path / "server"))
