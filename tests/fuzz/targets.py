# SPDX-License-Identifier: Apache-2.0
"""Fuzz targets for what hooks, sidecar and command line read.

Each is a function that must take any bytes, in one of `TARGETS`; what may be raised is caught in it,
and whatever else is raised is a finding.  Nothing here needs root, Podman or a fuzzer: tests run the
targets on their seeds (corpus/NAME), `python -m tests.fuzz NAME` on everything else.
"""

from __future__ import annotations

import array
import asyncio
import contextlib
import io
import json
import logging
import os
import re
import socket
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

from avckpt import config, yamlfile
from avckpt._native import ffi
from avckpt.api.server import ApiServer
from avckpt.cli.compose import manifest
from avckpt.containers import units
from avckpt.containers.protected import Protected
from avckpt.containers.records import Records
from avckpt.daemon import Daemon, Watch
from avckpt.engine import _event
from avckpt.errors import ConfigError, LabelsWrong
from avckpt.events.history import History
from avckpt.events.metrics import Metrics
from avckpt.events.record import EventRecord, of_guard
from avckpt.events.vocabulary import Kind, Reason
from avckpt.guard import GuardConfig
from avckpt.policy import guard_config, settings_of
from avckpt.supervision import health
from avckpt_hooks import VERSION, podman, poststop, precreate, prestart
from avckpt_hooks import health as hook_health
from avckpt_hooks.shared import labels, protocol, tell
from avckpt_hooks.shared.protocol import Register

ID = "ab" * 32
CONFIG = GuardConfig(3.0, 2, True, True, frozenset(), 5, 60.0, 0.02)

logging.getLogger("avckpt").addHandler(logging.NullHandler())
logging.getLogger("avckpt").propagate = False
logging.getLogger("aiohttp").disabled = True


@lru_cache(maxsize=1)
def home() -> Path:
    """A run-time directory of our own, where hooks find no sidecar."""
    folder = Path(tempfile.mkdtemp(prefix="avckpt-fuzz-"))
    os.environ["AVCKPT_RUN_DIR"] = str(folder / "run")
    (folder / "run").mkdir()
    return folder


@contextlib.contextmanager
def alone(data: bytes) -> Iterator[io.BytesIO]:
    """A hook's standard input; its output.  It tells nobody anything, and starts no process."""
    home()
    out = io.BytesIO()
    silent: Callable[..., bool] = lambda *_: False  # noqa: E731
    with (
        mock.patch.object(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data))),
        mock.patch.object(sys, "stdout", SimpleNamespace(buffer=out)),
        mock.patch.object(tell, "parent", silent),
        mock.patch.object(tell, "journal", silent),
        mock.patch.object(hook_health, "ask_later", silent),
    ):
        yield out


def must_be_line(text: str) -> None:
    """What a message may be: one line that does nothing to a terminal."""
    assert text.isprintable(), text


# ---- hooks -------------------------------------------------------------------------


def hook_config(data: bytes) -> None:
    """A container's OCI configuration and, behind a NUL, what `podman generate spec` says of it."""
    given, _, spec = data.partition(b"\0")
    with alone(given) as out, mock.patch.object(podman, "generate_spec", return_value=spec or b"{}"):
        status = precreate.main()
    written = out.getvalue()
    assert status in (0, 1)
    if status == 0 and written != given:
        now = json.loads(written)
        assert now["annotations"]["avckpt.version"] == VERSION
        if "avckpt.notify" not in now["annotations"]:
            assert now["process"]["args"][0] == precreate.INIT_PATH
    if b'"avckpt' not in data.lower():
        assert (status, written) == (0, given)


def hook_state(data: bytes) -> None:
    """The state that an OCI runtime gives the other two hooks; they never fail, and write where they may."""
    for main in (prestart.main, poststop.main):
        with alone(data):
            assert main() == 0
    for path in home().rglob("*"):
        assert path.is_dir() or protocol.is_container_id(path.stem), path
        if path.is_file():
            path.unlink()


def unit_claim(data: bytes) -> None:
    """What an avckpt-init in front of a node says of itself, and what comes of its labels."""
    try:
        claim = units.decode_claim(data)
    except protocol.ProtocolError:
        return
    assert re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,62}", claim.name), claim.name
    assert all(key.startswith("avckpt.") for key in claim.labels)
    with contextlib.suppress(LabelsWrong):
        merged = units.labels_of_node(claim.labels, {"avckpt.enable": "true", "avckpt.scope": "nodes"})
        policy = settings_of(merged).policy
        assert policy.guarded
        assert not policy.group
        assert policy.interval_s >= units.LEAST_INTERVAL_S


def hook_packet(data: bytes) -> None:
    """A packet on the hooks' socket (the first byte: with how many descriptors), or the answer to one."""
    count, packet = (data[0] % 6, data[1:]) if data else (0, b"")
    before = len(os.listdir("/proc/self/fd"))
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.setblocking(False)
        fds = array.array("i", [ours.fileno()] * count)
        ours.sendmsg([packet], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, fds)] if count else [])
        try:
            request, pidfd = protocol.receive_request(theirs)
        except protocol.ProtocolError as error:
            protocol.decode_reply(protocol.encode_reply(str(error)))
        except OSError:
            pass
        else:
            assert protocol.is_container_id(request.id)
            assert type(protocol.decode_request(request.encode())) is type(request)
            if pidfd is not None:
                os.close(pidfd)
    assert len(os.listdir("/proc/self/fd")) == before
    with contextlib.suppress(protocol.ProtocolError):
        protocol.decode_reply(packet)


def label(data: bytes) -> None:
    """Labels and annotations: lines NAME=VALUE, those of annotations begin with a blank."""
    given: dict[str, str] = {}
    annotations: dict[str, str] = {}
    for line in data.decode("utf-8", "surrogateescape").split("\n"):
        key, _, value = line.partition("=")
        (annotations if key.startswith(" ") else given)[key.strip()] = value
    try:
        wanted = labels.merge(given, annotations)
        guard_config(labels.parse_policy(wanted))
    except labels.LabelError as error:
        must_be_line(str(error))
    else:
        settings_of(wanted)
    for key in given:
        labels.meant_by(key)
    with contextlib.suppress(LabelsWrong):
        settings_of(given)


# ---- files ---------------------------------------------------------------------------


def record(data: bytes) -> None:
    """A container's record, as a hook leaves it."""
    folder = home() / "records"
    folder.mkdir(exist_ok=True)
    (folder / f"{ID}.json").write_bytes(data)
    for found, pidfd in Records(folder).adoptable(lambda _: False):
        os.close(pidfd)
        assert protocol.is_container_id(found.id)


def history(data: bytes) -> None:
    """The events of an earlier sidecar."""
    path = home() / "history.jsonl"
    path.write_bytes(data)
    kept = History(path, limit=20)
    metrics = Metrics("1.0", "1.0")
    for event in kept.after():
        json.dumps(event.to_json(), allow_nan=False).encode()
        metrics.take(event)
    try:
        if kept.after():
            assert kept.add(kept.after()[-1]).seq > 0
    finally:
        kept.close()
    again = History(path, limit=20)
    again.close()
    assert [event.seq for event in again.after()] == [event.seq for event in kept.after()]


def health_answer(data: bytes) -> None:
    """A container's health check, as `podman inspect` told a hook."""
    path = home() / "health.json"
    path.write_bytes(data)
    told: list[EventRecord] = []

    def tell_it(event: EventRecord) -> EventRecord:
        told.append(event)
        return event

    check = asyncio.run(health._known(path, tell_it))
    assert (check is None) == bool(told)
    for event in told:
        json.dumps(event.to_json()).encode()
    if check is not None:
        assert check.interval_s > 0
        assert check.timeout_s > 0
        health.Pulse(check).take(False, 1.0)


def yaml_file(data: bytes) -> None:
    """The sidecar's configuration, or a Compose file."""
    path = home() / "file.yaml"
    path.write_bytes(data)
    os.chdir(home())
    with contextlib.suppress(yamlfile.Unreadable):
        yamlfile.read(path)
    with contextlib.suppress(ConfigError):
        defaults = config.read(path)
        with contextlib.suppress(LabelsWrong):
            settings_of(defaults.under({"avckpt.enable": "true"}, "web"))
    found = manifest.check([path])
    json.dumps(found.to_json()).encode("utf-8", "surrogatepass")
    for problem in found.problems:
        str(problem)


# ---- a guard -------------------------------------------------------------------------------


def guard_event(data: bytes) -> None:
    """What a guard says of its container, as far as the engine lets it through (native/guard/client.c)."""
    said = ffi.new("struct avc_event *")
    ffi.buffer(said)[: len(data)] = data[: ffi.sizeof("struct avc_event")]
    said.kind = 1 + said.kind % 13
    said.reason = abs(said.reason) % 19
    said.images = abs(said.images) % 2
    said.fork_reason = abs(said.fork_reason) % 16
    said.again %= 4
    for text in (said.error.detail, said.error.operation, said.error.syscall):
        text[len(text) - 1] = b"\0"
    event = _event(said)
    container = Protected(id=ID, name="web", cookie=1, init_pid=1, config=CONFIG, registered_at=0.0)
    container.apply(event, 1.0)
    told = of_guard(event, container="web", id=ID)
    assert isinstance(told.kind, Kind)
    assert told.reason is None or isinstance(told.reason, Reason)
    json.dumps([told.to_json(), container.to_json(), event.to_json()], allow_nan=False).encode()
    metrics = Metrics("1.0", "1.0")
    metrics.take(told)
    metrics.render([container], [container])


# ---- API --------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def api_socket() -> str:
    """A daemon's API, served by a thread of this process."""
    path = home() / "api.sock"
    ready = threading.Event()

    async def serve() -> None:
        daemon = Daemon(home() / "run", home() / "config.yaml")
        for cookie, (container_id, name) in enumerate([(ID, "web"), ("cd" * 32, "")], 1):
            container = Protected(
                id=container_id, name=name, cookie=cookie, init_pid=os.getpid(), config=CONFIG, registered_at=0
            )
            daemon.registry.add(container)
            # Without a guard: commands are refused, everything else is real.
            request = Register(
                id=container_id, name=name, pid=container.init_pid, starttime=0, bundle="", annotations={}
            )
            settings = settings_of({})
            daemon._watches[cookie] = Watch(container, pidfd=-1, labels={}, settings=settings, request=request)
        await ApiServer(daemon, path).start()
        ready.set()
        await asyncio.Event().wait()

    threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
    assert ready.wait(20)
    return str(path)


def api(data: bytes) -> None:
    """A request: method, path with query and headers, as they come."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(10)
        connection.connect(api_socket())
        head, _, body = data.partition(b"\n\n")
        first, *headers = head.split(b"\n")
        method, _, path = first.partition(b" ")
        lines = [method + b" " + path + b" HTTP/1.1", b"Host: a", b"Connection: close", *headers]
        connection.sendall(b"\r\n".join(lines) + b"\r\n\r\n" + body)
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        with contextlib.suppress(ConnectionError):
            while b"\r\n\r\n" not in answer and (part := connection.recv(65536)):
                answer += part
    status = answer.split(b" ", 2)[1] if answer else b""
    assert status != b"500", answer
    assert status or not answer


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target
    for target in (
        hook_config,
        hook_state,
        hook_packet,
        unit_claim,
        label,
        record,
        history,
        health_answer,
        yaml_file,
        guard_event,
        api,
    )
}
