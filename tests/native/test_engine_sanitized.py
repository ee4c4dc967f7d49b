# SPDX-License-Identifier: Apache-2.0
"""The engine under AddressSanitizer, LeakSanitizer and UndefinedBehaviorSanitizer."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from testkit.family import kill_main
from testkit.guarded import Victim
from testkit.harness import ROOT, wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "sanitizers make the guard several times slower"
)

SOURCE = Path(__file__).with_name("sanitized_guard.c")
GUARD = ROOT / "native/build-san/avckpt-guard"
FLAGS = [
    "-std=gnu11",
    "-D_GNU_SOURCE",
    "-g",
    "-pthread",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=undefined",
]


@pytest.fixture(scope="module")
def guard_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    subprocess.run(["make", "-s", "-C", str(ROOT / "native"), "SANITIZE=1"], check=True, timeout=300)
    program = tmp_path_factory.mktemp("sanitized") / "guard"
    library = ROOT / "native/build-san/libavckpt-client.a"
    subprocess.run(
        ["cc", *FLAGS, f"-I{ROOT}/native/include", str(SOURCE), str(library), "-o", str(program)],
        check=True,
        timeout=120,
    )
    return program


class Guard:
    """The sanitized guard of one victim, with its output."""

    def __init__(self, popen: subprocess.Popen[bytes], output: Path) -> None:
        self.popen = popen
        self._output = output

    @property
    def said(self) -> str:
        return self._output.read_text(errors="replace")

    def count(self, event: str) -> int:
        return sum(line.split(" ", 1)[0] == event for line in self.said.splitlines())

    def wait(self, event: str, count: int) -> None:
        wait_until(lambda: self.count(event) >= count or self.popen.poll() is not None, 30, f"{count} x {event}")
        assert self.popen.poll() is None, self.said


@contextmanager
def guarding(program: Path, victim: Victim, interval_ms: int, commands: int, output: Path) -> Iterator[Guard]:
    """Ends the guard with SIGTERM; the sanitizers must have reported nothing, leaks included."""
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=1:detect_stack_use_after_return=0"}
    with output.open("wb") as file:
        popen = subprocess.Popen(
            [program, GUARD, str(victim.pid), str(interval_ms), str(commands)],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=environment,
        )
    guard = Guard(popen, output)
    try:
        yield guard
        popen.send_signal(signal.SIGTERM)
        status = popen.wait(timeout=30)
    finally:
        popen.kill()
        popen.wait()
    assert "Sanitizer" not in guard.said, guard.said
    assert "runtime error" not in guard.said, guard.said
    assert status == 0, guard.said
    assert guard.count("guard-lost") == 0, guard.said


@pytest.mark.parametrize(
    "command", ["threads 8 4", "crash", "busy 4", "tree 8", "prefork 2 1 --private 20", "traits exit-signal"]
)
def test_kills_and_restores(command: str, guard_program: Path, tmp_path: Path) -> None:
    rng = random.Random(command)
    with Victim(command, tmp_path) as victim:
        with guarding(guard_program, victim, 30, 3, tmp_path / "guard.out") as guard:
            guard.wait("checkpoint", 4)
            for n in range(1, 9):
                time.sleep(rng.uniform(0.01, 0.2))
                kill_main(victim)
                guard.wait("restored", n)
                victim.wait_beats(3)
        # The guard has gone in good order: the victim runs on, without it.
        victim.wait_beats(5)
        wait_until(lambda: victim.others() == [], 30, "what the guard has left ends")


def test_the_container_ends_first(guard_program: Path, tmp_path: Path) -> None:
    output = tmp_path / "guard.out"
    with Victim("idle 4 3", tmp_path) as victim, guarding(guard_program, victim, 20, 0, output) as guard:
        guard.wait("checkpoint", 3)
        os.kill(victim.pid, signal.SIGKILL)
        wait_until(lambda: guard.count("ended") == 1, 10, "the end is noticed")


SCRIBBLED_S = float(os.environ.get("AVCKPT_FUZZ_S", "8"))
"""How long memory is scribbled on in all; `make fuzz` takes longer."""
LIFE_S = 2.0
"""Of a victim, which may not live that long: what it does to itself is its own affair."""


def test_the_parasite_is_written_at_random(guard_program: Path, tmp_path: Path) -> None:
    """The guard survives whatever the application writes to their shared memory while it is in use."""
    first = int.from_bytes(os.urandom(4), "little")
    end = time.monotonic() + SCRIBBLED_S
    found = 0
    for number in range(10_000):
        if time.monotonic() > end:
            break
        print(f"scribble {first + number}")
        with (
            Victim(f"scribble {first + number}", tmp_path) as victim,
            guarding(guard_program, victim, 10, 0, tmp_path / f"guard-{number}.out") as guard,
        ):
            wait_until(
                lambda: victim.see().counter[0] or guard.count("unprotected") or victim.popen.poll() is not None,
                20,
                "it has found the parasite",
            )
            with contextlib.suppress(subprocess.TimeoutExpired):
                victim.popen.wait(LIFE_S)
            found += victim.see().counter[0]
    assert found
