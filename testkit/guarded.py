# SPDX-License-Identifier: Apache-2.0
"""A victim below avckpt-init in a PID namespace of its own, guarded by a process that a test can see into."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import json
import os
import random
import re
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest
from avckpt.guard import GuardConfig, Images

from testkit import guard_peer
from testkit.board import UNAVAILABLE_STATUS, Board, Seen
from testkit.forked import Forked, preload
from testkit.harness import ROOT, SLOWNESS, app_pid, wait_until
from testkit.init_peer import Init
from testkit.procfs import children_of, inside

preload("testkit.guard_peer")

BUILD = ROOT / "tests/victims/build"
PATIENCE_S = 60.0 * SLOWNESS
"""Only a test that fails takes as long: where others take the CPU, to start a guard may take ten seconds."""

IMAGES = Images[os.environ.get("AVCKPT_TEST_IMAGES", "fork").upper()]
"""How checkpoints are made where a test does not care: AVCKPT_TEST_IMAGES=dirty runs them all the other way."""

PR_SET_TIMERSLACK = 29

Json = dict[str, Any]


def config(interval_s: float = 0.0, **changes: Any) -> GuardConfig:
    """Restores as often as it takes, looks for no quiet moment; 0: checkpoints on command only."""
    plain = GuardConfig(
        interval_s=interval_s,
        keep=2,
        restore_on_signal=True,
        restore_on_exit=True,
        restore_on_statuses=frozenset(),
        restore_max=64,
        restore_window_s=0.5,
        quiesce_s=0.0,
        # 0: the engine's own.
        freeze_deadline_s=0.05 * SLOWNESS if SLOWNESS > 1 else 0.0,
        images=IMAGES,
    )
    return dataclasses.replace(plain, **changes)


class GuardProcess:
    """guard_peer.py; see there.  A context manager that kills it."""

    def __init__(self, guard_config: GuardConfig, inits: Sequence[int]) -> None:
        fields = dataclasses.asdict(guard_config)
        fields["restore_on_statuses"] = sorted(guard_config.restore_on_statuses)
        stdin, commands = os.pipe()
        answers, stdout = os.pipe()
        self.process = Forked(guard_peer.main, [json.dumps(fields), *map(str, inits)], stdin=stdin, stdout=stdout)
        os.close(stdin)
        os.close(stdout)
        self._commands, self._answers = os.fdopen(commands, "w"), os.fdopen(answers)
        self.events: list[Json] = []
        self._news = threading.Condition()
        self._ended = False
        self._tickets = 0
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.guards: list[int] = self.wait("started")["guards"]

    def __enter__(self) -> GuardProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()
        self._reader.join()
        self._commands.close()
        self._answers.close()

    @property
    def pid(self) -> int:
        """The (first) guard."""
        return self.guards[0]

    def kill(self) -> None:
        """SIGKILL for the guards, then for the process that started them; returns when they are gone."""
        self.kill_guards()
        self.process.kill()
        self.process.wait()

    def start_another(self, init: int) -> None:
        """The (first) guard is killed, and another one takes its place: ten times as fast as another GuardProcess."""
        self.kill_guards()
        since = self.mark()
        self._say(f"start 1 {init}")
        self.guards = self.wait("started", since=since)["guards"]
        self.wait("attached", since=since)

    def kill_guards(self) -> None:
        """SIGKILL; returns when they are gone."""
        pidfds = []
        for pid in self.guards:
            with contextlib.suppress(ProcessLookupError):
                pidfds.append(os.pidfd_open(pid))
        for pidfd in pidfds:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        for pidfd in pidfds:
            select.select([pidfd], [], [], PATIENCE_S)
            os.close(pidfd)

    def fds(self) -> Counter[str]:
        """Its descriptors: how many there are of each kind."""
        kinds: Counter[str] = Counter()
        for number in os.listdir(f"/proc/{self.pid}/fd"):
            with contextlib.suppress(FileNotFoundError):
                kinds[re.sub(r"\d+", "N", os.readlink(f"/proc/{self.pid}/fd/{number}"))] += 1
        return kinds

    def mark(self) -> int:
        """A moment: give it to wait() as `since`."""
        with self._news:
            return len(self.events)

    def wait(
        self, what: str, *, since: int = 0, count: int = 1, cookie: int = 0, timeout_s: float = PATIENCE_S
    ) -> Json:
        """The `count`th event of the kind `what` after `since`.  Fails with what came instead."""
        return self.wait_for(
            lambda event: event.get("kind") == what and cookie in (0, event.get("cookie")),
            f"{count} x {what}",
            since=since,
            count=count,
            timeout_s=timeout_s,
        )

    def wait_for(
        self,
        fits: Callable[[Json], bool],
        what: str,
        *,
        since: int = 0,
        count: int = 1,
        timeout_s: float = PATIENCE_S,
    ) -> Json:
        """The `count`th event after `since` that fits."""
        deadline = time.monotonic() + timeout_s
        at, found = since, 0
        with self._news:
            while True:
                while at < len(self.events):
                    found += fits(self.events[at])
                    at += 1
                    if found == count:
                        return self.events[at - 1]
                left = deadline - time.monotonic()
                if left <= 0 or self._ended or not self._news.wait(left):
                    raise AssertionError(
                        f"no {what}; but {self.events[since:][-12:]}, after {self.events[:since][-8:]}"
                    )

    def wait_held(self, cookie: int = 1) -> None:
        """Until it holds a generation.  A restore that gets no CPU to make another template uses its own up."""
        with self._news:
            since = len(self.events)
            last = next(event for event in reversed(self.events) if event.get("cookie") == cookie)
        if not last.get("generations"):
            self.wait("checkpoint", since=since, cookie=cookie)

    def command(self, name: str, cookie: int = 1, timeout_s: float = PATIENCE_S) -> Json:
        """`checkpoint` or `restore`, once init was found; returns the answer."""
        ticket = self.say_command(name, cookie)
        return self.wait_for(lambda event: event.get("ticket") == ticket, f"answer to {name}", timeout_s=timeout_s)

    def checkpoint(self, cookie: int = 1) -> Json:
        """Has one taken, again while it is missed, as where others take the CPU; the last answer."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            answer = self.command("checkpoint", cookie)
            if answer["kind"] != "missed" or time.monotonic() > deadline:
                return answer

    def say_command(self, name: str, cookie: int = 1, within_s: float = 0.0) -> int:
        """The same without waiting for the answer, which has this ticket; to be begun within that time (0: any)."""
        self.wait("attached", cookie=cookie)
        return self._say(f"{name} {cookie} %d {within_s}")

    def say_seen(self, pid: int, cookie: int = 1) -> None:
        """The memory of the dead, a `remains_pid` or `likeness_pid`, has been looked at."""
        self._say(f"seen {cookie} {pid}")

    def say_tasks(self, limit: int, cookie: int = 1) -> None:
        """The limit of its container's tasks has changed (`podman update --pids-limit`)."""
        self._say(f"tasks {cookie} {limit}")

    def say_memory(self, limit_bytes: int, cookie: int = 1) -> None:
        """The limit of its container's memory has (`podman update --memory`)."""
        self._say(f"memory {cookie} {limit_bytes}")

    def burst(self, n: int, cookie: int = 1, timeout_s: float = 110.0) -> Json:
        """`n` checkpoints back to back."""
        self.wait("attached", cookie=cookie)
        ticket = self._say(f"burst {cookie} %d {n}")
        return self.wait_for(lambda event: event.get("burst") == ticket, f"end of {n} checkpoints", timeout_s=timeout_s)

    def stop(self) -> None:
        """Stops the guards, in good order; the process stays."""
        since = self.mark()
        self._say("stop")
        self.wait("stopped", since=since)

    def _say(self, line: str) -> int:
        self._tickets += 1
        self._commands.write((line % self._tickets if "%d" in line else line) + "\n")
        self._commands.flush()
        return self._tickets

    def _read(self) -> None:
        for line in self._answers:
            with self._news:
                self.events.append(json.loads(line))
                if self.events[-1].get("kind") == "started":
                    self.guards = self.events[-1]["guards"]
                self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()


class Victim(Init):
    """A program of tests/victims below avckpt-init, with its board."""

    def __init__(
        self,
        command: str,
        folder: Path,
        *,
        options: Sequence[str] = (),
        with_board: bool = True,
        preexec: Callable[[], None] | None = None,
    ) -> None:
        program, *args = command.split()
        self.command = command
        self.board = Board(folder / f"board-{Path(program).name}-{time.monotonic_ns()}")
        self.output_path = self.board.path.with_suffix(".out")
        if with_board:
            args += ["--board", str(self.board.path)]
        self._file = self.output_path.open("wb")
        super().__init__(
            [BUILD / program, *args],
            pid1=True,
            # So that one who gets no CPU for seconds has not died for good.
            options=("--wait-ms", "60000", *options),
            stdout=self._file.fileno(),
            stderr=subprocess.STDOUT,
            preexec=preexec,
        )

    def __enter__(self) -> Victim:
        super().__enter__()
        try:
            wait_until(
                lambda: self.see().ready or self.popen.poll() is not None, PATIENCE_S, f"{self.command} is ready"
            )
        except TimeoutError:
            self.__exit__(None, None, None)  # nobody else would
            raise
        if self.popen.poll() == UNAVAILABLE_STATUS:
            self.__exit__(None, None, None)
            pytest.skip(self.said.splitlines()[0])
        assert self.popen.poll() is None, self.said
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        self._file.close()
        self.board.page.close()
        if error is not None and (said := self.said):
            error.add_note(f"{self.command} said: {said[-2000:]}")

    @property
    def said(self) -> str:
        """All its output."""
        return self.output_path.read_text(errors="replace")

    def see(self) -> Seen:
        return self.board.see()

    @property
    def player(self) -> int:
        """The process that does everything: with --in-child a child of the victim's."""
        app = self.app
        return children_of(app)[0] if "--in-child" in self.command else app

    @property
    def app(self) -> int:
        """The victim's PID in our namespace; waits while it is being restored."""

        def look() -> int:
            try:
                return app_pid(self.pid)
            except LookupError:
                return 0

        return wait_until(look, PATIENCE_S, f"{self.command} is there", every_s=0.001)

    def kill_app(self, signum: int = signal.SIGKILL) -> None:
        """Kills the victim, as it is now."""
        os.kill(self.app, signum)

    def others(self) -> list[int]:
        """Children of init that are not the victim, zombies included."""
        app = self.app
        return [pid for pid in children_of(self.pid) if pid != app]

    def wait_beats(self, n: int = 5, timeout_s: float = PATIENCE_S) -> None:
        """Waits for `n` more beats.  Fails when the victim has ended, or found something wrong."""
        wanted = self.see().beats + n
        wait_until(lambda: self.see().beats >= wanted or self.popen.poll() is not None, timeout_s, "beats", 0.002)
        self.check()

    def check(self) -> None:
        """It runs, was started once, and has found nothing wrong."""
        seen = self.see()
        assert seen.violations == 0, self.said
        assert "VIOLATION" not in self.said, self.said
        assert self.popen.poll() is None, f"avckpt-init ended with {self.popen.poll()}: {self.said}"
        assert seen.starts == 1


def since_linux(major: int, minor: int, what: str) -> pytest.MarkDecorator:
    """Skips on kernels before that, which have not got `what`."""
    release = tuple(int(part) for part in re.findall(r"\d+", os.uname().release)[:2])
    return pytest.mark.skipif(release < (major, minor), reason=f"{what}: Linux {major}.{minor}")


def parasites(pid: int) -> int:
    """Mappings of ours in a process."""
    return Path(f"/proc/{pid}/maps").read_text().count("/memfd:avckpt-parasite (deleted)")


def kill_at_random(
    guard: GuardProcess, victim: Victim, kills: int, pause_s: tuple[float, float], seed: int = 1, cookie: int = 1
) -> None:
    """Kills the victim again and again, and sees each time that it goes on."""
    rng = random.Random(seed)
    guard.wait("checkpoint", cookie=cookie)
    pid, acting = inside(victim.app), victim.see().pid
    for _ in range(kills):
        time.sleep(rng.uniform(*pause_s))
        guard.wait_held(cookie)
        since = guard.mark()
        victim.kill_app()
        guard.wait("restored", since=since, cookie=cookie)
        victim.wait_beats(3)
        assert inside(victim.app) == pid
        assert victim.see().pid == acting


def sleep_exactly(s: float) -> None:
    """Without the 50 us by which the kernel may be late with other sleeps."""
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    time.sleep(s)


@contextlib.contextmanager
def meanwhile(command: Sequence[str], count: int = 1) -> Iterator[None]:
    """Others are at work; of sessions of their own, which counts (sched(7), autogroups)."""
    loops = [subprocess.Popen(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def are_all(tasks: Path, line: str) -> bool:
    """Whether that line is in the status of all threads of /proc/PID/task."""
    with contextlib.suppress(OSError):  # one ends just now
        return all(line in (task / "status").read_text() for task in tasks.iterdir())
    return False


@contextlib.contextmanager
def injected(whose: GuardProcess | Victim, calls: str, what: str, log: Path = Path("/dev/null")) -> Iterator[None]:
    """strace does something to these system calls of a guard, or of a victim's init: inject=... of strace(1).

    It writes them to `log`.
    """
    if not shutil.which("strace"):
        pytest.skip("strace is what meddles with system calls; it is not installed")
    tasks = Path(f"/proc/{whose.pid}/task")
    with subprocess.Popen(
        [
            *("strace", "-f", "-qq", "-o", str(log), "-e", f"trace={calls}"),
            *("-e", f"inject={calls}:{what}", "-p", str(whose.pid)),
        ],
        stderr=subprocess.DEVNULL,
    ) as strace:
        try:
            traced = f"TracerPid:\t{strace.pid}\n"
            wait_until(lambda: are_all(tasks, traced), PATIENCE_S, "strace traces all its threads", 0.001)
            yield
        finally:
            strace.kill()


def forks_beside(victim: Victim) -> contextlib.AbstractContextManager[None]:
    """Somebody forks all the time in the victim's PID namespace, as a shell of `podman exec` does."""
    loop = "while :; do /bin/true; done"
    return meanwhile(["nsenter", "--pid", f"--target={victim.pid}", "sh", "-c", loop])


WHERE = ("", "--in-child")
"""What a test of a victim is done with: the main process does everything, or a child of it."""


ROUND_S = 1.0
"""A round of a storm is as long as first checkpoints take, here and now: long where others take the CPU."""


def storm(guard_config: GuardConfig, kills: int, reach: float, seed: int, *victims: Victim) -> dict[str, object]:
    """Runs kill_storm.py; what it says at the end."""
    fields = {**dataclasses.asdict(guard_config), "restore_on_statuses": []}
    done = subprocess.run(
        [
            *(sys.executable, "-m", "testkit.kill_storm", json.dumps(fields), str(kills), str(reach), str(seed)),
            *(str(victim.pid) for victim in victims),
        ],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S + kills * ROUND_S * SLOWNESS,
        check=False,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr + "".join(victim.said for victim in victims)
    assert done.stderr == "", done.stderr
    said: dict[str, object] = json.loads(done.stdout)
    return said
