# SPDX-License-Identifier: Apache-2.0
"""avckpt-init as a container's init: what users of `podman run --init` expect.

Real processes; `pid1` runs init as PID 1 of a PID namespace of its own.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from testkit.harness import wait_until
from testkit.init_peer import INIT, PATIENCE_S, Guard, Init, Phoenix
from testkit.pipes import full_pipe
from testkit.procfs import children_of, state_of

pytestmark = pytest.mark.usefixtures("init_built", "victims_built")
SHARED = pytest.mark.shared_machine("init, the application and a stand-in for the guard are given a time")

both = pytest.mark.parametrize("pid1", [False, True], ids=["child", "pid1"])
PYTHON = os.path.realpath(sys.executable)
NOBODY = 65534
FORWARDED = [n for n in range(1, 65) if n not in (signal.SIGKILL, signal.SIGSTOP, signal.SIGCHLD, 32, 33)]


@pytest.fixture
def public_init(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A copy of avckpt-init that every user may execute."""
    folder = Path(subprocess.check_output(["mktemp", "-d", "/tmp/avckpt-init-test.XXXXXX"], text=True).strip())
    folder.chmod(0o755)
    shutil.copy(INIT, folder / "avckpt-init")
    yield folder / "avckpt-init"
    shutil.rmtree(folder)


def be_nobody() -> None:
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)


# --- the app's start -------------------------------------------------------


@both
@pytest.mark.parametrize("status", [0, 1, 3, 127, 255])
def test_ends_with_the_exit_status_of_the_app(pid1: bool, status: int) -> None:
    with Init(["sh", "-c", f"exit {status}"], pid1=pid1) as init:
        assert init.end() == status
        assert init.error_text() == ""


@both
@pytest.mark.parametrize("sig", [signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT, signal.SIGTERM])
def test_ends_with_128_plus_the_signal_the_app_died_of(pid1: bool, sig: int) -> None:
    with Init(["sh", "-c", f"kill -{int(sig)} $$"], pid1=pid1) as init:
        assert init.end() == 128 + sig


def test_options_end_at_the_program_even_without_dashes() -> None:
    done = subprocess.run([INIT, "--wait-ms", "5", "sh", "-c", 'echo "$0 $1"', "--wait-ms", "x"], capture_output=True)
    assert (done.returncode, done.stdout) == (0, b"--wait-ms x\n")


def test_program_not_found() -> None:
    with Init(["no-such-program"]) as init:
        assert init.end() == 127
        assert init.error_text() == "avckpt-init: no-such-program: No such file or directory\n"


def test_nobody_waits_for_a_reader_of_its_messages() -> None:
    with full_pipe() as (_, writer), Init(["no-such-program"], stderr=writer) as init:
        assert init.end() == 127


@pytest.mark.parametrize("program", ["/etc/passwd", "/etc"])
def test_program_not_executable(program: str) -> None:
    with Init([program]) as init:
        assert init.end() == 126
        assert init.error_text() == f"avckpt-init: {program}: Permission denied\n"


@pytest.mark.parametrize("text", ["exit 0\n", "", "\x7fELF"])
@pytest.mark.parametrize("by_path", [False, True])
def test_no_shell_reads_what_is_no_program(text: str, by_path: bool, tmp_path: Path) -> None:
    """The runtime would not have run it, either."""
    script = tmp_path / "script"
    script.write_text(text)
    script.chmod(0o755)
    name = "script" if by_path else str(script)
    path = f"/nowhere:/etc/passwd:{tmp_path}:{os.environ['PATH']}"
    with Init([name], env={**os.environ, "PATH": path}) as init:
        assert init.end() == 126
        assert init.error_text() == f"avckpt-init: {name}: Exec format error\n"


@pytest.mark.parametrize(
    ("path", "status"), [("/nowhere:/bin", 0), ("", 127), (":/usr/bin", 0), (None, 0), ("/etc", 127)]
)
def test_programs_are_found_by_path(path: str | None, status: int) -> None:
    env = {key: value for key, value in os.environ.items() if key != "PATH"} | ({} if path is None else {"PATH": path})
    with Init(["true"], env=env) as init:
        assert init.end() == status


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["--"],
        ["--wait-ms"],
        ["--wait-ms", "x", "true"],
        ["--wait-ms", "-1", "true"],
        ["--stop-signal", "65", "true"],
        ["--x", "true"],
    ],
)
def test_wrong_usage(args: list[str]) -> None:
    done = subprocess.run([INIT, *args], capture_output=True, text=True)
    assert done.returncode == 125
    assert done.stderr.startswith("avckpt-init: usage: ")
    assert done.stderr.count("\n") == 1


def signals_of_child(setup: Callable[[], None], under_init: bool) -> str:
    # No shell in between: some put SIGCHLD right.
    argv = ["grep", "-E", "Sig(Blk|Ign|Cgt)", "/proc/self/status"]
    if under_init:
        argv = [str(INIT), "--", *argv]
    return subprocess.check_output(argv, text=True, preexec_fn=setup)


def odd_signal_state() -> None:
    for sig in (signal.SIGCHLD, signal.SIGPIPE, signal.SIGTTOU, 40):
        signal.signal(sig, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_SETMASK, {signal.SIGUSR2, signal.SIGTERM, 34, 64})


def normal_signal_state() -> None:
    for sig in set(range(1, 65)) - {signal.SIGKILL, signal.SIGSTOP, 32, 33}:
        signal.signal(sig, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, set())


@pytest.mark.parametrize("setup", [odd_signal_state, normal_signal_state])
def test_app_inherits_signal_mask_and_dispositions(setup: Callable[[], None]) -> None:
    assert signals_of_child(setup, True) == signals_of_child(setup, False)


@pytest.mark.parametrize("closed", [(), (0,), (1,), (0, 1), (0, 1, 2)], ids=str)
def test_app_has_exactly_the_inherited_descriptors(closed: tuple[int, ...], tmp_path: Path) -> None:
    extra_read, extra_write = os.pipe()
    listed = {}
    for kind, argv in (("init", [str(INIT), "--"]), ("plain", [])):
        out = tmp_path / kind
        script = f"import os; fds = os.listdir('/proc/self/fd'); open({str(out)!r}, 'w').write(repr(sorted(fds)))"

        def setup() -> None:
            for fd in closed:
                os.close(fd)

        subprocess.run([*argv, PYTHON, "-c", script], pass_fds=(extra_read,), preexec_fn=setup, check=True)
        listed[kind] = out.read_text()
    os.close(extra_read)
    os.close(extra_write)
    assert listed["init"] == listed["plain"]


@SHARED
def test_init_lets_go_of_what_the_app_inherited() -> None:
    """When the application closes a pipe, its reader sees the end although init lives."""
    read_end, write_end = os.pipe()
    script = f"import os, time; os.close({write_end}); os.close(1); time.sleep(60)"
    with Init([PYTHON, "-c", script], pass_fds=(write_end,)) as init:
        os.close(write_end)
        assert os.read(read_end, 1) == b""
        assert init.popen.stdout
        assert init.popen.stdout.read() == b""
        os.close(read_end)


@SHARED
@pytest.mark.parametrize("closed", [(0,), (0, 1), (0, 1, 2)], ids=str)
def test_protected_also_with_closed_stdio(closed: tuple[int, ...]) -> None:
    def setup() -> None:
        for fd in closed:
            os.close(fd)

    with Init(["sleep", "60"], stdin=None, stdout=None, stderr=None, preexec=setup) as init, Guard(init) as guard:
        ctl = guard.ctl()
        assert min(ctl.report_fd, ctl.verdict_fd) > 2
        init.kill(signal.SIGTERM)
        assert init.end() == 128 + signal.SIGTERM


def test_socket_activation_names_the_app() -> None:
    # The shell's exec keeps the PID, so that LISTEN_PID is init's as systemd would say it.
    argv = ["sh", "-c", f'LISTEN_FDS=1 LISTEN_PID=$$ exec {INIT} -- sh -c "echo \\$\\$ \\$LISTEN_PID"']
    pid, listen_pid = subprocess.check_output(argv, text=True).split()
    assert pid == listen_pid
    argv = ["sh", "-c", f'LISTEN_FDS=1 LISTEN_PID=1 exec {INIT} -- sh -c "echo \\$LISTEN_PID"']
    assert subprocess.check_output(argv, text=True) == "1\n"


# --- the app comes first ---------------------------------------------------


@pytest.mark.parametrize("limit", range(4, 16))
def test_app_runs_however_few_descriptors_there_are(limit: int) -> None:
    done = subprocess.run(
        [INIT, "--", "sh", "-c", "exit 7"],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (limit, limit)),
    )
    assert done.returncode == 7
    if limit < 11:
        assert done.stderr.endswith("Too many open files; sh runs unprotected\n")
        assert done.stderr.count("\n") == 1
    else:
        assert done.stderr == ""


def test_app_runs_when_init_can_open_nothing_at_all() -> None:
    # A statically linked app needs no descriptor to start: an init that is used wrongly says so.
    done = subprocess.run(
        [INIT, "--", INIT, "--nonsense"],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3)),
    )
    first, second = done.stderr.splitlines()
    assert first == f"avckpt-init: signalfd: Too many open files; {INIT} runs without an init"
    assert second.startswith("avckpt-init: usage: ")


def test_app_runs_when_init_can_not_fork(public_init: Path) -> None:
    def setup() -> None:
        be_nobody()
        resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))

    argv = [str(public_init), "--", "/bin/sh", "-c", "exit 7"]
    done = subprocess.run(argv, capture_output=True, text=True, preexec_fn=setup)
    assert done.returncode == 7
    assert "runs without an init" in done.stderr


def test_unprotected_app_dies_as_under_any_init() -> None:
    with Init(
        ["sh", "-c", "kill -SEGV $$"],
        preexec=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (5, 5)),
    ) as init:
        assert init.end() == 128 + signal.SIGSEGV


@SHARED
def test_app_of_the_same_user_can_not_reach_the_guards_page(public_init: Path) -> None:
    script = "for f in 3 4 5 6 7 8; do cat /proc/$PPID/fd/$f; done 2>&1; ls /proc/$PPID/fd 2>&1; id -u; sleep 60"
    argv = [str(public_init), "--", "sh", "-c", script]
    popen = subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, preexec_fn=be_nobody)
    try:
        assert popen.stdout
        lines: list[str] = []
        while not lines or lines[-1] != f"{NOBODY}\n":
            lines.append(popen.stdout.readline())
        assert len(lines) == 8
        assert all("Permission denied" in line for line in lines[:-1]), lines
        # ... but it is there for root:
        links = [os.readlink(f"/proc/{popen.pid}/fd/{n}") for n in os.listdir(f"/proc/{popen.pid}/fd")]
        assert any("avckpt-ctl" in link for link in links)
    finally:
        popen.terminate()
        assert popen.wait(10) == 128 + signal.SIGTERM
        assert popen.stdout
        popen.stdout.close()


# --- signals ---------------------------------------------------------------


@SHARED
@both
def test_every_signal_reaches_the_app(pid1: bool) -> None:
    with Phoenix(pid1=pid1) as init:
        assert init.app.ask("catch") == "caught"
        for sig in FORWARDED:
            init.kill(sig)
            assert init.app.hear() == f"signal {sig} -1"
        for sig in (signal.SIGTERM, signal.SIGTERM):  # again and again
            init.kill(sig)
            assert init.app.hear() == f"signal {int(sig)} -1"


@SHARED
@both
@pytest.mark.parametrize("sig", [32, 33])
def test_signals_that_libc_keeps_for_itself_are_forwarded_too(pid1: bool, sig: int) -> None:
    with Init(["sleep", "60"], pid1=pid1) as init, Guard(init, armed=False):
        # Not os.kill: to PID 1 of a namespace below, too, the kernel delivers it only if blocked there.
        init.kill(sig)
        assert init.end() == 128 + sig


@SHARED
def test_queued_realtime_signals_keep_order_and_value() -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    with Phoenix() as init:
        assert init.app.ask("catch") == "caught"
        for value in range(1, 6):
            assert libc.sigqueue(init.pid, 40, ctypes.c_void_p(value)) == 0
        assert [init.app.hear() for _ in range(5)] == [f"signal 40 {value}" for value in range(1, 6)]


@SHARED
def test_signals_go_to_the_main_process_only() -> None:
    script = (
        "import os, signal, time\n"
        "name = 'child' if os.fork() == 0 else 'parent'\n"
        "signal.signal(signal.SIGUSR1, lambda *_: os.write(1, name.encode() + b'\\n'))\n"
        "os.write(1, b'ready\\n')\n"
        "time.sleep(60)\n"
    )
    with Init([PYTHON, "-c", script]) as init:
        out = init.popen.stdout
        assert out
        assert [out.readline(), out.readline()] == [b"ready\n", b"ready\n"]
        init.kill(signal.SIGUSR1)
        assert out.readline() == b"parent\n"
        time.sleep(0.1)
        os.set_blocking(out.fileno(), False)
        assert not out.read()


@SHARED
def test_sigchld_is_not_forwarded() -> None:
    script = (
        "import signal\n"
        "both = {signal.SIGCHLD, signal.SIGUSR1}\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, both)\n"
        "print('ready', flush=True)\n"
        "while True: print(signal.sigwait(both).name, flush=True)\n"
    )
    with Init([PYTHON, "-c", script]) as init:
        out = init.popen.stdout
        assert out
        assert out.readline() == b"ready\n"
        init.kill(signal.SIGCHLD)
        time.sleep(0.1)
        init.kill(signal.SIGUSR1)
        assert out.readline() == b"SIGUSR1\n"


@SHARED
def test_the_app_signalling_its_own_group_hears_it_once() -> None:
    script = (
        "import os, signal\n"
        "usr1 = {signal.SIGUSR1}\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, usr1)\n"
        "for _ in range(20):\n"
        "    os.kill(0, signal.SIGUSR1)\n"
        "    while signal.sigtimedwait(usr1, 0.02): print('heard')\n"
    )
    # A session of its own, or a broken init would take the test down with it.
    with Init([PYTHON, "-c", script], preexec=os.setsid) as init:
        assert init.end() == 0
        assert init.output() == "heard\n" * 20


@SHARED
@both
def test_stopped_and_continued_app_goes_on(pid1: bool) -> None:
    with Phoenix(pid1=pid1) as init:
        app_pid = init.app_pid()
        host_pid = next(pid for pid in children_of(init.pid) if pid == app_pid or pid1)
        os.kill(host_pid, signal.SIGSTOP)
        wait_until(lambda: state_of(host_pid) == "T", PATIENCE_S, "the stop")
        init.kill(signal.SIGCONT)
        wait_until(lambda: state_of(host_pid) == "S", PATIENCE_S, "going on")
        assert init.app_pid() == app_pid


@SHARED
@pytest.mark.parametrize("guarded", [True, False])
def test_init_sleeps_when_there_is_nothing_to_do(guarded: bool) -> None:
    with Phoenix() as init:
        init.app_pid()
        Guard(init).__exit__(None, None, None)  # has been there, and is gone again
        with Guard(init) if guarded else contextlib.nullcontext():

            def switches() -> str:
                return Path(f"/proc/{init.pid}/status").read_text().rpartition("\nvoluntary_ctxt_switches:")[2]

            time.sleep(0.1)
            before = switches()
            time.sleep(0.3)
            assert switches() == before
            assert state_of(init.pid) == "S"


# --- children --------------------------------------------------------------


@SHARED
@both
def test_orphans_are_reaped(pid1: bool) -> None:
    with Phoenix(pid1=pid1) as init:
        init.app_pid()
        family = set(children_of(init.pid))
        assert len(family) == 2
        init.app.say("orphans 1000")
        assert init.app.hear(patience_s=60) == "done"
        wait_until(lambda: set(children_of(init.pid)) == family, PATIENCE_S, "the orphans' end")
        assert init.app_pid() > 0


@SHARED
@both
def test_what_the_app_leaves_behind_ends_with_it(pid1: bool, tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    # A grandchild in a session of its own, which holds the fifo as long as it lives.
    orphan = "trap : TERM HUP INT; sleep 60 & while :; do wait; sleep 1; done"
    script = f"setsid sh -c '{orphan}' >{fifo} </dev/null 2>&1 & sleep 0.2; exit 5"
    with Init(["sh", "-c", script], pid1=pid1) as init:
        fd = os.open(fifo, os.O_RDONLY)
        assert init.end() == 5
        assert os.read(fd, 1) == b""
        os.close(fd)
        assert init.error_text() == ""


@both
def test_a_program_that_becomes_a_daemon_is_told_of(pid1: bool) -> None:
    daemon = "import os, time\nif os.fork(): os._exit(0)\nos.setsid()\ntime.sleep(60)"
    with Init([PYTHON, "-c", daemon], pid1=pid1) as init:
        assert init.end() == 0
        assert "and what it left in the background ends with it; a daemon has to be started in the foreground" in (
            init.error_text()
        )
