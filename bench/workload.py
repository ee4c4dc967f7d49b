# SPDX-License-Identifier: Apache-2.0
"""The workload of bench/peers.py and bench/cost.py: bench/server.c, and bench/client.c that asks it."""

from __future__ import annotations

import array
import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from bench.subjects import BUILD, VICTIMS, BenchFailed, eventually
from testkit.board import Board
from testkit.harness import ROOT

PROGRAMS = BUILD / "programs"
ASK_EVERY_US = 1000
NAME = "server"


def build_workload() -> None:
    """Compiles both, statically: they run in whatever Debian.  Raises BenchFailed."""
    PROGRAMS.mkdir(parents=True, exist_ok=True)
    for name in (NAME, "client"):
        command = [os.environ.get("CC", "cc"), "-std=gnu11", "-D_GNU_SOURCE", "-O2", "-Wall", "-Wextra", "-pthread"]
        command += ["-static", f"-I{VICTIMS}", "-o", str(PROGRAMS / f"{name}.{os.getpid()}"), f"{ROOT}/bench/{name}.c"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise BenchFailed(f"`{' '.join(command)}` failed: {done.stderr.strip()}")
        # Not over a copy that is being run.
        (PROGRAMS / f"{name}.{os.getpid()}").replace(PROGRAMS / name)


@contextmanager
def boards_folder() -> Iterator[Path]:
    """In memory: writing to a mapped file on a disk can make a process wait."""
    with tempfile.TemporaryDirectory(prefix="avckpt-bench-", dir="/dev/shm") as folder:
        os.chmod(folder, 0o755)
        yield Path(folder)


@dataclass(frozen=True)
class Identity:
    """Who answers the client, and over how many connections so far."""

    pid: int
    token: int
    served: int
    connections: int


@dataclass(frozen=True)
class Log:
    """Of every answered request, in the order of the answers: when it was sent (ns) and how long that took (ms)."""

    sent_ns: Sequence[int]
    latency_ms: Sequence[float]


class Client:
    """bench/client.c; `enter`: the command that starts a program where the server is."""

    def __init__(
        self,
        folder: Path,
        port: int,
        *,
        enter: Sequence[str] = (),
        program: Path = PROGRAMS / "client",
        inside: Path | None = None,
        every_us: int = ASK_EVERY_US,
        log: Path | None = None,
        seconds: float | None = None,
    ) -> None:
        self.board = Board(folder / f"client-{port}")
        command = [*enter, str(program), "127.0.0.1", str(port), "--every-us", str(every_us)]
        command += ["--board", str((inside or folder) / self.board.path.name)]
        if log is not None:
            command += ["--log", str(log)]
        if seconds is not None:
            command += ["--seconds", str(seconds)]
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        self.board.page.close()
        self.board.path.unlink(missing_ok=True)

    def wait_end(self) -> None:
        """Until `seconds` are over and the log is whole.  Raises BenchFailed."""
        try:
            status = self._process.wait(30)
        except subprocess.TimeoutExpired:
            raise BenchFailed("the client does not end") from None
        if status != 0:
            raise BenchFailed(f"the client has ended with {status}")

    @property
    def answers(self) -> int:
        return self.board.see().counter[0]

    @property
    def sent(self) -> int:
        return self.board.see().counter[5]

    def identity(self) -> Identity:
        counter = self.board.see().counter
        return Identity(pid=counter[2], token=counter[3], served=counter[4], connections=counter[1])

    def wait_answers(self, more: int, what: str) -> None:
        """Raises BenchFailed when there are not so many more answers in time."""
        enough = self.answers + more
        eventually(lambda: self.answers >= enough or self._process.poll() is not None, what, 0.001)
        if self._process.poll() is not None:
            raise BenchFailed(f"the client has ended with {self._process.returncode}")


def read_log(path: Path) -> Log:
    """What `--log` has written."""
    times = array.array("Q")
    data = path.read_bytes()
    times.frombytes(data[: len(data) // 16 * 16])
    sent, came = times[0::2], times[1::2]
    return Log(sent, [(b - a) / 1e6 for a, b in zip(sent, came)])


def find_server(board: Path) -> int:
    """The running server with this board, in our PID namespace; what avckpt makes of it has other names.

    Raises LookupError when there is none at this moment.
    """
    wanted = board.name.encode()
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        try:
            stat = Path(f"/proc/{entry}/stat").read_text()
            name, rest = stat[stat.index("(") + 1 :].rsplit(")", 1)
            if name != NAME or rest.split()[0] in "ZX":
                continue
            if any(Path(os.fsdecode(word)).name == board.name for word in _words(entry) if wanted in word):
                return int(entry)
        except OSError:
            continue
    raise LookupError(f"no running server has the board {board.name}")


def _words(pid: str) -> list[bytes]:
    return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
