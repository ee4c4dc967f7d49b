# SPDX-License-Identifier: Apache-2.0
"""Hostile applications, and a hostile avckpt-init: they harm only themselves."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from testkit.fake_init import FAKE_INIT, FOLLY
from testkit.guarded import GuardProcess, Victim, config, meanwhile
from testkit.harness import wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; attacks and checkpoints race"
)

SCRIBBLED_S = 3.0


def lost(guard: GuardProcess) -> list[dict[str, object]]:
    """How many guards have died."""
    assert guard.process.poll() is None
    return [event for event in guard.events if event["kind"] == "guard_lost"]


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def test_what_the_application_writes_is_not_believed(tmp_path: Path) -> None:
    """The call count is in memory that the application can write; a guard that trusts it writes past the parasite."""
    with (
        Victim("scribble", tmp_path) as hostile,
        Victim("idle 1 1", tmp_path) as peaceful,
        GuardProcess(config(0.02), [hostile.pid, peaceful.pid]) as guard,
    ):
        guard.wait("checkpoint", cookie=2)
        wait_until(lambda: hostile.see().counter[0], 15, "the application has found the parasite")
        time.sleep(SCRIBBLED_S)
        assert not lost(guard)
        guard.wait("checkpoint", cookie=2, since=guard.mark(), count=3)
        peaceful.wait_beats(3)


FILE_BYTES = {"long": 16 << 20, "short": 4096}


@pytest.mark.parametrize("kind", FILE_BYTES)
def test_the_parasite_is_replaced_by_a_file(tmp_path: Path, kind: str) -> None:
    """While the parasite is mapped, a thread maps a file over it that it may only read.

    The file must not change, and the guard must survive even if the file is shorter than the parasite.
    """
    attempts = 4
    file = tmp_path / "file"
    file.write_bytes(os.urandom(FILE_BYTES[kind]))
    content = hashlib.sha256(file.read_bytes()).digest()
    swaps = 0
    with Victim("idle 1 1", tmp_path) as peaceful:
        for _ in range(attempts):
            with Victim(f"padswap {file}", tmp_path) as hostile:
                with GuardProcess(config(0.05), [hostile.pid]):
                    wait_until(lambda: hostile.see().counter[0], 15, "the application has seen a parasite")
                hostile.kill_app(signal.SIGUSR1)
                wait_until(lambda: hostile.see().counter[1], 15, "the application lies in wait")
                with GuardProcess(config(0.05), [hostile.pid, peaceful.pid]) as guard:
                    guard.wait("checkpoint", cookie=2, count=3)
                    wait_until(
                        lambda: hostile.see().counter[2] or hostile.popen.poll() is not None, 15, "it was replaced"
                    )
                    guard.wait("checkpoint", cookie=2, since=guard.mark(), count=3)
                    assert not lost(guard)
                swaps += hostile.see().counter[2]
        peaceful.wait_beats(3)
    assert swaps > 0
    assert hashlib.sha256(file.read_bytes()).digest() == content


def test_the_code_can_not_be_written(tmp_path: Path) -> None:
    """Code that runs in the application with more privileges than it has must not be writable for it."""
    with Victim("overwrite", tmp_path) as hostile, GuardProcess(config(0.05), [hostile.pid]) as guard:
        wait_until(lambda: hostile.see().counter[0], 15, "the application has tried")
        mprotect, write, remove = hostile.see().counter[1:4]
        assert mprotect == errno.EACCES
        assert write == errno.EIO
        assert remove == errno.EACCES
        guard.wait("checkpoint", since=guard.mark(), count=3)
        hostile.wait_beats(3)


@pytest.mark.parametrize("filters", ["", "--little"])
@pytest.mark.parametrize("where", ["lists", "code", "setup"])
def test_a_seccomp_filter_holds_for_what_runs_in_it(
    tmp_path: Path, where: str, filters: str, victims_built: Path
) -> None:
    """Injected code that somebody modifies can make no call that the application's own filter refuses."""
    folder = tmp_path / "smuggled"
    with (
        contextlib.ExitStack() as accomplice,
        Victim(f"smuggle {where} {folder} {filters}", tmp_path) as hostile,
        Victim("idle 1 1", tmp_path) as peaceful,
        GuardProcess(config(0.02), [hostile.pid, peaceful.pid]) as guard,
    ):
        guard.wait("checkpoint", cookie=1, count=3)  # what attempts have left behind is gone by then
        hostile.kill_app(signal.SIGUSR1)
        wait_until(lambda: hostile.see().counter[0], 15, "the application has found the parasite")
        if where == "lists":
            program, address = victims_built / "smuggle", hostile.see().counter[3]
            accomplice.enter_context(meanwhile([str(program), "outside", str(hostile.app), str(address)]))
        # The newest checkpoint may be younger than the last time that the application got a CPU.
        for _ in range(10 if where == "setup" else 0):
            guard.wait("checkpoint", cookie=1, since=guard.mark(), count=2)
            since = guard.mark()
            hostile.kill_app()
            guard.wait("restored", cookie=1, since=since)
            hostile.wait_beats(3)
            if hostile.see().counter[1] or folder.exists():
                break
        wait_until(lambda: hostile.see().counter[1] or folder.exists(), 15, "the call was made, and refused")
        assert not folder.exists()
        assert not lost(guard)
        guard.wait("checkpoint", cookie=2, since=guard.mark(), count=3)
        peaceful.wait_beats(3)


@pytest.mark.parametrize("kind", FOLLY)
def test_what_init_shows_is_looked_at_first(tmp_path: Path, kind: str) -> None:
    """A process in init's place can make the guard open and map only what it could open and map itself."""
    with (
        subprocess.Popen(
            [sys.executable, FAKE_INIT, kind],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "TMPDIR": str(tmp_path)},
        ) as init,
        Victim("idle 1 1", tmp_path) as peaceful,
    ):
        assert init.stdin is not None
        assert init.stdout is not None
        assert init.stdout.readline() == b"ready\n"
        with GuardProcess(config(0.02), [init.pid, peaceful.pid]) as guard:
            honest = kind == "honest"
            if honest:
                guard.wait("checkpoint", cookie=1, count=2)
            else:
                guard.wait_for(
                    lambda event: event.get("cookie") == 1 and event["kind"] in ("unprotected", "attached"),
                    "news of init",
                )
            init.stdin.write(b"go on\n")
            init.stdin.flush()
            unchanged = init.stdout.readline() == b"done True\n"
            guard.wait("checkpoint", cookie=2, since=guard.mark(), count=3)
            assert not lost(guard)
            attached = any(event["kind"] == "attached" and event.get("cookie") == 1 for event in guard.events)
            assert attached == honest
        assert unchanged == (not honest and kind != "unsealed")
        peaceful.wait_beats(3)
        init.kill()
