# SPDX-License-Identifier: Apache-2.0
"""A restored process and its threads are to the kernel what they were."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from native.guarded import BUILD, WHERE, GuardProcess, Victim, config, kill_at_random


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("command", ["attributes --inherited", "attributes"])
def test_attributes(command: str, where: str, tmp_path: Path) -> None:
    """Scheduling, I/O priority, credentials, prctl settings; limits, umask, directories."""
    with Victim(f"{command} {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 40, (0.01, 0.12))


def test_one_that_may_not_have_another_process(tmp_path: Path) -> None:
    """Its limit of processes is reached: it goes on unharmed, and it is said why there is no checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        os.chmod(folder, 0o777)  # the victim is not root
        user = "/usr/bin/setpriv --reuid 54321 --regid 54321 --clear-groups --bounding-set -all --inh-caps -all"
        command = f"{user} /usr/bin/prlimit --nproc=4:4 {BUILD / 'idle'} 0 4"
        with Victim(command, Path(folder)) as victim, GuardProcess(config(), [victim.pid]) as guard:
            guard.wait("attached")
            victim.wait_beats(5)
            victim.board.forget_gap()
            for _ in range(5):
                answer = guard.command("checkpoint")
                assert answer["kind"] == "missed"
                assert "may not have another process" in answer["error"]["message"]
            victim.wait_beats(5)
            assert victim.see().gap_ns < 60e6


@pytest.mark.parametrize("command", ["sandbox", "sandbox --kill"])
def test_a_seccomp_filter_of_its_own(command: str, tmp_path: Path) -> None:
    """It neither stands in the way of a restore nor is it gone after it."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 30, (0.01, 0.12))
        for task in Path(f"/proc/{victim.app}/task").iterdir():
            assert "Seccomp:\t2\nSeccomp_filters:\t1\n" in (task / "status").read_text()
