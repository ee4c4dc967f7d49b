# SPDX-License-Identifier: Apache-2.0
"""The hooks' socket, with real hooks' code on its other end."""

from __future__ import annotations

import asyncio
import errno
import os
import resource
import socket
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from avckpt.containers.listener import HookListener
from avckpt.errors import Busy
from avckpt_hooks.shared import protocol
from avckpt_hooks.shared.protocol import Deregister, Register

T = TypeVar("T")
REGISTER = Register(id="ab" * 32, name="web", pid=1, starttime=1, bundle="/b", annotations={"avckpt.enable": "true"})


@pytest.fixture(autouse=True)
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path))
    return tmp_path


def served(handler: Callable[[Register | Deregister, int | None], None], talk: Callable[[], T]) -> T:
    """What `talk`, in a thread, gets while the listener runs."""

    async def main() -> T:
        listener = HookListener(Path(protocol.hooks_socket()), handler)
        try:
            return await asyncio.get_running_loop().run_in_executor(None, talk)
        finally:
            listener.close()

    return asyncio.run(main())


def test_a_registration_arrives_with_its_pidfd() -> None:
    got: list[tuple[str, int]] = []

    def handler(request: Register | Deregister, pidfd: int | None) -> None:
        assert isinstance(request, Register)
        assert pidfd is not None
        got.append((request.name, os.fstat(pidfd).st_ino))
        os.close(pidfd)

    pidfd = os.pidfd_open(os.getpid())
    assert served(handler, lambda: protocol.exchange(REGISTER.encode(), pidfd)) is None
    assert got == [("web", os.fstat(pidfd).st_ino)]
    os.close(pidfd)


def test_a_refusal_reaches_the_hook() -> None:
    def handler(request: Register | Deregister, pidfd: int | None) -> None:
        raise Busy("not now")

    assert served(handler, lambda: protocol.exchange(Deregister(id="ab" * 32).encode())) == "not now"


def test_what_the_kernel_refuses_reaches_the_hook_too() -> None:
    def handler(request: Register | Deregister, pidfd: int | None) -> None:
        raise OSError(errno.EAGAIN, "as good as any")

    said = served(handler, lambda: protocol.exchange(Deregister(id="ab" * 32).encode()))
    assert said == "the kernel said no (Resource temporarily unavailable)"


def test_nonsense_is_answered_and_the_next_one_served() -> None:
    def handler(request: Register | Deregister, pidfd: int | None) -> None:
        return

    def talk() -> tuple[str | None, str | None]:
        return protocol.exchange(b"{}"), protocol.exchange(Deregister(id="ab" * 32).encode())

    first, second = served(handler, talk)
    assert first is not None
    assert "unknown op" in first
    assert second is None


def test_a_silent_hook_is_dropped_and_blocks_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "TIMEOUT_S", 0.1)

    def talk() -> tuple[str | None, bytes]:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as silent:
            silent.settimeout(5)
            silent.connect(protocol.hooks_socket())
            answer = protocol.exchange(Deregister(id="ab" * 32).encode(), timeout_s=5)
            return answer, silent.recv(100)

    assert served(lambda request, pidfd: None, talk) == (None, b"")


def test_without_descriptors_it_waits_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    def talk() -> tuple[str | None, float]:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as hook:
            hook.settimeout(5)
            before = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
            try:
                hook.connect(protocol.hooks_socket())
                hook.send(Deregister(id="ab" * 32).encode())
                begun = time.process_time()
                time.sleep(0.7)
                busy_s = time.process_time() - begun
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, before)
            return protocol.decode_reply(hook.recv(1000)), busy_s

    answer, busy_s = served(lambda request, pidfd: None, talk)
    assert answer is None
    assert busy_s < 0.2
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("hooks cannot be answered (Too many open files): ")


def test_the_socket_is_roots_alone_and_replaces_a_dead_one(run_dir: Path) -> None:
    path = run_dir / "hooks.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left_behind:
        left_behind.bind(str(path))

    def talk() -> int:
        assert protocol.exchange(Deregister(id="ab" * 32).encode()) is None
        return stat.S_IMODE(path.stat().st_mode)

    assert served(lambda request, pidfd: None, talk) == 0o600
    assert not path.exists()
