# SPDX-License-Identifier: Apache-2.0
"""Runtimes that report a crash themselves before they die: one crash costs one restore.

The programs crash once the file named by their argument is there.  They remove it, and append to
another one immediately before the fault: an image of the moment before that is good, crashes again,
and counts as one more crash.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from testkit.harness import avckpt_command, wait_until

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="avckpt run needs root"),
    pytest.mark.shared_machine(
        "init waits two seconds for its guard, which may get no CPU for as long; "
        "which of two comes first, a death or a checkpoint, is the scheduler's choice"
    ),
]

CRASHES = 4
PROGRAMS = Path(__file__).parents[1] / "victims" / "runtimes"


def python(_: Path) -> list[str]:
    return ["python3", f"{PROGRAMS}/crash.py"]


def ruby(_: Path) -> list[str]:
    return ["ruby", f"{PROGRAMS}/crash.rb"]


def go(folder: Path) -> list[str]:
    subprocess.run(["go", "build", "-o", folder / "crash", PROGRAMS / "crash.go"], check=True)
    return [f"{folder}/crash"]


def java(folder: Path) -> list[str]:
    subprocess.run(["javac", "-nowarn", "-d", folder, PROGRAMS / "Crash.java"], check=True, stderr=subprocess.DEVNULL)
    return ["java", "-XX:+UseSerialGC", f"-XX:ErrorFile={folder}/report.log", "-cp", str(folder), "Crash"]


NEEDS = {"python": "python3", "ruby": "ruby", "go": "go", "java": "javac"}
LABELS = ("avckpt.interval=20ms", "avckpt.keep=3", "avckpt.restore.max=50/60s")


@pytest.mark.timeout(300)
@pytest.mark.parametrize("command", [python, ruby, go, java])
def test_one_restore_for_each_crash(command: Callable[[Path], list[str]], tmp_path: Path) -> None:
    needed = NEEDS[command.__name__]
    if not shutil.which(needed):
        pytest.skip(f"{needed} is not installed")
    trigger, messages, crashes = (tmp_path / name for name in ("trigger", "messages", "trigger.crashes"))

    def count(pattern: str) -> int:
        return len(re.findall(pattern, messages.read_text(errors="replace")))

    def undone() -> bool:
        """It takes the trigger away before it notes that it crashes."""
        gone = not trigger.exists() and crashes.exists()
        return gone and count(r" restored in \d") >= len(crashes.read_text())

    def wait_checkpoints(n: int) -> None:
        before = count(": checkpoint: ")
        wait_until(lambda: count(": checkpoint: ") >= before + n, 20, "checkpoints")

    argv = [*avckpt_command(), "run", "-v", *(f"--label={label}" for label in LABELS), "--"]
    with messages.open("wb") as err:
        process = subprocess.Popen(
            [*argv, *command(tmp_path), str(trigger)], stdin=subprocess.DEVNULL, stdout=err, stderr=err, cwd=tmp_path
        )
    try:
        for _ in range(CRASHES):
            wait_checkpoints(5)
            trigger.touch()
            wait_until(undone, 30, "it is restored")
        wait_checkpoints(20)
        assert count(r" restored in \d") == len(crashes.read_text()) >= CRASHES
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
