# SPDX-License-Identifier: Apache-2.0
"""The peers' world: a Debian 13 with Podman 5 and CRIU 4, in memory and in namespaces of its own.

It does not touch the host's Podman, network or files, and ends with its first
process.  scripts/setup-peers.sh creates the tarball.
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType

from bench.subjects import BenchFailed, eventually
from bench.workload import PROGRAMS
from testkit.harness import ROOT, Completed, run
from testkit.procfs import children_of

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "avckpt"
# Where the script puts them.
PROGRAMS_INSIDE = Path("/programs")
BOARDS_INSIDE = Path("/boards")
IMAGE = "localhost/base"
COMMAND_TIMEOUT_S = 120.0


def _newest(pattern: str, setup: str) -> Path:
    found = sorted(CACHE.glob(pattern), key=lambda path: path.stat().st_mtime)
    if not found:
        raise BenchFailed(f"no {CACHE / pattern}: run {setup}")
    return found[-1]


class World:
    """A context manager; leaving it ends everything in it.  Raises BenchFailed, CommandFailed."""

    def __init__(self, boards: Path) -> None:
        self._boards = boards
        self._mountpoint = Path(tempfile.mkdtemp(prefix="avckpt-peers-"))
        self._base = _newest("base-*.tar", "make setup")
        tarball = _newest("peers-*.tar", "scripts/setup-peers.sh")
        PROGRAMS.mkdir(parents=True, exist_ok=True)
        command = ["unshare", "--mount", "--pid", "--net", "--ipc", "--uts", "--propagation", "private"]
        command += ["--fork", "--kill-child", "sh", str(ROOT / "bench" / "peers_world.sh")]
        command += [str(path) for path in (tarball, self._mountpoint, PROGRAMS, boards, CACHE)]
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
        self._has_image = self._uses_podman = False
        self._first = 0
        self.enter: list[str] = []
        """The command in front of a program that shall run in it."""

    def __enter__(self) -> World:
        try:
            assert self._process.stdout is not None
            if self._process.stdout.readline() != "up\n":
                raise BenchFailed("the peers' world does not start; what it said is above")
            eventually(lambda: len(children_of(self._process.pid)) == 1, "the peers' world has a first process")
            (self._first,) = children_of(self._process.pid)
            self.enter = ["nsenter", "--target", str(self._first), "--mount", "--pid", "--net", "--ipc", "--uts"]
            self.enter += ["--root", "--wd", "--", "env", "PODMAN_IGNORE_CGROUPSV1_WARNING=1", "HOME=/root"]
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._uses_podman:
            # So that no cgroups are left on the host.
            self.run("podman", "rm", "--all", "--force", "--time", "0", check=False)
        self._process.kill()
        self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        # Its mounts were in its own namespace.
        self._mountpoint.rmdir()

    def run(self, *args: str, check: bool = True) -> Completed:
        """A command inside, to its end.  Raises CommandFailed."""
        return run([*self.enter, *args], timeout_s=COMMAND_TIMEOUT_S, check=check)

    def start(self, *args: str) -> None:
        """A command inside that goes on by itself, in a session of its own."""
        self.run("setsid", "--fork", "sh", "-c", 'exec "$@" </dev/null >/dev/null 2>&1', "sh", *args)

    def outside(self, pid: int) -> int:
        """The number in our PID namespace of one of its processes.  Raises BenchFailed."""
        for entry in filter(str.isdigit, os.listdir("/proc")):
            with contextlib.suppress(OSError):
                numbers = Path(f"/proc/{entry}/status").read_text().split("NSpid:")[1].split("\n")[0].split()
                if len(numbers) > 1 and int(numbers[1]) == pid and self._is_inside(entry):
                    return int(entry)
        raise BenchFailed(f"no process {pid} in the peers' world")

    def _is_inside(self, pid: str) -> bool:
        mine, theirs = (os.readlink(f"/proc/{each}/ns/net") for each in (self._first, pid))
        return mine == theirs

    def import_image(self) -> None:
        """The same base image that the host's containers start from."""
        if not self._has_image:
            self._has_image = self._uses_podman = True
            self.run("podman", "import", "--quiet", f"/cache/{self._base.name}", IMAGE)

    def load_image(self, archive: Path) -> None:
        """Of `podman save`, by its path inside."""
        self._uses_podman = True
        self.run("podman", "load", "--quiet", "--input", str(archive))

    def versions(self) -> dict[str, str]:
        """Of what is compared with."""
        found = {}
        for name, args in {
            "criu": ("criu", "--version"),
            "podman": ("podman", "--version"),
            "crun": ("crun", "--version"),
            "runc": ("runc", "--version"),
        }.items():
            match = re.search(r"\d+\.\d+[.\d]*", self.run(*args).stdout)
            found[name] = match.group() if match else "?"
        return found
