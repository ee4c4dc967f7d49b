# SPDX-License-Identifier: Apache-2.0
"""The protocol between a hook and the sidecar.

Transport: a Unix socket of type SOCK_SEQPACKET at `hooks_socket()`. One connection
carries one request and one reply, each a single packet of JSON (UTF-8, at most
`MAX_BYTES`), so that messages need no framing.

Requests (`Register.encode()`, `Deregister.encode()`; `decode_request()` reads both):

    {"version": 1, "op": "register", "id": ..., "name": ..., "pid": ...,
     "starttime": ..., "bundle": ..., "annotations": {...}}
        (annotations: only those that begin with "avckpt.") with exactly one
        descriptor (SCM_RIGHTS): a pidfd of the container's main process.  "pid"
        and "starttime" belong to the *hook's* PID namespace, for logs only: the receiver's may be another one.
    {"version": 1, "op": "deregister", "id": ...}

Reply (`encode_reply()`, `decode_reply()`):

    {"version": 1, "ok": true}
    {"version": 1, "ok": false, "error": "one line for a person"}

Podman holds the container's lock while a hook runs, so the receiver answers at
once and calls neither `podman ps` nor `podman inspect` before it has answered.

Registration must be idempotent. The hook writes `record_path(id)` *before* it connects, and a starting
sidecar listens *before* it reads the records, so that no container is missed between the two; in return, one
may be registered twice.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import time

RUN_DIR = "/run/avckpt"
STATE_DIR = "/var/lib/avckpt"
"""What outlives a reboot, where it exists."""
VERSION = 1
MAX_BYTES = 128 * 1024
"""Longest packet; below the default SO_SNDBUF, so that a send never splits."""

TIMEOUT_S = 1.0
"""A hook's total timeout for the sidecar, from connect to reply."""

START_S = 2.0
"""How long a hook waits for a sidecar that is starting."""


class ProtocolError(ValueError):
    """The peer violated this protocol."""


def run_dir() -> str:
    """The runtime directory: $AVCKPT_RUN_DIR, or /run/avckpt."""
    return os.environ.get("AVCKPT_RUN_DIR") or RUN_DIR


def hooks_socket() -> str:
    """Where the sidecar listens for hooks."""
    return os.path.join(run_dir(), "hooks.sock")


def starting_lock() -> str:
    """A file that a sidecar has locked, with flock(2), from the first moment on; it listens a second later."""
    return os.path.join(run_dir(), "starting")


UNITS_IN_CONTAINER = "/run/avckpt-units"
"""Where a container with avckpt.scope=nodes has `units_dir()`."""


def units_dir() -> str:
    """The directory of the socket for units: containers see it, and nothing else of avckpt."""
    return os.path.join(run_dir(), "units")


def records_dir() -> str:
    """The directory with one record per live protected container."""
    return os.path.join(run_dir(), "containers")


def record_path(container_id: str) -> str:
    """The record of one container: the JSON of its `Register`, without "op", and `pid_namespace`, its inode."""
    return os.path.join(records_dir(), container_id + ".json")


def health_path(container_id: str) -> str:
    """The checks of one container, {"healthcheck", "startup_healthcheck"}: as `podman inspect` has them, or null."""
    return os.path.join(run_dir(), "health", container_id + ".json")


def is_container_id(text: str) -> bool:
    """True for 64 lower-case hex digits: the only thing that becomes a file name here."""
    return len(text) == 64 and not text.strip("0123456789abcdef")


def key_of(container: str) -> str:
    """A container's id in avckpt: its own, or 64 hex digits derived from one of any form (containerd's)."""
    if is_container_id(container):
        return container
    import hashlib

    return hashlib.sha256(container.encode(errors="surrogateescape")).hexdigest()


class Register:
    """A container has been created; its main process waits to be started."""

    __slots__ = ("annotations", "bundle", "id", "name", "pid", "starttime")

    def __init__(
        self,
        *,
        id: str,
        name: str,
        pid: int,
        starttime: int,
        bundle: str,
        annotations: dict[str, str],
    ) -> None:
        """`starttime` is field 22 of /proc/PID/stat: clock ticks since boot."""
        self.id = id
        self.name = name
        self.pid = pid
        self.starttime = starttime
        self.bundle = bundle
        self.annotations = annotations

    def record(self) -> dict[str, object]:
        """The fields as in the container's record."""
        return {
            "version": VERSION,
            "id": self.id,
            "name": self.name,
            "pid": self.pid,
            "starttime": self.starttime,
            "bundle": self.bundle,
            "annotations": self.annotations,
        }

    def to_record(self) -> bytes:
        """What the container's record says.

        With the PID namespace that its PID is of, which is ours: a sidecar without --pid=host is in
        another one, and must not take the container for one that has ended.
        """
        record = {**self.record(), "pid_namespace": os.stat("/proc/self/ns/pid").st_ino}
        return json.dumps(record).encode() + b"\n"

    def encode(self) -> bytes:
        """The packet.  Raises ProtocolError when it is longer than MAX_BYTES."""
        return _encode({"op": "register", **self.record()})

    @classmethod
    def from_record(cls, data: object) -> Register:
        """Reads the fields of a record or a request.  Raises ProtocolError."""
        if not isinstance(data, dict):
            raise ProtocolError("a registration must be a JSON object")
        _check_version(data)
        container_id = _container_id(data)
        for key, kind in (("name", str), ("pid", int), ("starttime", int), ("bundle", str)):
            value = data.get(key)
            if not isinstance(value, kind) or isinstance(value, bool):
                raise ProtocolError(f"registration of {container_id[:12]}: {key!r} is {value!r}")
        annotations = data.get("annotations")
        if not isinstance(annotations, dict) or not all(
            isinstance(k, str) and isinstance(v, str) for k, v in annotations.items()
        ):
            raise ProtocolError(f"registration of {container_id[:12]}: bad annotations")
        return cls(
            id=container_id,
            name=data["name"],
            pid=data["pid"],
            starttime=data["starttime"],
            bundle=data["bundle"],
            annotations=annotations,
        )


class Deregister:
    """A container has stopped."""

    __slots__ = ("id",)

    def __init__(self, *, id: str) -> None:
        self.id = id

    def encode(self) -> bytes:
        """The packet."""
        return _encode({"op": "deregister", "version": VERSION, "id": self.id})


def decode_request(packet: bytes) -> Register | Deregister:
    """What a hook sent. Raises ProtocolError with a clause for users."""
    data = _decode(packet)
    op = data.get("op")
    if op == "register":
        return Register.from_record(data)
    if op == "deregister":
        _check_version(data)
        return Deregister(id=_container_id(data))
    raise ProtocolError(f"unknown op {op!r}")


def encode_reply(error: str | None = None) -> bytes:
    """The reply: ok, or not ok because of `error` (one line)."""
    if error is None:
        return _encode({"version": VERSION, "ok": True})
    return _encode({"version": VERSION, "ok": False, "error": error})


def decode_reply(packet: bytes) -> str | None:
    """None when the sidecar agreed, else its error.  Raises ProtocolError."""
    data = _decode(packet)
    if data.get("ok") is True:
        return None
    error = data.get("error")
    if data.get("ok") is not False or not isinstance(error, str):
        raise ProtocolError(f"not a reply: {packet[:80]!r}")
    return error


def received_fds(ancillary: list[tuple[int, int, bytes]]) -> list[int]:
    """The descriptors in the ancillary data of recvmsg(2); the caller must close them."""
    fds: list[int] = []
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            count = len(data) // struct.calcsize("i")
            fds.extend(struct.unpack(f"{count}i", data[: count * struct.calcsize("i")]))
    return fds


def receive_request(connection: socket.socket) -> tuple[Register | Deregister, int | None]:
    """Reads one request from an accepted connection (the sidecar's side).

    Returns it with the pidfd (which the caller must close) for a Register, None
    for a Deregister. Raises ProtocolError, OSError (timeouts and EAGAIN of the
    socket included); no descriptor is kept then. A hook that hangs up without a
    request only checked whether a sidecar listens (as precreate does):
    ConnectionResetError, an OSError.
    """
    room = socket.CMSG_SPACE(4 * struct.calcsize("i"))
    packet, ancillary, flags, _ = connection.recvmsg(MAX_BYTES, room, socket.MSG_CMSG_CLOEXEC)
    if not packet and not ancillary:
        raise ConnectionResetError("the hook hung up without a request")
    fds = received_fds(ancillary)
    try:
        if flags & socket.MSG_TRUNC:
            raise ProtocolError("the request is too long")
        if flags & socket.MSG_CTRUNC and not fds:
            raise ProtocolError("it has no descriptors left: give it more (podman run --ulimit nofile=N)")
        request = decode_request(packet)
        wanted = 1 if isinstance(request, Register) else 0
        if len(fds) != wanted or flags & socket.MSG_CTRUNC:
            raise ProtocolError(f"{wanted} descriptor(s) expected with the request, got {len(fds)}")
    except ProtocolError:
        for fd in fds:
            os.close(fd)
        raise
    return request, fds[0] if fds else None


def exchange(packet: bytes, pidfd: int | None = None, timeout_s: float = TIMEOUT_S) -> str | None:
    """Sends one request to the sidecar and waits for its reply (the hook's side).

    Returns None when the sidecar agreed, else its error. Raises TimeoutError when
    it does not answer, another OSError when there is no sidecar, ProtocolError
    when the answer is invalid. Never takes longer than `timeout_s`.
    """
    deadline = time.monotonic() + timeout_s
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
        connection.settimeout(timeout_s)
        # With a full backlog this is EAGAIN at once, not a wait: see connect(2).
        connection.connect(hooks_socket())
        ancillary = []
        if pidfd is not None:
            ancillary.append((socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack("i", pidfd)))
        connection.sendmsg([packet], ancillary)
        connection.settimeout(max(deadline - time.monotonic(), 0.001))
        try:
            packet = connection.recv(MAX_BYTES)
        except socket.timeout as error:  # an OSError of its own before Python 3.10
            raise TimeoutError(f"no answer within {timeout_s:g} s") from error
    if not packet:
        raise ProtocolError("the connection was closed without an answer")
    return decode_reply(packet)


def _encode(message: dict[str, object]) -> bytes:
    packet = json.dumps(message).encode()
    if len(packet) > MAX_BYTES:
        raise ProtocolError(f"the message is too long ({len(packet)} bytes)")
    return packet


def _decode(packet: bytes) -> dict[str, object]:
    try:
        data = json.loads(packet)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {packet[:80]!r}") from error
    if not isinstance(data, dict):
        raise ProtocolError(f"not a JSON object: {packet[:80]!r}")
    return data


def _container_id(data: dict[str, object]) -> str:
    container_id = data.get("id")
    if not isinstance(container_id, str) or not is_container_id(container_id):
        raise ProtocolError(f"not a container id: {container_id!r}")
    return container_id


def _check_version(data: dict[str, object]) -> None:
    if data.get("version") != VERSION:
        raise ProtocolError(
            f"protocol version {data.get('version')!r}, this side speaks {VERSION}: "
            "hooks and sidecar must be of the same release"
        )
