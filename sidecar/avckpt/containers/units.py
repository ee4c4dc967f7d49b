# SPDX-License-Identifier: Apache-2.0
"""Units of protection that no hook registers: an avckpt-init below a launcher, or of the host.

Each connects to the sidecar's socket for units and identifies itself (native/init/unit.c). As
it may be in a container, its message is not trusted, only what the kernel reports about the
peer. It can register only itself, in the container that it is in, if that was started with
avckpt.scope=nodes.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import os
import re
import socket
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from avckpt_hooks.shared.labels import LABELS, SHM_MAX_BYTES, LabelError, Policy, parse_policy
from avckpt_hooks.shared.protocol import ProtocolError

from avckpt.bucket import Bucket
from avckpt.containers.process import has_ended, is_foreign, pid_of, start_time, status
from avckpt.containers.strangers import is_busy, let_go, receive, received
from avckpt.errors import AvckptError, Busy, Denied, LabelsWrong, TargetGone, of_any
from avckpt.lock import identity

log = logging.getLogger("avckpt")

UNIT_BYTES = 16384
"""Longest packet; PACKET_MAX of native/init/unit.c."""
GREETING = b"avckpt-unit 1"
FIELDS_MOST = 64
BACKLOG = 64
MAX_WAITING = 16
"""Connections of one party that have not sent their request yet."""
WAIT_S = 1.0
UNITS_MOST = 128
"""Of one container, or of the host."""
REGISTRATIONS_PER_S = 4.0
"""Further registrations per second after UNITS_MOST at once: each starts a guard."""
CONNECTIONS_MOST = 1024
"""Of one party, at once, ..."""
CONNECTIONS_PER_S = 16.0
"""... and further ones; the rest are closed unread."""
LEAVE_S = 0.02
"""Then what was hung up meanwhile is closed."""
BUSY_S = 0.1
"""While things of strangers are waited for."""
PARTIES_MOST = 256
"""Remembered."""
OTHERS = 0
"""The party of everybody who is neither root of the host nor below a launcher: they are refused, sooner or later."""
REFUSALS_TOLD = 16
"""Logged at once; ..."""
REFUSAL_S = 10.0
"""... then one in so many seconds: anybody can have a request refused."""
ANCESTORS_MOST = 64
HOST = "host"
"""Prefix of a unit's name when it is in no container."""
LEAST_INTERVAL_S = 0.1
"""A node may ask for this, or for what its container has been granted."""
NOT_INHERITED = frozenset(
    {"avckpt.enable", "avckpt.scope", "avckpt.name", "avckpt.version", "avckpt.notify", "avckpt.io_uring"}
)
NOT_A_NODES = (
    "avckpt.scope",
    "avckpt.group",
    "avckpt.group.recovery",
    "avckpt.io_uring",
    "avckpt.core",
    "avckpt.version",
)
"""Labels that concern more than the node itself."""


@dataclass(frozen=True)
class Claim:
    """What a unit says about itself."""

    name: str
    labels: Mapping[str, str]


def decode_claim(packet: bytes) -> Claim:
    """Raises ProtocolError with a clause for users."""
    fields = packet.split(b"\0")
    if fields.pop() or not fields or fields[0] != GREETING:
        raise ProtocolError("it does not speak our protocol: avckpt-init and sidecar must be of the same release")
    if len(fields) > FIELDS_MOST:
        raise ProtocolError(f"it says more than {FIELDS_MOST} things")
    names: dict[str, str] = {}
    labels: dict[str, str] = {}
    for each in fields[1:]:
        try:
            key, _, value = each.decode().partition("=")
        except UnicodeDecodeError as error:
            raise ProtocolError("what it says is not UTF-8") from error
        if key == "label":
            label, _, value = value.partition("=")
            if not label.startswith("avckpt."):
                raise ProtocolError(f"label {label[:60]!r}: ours begin with avckpt.")
            labels[label] = value
        elif key in ("name", "program"):
            names[key] = value
        else:
            raise ProtocolError(f"unknown field {key[:60]!r}")
    name = names.get("name") or labels.pop("avckpt.name", "") or names.get("program", "")
    labels.pop("avckpt.name", None)
    # It is never used as a file name, but in messages and arguments.
    return Claim(re.sub(r"[^A-Za-z0-9_.-]", "_", name).strip(".-")[:63] or "node", labels)


def labels_of_node(claimed: Mapping[str, str], container: Mapping[str, str]) -> dict[str, str]:
    """The effective labels of a node: its own over its container's.

    Raises LabelsWrong when they are wrong, or exceed what the container was granted.
    """
    for key in NOT_A_NODES:
        if key in claimed:
            raise LabelsWrong(f"label {key}: it is for whoever starts the container to give, not for a node")
    inherited = {key: value for key, value in container.items() if key in LABELS and key not in NOT_INHERITED}
    merged = {"avckpt.enable": "true", **inherited, **claimed}
    try:
        policy, allowed = parse_policy(merged), parse_policy(inherited)
        plain = parse_policy({})
    except LabelError as error:
        raise LabelsWrong(str(error)) from error
    if policy.restore_on.unhealthy:
        raise LabelsWrong("label avckpt.restore.on: unhealthy takes a container's health check, leave it out")
    if policy.interval_s < min(allowed.interval_s, LEAST_INTERVAL_S):
        raise LabelsWrong("label avckpt.interval: a node may ask for less than 100ms only if its container's labels do")
    if policy.shm_bytes > max(allowed.shm_bytes, plain.shm_bytes) or policy.shm_bytes > SHM_MAX_BYTES:
        raise LabelsWrong("label avckpt.shm: more than the container was given")
    if _restores_per_s(policy) > max(_restores_per_s(allowed), _restores_per_s(plain)):
        raise LabelsWrong("label avckpt.restore.max: more often than the container was given")
    if not policy.enable:
        raise LabelsWrong("label avckpt.enable is not true")
    return merged


def _restores_per_s(policy: Policy) -> float:
    return policy.restore_max / policy.restore_window_s


def labels_of_host_unit(claimed: Mapping[str, str]) -> dict[str, str]:
    """The same for a unit of the host, whose labels are root's.  Raises LabelsWrong."""
    merged = {"avckpt.enable": "true", **claimed}
    try:
        policy = parse_policy(merged)
    except LabelError as error:
        raise LabelsWrong(str(error)) from error
    if policy.restore_on.unhealthy:
        raise LabelsWrong("label avckpt.restore.on: unhealthy takes a container's health check, leave it out")
    if policy.scope != "container":
        raise LabelsWrong("label avckpt.scope=nodes: here each program is a unit already, leave it out")
    if not policy.enable:
        raise LabelsWrong("label avckpt.enable is not true")
    return merged


def unique_name(name: str, taken: Iterable[str]) -> str:
    """The name, or with -2, -3, ... behind it."""
    names = set(taken)
    if name not in names:
        return name
    return next(f"{name}-{i}" for i in range(2, len(names) + 3) if f"{name}-{i}" not in names)


# Its identity, according to the kernel


def check_sender(pidfd: int, pid: int) -> None:
    """Whether a pidfd is of the process that has connected.  Raises AvckptError."""
    if has_ended(pidfd):
        raise TargetGone("it has ended already")
    if is_foreign(pidfd):
        raise Denied("the sidecar does not see the host's processes: start it with --pid=host")
    if pid_of(pidfd) != pid:
        raise Denied("it can register itself only")


def pid_namespace(pid: int) -> int:
    """The namespaces that it is in. Raises OSError when it is gone."""
    return os.stat(f"/proc/{pid}/ns/pid").st_ino


def is_in(pid: int, container_id: str, container_pid: int) -> bool:
    """Whether a process is in a container: its PID namespace, and its control groups or some below.

    Raises OSError when one of them is gone.
    """
    if pid_namespace(pid) != pid_namespace(container_pid):
        return False
    its, theirs = _groups(pid), _groups(container_pid)
    # The main process may have moved itself away (an init.scope).
    if any(container_id in path for path in its.values()):
        return True
    return all(_is_below(path, theirs[names]) for names, path in its.items() if names in theirs)


def is_of_host(pid: int) -> bool:
    """Whether it is in our own PID and user namespace.  Raises OSError when it is gone."""
    return all(
        os.stat(f"/proc/{pid}/ns/{kind}").st_ino == os.stat(f"/proc/self/ns/{kind}").st_ino for kind in ("pid", "user")
    )


def ancestors(pid: int) -> Iterator[int]:
    """Its parent, that one's parent, ...  Ends when one is gone."""
    for _ in range(ANCESTORS_MOST):
        try:
            pid = int(status(pid)["PPid"])
        except (OSError, KeyError, ValueError):
            return
        if pid <= 1:
            return
        yield pid


def unit_id(owner: str, pid: int) -> str:
    """64 hex digits, the same for the same process.  Raises TargetGone."""
    return hashlib.sha256(f"{owner} {pid} {start_time(pid)}".encode()).hexdigest()


def _groups(pid: int) -> dict[str, str]:
    lines = os.fsdecode(Path(f"/proc/{pid}/cgroup").read_bytes()).split("\n")[:-1]
    return {names: path for _, names, path in (line.split(":", 2) for line in lines)}


def _is_below(path: str, top: str) -> bool:
    return path == top or path.startswith(top.rstrip("/") + "/")


@dataclass
class Allowance(Bucket):
    """How many registrations one container has left."""

    most: float = UNITS_MOST
    per_s: float = REGISTRATIONS_PER_S

    def take(self) -> None:
        """Raises Busy when there are none."""
        if not self.has_one():
            raise Busy("too many units were started in too short a time")


# The socket


@dataclass(frozen=True)
class Peer:
    """The peer of a connection; the connection is its registration."""

    connection: socket.socket
    pidfd: int
    pid: int
    """In our own PID namespace."""
    uid: int


Handler = Callable[[Claim, Peer], None]
"""Registers a unit; connection and pidfd then belong to the registration. Raises AvckptError or OSError to
refuse."""


class UnitListener:
    """Accepts units.  Runs in the event loop that is running."""

    def __init__(self, path: Path, handler: Handler, is_launchers: Callable[[int], bool]) -> None:
        """`is_launchers`: whether a PID namespace is that of a container with nodes."""
        self._path = path
        self._handler = handler
        self._is_launchers = is_launchers
        self._own_space = pid_namespace(os.getpid())
        self._loop = asyncio.get_running_loop()
        self._waiting: dict[socket.socket, tuple[asyncio.TimerHandle, int]] = {}
        """And of which party."""
        self._parties: OrderedDict[int, Bucket] = OrderedDict()
        self._refusals = Bucket(REFUSALS_TOLD, 1 / REFUSAL_S)
        self._untold = 0
        self._leaving: list[socket.socket] = []
        self._reading: dict[socket.socket, socket.socket] = {}
        """By connection: where what it said will be."""
        self._listen()

    async def keep(self) -> bool:
        """Makes the socket again if its file was removed or replaced; whether it was.  Raises OSError."""
        if identity(self._path) == self._file:
            return False
        before = self._socket
        self._listen()
        self._loop.remove_reader(before)
        self._part(before)
        return True

    def _listen(self) -> None:
        self._socket = listen(self._path)
        self._file = identity(self._path)
        self._loop.add_reader(self._socket, self._accept)

    def close(self) -> None:
        """Closes every connection that is not a unit's yet, and removes the socket."""
        self._loop.remove_reader(self._socket)
        for connection in list(self._waiting):
            self._drop(connection)
        self._leaving.append(self._socket)  # with all that wait to be accepted
        self._leave()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        if is_busy():
            self._accept_later(BUSY_S)
            return
        try:
            connection, _ = self._socket.accept()
        except (BlockingIOError, ConnectionAbortedError):
            return
        except OSError as error:
            log.error("a unit cannot be accepted: %s", error.strerror)
            self._accept_later(WAIT_S)
            return
        connection.setblocking(False)
        try:
            pid, uid = credentials(connection)
            party = self._party(pid_namespace(pid), uid)
        except OSError:
            self._part(connection)
            return
        waiting = sum(1 for _, other in self._waiting.values() if other == party)
        if waiting >= MAX_WAITING or not self._may_ask(party):
            self._part(connection)  # it tries again
            return
        timer = self._loop.call_later(WAIT_S, self._drop, connection)
        self._waiting[connection] = timer, party
        self._loop.add_reader(connection, self._read, connection)

    def _party(self, space: int, uid: int) -> int:
        """Who shares what room there is.  Nobody is to get more by making namespaces, or changing its user."""
        if space == self._own_space:
            return space if uid == 0 else OTHERS
        return space if self._is_launchers(space) else OTHERS

    def _may_ask(self, party: int) -> bool:
        allowance = self._parties.setdefault(party, Bucket(CONNECTIONS_MOST, CONNECTIONS_PER_S))
        self._parties.move_to_end(party)
        if len(self._parties) > PARTIES_MOST:
            self._parties.popitem(last=False)
        return allowance.has_one()

    def _accept_later(self, seconds: float) -> None:
        self._loop.remove_reader(self._socket)
        self._loop.call_later(seconds, self._accept_again)

    def _accept_again(self) -> None:
        if self._socket.fileno() >= 0:
            self._loop.add_reader(self._socket, self._accept)

    def _read(self, connection: socket.socket) -> None:
        self._loop.remove_reader(connection)
        try:
            said = self._reading[connection] = receive(connection, UNIT_BYTES)
        except (OSError, RuntimeError) as error:
            log.error("a unit cannot be heard: %s", error)
            self._drop(connection)
        else:
            self._loop.add_reader(said, self._serve, connection, said)

    def _serve(self, connection: socket.socket, said: socket.socket) -> None:
        try:
            answer = serve(connection, said, self._handler)
        except BlockingIOError:
            return  # not readable after all
        if answer is None:
            self._forget(connection)
        else:
            self._drop(connection)
            self._tell(answer.partition(" ")[2])

    def _tell(self, refusal: str) -> None:
        if not self._refusals.has_one():
            self._untold += 1
            return
        more = f" (and {self._untold} others since this was last said)" if self._untold else ""
        self._untold = 0
        log.warning("refused a unit: %s%s", refusal, more)

    def _drop(self, connection: socket.socket) -> None:
        self._forget(connection)
        self._part(connection)

    def _part(self, connection: socket.socket) -> None:
        """Hangs up, and closes it soon: many together cost little more than one."""
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
        if not self._leaving:
            self._loop.call_later(LEAVE_S, self._leave)
        self._leaving.append(connection)

    def _leave(self) -> None:
        let_go(*(connection.detach() for connection in self._leaving))
        self._leaving.clear()

    def _forget(self, connection: socket.socket) -> None:
        waiting = self._waiting.pop(connection, None)
        if waiting is not None:
            waiting[0].cancel()
            self._loop.remove_reader(connection)
        said = self._reading.pop(connection, None)
        if said is not None:
            self._loop.remove_reader(said)
            said.close()


def listen(path: Path) -> socket.socket:
    """A listening socket that any process that can see it may connect to; replaces what a killed sidecar left
    behind."""
    path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    try:
        listening.bind(str(path))
        path.chmod(0o666)
        listening.listen(BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening


def credentials(connection: socket.socket) -> tuple[int, int]:
    """PID and UID of the process at the other end.  Raises OSError."""
    pid, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return pid, uid


def serve(connection: socket.socket, said: socket.socket, handler: Handler) -> str | None:
    """Takes a unit's request, which `receive()` has read, and answers. The refusal, or None: then the connection is
    the handler's.

    The caller hangs up on who was refused.  Raises BlockingIOError when there is no request yet.
    """
    name = "a unit"
    fds: list[int] = []
    try:
        request = received(said, UNIT_BYTES)
        if request is None:
            raise Busy("what it said cannot be read")
        packet, came, fds = request
        if len(packet) > UNIT_BYTES:
            raise ProtocolError("its message is too long")
        claim = decode_claim(packet)
        name = claim.name
        pid, uid = credentials(connection)
        name = f"{claim.name} (pid {pid})"
        if came != 1:
            raise ProtocolError(f"one descriptor wanted, {came} came")
        if not fds:
            raise Denied("its descriptor is not one of a process")
        check_sender(fds[0], pid)
        handler(claim, Peer(connection, fds[0], pid, uid))
    except BlockingIOError:
        raise
    except (ProtocolError, AvckptError, OSError) as error:
        for fd in fds:
            os.close(fd)
        word = "later" if isinstance(error, (Busy, OSError)) else "no"
        why = str(error) if isinstance(error, (ProtocolError, AvckptError)) else str(of_any(error))
        _say(connection, f"{word} {why}")
        return f"{word} {name}: {why}"
    _say(connection, "ok")
    return None


def _say(connection: socket.socket, text: str) -> None:
    try:
        connection.send(text.encode(errors="replace")[:1000])
    except OSError as error:
        log.debug("a unit went away: %s", error)
