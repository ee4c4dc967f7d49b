# SPDX-License-Identifier: Apache-2.0
"""Applications that cannot be protected run as without avckpt, and the reason is reported."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config, since_linux
from testkit.harness import wait_until
from testkit.init_peer import Init
from testkit.procfs import children_of, comm_of, state_of

SHARED = pytest.mark.shared_machine("an application that does not stop in time is told another reason")

NETWORKS = since_linux(6, 11, "a namespace of a thread can be asked for")
DISPATCH = since_linux(6, 4, "what a thread dispatches can be asked for")


BWRAP = shutil.which("bwrap")


LONG_S = 8.0
"""It is tried 6.4 s after the first time, and after as long again."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("unsupported iouring", "io_uring"),
        ("unsupported ringonly", "io_uring"),
        ("unsupported aio", "kernel AIO (most programs do without: avckpt.io_uring=off)"),
        ("unsupported userfault", "userfaultfd"),
        ("unsupported nested", "a container in the container"),
        ("under hindering places adopted", "adopts orphans"),
        ("under no-sigprocmask idle 1 1", "may refuse rt_sigprocmask"),
        ("under no-sigreturn idle 1 1", "may refuse rt_sigreturn"),
        ("under kill-sigprocmask idle 1 1", "may kill it"),
        ("sandbox --kill", "may kill it"),
        ("sandbox --kill --in-child", "may kill it"),
        ("unsupported strict", "strict mode"),
        ("unsupported filter", "asks another process (SECCOMP_RET_USER_NOTIF)"),
        ("unsupported unfiltered-child", "has not the seccomp filters of the main one"),
        ("unsupported other-filter", "has other seccomp filters than the main one"),
        ("under hindering tree 1", "forbids what restoring several processes takes"),
        ("unsupported groups", "other supplementary groups"),
        ("unsupported folder", "a working directory of its own"),
        ("unsupported files", "a descriptor table of its own"),
        pytest.param("unsupported network", "a namespace of its own (network)", marks=NETWORKS),
        ("unsupported bounds", "lacks CAP_SETPCAP"),
        ("unsupported locked", "which has locked its own"),
        ("unsupported locked-child", "which has locked its own"),
        ("unsupported rooted-child", "its parent has given up the right to chroot(2)"),
        ("unsupported user", "which has locked its own"),
        ("unsupported dropped", "which has given up the right to be that"),
        ("unsupported vfork", "executes no program (vfork)"),
        pytest.param("unsupported dispatch", "Syscall User Dispatch", marks=DISPATCH),
        pytest.param("unsupported dispatch --in-child", "Syscall User Dispatch", marks=DISPATCH),
        ("unsupported limited", "RLIMIT_AS"),
        ("unsupported limited --in-child", "RLIMIT_AS"),
        ("unsupported ring --in-child", "no other process can map: socket:"),
        ("unsupported secret --in-child", "no other process can map: /secretmem"),
        ("unsupported future --in-child", "no other process can map: /memfd:future"),
        ("unsupported stuck", "mseal"),
        ("unsupported vdso", "its parent has unmapped its own"),
    ],
)
def test_it_runs_unprotected_and_says_why(command: str, why: str, tmp_path: Path) -> None:
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        told = guard.wait("unprotected")
        assert told["error"]["kind"] == "unsupported"
        assert why in told["error"]["message"]
        since = guard.mark()
        time.sleep(0.3)
        # Once, not at every look.
        assert [e for e in guard.events[since:] if e["kind"] == "unprotected"] == []
        # One that does not stop in time is told another reason.
        wait_until(lambda: why in guard.command("checkpoint")["error"]["message"], PATIENCE_S, why)
        victim.wait_beats(20)
        wait_until(lambda: victim.others() == [], 5, "nothing is left in the container", every_s=0.001)
        victim.kill_app()
        # Nothing to restore from: the end is the app's own, and init does not wait.
        assert victim.end() == 128 + signal.SIGKILL


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        *(("iouring", "io_uring"), ("aio", "AIO"), ("aioinstead", "AIO"), ("userfault", "userfaultfd")),
        ("nested", "a container in the container"),
        ("strict", "strict mode"),
        pytest.param("dispatch", "Syscall User Dispatch", marks=DISPATCH),
        pytest.param("stuck", "mseal", marks=since_linux(6, 10, "mseal")),
    ],
)
def test_it_may_come_later(kind: str, why: str, tmp_path: Path) -> None:
    """The generations are dropped: the application can no longer be restored to them."""
    with Victim(f"unsupported {kind} signal", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        guard.wait("checkpoint")
        victim.kill_app(signal.SIGUSR1)
        assert why in guard.wait("unprotected")["error"]["message"]
        wait_until(lambda: victim.others() == [], 5, "nothing is left in the container", every_s=0.001)
        victim.wait_beats(20)


REFUSED = """
import ctypes, os, sys
ring = ctypes.CDLL(None).syscall(425, 4, ctypes.create_string_buffer(120))  # io_uring_setup(2); O_CLOEXEC
assert ring >= 0
os.read(0, 1)
os.execv("/bin/sleep", ["sleep", "1000"])
"""


def test_another_program_is_protected_at_once(tmp_path: Path) -> None:
    """However long the one before it has been refused, which is not tried more than once a minute then."""
    command = [sys.executable, "-S", "-c", REFUSED]
    with Init(command, pid1=True, stdin=subprocess.PIPE) as init, GuardProcess(config(0.2), [init.pid]) as guard:
        guard.wait("unprotected")
        time.sleep(LONG_S)
        assert init.popen.stdin is not None
        init.popen.stdin.write(b"x")
        init.popen.stdin.flush()
        guard.wait("checkpoint", timeout_s=LONG_S / 2)


# Waits for nothing, without end; for want of a C library its own.
NARROW = r"""
static int call(int nr, int a, int b, int c, int d)
{
	int r;

	__asm__ volatile("int $0x80" : "=a"(r) : "a"(nr), "b"(a), "c"(b), "d"(c), "S"(d) : "memory");
	return r;
}

void _start(void)
{
	char event[12];
	const int epoll_fd = call(329 /* epoll_create1 */, 0, 0, 0, 0);

	call(1 /* exit */, -call(256 /* epoll_wait */, epoll_fd, (int)event, 1, -1), 0, 0, 0);
}
"""


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="32-bit programs of x86-64")
def test_a_32_bit_program_is_not_even_stopped(tmp_path: Path) -> None:
    """Its interrupted calls are not repeated for it: it would get EINTR from each attempt."""
    source, program = tmp_path / "narrow.c", tmp_path / "narrow"
    source.write_text(NARROW)
    command = ["cc", "-m32", "-nostdlib", "-static", "-fno-pie", "-no-pie", "-fno-stack-protector", "-o"]
    if subprocess.run([*command, program, source], capture_output=True).returncode:
        pytest.skip("the compiler makes no 32-bit programs")
    with Init([program], pid1=True) as init, GuardProcess(config(0.05), [init.pid]) as guard:
        assert "32-bit" in guard.wait("unprotected")["error"]["message"]
        time.sleep(1)
        assert init.popen.poll() is None


def of_victim(victim: Victim, app: int) -> set[int]:
    """The processes of the application."""
    return {
        pid
        for pid in {app, *children_of(app), *children_of(victim.pid)}
        if state_of(pid) not in "ZX" and comm_of(pid) == "unsupported"
    }


def descriptors(pid: int) -> dict[str, str]:
    folder = f"/proc/{pid}/fd"
    return {number: os.readlink(f"{folder}/{number}") for number in os.listdir(folder)}


def test_a_table_that_two_children_share_and_their_parent_does_not(tmp_path: Path) -> None:
    """The end of one closes nothing of the other's."""
    with (
        Victim("unsupported siblings-files signal", tmp_path) as victim,
        GuardProcess(config(0.02), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint")
        app = victim.app
        os.kill(app, signal.SIGUSR1)
        wait_until(lambda: len(of_victim(victim, app)) == 3, 10, "all its processes are there")
        wait_until(lambda: victim.see().counter[0] == 1, 10, "they share it")
        told = guard.wait("unprotected")
        open_before = {pid: descriptors(pid) for pid in of_victim(victim, app)}
        os.kill(max(open_before, key=lambda pid: (pid != app, pid)), signal.SIGKILL)
        wait_until(lambda: len(of_victim(victim, app)) < 3, 10, "one has ended")
        guard.command("checkpoint")
        time.sleep(0.3)
        # Alone, one is protected again: there may be copies.
        left = open_before.keys() & of_victim(victim, app)
        assert left
        assert all(descriptors(pid) == open_before[pid] for pid in left)
        assert "shares its descriptor table" in told["error"]["message"]


@SHARED
@NETWORKS
def test_of_one_thread_and_not_for_long(tmp_path: Path) -> None:
    """One checkpoint is missed, and the generations stay valid."""
    with Victim("unsupported network signal 2", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        victim.kill_app(signal.SIGUSR1)
        wait_until(lambda: victim.see().counter[0] == 1, 5, "a thread is in a network of its own")
        answer = guard.command("checkpoint")
        assert answer["kind"] == "missed", answer
        assert "a namespace of its own (network)" in answer["error"]["message"]
        wait_until(lambda: victim.see().counter[0] == 0, 5, "it is back")
        assert guard.command("checkpoint")["generations"] == 2
        assert not [event for event in guard.events if event["kind"] == "unprotected"]


def test_a_tracer_of_its_own(tmp_path: Path) -> None:
    """A debugger was there first; protection comes back when it detaches."""
    with Victim("unsupported traced", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        app = guard.wait("attached")["app_pid"]
        told = guard.wait("unprotected")
        status = Path(f"/proc/{app}/status").read_text()
        tracer = int(status.split("TracerPid:")[1].split()[0])
        assert f"traced by process {tracer}" in told["error"]["message"]
        since = guard.mark()
        os.kill(tracer, signal.SIGKILL)
        guard.wait("checkpoint", since=since)
        victim.wait_beats(20)


@pytest.mark.skipif(not BWRAP, reason="no bubblewrap here")
@pytest.mark.parametrize("options", ["", "--unshare-pid", "--unshare-all"])
def test_a_sandbox_in_namespaces_of_its_own(options: str) -> None:
    """bubblewrap: the program in it has a mount namespace, and perhaps others."""
    command = [str(BWRAP), "--bind", "/", "/", *options.split(), "/bin/cat"]
    with (
        Init(command, pid1=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as init,
        GuardProcess(config(0.02), [init.pid]) as guard,
    ):
        assert "has a mnt namespace of its own" in guard.wait("unprotected")["error"]["message"]
        assert init.popen.stdin is not None
        assert init.popen.stdout is not None
        init.popen.stdin.write(b"it runs on\n")
        init.popen.stdin.flush()
        assert init.popen.stdout.readline() == b"it runs on\n"
        init.popen.stdin.close()
        assert init.popen.wait(PATIENCE_S) == 0


class Tracer:
    """strace of one thread, attached between two checkpoints."""

    def __init__(self, tid: int) -> None:
        self.process = self._start(tid)
        wait_until(lambda: self._traces(tid), 5, "strace traces it")

    @staticmethod
    def _start(tid: int) -> subprocess.Popen[bytes]:
        return subprocess.Popen(["strace", "-qq", "-o", "/dev/null", "-p", str(tid)], stderr=subprocess.DEVNULL)

    def _traces(self, tid: int) -> bool:
        if self.process.poll() is not None:  # a checkpoint was being taken
            self.process = self._start(tid)
        return f"TracerPid:\t{self.process.pid}\n" in Path(f"/proc/{tid}/status").read_text()

    def leave(self) -> None:
        """Detaches; the traced thread runs on."""
        self.process.terminate()
        self.process.wait()


@SHARED
@pytest.mark.skipif(not shutil.which("strace"), reason="strace is what traces the victim; it is not installed")
def test_a_tracer_from_outside(tmp_path: Path) -> None:
    """Checkpoints pause; generations from before serve for a crash after it has detached."""
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(0.02, keep=2), [victim.pid]) as guard:
        guard.wait("checkpoint", count=3)
        strace = Tracer(victim.app)
        since = guard.mark()
        for _ in range(5):
            missed = guard.wait("missed", since=since)
            assert missed["error"]["message"] == f"it is being traced by process {strace.process.pid} (strace)"
            assert missed["generations"] == 2
            since = guard.mark()
        strace.leave()
        victim.kill_app()
        guard.wait("restored", since=since)
        victim.wait_beats(20)
        assert not [event for event in guard.events if event["kind"] in ("unprotected", "dropped")]


def test_stopped_by_job_control(tmp_path: Path) -> None:
    """It stays stopped across checkpoints, is restored stopped, and continues on SIGCONT."""
    with Victim("threads 4 1", tmp_path) as victim, GuardProcess(config(0.02), [victim.pid]) as guard:
        guard.wait("checkpoint")
        os.kill(victim.app, signal.SIGSTOP)
        guard.wait("checkpoint", since=guard.mark(), count=3)
        beats = victim.see().beats
        for n in range(1, 4):
            guard.wait("checkpoint", since=guard.mark(), count=2)
            assert victim.see().beats == beats
            wait_until(lambda: is_stopped(victim.app), 5, "it is stopped")
            victim.kill_app()
            guard.wait("restored", count=n)
            wait_until(lambda: is_stopped(victim.app), 5, "it is stopped again")
        guard.wait("checkpoint", since=guard.mark(), count=2)
        assert victim.see().beats == beats
        os.kill(victim.app, signal.SIGCONT)
        victim.wait_beats(20)


def is_stopped(pid: int) -> bool:
    """Whether job control has stopped it; during a checkpoint it is in a ptrace stop, and runs injected code."""
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "T"


def test_another_program_takes_its_place(tmp_path: Path) -> None:
    """Repeatedly, at any moment: no thread is sent to an address that only the old program had."""
    with Victim("reexec 47", tmp_path) as victim, GuardProcess(config(0.004), [victim.pid]) as guard:
        guard.wait("checkpoint")
        wait_until(lambda: victim.see().counter[0] > 100 or victim.popen.poll() is not None, 30, "100 programs")
        assert victim.popen.poll() is None, [event for event in guard.events if event["kind"] == "died"]
        assert not [event for event in guard.events if event["kind"] == "died"]
        since = guard.mark()
        guard.wait("checkpoint", since=since, count=3)
