# SPDX-License-Identifier: Apache-2.0
"""Registers that not every CPU has."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest

from testkit.guarded import BUILD, WHERE, GuardProcess, Victim, config, kill_at_random


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", WHERE)
def test_tiles(where: str, tmp_path: Path) -> None:
    """AMX: a restored thread must be permitted to use its tiles before they can be put back."""
    with Victim(f"tiles 3 {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 40, (0.01, 0.12))
        assert not victim.see().violations


@pytest.mark.parametrize("where", WHERE)
def test_protection_keys(where: str, tmp_path: Path) -> None:
    """Each thread has its access rights again, and the keys are allocated."""
    with Victim(f"pkeys 3 {where}", tmp_path) as victim, GuardProcess(config(0.03), [victim.pid]) as guard:
        kill_at_random(guard, victim, 30, (0.01, 0.12))


def test_shadow_stacks_are_refused(tmp_path: Path) -> None:
    """A kernel with shadow stacks shows them for each thread; a program compiled for them uses one."""
    if "x86_Thread_features:" not in Path("/proc/self/status").read_text():
        pytest.skip("this kernel has no shadow stacks for programs (CONFIG_X86_USER_SHADOW_STACK)")
    tunables = "/usr/bin/env GLIBC_TUNABLES=glibc.cpu.x86_shstk=on"
    with Victim(f"{tunables} {BUILD / 'idle'} 0 1", tmp_path) as victim:
        if (
            "shstk"
            not in Path(f"/proc/{victim.app}/status").read_text().split("x86_Thread_features:")[1].split("\n")[0]
        ):
            pytest.skip("this CPU or C library gives a program no shadow stack")
        with GuardProcess(config(0.03), [victim.pid]) as guard:
            assert "shadow stacks" in guard.wait("unprotected")["error"]["message"]
            victim.wait_beats(20)


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="modes of x86-64")
@pytest.mark.parametrize("kind", ["trap", "narrow"])
def test_a_mode_in_which_injected_code_would_not_survive(kind: str, tmp_path: Path) -> None:
    """It is another one while that runs, and then the same; 32-bit code has none injected."""
    with Victim(f"modes {kind}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        answers = Counter(guard.command("checkpoint")["kind"] for _ in range(60))
        victim.wait_beats(20)
        if kind == "narrow":
            assert answers["unprotected"], answers
            return
        assert answers["checkpoint"], answers
        guard.command("restore")
        victim.wait_beats(20)
