# SPDX-License-Identifier: Apache-2.0
"""prestart and poststop, as real programs, against sidecars that behave well or badly."""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import socket
import stat
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from avckpt_hooks.shared import protocol

HOOK = Path(__file__).resolve().parents[2] / "hooks" / "avckpt-hook"
ID = "ab" * 32


@pytest.fixture
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path))
    return tmp_path


@pytest.fixture
def process() -> Iterator[subprocess.Popen[bytes]]:
    """Stands for a container's main process."""
    child = subprocess.Popen(["sleep", "60"])
    yield child
    child.kill()
    child.wait()


@pytest.fixture
def listener(run_dir: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(protocol.hooks_socket())
        listener.listen(1)
        yield listener


def call(stage: str, state: dict[str, Any] | bytes, *arguments: str) -> tuple[str, float]:
    """Runs a hook below a shell; returns what it told the shell's standard error, and how long it took."""
    stdin = state if isinstance(state, bytes) else json.dumps(state).encode()
    started = time.monotonic()
    done = subprocess.run(
        ["bash", "-c", f'{HOOK} {stage} "$@" 2>/dev/null; exit $?', "hook", *arguments],
        input=stdin,
        capture_output=True,
        timeout=20,
        check=False,
    )
    assert done.returncode == 0
    assert done.stdout == b""
    return done.stderr.decode(), time.monotonic() - started


def state_of(process: subprocess.Popen[bytes]) -> dict[str, Any]:
    annotations = {"avckpt.version": "0.1.0", "avckpt.enable": "true", "avckpt.name": "web"}
    return {"id": ID, "pid": process.pid, "bundle": "/b", "status": "created", "annotations": annotations}


def answer(listener: socket.socket, reply: Callable[[socket.socket, Any, int | None], object]) -> threading.Thread:
    def serve() -> None:
        connection, _ = listener.accept()
        with connection:
            request, pidfd = protocol.receive_request(connection)
            reply(connection, request, pidfd)
            if pidfd is not None:
                os.close(pidfd)

    thread = threading.Thread(target=serve)
    thread.start()
    return thread


def modes(folder: Path) -> tuple[int, set[int]]:
    """Those of a folder and of what is in it."""
    files = {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}
    return stat.S_IMODE(folder.stat().st_mode), files


@pytest.mark.parametrize("is_there", [False, True])
def test_the_record_is_for_root_only(run_dir: Path, process: subprocess.Popen[bytes], is_there: bool) -> None:
    """It holds labels; also where an earlier version has left it readable."""
    folder = run_dir / "containers"
    if is_there:
        folder.mkdir(mode=0o755)
        (folder / f"{ID}.json").write_text("{}")
        (folder / f"{ID}.json").chmod(0o644)
    call("prestart", state_of(process))
    assert modes(folder) == (0o700, {0o600})


def test_a_request_that_is_nested_too_deeply() -> None:
    with pytest.raises(protocol.ProtocolError, match="not JSON"):
        protocol.decode_request(b"[" * 100_000)


def test_prestart_registers_with_a_pidfd(listener: socket.socket, process: subprocess.Popen[bytes]) -> None:
    seen: list[protocol.Register] = []

    def reply(connection: socket.socket, request: Any, pidfd: int | None) -> None:
        assert pidfd is not None
        signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        seen.append(request)
        connection.send(protocol.encode_reply())

    thread = answer(listener, reply)
    said, _ = call("prestart", state_of(process))
    thread.join()
    assert said == ""
    assert process.wait(timeout=5) == -signal.SIGKILL
    [request] = seen
    assert (request.id, request.name, request.pid, request.bundle) == (ID, "web", process.pid, "/b")
    assert request.annotations["avckpt.enable"] == "true"
    record = json.loads(Path(protocol.record_path(ID)).read_text())
    assert record == {**request.record(), "pid_namespace": os.stat("/proc/self/ns/pid").st_ino}
    assert protocol.Register.from_record(record).record() == request.record()


def test_prestart_records_the_start_time_of_a_process_with_an_odd_name(run_dir: Path) -> None:
    script = "import ctypes, time; ctypes.CDLL(None).prctl(15, b') R 7 (x'); print(flush=True); time.sleep(60)"
    with subprocess.Popen(["/usr/bin/python3", "-c", script], stdout=subprocess.PIPE) as odd:
        assert odd.stdout is not None
        odd.stdout.readline()
        call("prestart", state_of(odd))
        record = json.loads(Path(protocol.record_path(ID)).read_text())
        boot_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        odd.kill()
    ticks = os.sysconf("SC_CLK_TCK")
    assert boot_s - 10 < record["starttime"] / ticks <= boot_s


def test_prestart_without_a_sidecar_leaves_a_record_and_says_so(
    run_dir: Path, process: subprocess.Popen[bytes]
) -> None:
    said, _ = call("prestart", state_of(process))
    why = f"no sidecar listens on {run_dir}/hooks.sock (No such file or directory)"
    assert said == f"avckpt: container web runs unprotected: {why}\n"
    assert Path(protocol.record_path(ID)).exists()
    said, _ = call("prestart", state_of(process), "--told")
    assert said == ""


def test_prestart_passes_a_refusal_on(listener: socket.socket, process: subprocess.Popen[bytes]) -> None:
    thread = answer(listener, lambda c, _, __: c.send(protocol.encode_reply("too many")))
    said, _ = call("prestart", state_of(process))
    thread.join()
    assert "the sidecar said: too many" in said


@pytest.mark.parametrize("key", ["com.example.blob", "avckpt.blob"])
def test_prestart_sends_what_is_ours_and_says_when_that_is_too_long(
    listener: socket.socket, process: subprocess.Popen[bytes], key: str
) -> None:
    seen: list[dict[str, str]] = []

    def reply(connection: socket.socket, request: Any, pidfd: int | None) -> None:
        seen.append(request.annotations)
        connection.send(protocol.encode_reply())

    state = state_of(process)
    ours = dict(state["annotations"])
    state["annotations"][key] = "x" * protocol.MAX_BYTES
    thread = answer(listener, reply) if key.startswith("com") else None
    said, _ = call("prestart", state)
    if thread is not None:
        thread.join()
        assert (said, seen) == ("", [ours])
    else:
        assert "web runs unprotected: its labels are too large for the sidecar: the message is too long (131" in said
        # Nor is such a record left in memory for a sidecar that starts later and could not read it.
        assert not os.path.exists(protocol.record_path(ID))


def test_prestart_registers_also_without_a_record(
    run_dir: Path, listener: socket.socket, process: subprocess.Popen[bytes]
) -> None:
    records = run_dir / "containers"
    records.write_text("in the way")
    thread = answer(listener, lambda c, _, __: c.send(protocol.encode_reply()))
    said, _ = call("prestart", state_of(process))
    thread.join()
    why = f"{records} cannot be written (File exists)"
    assert said == f"avckpt: container web is not known to a sidecar that starts later: {why}\n"
    listener.close()
    said, _ = call("prestart", state_of(process))
    assert said.startswith("avckpt: container web runs unprotected: no sidecar listens")
    assert said.endswith(f"; and {why}\n")


@pytest.mark.parametrize("temper", ["never accepts", "never answers", "hangs up", "talks nonsense", "full"])
def test_a_hook_ends_soon_whatever_the_sidecar_does(
    listener: socket.socket, process: subprocess.Popen[bytes], temper: str
) -> None:
    thread = None
    waiting: list[socket.socket] = []
    hold = threading.Event()
    if temper == "never answers":
        thread = answer(listener, lambda c, _, __: hold.wait(10))
    elif temper == "hangs up":
        thread = answer(listener, lambda c, _, __: None)
    elif temper == "talks nonsense":
        thread = answer(listener, lambda c, _, __: c.send(b"\xff[]"))
    elif temper == "full":
        for _ in range(10):
            waiting.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
            waiting[-1].setblocking(False)
            try:
                waiting[-1].connect(protocol.hooks_socket())
            except BlockingIOError:
                break
        else:
            pytest.fail("the backlog never filled up")
    said, took_s = call("prestart", state_of(process))
    hold.set()
    if thread:
        thread.join()
    for connection in waiting:
        connection.close()
    assert "container web runs unprotected" in said
    assert took_s < protocol.TIMEOUT_S + 1.0


def test_poststop_removes_the_record_and_deregisters(listener: socket.socket, process: subprocess.Popen[bytes]) -> None:
    seen: list[object] = []

    def reply(connection: socket.socket, request: Any, pidfd: int | None) -> None:
        seen.append((request.id, pidfd, type(request)))
        connection.send(protocol.encode_reply())

    record = Path(protocol.record_path(ID))
    record.parent.mkdir()
    record.write_text("{}")
    thread = answer(listener, reply)
    call("poststop", {"id": ID, "status": "stopped"})
    thread.join()
    assert seen == [(ID, None, protocol.Deregister)]
    assert not record.exists()


def test_poststop_hardly_waits_for_a_stuck_sidecar(listener: socket.socket) -> None:
    # The quickest of several: the machine may be busy.
    took_s = []
    for _ in range(5):
        took_s.append(call("poststop", {"id": ID})[1])
        listener.accept()[0].close()  # or the queue would be full, and the hook not wait at all
    assert min(took_s) < protocol.TIMEOUT_S


def test_poststop_without_a_sidecar(run_dir: Path) -> None:
    record = Path(protocol.record_path(ID))
    record.parent.mkdir()
    record.write_text("{}")
    call("poststop", {"id": ID})
    assert not record.exists()
    call("poststop", {"id": ID})


def test_poststop_touches_nothing_outside_its_directory(run_dir: Path) -> None:
    outside = run_dir / "precious.json"
    outside.write_text("{}")
    (run_dir / "containers").mkdir()
    call("poststop", {"id": "../precious"})
    assert outside.exists()


@pytest.mark.parametrize("stage", ["prestart", "poststop"])
@pytest.mark.parametrize("state", [b"", b"nonsense", b"[]", b"{}", b'{"id": 5}'])
def test_no_state_makes_a_hook_fail(run_dir: Path, stage: str, state: bytes) -> None:
    call(stage, state)


def test_a_process_that_is_gone_is_no_reason_to_fail(run_dir: Path, process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    said, _ = call("prestart", state_of(process))
    assert "container web runs unprotected" in said


@pytest.mark.parametrize(
    ("packet", "fds", "why"),
    [
        (b"{}", 0, "unknown op None"),
        (b"[]", 0, "not a JSON object"),
        (b"\xff", 0, "not JSON"),
        (b'{"op": "deregister", "version": 2, "id": "%s"}' % ID.encode(), 0, "protocol version 2"),
        (b'{"op": "deregister", "version": 1, "id": "../x"}', 0, "not a container id"),
        (
            b'{"op": "deregister", "version": 1, "id": "%s"}' % ID.encode(),
            1,
            "0 descriptor(s) expected with the request, got 1",
        ),
        (b'{"op": "register", "version": 1, "id": "%s"}' % ID.encode(), 1, "'name' is None"),
    ],
)
def test_the_receiver_refuses_and_keeps_no_descriptor(packet: bytes, fds: int, why: str) -> None:
    before = set(os.listdir("/proc/self/fd"))
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        rights = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack(f"{fds}i", *[0] * fds))] if fds else []
        ours.sendmsg([packet], rights)
        with pytest.raises(protocol.ProtocolError, match=why.replace("(", r"\(").replace(")", r"\)")):
            protocol.receive_request(theirs)
    assert set(os.listdir("/proc/self/fd")) == before


def test_a_receiver_without_descriptors_says_so() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    request = protocol.Register(id=ID, name="web", pid=1, starttime=1, bundle="", annotations={})
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ours, theirs:
        ours.sendmsg([request.encode()], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", 0))])
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        try:
            with pytest.raises(protocol.ProtocolError, match="no descriptors left"):
                protocol.receive_request(theirs)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_a_registration_needs_its_pidfd() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    request = protocol.Register(id=ID, name="web", pid=1, starttime=1, bundle="", annotations={})
    with ours, theirs:
        ours.send(request.encode())
        with pytest.raises(protocol.ProtocolError, match="1 descriptor"):
            protocol.receive_request(theirs)
        assert not select.select([theirs], [], [], 0)[0]


def test_a_look_whether_a_sidecar_listens_is_no_bad_request() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        ours.close()
        with pytest.raises(ConnectionResetError):
            protocol.receive_request(theirs)
