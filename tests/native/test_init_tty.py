# SPDX-License-Identifier: Apache-2.0
"""avckpt-init on a terminal: as session leader (what Podman's -t makes it) and under a shell's job control."""

from __future__ import annotations

import fcntl
import os
import select
import signal
import struct
import sys
import termios
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from testkit.harness import wait_until
from testkit.init_peer import INIT, PATIENCE_S, Guard, Init, Phoenix, Verdict
from testkit.procfs import children_of, state_of

pytestmark = pytest.mark.usefixtures("init_built", "victims_built")

PYTHON = os.path.realpath(sys.executable)
LONG_WAIT = ("--wait-ms", "60000")


@dataclass
class Terminal:
    master: int
    slave: int

    def take(self) -> None:
        """In the child: makes a new session with this as its controlling terminal."""
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    def type(self, keys: bytes) -> None:
        os.write(self.master, keys)

    def read_until(self, text: bytes, patience_s: float = 10) -> bytes:
        seen = b""
        deadline = time.monotonic() + patience_s
        while text not in seen:
            left = max(0.0, deadline - time.monotonic())
            assert select.select([self.master], [], [], left)[0], f"no {text!r} in {seen!r}"
            seen += os.read(self.master, 4096)
        return seen

    def close_slave(self) -> None:
        if self.slave >= 0:
            os.close(self.slave)
            self.slave = -1

    def hang_up(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            self.master = -1


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal(*os.openpty())
    yield made
    made.close_slave()
    made.hang_up()


@pytest.fixture
def init(terminal: Terminal) -> Iterator[Phoenix]:
    with Phoenix(options=LONG_WAIT, stdin=terminal.slave, preexec=terminal.take) as started:
        terminal.close_slave()
        yield started


def place(init: Phoenix) -> tuple[int, int, int]:
    """The app's PID, its process group, and the terminal's foreground group."""
    _, pid, group, foreground = init.app.ask("ping").split()
    return int(pid), int(group), int(foreground)


def listeners(init: Phoenix) -> list[int]:
    """The processes that the terminal's keys reach."""
    comms = {pid: Path(f"/proc/{pid}/comm") for pid in children_of(init.pid)}
    return [pid for pid, comm in comms.items() if comm.read_text() == "avckpt-keys\n"]


def test_app_leads_the_foreground_group(init: Phoenix) -> None:
    pid, group, foreground = place(init)
    assert pid == group == foreground != init.pid


@pytest.mark.parametrize(("key", "sig"), [(b"\x03", signal.SIGINT), (b"\x1c", signal.SIGQUIT)])
def test_keys_of_the_terminal_end_it_for_good(
    init: Phoenix, terminal: Terminal, key: bytes, sig: signal.Signals
) -> None:
    with Guard(init) as guard:
        place(init)
        terminal.type(key)
        assert init.end() == 128 + sig
        assert guard.report().flags == 1


def test_key_reaches_the_app_once(init: Phoenix, terminal: Terminal) -> None:
    assert init.app.ask("catch") == "caught"
    terminal.type(b"\x03")
    assert init.app.hear() == "signal 2 -1"
    assert init.app.is_silent(0.2)


@pytest.mark.parametrize("key", [b"\x03", b"\x1c"])
def test_who_ends_in_its_own_way_after_a_key_ends_for_good(init: Phoenix, terminal: Terminal, key: bytes) -> None:
    """Many programs exit with status 1 on Ctrl-C."""
    with Guard(init) as guard:
        assert init.app.ask("catch") == "caught"
        terminal.type(key)
        assert init.app.hear().startswith("signal")
        init.app.say("exit 1")
        assert init.end() == 1
        assert guard.report().flags == 1


def test_the_same_signal_from_a_process_is_no_key(init: Phoenix, terminal: Terminal) -> None:
    """Even from a process of its own group, as with `kill 0`."""
    with Guard(init) as guard:
        assert init.app.ask("catch") == "caught"
        os.killpg(place(init)[0], signal.SIGINT)
        assert init.app.hear().startswith("signal")
        init.app.say("exit 1")
        assert guard.report().flags == 0
        time.sleep(0.2)
        assert init.popen.poll() is None


def test_a_dead_apps_number_is_free_when_the_guard_hears(init: Phoenix, terminal: Terminal) -> None:
    """No process is left in its group; keys reach the restored application again."""
    with Guard(init) as guard:
        pid = place(init)[0]
        (listener,) = wait_until(lambda: listeners(init), PATIENCE_S, "a listener")
        os.kill(listener, signal.SIGSTOP)  # it may be stopped with its group, and still has to go
        init.app.say("die 11")
        guard.report()
        assert listeners(init) == []
        with pytest.raises(ProcessLookupError):
            os.killpg(pid, 0)
        init.spawn(pid)
        guard.answer(1, Verdict.RESTORED)
        init.go()
        assert init.app.ask("catch") == "caught"
        wait_until(lambda: len(listeners(init)) == 1, PATIENCE_S, "a listener of the restored one")
        terminal.type(b"\x03")
        assert init.app.hear().startswith("signal")
        init.app.say("exit 1")
        assert init.end() == 1


@pytest.mark.parametrize("status", [130, 131])
def test_shells_way_to_say_interrupted_is_final(init: Phoenix, terminal: Terminal, status: int) -> None:
    with Guard(init):
        init.app.say(f"exit {status}")
        assert init.end() == status


def test_same_statuses_without_a_terminal_are_not_final() -> None:
    with Phoenix(options=LONG_WAIT) as init, Guard(init) as guard:
        init.app.say("exit 130")
        assert guard.report().flags == 0
        time.sleep(0.2)
        assert init.popen.poll() is None


def test_crash_on_a_terminal_is_not_final(init: Phoenix, terminal: Terminal) -> None:
    with Guard(init) as guard:
        init.app.say("die 11")
        assert guard.report().flags == 0
        time.sleep(0.2)
        assert init.popen.poll() is None


def test_stop_key_does_not_stop_what_nobody_could_continue(init: Phoenix, terminal: Terminal) -> None:
    pid = place(init)[0]
    for _ in range(3):
        terminal.type(b"\x1a")
        terminal.read_until(b"^Z")  # echoed when the signal has been sent
        assert place(init)[0] == pid


def test_stopped_by_a_signal_it_stays_so(init: Phoenix, terminal: Terminal) -> None:
    """It was stopped on purpose."""
    pid = place(init)[0]
    os.kill(pid, signal.SIGSTOP)
    wait_until(lambda: state_of(pid) == "T", PATIENCE_S, "the stop")
    wait_until(lambda: state_of(init.pid) == "S", PATIENCE_S, "init to go on")
    assert state_of(pid) == "T"
    init.kill(signal.SIGCONT)
    assert place(init)[0] == pid


def test_window_size(init: Phoenix, terminal: Terminal) -> None:
    assert init.app.ask("catch") == "caught"
    fcntl.ioctl(terminal.master, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 100, 0, 0))
    assert init.app.hear() == f"signal {int(signal.SIGWINCH)} -1"
    assert init.app.is_silent(0.2)


def test_hang_up_is_final(init: Phoenix, terminal: Terminal) -> None:
    with Guard(init) as guard:
        place(init)
        terminal.hang_up()
        assert init.end() == 128 + signal.SIGHUP
        assert guard.ctl().stop_asked_ns > 0


def test_restored_app_has_the_terminal(init: Phoenix, terminal: Terminal) -> None:
    """The same number is not the same process group: without init's help the keys would go to the dead one."""
    with Guard(init) as guard:
        pid = place(init)[0]
        init.app.say("die 11")
        guard.report()
        init.spawn(pid)
        guard.answer(1, Verdict.RESTORED)
        init.go()
        assert place(init) == (pid, pid, pid)

        def ended_by_a_key() -> bool:
            terminal.type(b"\x03")  # init may not have read the verdict when the app runs already
            return init.popen.poll() is not None

        wait_until(ended_by_a_key, PATIENCE_S, "the end")
        assert init.end() == 128 + signal.SIGINT


def test_app_reads_from_the_terminal(terminal: Terminal) -> None:
    with Init(
        [PYTHON, "-c", "print('name?', flush=True); print('hello ' + input())"],
        stdin=terminal.slave,
        stdout=terminal.slave,
        stderr=terminal.slave,
        preexec=terminal.take,
    ) as init:
        terminal.close_slave()
        terminal.read_until(b"name?")
        terminal.type(b"you\n")
        terminal.read_until(b"hello you")
        assert init.end() == 0


@pytest.mark.shared_machine("a shell and what it starts are given a time")
def test_under_a_shells_job_control(terminal: Terminal) -> None:
    """Under a shell, init leads a foreground job and not the session; at the end the shell gets its terminal back."""
    pid = os.fork()
    if pid == 0:
        os.dup2(terminal.slave, 0)
        os.dup2(0, 1)
        os.dup2(0, 2)
        terminal.take()
        os.execvpe("bash", ["bash", "--norc", "--noprofile", "-i"], {**os.environ, "PS1": "$ ", "INIT": str(INIT)})
    terminal.close_slave()
    try:
        terminal.type(b"stty -echo\n")
        terminal.type(b"$INIT -- sh -c 'read x; echo got-$x; exit 5'; echo status-$?\n")
        time.sleep(0.5)
        terminal.type(b"line\n")
        terminal.read_until(b"status-5")
        terminal.type(b"$INIT -- sleep 60; echo status-$?\n")
        wait_until(lambda: any(children_of(child) for child in children_of(pid)), PATIENCE_S, "sleep")
        time.sleep(0.1)
        terminal.type(b"\x03")
        terminal.read_until(b"status-130")
        # In the background it must leave the terminal alone.
        terminal.type(b"$INIT -- sleep 2 &\necho still-$((40+2))\n")
        terminal.read_until(b"still-42")
        terminal.type(b"exit 0\n")
        deadline = time.monotonic() + 10
        while os.waitpid(pid, os.WNOHANG)[0] == 0:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        pid = 0
    finally:
        if pid:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
