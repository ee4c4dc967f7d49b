# SPDX-License-Identifier: Apache-2.0
"""The other sides of avckpt-init: who starts it, and the guard that it reports to.

Nothing in here is a stand-in: `Guard` speaks the protocol of avckpt/ctl.h through
/proc/INIT/fd, and `Phoenix` really puts a new process under the app's PID.
"""

from __future__ import annotations

import contextlib
import enum
import fcntl
import mmap
import os
import select
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from testkit.harness import ROOT, SLOWNESS, wait_until
from testkit.procfs import children_of, comm_of

INIT = Path(os.environ.get("AVCKPT_TEST_INIT") or ROOT / "native/build/avckpt-init")  # another build of it
PHOENIX = ROOT / "tests/victims/build/phoenix"

MAGIC = 0x314C544354504B43
CTL = struct.Struct("=QIiiiiIIxxxxQiiixxxx")
REPORT = struct.Struct("=IIiiIIQ")
VERDICT = struct.Struct("=II")
ARMED_OFFSET = 32

PATIENCE_S = 30.0 * SLOWNESS

InitT = TypeVar("InitT", bound="Init")
PageT = TypeVar("PageT", bound="Page")


class Verdict(enum.IntEnum):
    RESTORED = 1
    GIVE_UP = 2
    WORKING = 3


@dataclass(frozen=True)
class Ctl:
    """struct avc_ctl."""

    magic: int
    version: int
    init_pid: int
    app_pid: int
    report_fd: int
    verdict_fd: int
    wait_ms: int
    armed: int
    stop_asked_ns: int
    exec_errno: int
    is_unit: int
    keys_pid: int


@dataclass(frozen=True)
class Report:
    """struct avc_report."""

    kind: int
    seq: int
    pid: int
    status: int
    flags: int
    reserved: int
    reaped_ns: int


class Lines:
    """Lines over a stream socket, with patience."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.buffer = b""

    def say(self, line: str) -> None:
        self.sock.sendall(line.encode() + b"\n")

    def hear(self, patience_s: float = PATIENCE_S) -> str:
        """The next line; "" at the end of the stream. Raises TimeoutError."""
        self.sock.settimeout(patience_s)
        while b"\n" not in self.buffer:
            data = self.sock.recv(4096)
            if not data:
                return ""
            self.buffer += data
        line, _, self.buffer = self.buffer.partition(b"\n")
        return line.decode()

    def ask(self, line: str) -> str:
        self.say(line)
        return self.hear()

    def is_silent(self, for_s: float) -> bool:
        return not self.buffer and not select.select([self.sock], [], [], for_s)[0]


class Init:
    """A running avckpt-init with something under it; ends it on the way out."""

    def __init__(
        self,
        command: Sequence[str | Path],
        *,
        pid1: bool = False,
        options: Sequence[str] = (),
        pass_fds: Sequence[int] = (),
        prefix: Sequence[str] = (),
        stdin: int | None = subprocess.DEVNULL,
        stdout: int | None = subprocess.PIPE,
        stderr: int | None = subprocess.PIPE,
        env: dict[str, str] | None = None,
        preexec: Callable[[], None] | None = None,
    ) -> None:
        argv: list[str | Path] = list(prefix)
        if pid1:
            argv += ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child=KILL"]
        argv += [INIT, *options, "--", *command]
        self.pid1 = pid1
        self.popen = subprocess.Popen(
            argv,
            stdin=stdin,
            stdout=stdout,
            stderr=stderr,
            pass_fds=pass_fds,
            env=env,
            preexec_fn=preexec,
        )
        self.pid = self.popen.pid
        self.pidfd = -1
        self.prefixed = bool(prefix)

    def __enter__(self: InitT) -> InitT:
        if self.pid1 or self.prefixed:
            self.pid = self._find(self.popen.pid)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.popen.poll() is None:
            orphans = [] if self.pid1 else children_of(self.pid)
            if self.pid != self.popen.pid:
                self.kill(signal.SIGKILL)
            self.popen.kill()
            self.popen.wait()
            for pid in orphans:
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    continue
        for stream in (self.popen.stdout, self.popen.stderr):
            if stream:
                stream.close()

    def _find(self, pid: int) -> int:
        """avckpt-init among the descendants of pid."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            todo = [(pid, pid)]
            while todo:
                above, here = todo.pop()
                if comm_of(here) == "avckpt-init":
                    # It may have become that, and forked the application, since it was looked at: both have the name.
                    return above if comm_of(above) == "avckpt-init" else here
                todo += [(here, child) for child in children_of(here)]
            if self.popen.poll() is not None:
                return pid  # over already: there is only the status to look at
            time.sleep(0.002)
        raise AssertionError("avckpt-init did not start")

    def kill(self, sig: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, sig)

    def end(self, patience_s: float = PATIENCE_S) -> int:
        """Waits for init's exit status; negative: killed by that signal."""
        return self.popen.wait(patience_s)

    def error_text(self) -> str:
        assert self.popen.stderr
        data = self.popen.stderr.read()
        return data.decode() if isinstance(data, bytes) else str(data)

    def output(self) -> str:
        assert self.popen.stdout
        data = self.popen.stdout.read()
        return data.decode() if isinstance(data, bytes) else str(data)

    def ctl_path(self) -> str | None:
        folder = f"/proc/{self.pid}/fd"
        try:
            for name in os.listdir(folder):
                if "memfd:avckpt-ctl" in os.readlink(f"{folder}/{name}"):
                    return f"{folder}/{name}"
        except (FileNotFoundError, ProcessLookupError):
            pass
        return None


class Phoenix(Init):
    """avckpt-init with tests/victims/phoenix under it."""

    def __init__(
        self,
        *,
        pid1: bool = False,
        options: Sequence[str] = (),
        prefix: Sequence[str] = (),
        stdin: int | None = subprocess.DEVNULL,
        stderr: int | None = subprocess.PIPE,
        preexec: Callable[[], None] | None = None,
    ) -> None:
        template, template_far = socket.socketpair()
        app, app_far = socket.socketpair()
        self.template, self.app = Lines(template), Lines(app)
        far = (template_far.fileno(), app_far.fileno())
        super().__init__(
            [PHOENIX, *map(str, far)],
            pid1=pid1,
            options=options,
            pass_fds=far,
            prefix=prefix,
            stdin=stdin,
            stderr=stderr,
            preexec=preexec,
        )
        template_far.close()
        app_far.close()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        super().__exit__(kind, error, trace)
        self.template.sock.close()
        self.app.sock.close()

    def app_pid(self) -> int:
        """The app's main process as it sees itself."""
        answer = self.app.ask("ping").split()
        assert answer[0] == "pong", answer
        return int(answer[1])

    def spawn(self, pid: int) -> None:
        """A new process with that PID (in init's namespace), which does not run yet."""
        answer = ""
        deadline = time.monotonic() + PATIENCE_S
        # The number is free as soon as init has reaped: as a guard, we try again.
        while answer != f"spawned {pid}":
            assert time.monotonic() < deadline, answer
            answer = self.template.ask(f"spawn {pid}")

    def go(self) -> None:
        assert self.template.ask("go") == "gone"


class Page:
    """The ctl page of one avckpt-init, mapped through /proc as a guard does."""

    def __init__(self, init: Init) -> None:
        self.init = init
        paths: list[str] = []

        def found() -> bool:
            path = init.ctl_path()
            paths[:] = [path] if path else []
            return bool(paths)

        wait_until(found, PATIENCE_S, "the ctl page")
        self.fd = os.open(paths[0], os.O_RDWR)
        wait_until(lambda: os.fstat(self.fd).st_size == CTL.size, PATIENCE_S, "its size")
        self.page = mmap.mmap(self.fd, CTL.size)
        wait_until(lambda: self.ctl().magic == MAGIC, PATIENCE_S, "its magic")

    def __enter__(self: PageT) -> PageT:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.page.close()
        os.close(self.fd)

    def ctl(self) -> Ctl:
        return Ctl(*CTL.unpack(self.page[: CTL.size]))


class Guard(Page):
    """The guard's side of avckpt/ctl.h for one avckpt-init."""

    def __init__(self, init: Init, armed: bool = True) -> None:
        super().__init__(init)
        fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        wait_until(lambda: self.ctl().app_pid != 0, PATIENCE_S, "the app's start")
        assert self.ctl().version == 1
        ctl = self.ctl()
        folder = f"/proc/{init.pid}/fd"
        self.report_fd = os.open(f"{folder}/{ctl.report_fd}", os.O_RDONLY | os.O_NONBLOCK)
        self.verdict_fd = os.open(f"{folder}/{ctl.verdict_fd}", os.O_WRONLY)
        self.arm(armed)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.die()
        os.close(self.report_fd)
        super().__exit__(kind, error, trace)

    def arm(self, armed: bool = True) -> None:
        self.page[ARMED_OFFSET : ARMED_OFFSET + 4] = struct.pack("=I", armed)

    def report(self, patience_s: float = PATIENCE_S) -> Report:
        """The next report of a death. Raises AssertionError when none comes."""
        assert select.select([self.report_fd], [], [], patience_s)[0], "no report"
        return Report(*REPORT.unpack(os.read(self.report_fd, REPORT.size)))

    def hears_nothing(self, for_s: float) -> bool:
        return not select.select([self.report_fd], [], [], for_s)[0]

    def answer(self, seq: int, verdict: int) -> None:
        os.write(self.verdict_fd, VERDICT.pack(seq, verdict))

    def die(self) -> None:
        """What init sees of a guard that dies."""
        if self.verdict_fd >= 0:
            os.close(self.verdict_fd)
            self.verdict_fd = -1
