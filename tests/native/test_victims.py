# SPDX-License-Identifier: Apache-2.0
"""The victims by themselves: silent when nothing is wrong, loud when something is.

What finds faults in checkpoints must be right without any.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from testkit.board import MAGIC, UNAVAILABLE_STATUS, VIOLATION_STATUS, Board
from testkit.harness import SLOWNESS, wait_until
from testkit.init_peer import PATIENCE_S
from testkit.meddle import set_fpu_register

SHARED = pytest.mark.shared_machine(
    "a victim that looks at clocks, or runs for a second only, may get no CPU for as long"
)

Start = Callable[..., "subprocess.Popen[str]"]

TIMED = [
    *("epoll_wait", "epoll_pwait", "epoll_pwait2", "poll", "ppoll", "select", "pselect", "futex", "futex_abs"),
    *("nanosleep", "clock_nanosleep", "clock_nanosleep_abs", "accept", "recv", "sigtimedwait", "semtimedop"),
    *("io_getevents", "io_pgetevents", "ppoll_const", "select_const", "pselect_const", "accept_old", "connect"),
    *("read_socket", "readv", "preadv2", "recvmsg", "recvmmsg", "send", "write", "writev", "pwritev2", "sendmsg"),
    *("sendmmsg", "sendfile", "splice", "futex_waitv", "clock_nanosleep_tai", "mq_receive", "mq_send", "connect_tcp"),
]
WOKEN = [
    *(kind for kind in TIMED if not re.search("sleep|getevents|tcp", kind)),
    *("read", "semop", "msgrcv", "flock", "fcntl", "msgsnd", "futex_pi", "open", "eventfd", "inotify", "tee"),
]


@pytest.fixture
def board(tmp_path: Path) -> Iterator[Board]:
    with Board(tmp_path / "board") as made:
        yield made


@pytest.fixture
def start(victims_built: Path, board: Board) -> Iterator[Start]:
    """Starts a victim with the board; kills all that is left at the end."""
    started: list[subprocess.Popen[str]] = []

    def go(*command: str) -> subprocess.Popen[str]:
        program, *args = command
        victim = subprocess.Popen(
            [victims_built / program, *args, "--board", str(board.path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(victim)
        wait_until(lambda: board.see().ready == 1 or victim.poll() is not None, PATIENCE_S, "ready")
        return victim

    yield go
    for victim in started:
        victim.kill()
        victim.communicate()


@SHARED
@pytest.mark.parametrize(
    "command",
    [
        "idle 10 4",
        "idle 0 1 --beat-us 100",
        "busy 8",
        "threads 1 0",
        "threads 12 4",
        "threads 3 1 --no-churn",
        "fpu 3",
        "rseq 3",
        "signals 4",
        "signals 4 --pending",
        "pending 4",
        "timers",
        "sandbox",
        "attributes",
        "attributes --inherited",
        "alarm 20",
        "mappings",
        "mappings 0",
        "forker",
        "forker 0.2 0.3",
        "crash",
        "tcpecho 0",
        "unsupported iouring",
        "unsupported aio",
        "unsupported traced",
        "unsupported sysvshm 0.1 0.2",
        "unsupported sysvsem",
        "unsupported shared 0.1 0.2",
        "unsupported userfault",
    ],
)
def test_content_when_nothing_is_wrong(start: Start, board: Board, command: str) -> None:
    victim = start(*command.split(), "--seconds", "1")
    out, err = victim.communicate(timeout=20 * SLOWNESS)
    if victim.returncode == UNAVAILABLE_STATUS:
        pytest.skip(f"this machine has no such thing: {err.strip()}")
    seen = board.see()
    assert (victim.returncode, out, err) == (0, "ready\n", "")
    assert (seen.magic, seen.starts, seen.pid, seen.violations) == (MAGIC, 1, victim.pid, 0)
    assert seen.beats > 10
    assert seen.gap_ns > 0
    if command.split()[0] in ("busy", "threads", "fpu", "rseq", "signals", "mappings", "forker"):
        assert seen.counter[0] > 0


@pytest.mark.parametrize("kind", WOKEN)
def test_blocked_and_woken(start: Start, board: Board, kind: str) -> None:
    start("eintr", kind, "30")
    wait_until(lambda: board.see().counter[5] >= 5, PATIENCE_S, "wake-ups")
    assert board.see().counter[1] == 0


@SHARED
@pytest.mark.parametrize("kind", TIMED)
def test_blocked_until_the_timeout(start: Start, board: Board, kind: str) -> None:
    start("eintr", kind, "0.1", "--quiet")
    wait_until(lambda: board.see().counter[4] >= 3, PATIENCE_S, "timeouts")
    seen = board.see()
    assert seen.counter[1] == 0
    assert 99e6 < seen.counter[2] <= seen.counter[3] < 2e9


@pytest.mark.skipif(not shutil.which("strace"), reason="strace is what stops the victim; it is not installed")
def test_eintr_is_counted(start: Start, board: Board) -> None:
    """A ptrace stop makes epoll_wait fail with EINTR: this is what avckpt has to hide."""
    victim = start("eintr", "epoll_wait", "30", "--quiet")
    time.sleep(0.1)
    subprocess.run(["timeout", "0.3", "strace", "-qq", "-o", "/dev/null", "-p", str(victim.pid)])
    wait_until(lambda: board.see().counter[1] > 0, PATIENCE_S, "an EINTR")
    assert board.see().violations == board.see().counter[1]


# --- loud when something is wrong ------------------------------------------


def largest_writable(pid: int) -> tuple[int, int]:
    """Start and size of the largest private, writable, anonymous mapping that has pages."""
    best = (0, 0)
    for header, body in re.findall(
        r"^([0-9a-f]+-[0-9a-f]+ rw-p [^\n]*)\n(.*?)(?=^[0-9a-f]+-|\Z)",
        Path(f"/proc/{pid}/smaps").read_text(),
        re.MULTILINE | re.DOTALL,
    ):
        rss = re.search(r"Rss:\s+(\d+) kB", body)
        if rss and int(rss[1]) * 1024 > best[1] and "[stack]" not in header:
            best = (int(header.split("-")[0], 16), int(rss[1]) * 1024)
    return best


@pytest.mark.parametrize("command", ["busy 8", "threads 3 8", "idle 8 2"])
def test_foreign_memory_is_noticed(start: Start, board: Board, command: str) -> None:
    victim = start(*command.split())
    address, size = largest_writable(victim.pid)
    assert size >= 1 << 20
    # Old pages among new ones: what a torn image looks like. Only in the middle: the edges may be libc's.
    with open(f"/proc/{victim.pid}/mem", "r+b", buffering=0) as memory:
        for at in range(address + size // 4, address + size * 3 // 4, 8192):
            memory.seek(at)
            memory.write(b"\x5a" * 4096)
    _, err = victim.communicate(timeout=20 * SLOWNESS)
    assert victim.returncode == VIOLATION_STATUS
    assert err.startswith("VIOLATION: ")
    assert board.see().violations > 0


def meddle_until_noticed(victim: subprocess.Popen[str], deed: Callable[[], object]) -> str:
    """The victim's report.  A changed value may be overwritten before it is checked, so this tries more than once."""
    for _ in range(100):
        deed()
        with contextlib.suppress(subprocess.TimeoutExpired):
            victim.wait(0.5)
            break
    _, err = victim.communicate(timeout=10 * SLOWNESS)
    assert victim.returncode == VIOLATION_STATUS, err
    return err


@pytest.mark.skipif(not shutil.which("gdb"), reason="gdb is what changes the victim; it is not installed")
@pytest.mark.parametrize(
    ("command", "deed", "complaint"),
    [
        ("signals 1", "call (int)raise(10)", "not on the stack"),
        # A handler, not the default: the victim sends itself SIGHUP and would die of it without a word.
        ("signals 1", "call (void*)signal(1, on_usr1)", "SIGHUP is not ignored|the handler of 1 "),
        ("rseq 2", "set var counters[0] = counters[0] - 1", "counted"),
        ("threads 2 0", "thread 2|set var my_tag = 7", "thread-local storage"),
        ("mappings", "set var version = version + 1", "not of version"),
    ],
)
def test_foreign_state_is_noticed(start: Start, board: Board, command: str, deed: str, complaint: str) -> None:
    victim = start(*command.split())
    # The victim's own signals do not end a call.  gdb would leave the victim in it, or give it the SIGSEGV
    # by which the call comes back (to a stack that is not executable).
    argv = ["gdb", "-q", "-batch", "-p", str(victim.pid), "-ex", "handle all nostop noprint pass"]
    for step in deed.split("|"):
        argv += ["-ex", step]
    err = meddle_until_noticed(victim, lambda: subprocess.run(argv, capture_output=True, timeout=30))
    assert re.search(complaint, err), err
    assert board.see().violations > 0


@pytest.mark.parametrize(
    ("register", "value", "complaint"),
    [("xmm5", 1, "register 5 changed"), ("mxcsr", 0x1FC0, "MXCSR"), ("st3", 1 << 63, "st\\(")],
)
def test_foreign_registers_are_noticed(start: Start, board: Board, register: str, value: int, complaint: str) -> None:
    victim = start("fpu", "1")

    def deed() -> None:
        tid = max(int(task) for task in os.listdir(f"/proc/{victim.pid}/task"))
        with contextlib.suppress(ProcessLookupError):  # it has noticed already, and ends
            set_fpu_register(tid, register, value)

    assert re.search(complaint, meddle_until_noticed(victim, deed))
    assert board.see().violations > 0


def test_stop_and_continue_do_no_harm(start: Start, board: Board) -> None:
    commands = ("threads 6 2", "fpu 2", "rseq 2", "busy 2", "mappings", "signals 2 --pending")
    victims = [start(*command.split()) for command in commands]
    for _ in range(5):
        for victim in victims:
            victim.send_signal(signal.SIGSTOP)
            time.sleep(0.02)
            victim.send_signal(signal.SIGCONT)
    time.sleep(0.3)
    assert [victim.poll() for victim in victims] == [None] * len(victims)
    assert board.see().violations == 0


# --- the ones that are told what to do ---------------------------------------


@pytest.mark.parametrize(
    ("sig", "status"),
    [(signal.SIGUSR1, -signal.SIGSEGV), (signal.SIGUSR2, -signal.SIGABRT), (signal.SIGHUP, 3)],
)
def test_crash_on_command(start: Start, board: Board, sig: signal.Signals, status: int) -> None:
    victim = start("crash")
    time.sleep(0.05)
    victim.send_signal(sig)
    assert victim.wait(10) == status


@pytest.mark.parametrize(
    ("how", "status"), [("segv", -11), ("abort", -6), ("exit", 3), ("fpe", -8), ("ill", -4), ("kill", -9)]
)
def test_crash_by_itself(start: Start, board: Board, how: str, status: int) -> None:
    victim = start("crash", how, "0.2")
    assert victim.wait(10) == status
    assert board.see().starts == 1
    assert start("crash", how, "0").wait(10) == status
    assert board.see().starts == 2


def test_echo_server(start: Start, board: Board, tmp_path: Path) -> None:
    victim = start("tcpecho", "0")
    port = board.see().counter[1]
    with (
        socket.create_connection(("127.0.0.1", port), 10) as one,
        socket.create_connection(("127.0.0.1", port), 10) as two,
    ):
        lines = one.makefile("rw")
        others = two.makefile("rw")

        def ask(line: str, over: object = lines) -> str:
            assert hasattr(over, "write")
            stream = lines if over is lines else others
            stream.write(line + "\n")
            stream.flush()
            return stream.readline().rstrip("\n")

        assert ask("hello") == "1 hello"
        assert ask("hello") == "2 hello"
        assert ask("there", others) == "1 there"
        assert ask("pid") == f"3 pid {victim.pid}"
        assert ask(f"open {tmp_path}/file") == f"4 open {tmp_path}/file"
        assert ask("write some text") == "5 write some text"
        assert (tmp_path / "file").read_text() == "some text\n"
        assert ask("fclose") == "6 fclose"
        assert not [fd for fd in os.listdir(f"/proc/{victim.pid}/fd") if str(tmp_path / "file") == link(victim.pid, fd)]
        assert ask("listenclose") == "7 listenclose"
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), 10)
        assert ask("close") == "8 close"
        assert lines.readline() == ""
        assert ask("still here", others) == "2 still here"
    wait_until(lambda: board.see().counter[0] == 10, PATIENCE_S, "ten lines")  # they are counted after the answer


def link(pid: int, fd: str) -> str:
    try:
        return os.readlink(f"/proc/{pid}/fd/{fd}")
    except FileNotFoundError:
        return ""
