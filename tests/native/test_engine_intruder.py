# SPDX-License-Identifier: Apache-2.0
"""A container with CAP_SYS_PTRACE: what it gains from avckpt's tasks in its PID namespace."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from testkit.guarded import BUILD, GuardProcess, Victim, config

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "it must meet tasks that live for milliseconds"
)

SECONDS = 60


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def intrude(guard: GuardProcess, victim: Victim, *options: str) -> str:
    """Restores the victim until the intruder in its namespaces has attached to a task; the intruder's report."""
    guard.wait("checkpoint", count=2)
    with subprocess.Popen(
        ["nsenter", "--all", f"--target={victim.pid}", str(BUILD / "intruder"), str(SECONDS), *options],
        stdout=subprocess.PIPE,
        text=True,
    ) as intruder:
        try:
            while intruder.poll() is None and victim.popen.poll() is None:
                since = guard.mark()
                victim.kill_app()
                guard.wait_for(
                    lambda event: event.get("kind") in ("restored", "gave-up", "ended"), "an answer", since=since
                )
                if "--inject" not in options:
                    guard.wait("checkpoint", since=since)
            said, _ = intruder.communicate(timeout=SECONDS)
        finally:
            intruder.kill()
    assert intruder.returncode == 0, said
    return said


def test_its_helper_has_nothing_of_the_sidecars(tmp_path: Path) -> None:
    """The intruder inspects the helper and detaches, and the restore goes on."""
    with (
        Victim("threads 4 1", tmp_path) as victim,
        GuardProcess(config(0.05, keep=3), [victim.pid]) as guard,
    ):
        said = intrude(guard, victim)
        assert "looked at" in said
        assert "GAIN" not in said, said
        victim.wait_beats(5)


def test_its_helper_does_nothing_else(tmp_path: Path) -> None:
    """A helper that is made to open a file is killed; this costs one restore, and at worst the container itself."""
    with (
        Victim("threads 4 1", tmp_path) as victim,
        GuardProcess(config(0.05, keep=3), [victim.pid]) as guard,
    ):
        said = intrude(guard, victim, "--inject")
        assert "killed by signal 31" in said, said
        assert "GAIN" not in said, said
        assert guard.process.poll() is None
