# SPDX-License-Identifier: Apache-2.0
"""OpenSSH's server: privilege separation, with a child under a seccomp filter before the login."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, config
from testkit.harness import wait_until
from testkit.init_peer import Init
from testkit.procfs import below, state_of

SSHD = "/usr/sbin/sshd"
CLIENT = "nobody"
"""Another user than the server's, which logs in without a shell."""

pytestmark = pytest.mark.skipif(not os.access(SSHD, os.X_OK) or not shutil.which("sftp"), reason="no OpenSSH here")

CONFIG = """
HostKey {folder}/key
ListenAddress 127.0.0.1
Port {port}
PidFile none
UsePAM no
StrictModes no
AuthorizedKeysFile {folder}/key.pub
LoginGraceTime 0
Subsystem sftp internal-sftp
ForceCommand internal-sftp
"""


@dataclass
class Server:
    """sshd below avckpt-init."""

    init: Init
    folder: Path
    port: int
    app: int = 0

    def restored(self, guard: GuardProcess) -> None:
        since = guard.mark()
        os.kill(self.app, signal.SIGKILL)
        event = guard.wait("restored", since=since)
        assert "error" not in event, event
        self.app = event["app_pid"]

    def named(self, name: str) -> list[int]:
        """Its processes with that in their command line."""
        return [pid for pid in below(self.app) if f"[{name}]" in command_of(pid) and state_of(pid) not in "ZX"]


def command_of(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text().replace("\0", " ")
    return ""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@pytest.fixture
def server(init_built: None) -> Iterator[Server]:
    # The user that logs in reads the key.
    with tempfile.TemporaryDirectory() as name:
        folder, port = Path(name), free_port()
        folder.chmod(0o755)
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / "key"], check=True)
        (folder / "config").write_text(CONFIG.format(folder=folder, port=port))
        Path("/run/sshd").mkdir(exist_ok=True)
        with Init([SSHD, "-D", "-f", folder / "config"], pid1=True) as init:
            yield Server(init, folder, port)


def next_checkpoint(guard: GuardProcess) -> None:
    """Of a state that is there now."""
    guard.wait("checkpoint", since=guard.mark(), count=2)


class Session:
    """A client that has logged in."""

    def __init__(self, server: Server) -> None:
        options = ["StrictHostKeyChecking=no", "UserKnownHostsFile=/dev/null", "LogLevel=ERROR", "BatchMode=yes"]
        self.process = subprocess.Popen(
            [
                *("sftp", "-q", "-P", str(server.port), "-i", str(server.folder / "key")),
                *(word for option in options for word in ("-o", option)),
                f"{CLIENT}@127.0.0.1",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_error: object) -> None:
        self.process.kill()
        self.process.communicate()

    def ask(self, command: str, answer: str) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{command}\n".encode())
        said, end = b"", time.monotonic() + PATIENCE_S
        while answer.encode() not in said:
            assert select.select([self.process.stdout], [], [], max(end - time.monotonic(), 0))[0], said
            some = os.read(self.process.stdout.fileno(), 4096)
            assert some, said
            said += some


def test_a_session_goes_on(server: Server) -> None:
    """Its processes are several users' in a directory of their own, and the connection is the same."""
    with GuardProcess(config(0.1), [server.init.pid]) as guard:
        server.app = guard.wait("attached")["app_pid"]
        next_checkpoint(guard)
        with Session(server) as session:
            session.ask("cd /usr", "sftp>")
            for _ in range(3):
                next_checkpoint(guard)
                server.restored(guard)
                session.ask("pwd", "Remote working directory: /usr")
        with Session(server) as session:
            session.ask("pwd", "Remote working directory: /")


def test_before_the_login(server: Server) -> None:
    """Its child is killed for what a checkpoint calls, and for restart_syscall(2): no checkpoint, no harm."""
    with GuardProcess(config(0.02), [server.init.pid]) as guard:
        server.app = guard.wait("attached")["app_pid"]
        next_checkpoint(guard)
        with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE_S) as client:
            assert client.recv(256).startswith(b"SSH-2.0-")
            client.sendall(b"SSH-2.0-test\r\n")
            (child,) = wait_until(lambda: server.named("net"), PATIENCE_S, "its child is there")
            guard.wait_for(
                lambda event: "may kill it, if the guard dies" in event.get("error", {}).get("message", ""), "a reason"
            )
            assert server.named("net") == [child]
        wait_until(lambda: not server.named("net"), PATIENCE_S, "it has ended")
        next_checkpoint(guard)
        server.restored(guard)
        with Session(server) as session:
            session.ask("pwd", "Remote working directory: /")
