# SPDX-License-Identifier: Apache-2.0
"""What a unit may claim about itself, and how that is used."""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from avckpt.containers import units
from avckpt.containers.strangers import receive
from avckpt.errors import AvckptError, Busy, LabelsWrong
from avckpt.policy import settings_of
from avckpt_hooks.shared.protocol import ProtocolError

LAUNCHER = {"avckpt.enable": "true", "avckpt.scope": "nodes", "avckpt.interval": "1s", "avckpt.group": "drive"}


def packet(*fields: str) -> bytes:
    return b"".join(field.encode() + b"\0" for field in ("avckpt-unit 1", *fields))


def test_a_claim_is_a_name_and_labels() -> None:
    claim = units.decode_claim(packet("label=avckpt.interval=1s", "label=avckpt.keep=3", "program=lidar"))
    assert (claim.name, claim.labels) == ("lidar", {"avckpt.interval": "1s", "avckpt.keep": "3"})
    assert units.decode_claim(packet("name=front", "label=avckpt.name=rear", "program=lidar")).name == "front"
    named = units.decode_claim(packet("label=avckpt.name=rear", "program=lidar"))
    assert (named.name, named.labels) == ("rear", {})
    # Options come after the environment.
    twice = units.decode_claim(packet("label=avckpt.keep=3", "label=avckpt.keep=4", "program=lidar"))
    assert twice.labels == {"avckpt.keep": "4"}


@pytest.mark.parametrize(
    ("name", "called"),
    [("a/b c\n", "a_b_c_"), ("../..", "_"), ("", "node"), ("\u202eevil", "_evil"), ("x" * 500, "x" * 63)],
)
def test_a_name_is_harmless(name: str, called: str) -> None:
    assert units.decode_claim(packet(f"name={name}")).name == called


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (b"", "does not speak our protocol"),
        (b"avckpt-unit 2\0", "does not speak our protocol"),
        (b"avckpt-unit 1\0name=x", "does not speak our protocol"),
        (b"avckpt-unit 1\0name=\xff\0", "not UTF-8"),
        (packet("colour=red"), "unknown field 'colour'"),
        (packet("label=colour=red"), "ours begin with avckpt."),
        (packet(*["label=avckpt.keep=3"] * 100), "more than 64 things"),
    ],
)
def test_what_is_no_claim_is_refused(said: bytes, why: str) -> None:
    with pytest.raises(ProtocolError, match=why):
        units.decode_claim(said)


def test_a_nodes_labels_are_over_its_containers() -> None:
    policy = settings_of(units.labels_of_node({"avckpt.keep": "5"}, LAUNCHER)).policy
    assert (policy.keep, policy.interval_s, policy.group, policy.scope) == (5, 1.0, "drive", "container")
    assert policy.guarded
    policy = settings_of(units.labels_of_node({"avckpt.interval": "100ms"}, LAUNCHER)).policy
    assert policy.interval_s == 0.1


@pytest.mark.parametrize(
    ("labels", "container", "why"),
    [
        ({"avckpt.scope": "container"}, {}, "avckpt.scope: it is for whoever starts the container"),
        ({"avckpt.group": "other"}, {}, "avckpt.group: it is for whoever starts the container"),
        ({"avckpt.interval": "20ms"}, {}, "less than 100ms only if its container's labels do"),
        ({"avckpt.shm": "1GB"}, {}, "avckpt.shm: more than the container was given"),
        ({"avckpt.restore.max": "6/60s"}, {}, "avckpt.restore.max: more often than the container was given"),
        ({"avckpt.restore.max": "2/1s"}, {"avckpt.restore.max": "60/60s"}, "more often than the container"),
        ({"avckpt.restore.on": "unhealthy"}, {}, "takes a container's health check"),
        ({"avckpt.enable": "false"}, {}, "avckpt.enable is not true"),
        ({"avckpt.kepe": "3"}, {}, "did you mean avckpt.keep"),
        ({"avckpt.keep": "17"}, {}, "not within 1 to 16"),
    ],
)
def test_a_node_may_not_ask_for_everything(labels: dict[str, str], container: dict[str, str], why: str) -> None:
    with pytest.raises(LabelsWrong, match=why):
        units.labels_of_node(labels, {**LAUNCHER, **container})


def test_what_the_container_was_given_a_node_may_have() -> None:
    given = {**LAUNCHER, "avckpt.interval": "20ms", "avckpt.shm": "64MB"}
    policy = settings_of(units.labels_of_node({"avckpt.shm": "10MB"}, given)).policy
    assert (policy.interval_s, policy.shm_bytes) == (0.02, 10_000_000)


def test_a_host_units_labels() -> None:
    assert settings_of(units.labels_of_host_unit({"avckpt.group": "drive"})).policy.group == "drive"
    with pytest.raises(LabelsWrong, match="each program is a unit already"):
        units.labels_of_host_unit({"avckpt.scope": "nodes"})


def test_names_are_made_unique() -> None:
    assert units.unique_name("car/a", []) == "car/a"
    assert units.unique_name("car/a", ["car/a", "car/b"]) == "car/a-2"
    assert units.unique_name("car/a", ["car/a", "car/a-2", "car/a-4"]) == "car/a-3"


def test_registrations_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    allowance = units.Allowance(at_s=0.0)
    for _ in range(units.UNITS_MOST):
        allowance.take()
    with pytest.raises(Busy):
        allowance.take()
    now = 1.0
    for _ in range(int(units.REGISTRATIONS_PER_S)):
        allowance.take()
    with pytest.raises(Busy):
        allowance.take()


@contextmanager
def connected() -> Iterator[tuple[socket.socket, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.setblocking(False)
        yield ours, theirs


def send(connection: socket.socket, said: bytes, *fds: int) -> None:
    connection.sendmsg([said], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, struct.pack(f"{len(fds)}i", *fds))])


def served(connection: socket.socket, handler: units.Handler) -> str | None:
    with receive(connection, units.UNIT_BYTES) as said:
        said.settimeout(10)
        return units.serve(connection, said, handler)


def test_a_process_registers_itself_and_nobody_else() -> None:
    taken: list[units.Claim] = []

    def handler(claim: units.Claim, peer: units.Peer) -> None:
        assert (peer.pid, peer.uid) == (os.getpid(), os.getuid())
        taken.append(claim)
        os.close(peer.pidfd)

    before = len(os.listdir("/proc/self/fd"))
    own, other = os.pidfd_open(os.getpid()), os.pidfd_open(os.getppid())
    with connected() as (ours, theirs):
        send(ours, packet("name=a"), own)
        assert served(theirs, handler) is None
        assert ours.recv(100) == b"ok"
        assert [claim.name for claim in taken] == ["a"]
    for said, fds, answer in (
        (packet("name=a"), [other], b"no it can register itself only"),
        (packet("name=a"), [], b"no one descriptor wanted, 0 came"),
        (packet("name=a"), [own, own], b"no one descriptor wanted, 2 came"),
        (b"x" * units.UNIT_BYTES * 2, [own], b"no its message is too long"),
        (packet("name=a"), [0], None),
    ):
        with connected() as (ours, theirs):
            send(ours, said, *fds) if fds else ours.send(said)
            refused = served(theirs, handler)
            assert refused is not None
            heard = ours.recv(1000)
            assert heard.startswith(answer or b""), heard
    os.close(own)
    os.close(other)
    assert len(os.listdir("/proc/self/fd")) == before
    assert len(taken) == 1


@pytest.mark.parametrize(
    ("error", "word"), [(Busy("x"), "later"), (AvckptError("x"), "no"), (OSError(24, "x"), "later")]
)
def test_what_may_be_better_later_is_said_so(error: Exception, word: str) -> None:
    def handler(claim: units.Claim, peer: units.Peer) -> None:
        raise error

    own = os.pidfd_open(os.getpid())
    with connected() as (ours, theirs):
        send(ours, packet("name=a"), own)
        served(theirs, handler)
        assert ours.recv(100).split()[0].decode() == word
    os.close(own)
