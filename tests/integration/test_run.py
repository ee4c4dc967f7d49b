# SPDX-License-Identifier: Apache-2.0
"""`avckpt run`: a plain program, protected, with no Podman and no sidecar."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from testkit.harness import Completed, avckpt_command, run, wait_until
from testkit.local_sidecar import app_of
from testkit.pipes import full_pipe
from testkit.procfs import children_of, comm_of, status_of

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="avckpt run needs root")
SHARED = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "a command is given a time to protect its program"
)

COUNTER = """
import sys, time
for i in range(10**9):
    print(i, flush=True)
    time.sleep(0.02)
"""


def avckpt_run(*args: str, stdin: str | None = None, wrapper: tuple[str, ...] = ()) -> Completed:
    return run([*wrapper, *avckpt_command(), "run", *args], check=False, stdin=stdin, timeout_s=30)


@dataclass
class Running:
    """A running `avckpt run`, with its standard error in a file."""

    process: subprocess.Popen[bytes]
    stderr: Path
    pids: list[int] = field(default_factory=list)

    @property
    def messages(self) -> str:
        return self.stderr.read_text()

    @property
    def init(self) -> int:
        """PID of avckpt-init, or of the process that is about to execute it; waits until it is there."""
        return wait_until(self._init, 10, "init is there", every_s=0.001)

    def _init(self) -> int:
        # The engine's probe has children, too, but in our own namespace.
        for pid in children_of(self.process.pid):
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                if len(Path(f"/proc/{pid}/status").read_text().partition("NSpid:")[2].split("\n")[0].split()) == 2:
                    return pid
        return 0

    @property
    def app(self) -> int:
        """The program's PID; waits until it is there."""
        return wait_until(lambda: app_of(self.init), 10, "the program is there")

    def wait_for(self, text: str, count: int = 1) -> None:
        wait_until(lambda: self.messages.count(text) >= count, 15, f"{text!r} in {self.messages!r}")


@pytest.fixture
def start(tmp_path: Path) -> Iterator[object]:
    """Starts `avckpt run ARGS`, output into the file `out`; everything is killed at the end."""
    started: list[Running] = []

    def start(*args: str) -> Running:
        with (tmp_path / "out").open("wb") as out, (tmp_path / "err").open("wb") as err:
            process = subprocess.Popen(
                [*avckpt_command(), "run", *args], stdin=subprocess.DEVNULL, stdout=out, stderr=err
            )
        started.append(Running(process, tmp_path / "err"))
        return started[-1]

    yield start
    for running in started:
        for pid in [*children_of(running.process.pid), *running.pids]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        running.process.kill()
        running.process.wait()


@SHARED
@pytest.mark.parametrize(
    ("script", "status"), [("exit 0", 0), ("exit 7", 7), ("kill -KILL $$", 137), ("kill -SEGV $$", 139)]
)
def test_the_exit_status_is_the_programs(script: str, status: int) -> None:
    assert avckpt_run("--", "sh", "-c", script).status == status


@pytest.mark.parametrize(("program", "status"), [("/nowhere/at/all", 127), ("/etc/passwd", 126)])
def test_a_program_that_can_not_be_started(program: str, status: int) -> None:
    done = avckpt_run("--", program)
    assert done.status == status
    assert program in done.stderr


def test_input_and_output_are_the_programs_own() -> None:
    done = avckpt_run("--", "sh", "-c", "cat; echo to stderr >&2", stdin="some\ninput")
    assert (done.status, done.stdout, done.stderr) == (0, "some\ninput", "to stderr\n")


def test_options_after_the_program_are_the_programs() -> None:
    done = avckpt_run("echo", "-v", "--label", "--help")
    assert done.stdout == "-v --label --help\n"


def test_it_lives_in_a_pid_namespace_with_its_own_proc() -> None:
    done = avckpt_run("--", "sh", "-c", "echo $$; cat /proc/1/comm; ls -d /proc/[0-9]* | wc -l")
    pid, init, count = done.stdout.split()
    assert (pid, init) == ("2", "avckpt-init")
    assert int(count) < 8
    assert Path("/proc/1/comm").read_text().strip() != "avckpt-init"


def test_its_mounts_are_its_own() -> None:
    """Also where mount propagation is shared, as systemd sets it up."""
    shared = ("unshare", "--mount", "--propagation", "shared", "sh", "-c", '"$@" && cat /proc/1/comm', "sh")
    done = avckpt_run("--", "cat", "/proc/1/comm", wrapper=shared)
    assert done.stdout.splitlines() == ["avckpt-init", Path("/proc/1/comm").read_text().strip()]


def test_no_descriptor_and_no_signal_setting_of_ours_leaks() -> None:
    script = "ls -l /proc/self/fd | wc -l; grep -E '^Sig(Blk|Ign)' /proc/self/status"
    bare = run(["sh", "-c", script])
    assert avckpt_run("--", "sh", "-c", script).stdout == bare.stdout


@pytest.mark.parametrize("closed", ["<&-", "2>&-", ">&- 2>&-", "<&- 2>&-", "<&- >&- 2>&-"])
def test_standard_descriptors_that_are_closed_are_so_for_the_program(closed: str, tmp_path: Path) -> None:
    def found(*wrapper: str) -> str:
        script = f"sleep 0.3; ls /proc/$$/fd > {tmp_path}/found; exit 5"
        done = run(["sh", "-c", f'"$@" {closed}', "sh", *wrapper, "sh", "-c", script], check=False, timeout_s=30)
        assert done.status == 5
        return (tmp_path / "found").read_text()

    avckpt = (*avckpt_command(), "run", "-v", "--label", "avckpt.interval=50ms", "--")
    assert found(*avckpt) == found()


def test_nohup_is_passed_on() -> None:
    done = avckpt_run(
        "--", "grep", "^SigIgn", "/proc/self/status", wrapper=("sh", "-c", 'trap "" HUP INT; exec "$@"', "sh")
    )
    ignored = int(done.stdout.split()[1], 16)
    assert ignored & 0b11 == 0b11  # SIGHUP is 1, SIGINT 2


ASYNC_IO = "import ctypes; c = ctypes.CDLL(None, use_errno=True); print(c.syscall({}, 0, 0), ctypes.get_errno())"


IO_SETUP = {"x86_64": 206, "aarch64": 0}[platform.machine()]


@pytest.mark.parametrize("number", [425, IO_SETUP], ids=["io_uring_setup", "io_setup"])
def test_io_uring_can_be_taken_away(number: int) -> None:
    """And kernel AIO, which programs fall back on."""
    python = ("--", sys.executable, "-c", ASYNC_IO.format(number))
    assert avckpt_run(*python).stdout.split()[1] != str(errno.ENOSYS)
    assert avckpt_run("--label", "avckpt.io_uring=off", *python).stdout == f"-1 {errno.ENOSYS}\n"


@pytest.mark.parametrize(
    "labels",
    [["avckpt.intervall=1s"], ["avckpt.interval=1"], ["app=web"], ["avckpt.enable=false"], ["avckpt.tcp=drop"]],
)
def test_wrong_labels_are_one_line_and_nothing_is_started(labels: list[str], tmp_path: Path) -> None:
    done = avckpt_run(*[word for label in labels for word in ("--label", label)], "--", "touch", str(tmp_path / "f"))
    assert done.status == 2
    assert done.stderr.startswith("avckpt: label ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "f").exists()


@pytest.mark.parametrize("missing", ["-sys_admin", "-sys_ptrace", "-sys_ptrace,-sys_admin"])
def test_without_privileges_nothing_is_started(missing: str, tmp_path: Path) -> None:
    drop = ("setpriv", f"--bounding-set={missing}", "--inh-caps=-all")
    done = avckpt_run("--", "touch", str(tmp_path / "f"), wrapper=drop)
    assert done.status == 125
    assert done.stderr.startswith("avckpt: touch was not started: ")
    assert "CAP_SYS_" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "f").exists()


def test_who_is_not_root_is_told_to_use_sudo() -> None:
    reach = ("--inh-caps=-all,+dac_read_search", "--ambient-caps=-all,+dac_read_search")  # of this checkout
    done = avckpt_run("--", "touch", "f", wrapper=("setpriv", "--reuid=65534", "--clear-groups", *reach))
    assert done.status == 125
    assert done.stderr.startswith("avckpt: touch was not started: this needs root: use sudo (")
    assert done.stderr.count("\n") == 1


def test_what_a_daemon_leaves_behind_is_told() -> None:
    done = avckpt_run("--", "sh", "-c", "setsid sleep 60 >&- 2>&- & exit 0")
    assert done.status == 0
    assert "what it left in the background ends with it" in done.stderr


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1, signal.SIGRTMIN + 1])
def test_signals_reach_the_program(signum: int, start, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    name = signum if signum > 31 else signal.Signals(signum).name[3:]
    running = start("--", "sh", "-c", f"trap 'echo got; exit 5' {name}; echo ready; while :; do sleep 0.05; done")
    wait_until(lambda: "ready" in (tmp_path / "out").read_text(), 10, "the program is ready")
    running.process.send_signal(signum)
    assert running.process.wait(10) == 5
    assert "got" in (tmp_path / "out").read_text()


def test_a_signal_that_comes_very_early_is_not_lost(start) -> None:  # type: ignore[no-untyped-def]
    """The kernel drops signals to a PID 1 that has no handler yet: avckpt must keep it until then."""
    for _ in range(5):
        running = start("--", "sleep", "60")
        assert running.init
        running.process.terminate()
        assert running.process.wait(10) == 128 + signal.SIGTERM


@SHARED
def test_messages_that_nobody_reads_hold_nothing_up() -> None:
    program = ("sh", "-c", "trap 'exit 5' TERM; echo ready; while :; do sleep 0.05; done")
    with full_pipe() as (_, writer):
        argv = [*avckpt_command(), "run", "-v", "--label", "avckpt.interval=50ms", "--", *program]
        with subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=writer) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == b"ready\n"
                process.terminate()
                assert process.wait(20) == 5
            finally:
                process.kill()


@SHARED
def test_a_killed_program_goes_on_where_it_was(start, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    running = start("-v", "--label", "avckpt.interval=100ms", "--", sys.executable, "-c", COUNTER)
    running.wait_for("protected: first checkpoint")
    out = tmp_path / "out"
    wait_until(lambda: len(out.read_text().split()) > 30, 10, "it counts")
    for kills, signum in enumerate((signal.SIGKILL, signal.SIGSEGV, signal.SIGKILL), 1):
        os.kill(running.app, signum)
        running.wait_for("restored in", kills)
        time.sleep(0.3)
    running.process.terminate()
    assert running.process.wait(10) == 128 + signal.SIGTERM
    numbers = [int(line) for line in out.read_text().split()]
    # It went back a little at each kill and never to the start.
    back = [(a, b) for a, b in zip(numbers, numbers[1:]) if b != a + 1]
    assert len(back) <= 3
    assert all(0 < b <= a + 1 and a - b < 20 for a, b in back), back
    assert running.messages.count("killed by SIGKILL, restored in") == 2
    assert running.messages.count("killed by SIGSEGV, restored in") == 1
    assert all(line.startswith("avckpt: ") for line in running.messages.splitlines())


@SHARED
def test_quiet_but_for_deaths_and_restores(start) -> None:  # type: ignore[no-untyped-def]
    running = start("--label", "avckpt.interval=50ms", "--", "sleep", "60")
    app = running.app
    time.sleep(1.5)
    assert running.messages == ""
    os.kill(app, signal.SIGKILL)
    running.wait_for("restored in")
    assert running.messages.startswith("avckpt: sleep: killed by SIGKILL, restored in ")
    assert running.messages.count("\n") == 1


def test_its_guard_has_a_seccomp_filter(start) -> None:  # type: ignore[no-untyped-def]
    running = start("-v", sys.executable, "-c", COUNTER)
    running.wait_for("protected: first checkpoint")
    guards = [pid for pid in children_of(running.process.pid) if comm_of(pid) == "avckpt-guard"]
    assert [status_of(pid)["Seccomp"] for pid in guards] == ["2"]


@SHARED
@pytest.mark.parametrize("restored", [False, True], ids=["as-started", "restored"])
def test_a_killed_avckpt_ends_the_program(restored: bool, start) -> None:  # type: ignore[no-untyped-def]
    """Otherwise it would run on unnoticed, with neither parent nor job by which to find it."""
    running = start("-v", "--label", "avckpt.interval=100ms", "--", sys.executable, "-c", COUNTER)
    running.wait_for("protected: first checkpoint")
    if restored:
        os.kill(running.app, signal.SIGKILL)
        running.wait_for("restored in")
    pidfds = [os.pidfd_open(pid) for pid in (running.init, running.app)]
    running.pids.append(running.init)
    running.process.kill()
    running.process.wait(10)
    for pidfd in pidfds:
        assert select.select([pidfd], [], [], 10)[0], "it has ended"
        os.close(pidfd)


@SHARED
@pytest.mark.parametrize("moment_s", [0.05 * n for n in range(12)])
def test_killed_at_any_time_it_leaves_nothing(moment_s: float, tmp_path: Path) -> None:
    mark = f"17{os.getpid()}{int(moment_s * 100):03}"
    process = subprocess.Popen([*avckpt_command(), "run", "--", "sleep", mark], cwd=tmp_path)
    time.sleep(moment_s)
    process.kill()
    process.wait(10)

    def left() -> list[int]:
        return [each.pid for each in psutil.process_iter(["cmdline"]) if mark in (each.info["cmdline"] or [])]

    wait_until(lambda: not left(), 10, "nothing of it is left")


class Terminal:
    """A session on a pseudo-terminal whose leader is a shell script."""

    def __init__(self, script: str) -> None:
        self.pid, self.fd = pty.fork()
        if self.pid == 0:
            os.execvp("bash", ["bash", "--norc", "-c", script])
        self.text = ""

    def wait_for(self, text: str, timeout_s: float = 10.0) -> None:
        deadline = time.monotonic() + timeout_s
        while text not in self.text:
            ready, _, _ = select.select([self.fd], [], [], max(deadline - time.monotonic(), 0))
            assert ready, f"no {text!r} in {self.text!r}"
            try:
                self.text += os.read(self.fd, 4096).decode()
            except OSError:
                raise AssertionError(f"no {text!r} in {self.text!r}, and it ended") from None

    def type(self, text: str) -> None:
        os.write(self.fd, text.encode())

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        os.close(self.fd)
        os.waitpid(self.pid, 0)


@pytest.fixture
def terminal() -> Iterator[object]:
    """`terminal(SCRIPT)` runs a bash script on a terminal of its own."""
    opened: list[Terminal] = []

    def open_terminal(script: str) -> Terminal:
        opened.append(Terminal(script))
        return opened[-1]

    yield open_terminal
    for one in opened:
        one.close()


RUN = " ".join([*avckpt_command(), "run", "-v"])


def test_the_program_has_the_terminal(terminal) -> None:  # type: ignore[no-untyped-def]
    program = "bash -c 'grep SigBlk /proc/self/status; read -p question: x; echo answer=$x; exit 4'"
    session = terminal(f"{RUN} -- {program}; echo status=$?; read y; echo y=$y")
    session.wait_for("question:")
    session.type("forty\n")
    session.wait_for("answer=forty")
    assert "SigBlk:\t0000000000000000" in session.text
    session.wait_for("status=4")
    # The script has its terminal back: it is not stopped when it reads.
    session.type("two\n")
    session.wait_for("y=two")


def test_control_c_is_the_programs(terminal) -> None:  # type: ignore[no-untyped-def]
    session = terminal(
        f"{RUN} -- bash -c 'trap \"echo caught; exit 6\" INT; echo ready; while :; do sleep 0.05; done'; echo status=$?"
    )
    session.wait_for("ready")
    session.type("\x03")
    session.wait_for("caught")
    session.wait_for("status=6")
    assert "SIGINT passed on" not in session.text  # once, from the terminal


@SHARED
def test_control_c_ends_a_plain_program_for_good(terminal) -> None:  # type: ignore[no-untyped-def]
    session = terminal(f"{RUN} --label avckpt.interval=50ms -- sleep 60; echo status=$?")
    session.wait_for("protected: first checkpoint")
    session.type("\x03")
    session.wait_for("status=130")
    assert "restored in" not in session.text


def test_control_z_does_not_lock_the_terminal(terminal) -> None:  # type: ignore[no-untyped-def]
    session = terminal(f"{RUN} -- bash -c 'echo ready; read x; echo got=$x'; echo status=$?")
    session.wait_for("ready")
    session.type("\x1a")
    session.type("on\n")
    session.wait_for("got=on")
    session.wait_for("status=0")


@SHARED
@pytest.mark.parametrize("how", ["fg", "bg; sleep 0.2; fg"])
def test_control_z_stops_it_as_a_job(how: str, terminal) -> None:  # type: ignore[no-untyped-def]
    program = "bash -c 'echo ready; while read x; do echo got=$x; done'"
    session = terminal(
        f"set -m; {RUN} --label avckpt.interval=50ms -- {program}; echo stopped=$?; read y; echo y=$y; {how}; "
        "echo status=$?"
    )
    session.wait_for("protected: first checkpoint")
    session.type("\x1a")
    session.wait_for(f"stopped={128 + signal.SIGTSTP}")
    # Now the terminal is the shell's.
    session.type("mine\n")
    session.wait_for("y=mine")
    session.type("yours\n")
    session.wait_for("got=yours")
    session.type("\x04")
    session.wait_for("status=0")


@SHARED
def test_the_terminal_comes_back_after_a_restore(terminal) -> None:  # type: ignore[no-untyped-def]
    session = terminal(
        f"{RUN} --label avckpt.interval=50ms -- bash -c 'while read -p ? x; do echo got=$x; done'; echo status=$?"
    )
    session.wait_for("protected: first checkpoint")
    session.type("kill -KILL $$\n")
    session.wait_for("got=kill")
    avckpt = children_of(session.pid)[0]
    os.kill(app_of(children_of(avckpt)[0]), signal.SIGKILL)
    session.wait_for("restored in")
    session.type("again\n")
    session.wait_for("got=again")
    session.type("\x04")
    session.wait_for("status=0")


@SHARED
def test_in_the_background_it_leaves_the_terminal_alone(terminal, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    # Only builtins while it runs: for a command the shell would take the terminal back.
    session = terminal(
        f"set -m; {RUN} -- sh -c 'touch {tmp_path}/on; sleep 2' & until [ -e {tmp_path}/on ]; do :; done; "
        "echo ready; read x; echo x=$x; wait %1; echo status=$?"
    )
    session.wait_for("ready")
    session.type("mine\n")
    session.wait_for("x=mine", timeout_s=1.5)
    session.wait_for("status=0")
