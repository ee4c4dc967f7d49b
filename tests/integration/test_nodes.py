# SPDX-License-Identifier: Apache-2.0
"""Nodes below a launcher, and units of the host: real avckpt-init processes, no Podman."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from avckpt.artifacts import init_binary

from testkit.harness import ROOT, avckpt_command, run, wait_until
from testkit.local_sidecar import LocalSidecar
from testkit.procfs import children_of, comm_of, inside

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root")
SHARED = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; the sidecar is given a time to protect"
)

INIT = str(init_binary())
COUNTER = """
import os, sys, time
for i in range(10**9):
    print("n", i, os.getpid(), os.getpgrp(), os.getsid(0), flush=True)
    time.sleep(0.02)
"""
COUNT = [sys.executable, "-c", COUNTER]
QUICK = ("--label", "avckpt.interval=100ms")
Json = dict[str, Any]


@pytest.fixture
def start(local: LocalSidecar, tmp_path: Path) -> Iterator[Any]:
    """Starts `avckpt-init ARGS` with its output in a file; everything is killed at the end."""
    started: list[subprocess.Popen[bytes]] = []

    def start(*args: str, preexec: Any = os.setsid, **env: str) -> subprocess.Popen[bytes]:
        with (tmp_path / f"{len(started)}.out").open("wb") as out, (tmp_path / f"{len(started)}.err").open("wb") as err:
            started.append(
                subprocess.Popen(
                    [INIT, *args],
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=err,
                    env={**os.environ, **local.env, **env},
                    preexec_fn=preexec,
                )
            )
        return started[-1]

    yield start
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.wait()


def row(local: LocalSidecar, name: str, **wanted: Any) -> Json:
    """A unit's row of `avckpt ps`, once it is in that state."""
    last: list[Json] = []

    def found() -> Json:
        last[:] = local.ps(ended=True)
        rows = [each for each in last if each["name"] == name and not each["ended_at"]]
        return next((each for each in rows if all(each[key] == value for key, value in wanted.items())), {})

    try:
        return wait_until(found, 20, f"{name} {wanted}", every_s=0.05)
    except TimeoutError as error:
        raise AssertionError(f"{error}: {last}; log:\n{local.log}") from None


def lines(path: Path) -> list[list[str]]:
    return [line.split()[1:] for line in path.read_text().splitlines() if line.startswith("n ")]


@SHARED
def test_a_unit_of_the_host_goes_on_in_place(local: LocalSidecar, start: Any, tmp_path: Path) -> None:
    process = start("--name", "counter", *QUICK, "--", *COUNT)
    before = row(local, "host/counter", state="protected")
    assert (before["node_of"], before["init_pid"], before["interval_s"]) == ("host", process.pid, 0.1)
    for restores in (1, 2):
        wait_until(lambda: row(local, "host/counter", state="protected")["generations"] == 2, 10, "two generations")
        os.kill(before["app_pid"], signal.SIGSEGV)
        assert row(local, "host/counter", restores=restores, state="protected")["app_pid"] == before["app_pid"]
    assert process.poll() is None
    seen = lines(tmp_path / "0.out")
    wait_until(lambda: len(lines(tmp_path / "0.out")) > len(seen) + 10, 10, "it goes on")
    # One process, in the group and session that it was started in: init's.
    assert {tuple(line[1:]) for line in lines(tmp_path / "0.out")} == {
        (str(before["app_pid"]), str(process.pid), str(process.pid))
    }
    assert [line[0] for line in seen].count("0") == 1
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == -signal.SIGTERM
    assert (tmp_path / "0.err").read_text() == ""


@SHARED
@pytest.mark.parametrize(
    ("script", "status"), [("exit 0", 0), ("exit 7", 7), ("kill -KILL $$", -9), ("kill -SEGV $$", -11)]
)
def test_a_unit_that_is_not_restored_ends_as_its_program(start: Any, script: str, status: int) -> None:
    # No checkpoint within the hour.
    process = start("--label", "avckpt.interval=1h", "--", "sh", "-c", f"sleep 0.3; {script}")
    assert process.wait(10) == status


@SHARED
def test_options_and_environment_are_labels(local: LocalSidecar, start: Any) -> None:
    start("--", "sleep", "1000", AVCKPT_INIT=INIT, AVCKPT_LABELS="avckpt.keep=4  avckpt.interval=200ms")
    assert (lambda r: (r["keep"], r["interval_s"]))(row(local, "host/sleep", state="protected")) == (4, 0.2)
    start("--label", "avckpt.keep=5", "--", "sleep", "1000", AVCKPT_LABELS="avckpt.keep=4 avckpt.interval=200ms")
    assert row(local, "host/sleep-2")["keep"] == 5


@SHARED
def test_what_is_refused_is_said_and_runs(local: LocalSidecar, start: Any, tmp_path: Path) -> None:
    process = start("--label", "avckpt.kepe=4", "--", "sh", "-c", "sleep 1; exit 5")
    assert process.wait(10) == 5
    assert (tmp_path / "0.err").read_text() == (
        "avckpt-init: sh runs unprotected: label avckpt.kepe: unknown label; did you mean avckpt.keep?\n"
    )
    assert local.ps() == []


@SHARED
def test_of_the_host_only_root_registers(local: LocalSidecar, start: Any, tmp_path: Path) -> None:
    def nobody() -> None:
        os.setsid()
        os.setgid(65534)
        os.setuid(65534)

    for path in (tmp_path, *tmp_path.parents):
        if path.stat().st_uid == 0 and path != Path("/tmp"):
            path.chmod(path.stat().st_mode | 0o011)
    process = start("--label", "avckpt.keep=4", "--", "sh", "-c", "sleep 1; exit 5", preexec=nobody)
    assert process.wait(10) == 5
    assert "of the host only root may" in (tmp_path / "0.err").read_text()
    assert local.ps() == []


FLOOD = """
import os, socket, sys
os.setgid(65534)
os.setuid(65534)
refused = 0
while refused < 2000:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        try:
            connection.connect(sys.argv[1])
            connection.send(b"nonsense")
            connection.recv(1000)
        except ConnectionError:
            pass
        refused += 1
"""


CLAIMS = """
import os, socket, struct, sys
rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", os.pidfd_open(os.getpid())))]
answers = set()
for _ in range(200):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.connect(sys.argv[1])
        connection.sendmsg([b"avckpt-unit 1\\0name=a\\0label=avckpt.kepe=1\\0"], rights)
        answers.add(connection.recv(1000).decode())
print(sorted(answers))
"""


@SHARED
def test_labels_of_a_node_are_read_as_often_as_it_may_register(local: LocalSidecar) -> None:
    """What reading them takes is up to the node."""
    path = str(local.run_dir / "units" / "units.sock")
    said = run([sys.executable, "-c", CLAIMS, path], timeout_s=60).stdout
    assert "no label avckpt.kepe: unknown label" in said
    assert "later too many units were started in too short a time" in said


@SHARED
def test_requests_of_anybody_fill_no_log(local: LocalSidecar, start: Any) -> None:
    """Nor do they keep others out."""
    for path in (local.run_dir, *local.run_dir.parents):
        if path.stat().st_uid == 0 and path != Path("/tmp"):
            path.chmod(path.stat().st_mode | 0o011)
    subprocess.run([sys.executable, "-c", FLOOD, str(local.run_dir / "units" / "units.sock")], check=True, timeout=60)
    assert 0 < local.log.count("refused a unit") < 30
    start("--name", "counter", *QUICK, "--", *COUNT)
    row(local, "host/counter", state="protected")


HOG = """
import os, select, socket, sys, time
poller, held = select.poll(), {}
while True:
    while len(held) < 20:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        connection.connect(sys.argv[1])
        held[connection.fileno()] = connection
        poller.register(connection, select.POLLIN)
    for fd, _ in poller.poll():
        poller.unregister(fd)
        held.pop(fd).close()
    time.sleep(0.01)
"""


@SHARED
def test_whoever_makes_namespaces_has_no_more_room_by_it(local: LocalSidecar, start: Any) -> None:
    path = str(local.run_dir / "units" / "units.sock")
    with contextlib.ExitStack() as hogs:
        for _ in range(6):
            command = ["unshare", "--pid", "--fork", "--kill-child", sys.executable, "-c", HOG, path]
            hogs.callback(hogs.enter_context(subprocess.Popen(command)).kill)
        time.sleep(1)
        for _ in range(3):
            start("--name", "counter", *QUICK, "--", *COUNT)
        row(local, "host/counter-3", state="protected")


LIAR = """
import fcntl, os, socket, struct, subprocess, sys, time
report, write_end = os.pipe()
verdict, _ = os.pipe()
app = subprocess.Popen(["sleep", "1000"])
page = struct.pack("<QIiiiiIIxxxxQiiixxxx", int.from_bytes(b"CKPTCTL1", "little"), 1, os.getpid(), app.pid,
                   report, verdict, 2000, 0, 0, 0, 1, 0)
ctl = os.memfd_create("avckpt-ctl", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
os.write(ctl, page)
fcntl.fcntl(ctl, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
connection.connect(sys.argv[1])
rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", os.pidfd_open(os.getpid())))]
connection.sendmsg([b"avckpt-unit 1\\0name=liar\\0label=avckpt.interval=100ms\\0"], rights)
assert connection.recv(1000) == b"ok"
os.set_blocking(write_end, False)
deadline = time.monotonic() + 5
seq = 0
while time.monotonic() < deadline:
    try:  # asked to stop, and ended with status 0
        os.write(write_end, struct.pack("<IIiiIIQ", 1, seq, app.pid, 0, 1, 0, time.monotonic_ns()))
        seq += 1
    except BlockingIOError:
        time.sleep(0.001)
print(seq)
app.kill()
"""


@SHARED
def test_who_reports_deaths_all_the_time_is_heard_once(local: LocalSidecar, start: Any) -> None:
    """An avckpt-init of the application's own.  What the sidecar does for others does not wait for it."""
    start("--name", "counter", *QUICK, "--", *COUNT)
    row(local, "host/counter", state="protected")
    socket_path = str(local.run_dir / "units" / "units.sock")
    with subprocess.Popen([sys.executable, "-c", LIAR, socket_path], stdout=subprocess.PIPE, text=True) as liar:
        wait_until(lambda: "host/liar: died" in local.log, 10, "its first lie is heard")
        for restores in (1, 2):  # a third time would be a loop
            wait_until(lambda: row(local, "host/counter")["generations"] == 2, 10, "two generations")
            os.kill(row(local, "host/counter")["app_pid"], signal.SIGSEGV)
            row(local, "host/counter", restores=restores, state="protected")
        assert int(liar.communicate()[0]) > 100
    assert local.log.count("host/liar: died") == 1


LINGERING = """
import os, socket, struct, sys

def lingering():
    # Full, and to be waited for by whoever closes it last.
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        ours = socket.create_connection(listening.getsockname())
        theirs.append(listening.accept()[0])
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 60))
    ours.setblocking(False)
    try:
        while True:
            ours.send(bytes(65536))
    except BlockingIOError:
        return ours.detach()

def connect():
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(sys.argv[2])
    return connection

def send(connection, said, *fds):
    connection.sendmsg([said], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack(f"{len(fds)}i", *fds))])
    for fd in fds:
        os.close(fd)

theirs, how = [], sys.argv[1]
open("/proc/self/comm", "w").write("stranger")  # whom the file server answers
if how == "many served":
    socket.setdefaulttimeout(2)
    try:
        for _ in range(300):
            send(connect(), b"avckpt-unit 1\\0name=a\\0", os.open(sys.argv[3], os.O_RDONLY))
    except OSError:
        pass  # nobody accepts it any more
elif how != "ends":
    print("stop it", flush=True)
    sys.stdin.readline()
    sent = (lambda: os.open(sys.argv[3], os.O_RDONLY)) if how == "served" else lingering
    others = [connect() for _ in range(16 if how == "unread" else 0)]
    connection = connect()
    if how == "behind":
        connection.send(b"nonsense")
    send(connection, b"avckpt-unit 1\\0name=a\\0", *(sent() for _ in range(6 if how == "many" else 1)))
else:
    connection = connect()
    send(connection, b"avckpt-unit 1\\0name=a\\0label=avckpt.interval=1h\\0", os.pidfd_open(os.getpid()))
    assert connection.recv(100) == b"ok"
    send(connection, b"x", lingering())
    if os.fork():
        os._exit(0)
print("sent", flush=True)
sys.stdin.readline()
"""


@SHARED
@pytest.mark.parametrize("how", ["claims", "many", "behind", "unread", "ends", "served", "many served"])
def test_nobody_waits_for_what_strangers_send(local: LocalSidecar, tmp_path: Path, how: str) -> None:
    with contextlib.ExitStack() as served:
        if "served" in how:
            subprocess.run(["make", "-s", "-C", str(ROOT / "tests/victims")], check=True)
            daemon = comm_of(local.client.info()["pid"])
            command = [str(ROOT / "tests/victims/build/server"), str(tmp_path), daemon]
            server = served.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE))
            assert server.stdout is not None
            if server.stdout.readline() != b"ready\n":
                pytest.skip("/dev/fuse is not available here")
            served.callback(run, ["umount", "-l", str(tmp_path / "mount")])
            served.callback(server.kill)
        be_a_stranger(local, how, tmp_path / "mount" / "served")


def be_a_stranger(local: LocalSidecar, how: str, file: Path) -> None:
    path = local.run_dir / "units" / "units.sock"
    daemon = local.client.info()["pid"]
    with subprocess.Popen(
        [sys.executable, "-c", LINGERING, how, str(path), str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as stranger:
        assert stranger.stdin is not None
        assert stranger.stdout is not None
        if how not in ("ends", "many served"):
            assert stranger.stdout.readline() == "stop it\n"
            os.kill(daemon, signal.SIGSTOP)  # so that all of it is there when it looks
            stranger.stdin.write("\n")
            stranger.stdin.flush()
        assert stranger.stdout.readline() == "sent\n"
        os.kill(daemon, signal.SIGCONT)
        if how == "ends":
            wait_until(lambda: local.ps(ended=True)[0]["ended_at"], 5, "its end")
        used_s = sum(psutil.Process(daemon).cpu_times()[:2])
        for _ in range(10):
            local.client.info()  # within 10 s
            time.sleep(0.1)
        assert sum(psutil.Process(daemon).cpu_times()[:2]) - used_s < 0.5
        assert psutil.Process(daemon).num_threads() < 56
        stranger.stdin.write("\n")


@SHARED
def test_a_unit_within_a_unit_is_part_of_it(local: LocalSidecar, start: Any, tmp_path: Path) -> None:
    start("--name", "outer", *QUICK, "--", "sh", "-c", f"{INIT} --name inner -- sleep 1000; exit 3")
    row(local, "host/outer", state="protected")
    assert [each["name"] for each in local.ps()] == ["host/outer"]
    assert (tmp_path / "0.err").read_text() == "avckpt-init: sleep is part of outer, and is protected with it\n"
    # Nor does it help to hide that.
    start("--name", "other", *QUICK, "--", "sh", "-c", f"sleep 1; env -u AVCKPT_UNIT {INIT} --name inner -- sleep 1000")
    row(local, "host/other", state="protected")
    wait_until(lambda: "is part of host/other" in (tmp_path / "1.err").read_text(), 10, "it is refused")
    assert sorted(each["name"] for each in local.ps()) == ["host/other", "host/outer"]


@SHARED
def test_units_find_the_next_sidecar(local: LocalSidecar, start: Any, tmp_path: Path) -> None:
    process = start("--name", "a", *QUICK, "--", *COUNT)
    first = row(local, "host/a", state="protected")
    for signum in (signal.SIGTERM, signal.SIGKILL):
        local.stop(signum)
        local.start()
        assert row(local, "host/a", state="protected")["app_pid"] == first["app_pid"]
    os.kill(first["app_pid"], signal.SIGKILL)
    row(local, "host/a", restores=1, state="protected")
    local.stop()
    # Without a sidecar a death is final.
    os.kill(first["app_pid"], signal.SIGKILL)
    assert process.wait(10) == -signal.SIGKILL
    local.start()
    start("--name", "b", *QUICK, "--", *COUNT)
    local.stop()
    start("--name", "c", *QUICK, "--", *COUNT)
    alone = "runs unprotected until the sidecar is started"
    wait_until(lambda: alone in (tmp_path / "2.err").read_text(), 10, "it says that it is alone")
    local.start()
    for name in ("host/b", "host/c"):
        row(local, name, state="protected")


@SHARED
def test_whoever_kills_init_means_the_program(local: LocalSidecar, start: Any) -> None:
    process = start("--name", "a", *QUICK, "--", *COUNT)
    app = row(local, "host/a", state="protected")["app_pid"]
    os.kill(app, signal.SIGKILL)
    row(local, "host/a", restores=1, state="protected")
    pidfd = os.pidfd_open(app)
    process.kill()
    assert process.wait(10) == -signal.SIGKILL
    assert select.select([pidfd], [], [], 10)[0], "the program runs on"
    os.close(pidfd)
    wait_until(lambda: local.ps() == [], 10, "it is gone")


@SHARED
def test_what_a_unit_leaves_behind_stays_and_templates_do_not(local: LocalSidecar, start: Any, tmp_path: Path) -> None:
    script = (
        "import os, time\n"
        "if os.fork() == 0:\n"
        "    os.setsid()\n"
        f"    open({str(tmp_path / 'daemon')!r}, 'w').write(str(os.getpid()))\n"
        "    time.sleep(1000)\n"
        "time.sleep(1.5)\n"
    )
    launcher = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import ctypes, os, subprocess, sys\n"
            "ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)\n"  # whoever is orphaned becomes its child
            "node = subprocess.Popen(sys.argv[1:])\n"
            "reaped = [os.wait()[0] == node.pid]\n"
            "try:\n    reaped.append(os.waitpid(-1, os.WNOHANG))\nexcept ChildProcessError:\n    pass\n"
            "print(reaped, flush=True)\n",
            *(INIT, "--name", "a", *QUICK, "--", sys.executable, "-c", script),
        ],
        stdout=subprocess.PIPE,
        env={**os.environ, **local.env},
        text=True,
    )
    row(local, "host/a", state="protected")
    daemon = int(wait_until((tmp_path / "daemon").read_text, 10, "it has forked"))
    try:
        # It hears of one end, and the daemon runs on.
        assert launcher.wait(20) == 0
        assert launcher.stdout is not None
        assert launcher.stdout.readline() == "[True, (0, 0)]\n"
    finally:
        os.kill(daemon, signal.SIGKILL)
        launcher.kill()
        launcher.communicate()


LAUNCHER = f"""
trap 'echo stopping; kill -HUP $a; wait $a; echo a $?; kill $b; wait $b; echo b $?; exit 9' INT
$AVCKPT_INIT --name a -- {sys.executable} -c '{COUNTER}' >>a.out & a=$!
$AVCKPT_INIT -- {sys.executable} -c '{COUNTER}' >>b.out & b=$!
wait $a; echo a ended $?
wait
"""


@SHARED
def test_a_shell_launcher_without_podman(tmp_path: Path) -> None:
    """`avckpt run`: a node's death is undone without the launcher seeing it, and the launcher can stop its nodes."""
    with (tmp_path / "out").open("wb") as out, (tmp_path / "err").open("wb") as err:
        options = ("-v", "--label", "avckpt.scope=nodes", *QUICK)
        launched = subprocess.Popen(
            [*avckpt_command(), "run", *options, "--", "bash", "-c", LAUNCHER],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            cwd=tmp_path,
        )

    inits: dict[str, int] = {}

    def said() -> str:
        return (tmp_path / "err").read_text()

    def node(name: str) -> int:
        number = int(lines(tmp_path / f"{name}.out")[0][1])
        return next(pid for pid in children_of(inits[name]) if inside(pid) == number)

    try:
        wait_until(lambda: said().count("protected: first checkpoint") >= 2, 20, "both are protected")
        [init] = [pid for pid in children_of(launched.pid) if Path(f"/proc/{pid}/comm").read_text() == "avckpt-init\n"]
        [shell] = children_of(init)
        for pid in children_of(shell):
            arguments = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
            inits["a" if b"--name" in arguments else "b"] = pid
        time.sleep(1)
        for name, other in (("a", "b"), ("b", "a"), ("a", "b")):
            pid, count = node(name), said().count("restored in")
            sibling = len(lines(tmp_path / f"{other}.out"))
            os.kill(pid, signal.SIGKILL)
            wait_until(lambda: said().count("restored in") > count, 10, "it is restored")  # noqa: B023
            wait_until(lambda: len(lines(tmp_path / f"{other}.out")) > sibling, 10, "its sibling goes on")  # noqa: B023
            time.sleep(0.5)
        for name in "ab":
            numbers = [int(line[0]) for line in lines(tmp_path / f"{name}.out")]
            # One process, to itself; back by moments, at most as often as it died.
            assert len({line[1] for line in lines(tmp_path / f"{name}.out")}) == 1
            assert numbers.count(0) == 1
            assert sum(b <= a for a, b in zip(numbers, numbers[1:])) <= (2 if name == "a" else 1), said()
            assert max(b - a for a, b in zip(numbers, numbers[1:])) == 1
        assert (tmp_path / "out").read_text() == ""
        launched.send_signal(signal.SIGINT)
        assert launched.wait(15) == 9
    finally:
        launched.kill()
        launched.wait()
    # Asked to stop they end as any program does, in the launcher's order.
    assert (tmp_path / "out").read_text() == f"stopping\na {128 + signal.SIGHUP}\nb {128 + signal.SIGTERM}\n"


@SHARED
def test_a_job_of_a_shell_stops_and_continues(local: LocalSidecar, tmp_path: Path) -> None:
    """A key pressed on the terminal reaches a unit's program exactly once, as without avckpt."""
    (tmp_path / "job.py").write_text(
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, lambda *_: print('int', flush=True))\n"
        "signal.signal(signal.SIGQUIT, lambda *_: sys.exit(7))\n"
        "print('ready', flush=True)\n"
        "while True: time.sleep(0.05)\n"
    )
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update({**local.env, "PS1": "$ ", "TERM": "dumb"})
        os.execvp("bash", ["bash", "--norc", "--noprofile", "-i"])
    heard = bytearray()

    def until(text: bytes, count: int = 1) -> None:
        deadline = time.monotonic() + 15
        while heard.count(text) < count:
            assert select.select([terminal], [], [], max(deadline - time.monotonic(), 0))[0], bytes(heard)
            heard.extend(os.read(terminal, 4096))

    try:
        os.write(terminal, f"{INIT} --name job {' '.join(QUICK)} -- {sys.executable} {tmp_path}/job.py\n".encode())
        until(b"ready\r\n")
        app = row(local, "host/job", state="protected")["app_pid"]
        os.kill(app, signal.SIGKILL)
        row(local, "host/job", restores=1, state="protected")
        os.write(terminal, b"\x03")
        until(b"int\r\n")
        os.write(terminal, b"\x1a")
        until(b"Stopped")
        os.write(terminal, b"fg\n")
        time.sleep(0.3)
        os.write(terminal, b"\x03")
        until(b"int\r\n", 2)
        os.write(terminal, b"\x1c")
        until(b"$ ", heard.count(b"$ ") + 1)
        os.write(terminal, b"echo status-$?\n")
        until(b"status-7")
        assert heard.count(b"int\r\n") == 2, bytes(heard)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.close(terminal)
        os.waitpid(pid, 0)


COUNT_SIGNALS = """
import signal, time
def heard(signum, frame):
    with open("heard", "a") as out:
        print(signal.Signals(signum).name, file=out)
for signum in (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
    signal.signal(signum, heard)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
open("heard", "w").close()
while True:
    time.sleep(0.05)
"""


@SHARED
def test_a_signal_for_the_whole_group_comes_once(
    local: LocalSidecar, start: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """roslaunch signals a node's group: a second SIGINT would interrupt how it ends after the first."""
    monkeypatch.chdir(tmp_path)
    # Nothing counts as a stop but the last ones: what follows one is not restored.
    process = start("--name", "a", *QUICK, "--", sys.executable, "-c", COUNT_SIGNALS)
    heard: list[str] = []

    def send(whole: bool, *signals: signal.Signals) -> None:
        for signum in signals:
            (os.killpg if whole else os.kill)(process.pid, signum)
            heard.append(signum.name)
            wait_until(lambda: len((tmp_path / "heard").read_text().split()) >= len(heard), 10, f"{signum} comes")
            time.sleep(0.15)  # and comes no more
        assert (tmp_path / "heard").read_text().split() == heard

    app = row(local, "host/a", state="protected", generations=2)["app_pid"]
    send(True, signal.SIGHUP, signal.SIGUSR1, signal.SIGHUP)
    send(False, signal.SIGHUP, signal.SIGUSR1)
    os.kill(app, signal.SIGKILL)
    row(local, "host/a", restores=1, state="protected")
    send(True, signal.SIGUSR1)
    send(False, signal.SIGUSR1)
    send(True, signal.SIGINT, signal.SIGINT)
    # It ignores the next step, and the last one is final.
    os.killpg(process.pid, signal.SIGTERM)
    time.sleep(0.3)
    assert process.poll() is None
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait(10) == -signal.SIGKILL
    wait_until(lambda: local.ps() == [], 10, "it is gone")


def test_scope_nodes_takes_no_health_check() -> None:
    done = run(
        [*avckpt_command(), "run", "--label", "avckpt.scope=nodes", "--label", "avckpt.restore.on=unhealthy", "true"],
        check=False,
    )
    assert done.status == 2
    assert "a health check covers a whole container" in done.stderr


def test_a_launcher_without_avckpt_starts_its_nodes_all_the_same(tmp_path: Path) -> None:
    done = run(
        [INIT, "--label", "avckpt.keep=3", "sh", "-c", "echo $PPID; exit 4"],
        env={"AVCKPT_RUN_DIR": str(tmp_path / "nothing")},
        check=False,
    )
    assert (done.status, done.stdout) == (4, f"{os.getpid()}\n")  # no init stands in between
    assert "there is no avckpt here" in done.stderr


@SHARED
def test_the_row_of_a_unit_is_in_the_api(local: LocalSidecar, start: Any) -> None:
    start("--name", "a", "--", "sleep", "1000")
    assert row(local, "host/a")["node_of"] == "host"
    answer = json.loads(local.avckpt("checkpoint", "host/a", "--json").stdout)
    assert answer["event"]["kind"] == "checkpoint"
    assert answer["container"]["name"] == "host/a"
    assert "host/a: back at generation" in local.avckpt("restore", "host/a").stdout
