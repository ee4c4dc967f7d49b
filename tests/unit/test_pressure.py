# SPDX-License-Identifier: Apache-2.0
"""When generations are dropped for memory, and when they are taken again."""

from __future__ import annotations

import os
import select
import subprocess
import sys
from pathlib import Path

import pytest
from avckpt.supervision.pressure import (
    BACK_AFTER_MOST_S,
    BACK_AFTER_S,
    Advice,
    Allowance,
    HostPressure,
    held_bytes,
    templates_of,
)

MB = 1 << 20
LIMIT = 100 * MB


def test_near_the_limit_the_oldest_goes() -> None:
    assert Allowance().advise(89 * MB, LIMIT, 0, 2, 0.0) is Advice.KEEP
    assert Allowance().advise(90 * MB, LIMIT, 20 * MB, 2, 0.0) is Advice.DROP_OLDEST


def test_the_newest_one_does_not_go() -> None:
    assert Allowance().advise(95 * MB, LIMIT, 20 * MB, 1, 0.0) is Advice.KEEP


def test_what_would_free_nothing_is_kept() -> None:
    assert Allowance().advise(95 * MB, LIMIT, MB // 2, 2, 0.0) is Advice.KEEP


def test_it_comes_back_and_later_if_that_was_too_early() -> None:
    allowance = Allowance()
    now = 1000.0
    waited = []
    for _ in range(8):
        assert allowance.advise(95 * MB, LIMIT, 20 * MB, 2, now) is Advice.DROP_OLDEST
        given_up = now
        while allowance.advise(70 * MB, LIMIT, 0, 2, now) is not Advice.REFILL:
            now += 1
        waited.append(now - given_up)
        now += 1
    assert waited[0] == BACK_AFTER_S
    assert waited[1] == 2 * BACK_AFTER_S
    assert max(waited) == BACK_AFTER_MOST_S
    # A long time of peace: as at first.
    now += 3 * BACK_AFTER_MOST_S
    allowance.advise(95 * MB, LIMIT, 20 * MB, 2, now)
    assert allowance.advise(70 * MB, LIMIT, 0, 2, now + BACK_AFTER_S) is Advice.REFILL


def test_it_does_not_come_back_while_it_is_near() -> None:
    allowance = Allowance()
    allowance.advise(95 * MB, LIMIT, 20 * MB, 2, 0.0)
    assert allowance.advise(91 * MB, LIMIT, 0, 2, 10 * BACK_AFTER_S) is Advice.KEEP
    assert allowance.short


@pytest.mark.skipif(not Path("/proc/pressure/cpu").exists(), reason="this kernel has no PSI")
def test_a_trigger_of_the_kernel_is_heard() -> None:
    """By the CPU's file: to make a machine short of memory in earnest would hurt others on it."""
    host = HostPressure(Path("/proc/pressure/cpu"))
    assert host.fd is not None
    load = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2 * (os.cpu_count() or 1) + 1)]
    try:
        assert select.select([host.fd], [], [], 30)[0]
    finally:
        for process in load:
            process.kill()
            process.wait()
        host.close()


def test_without_psi_it_looks_at_what_is_available(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    host = HostPressure(tmp_path / "no-such-file")
    assert host.fd is None
    assert not host.is_high()
    monkeypatch.setattr("avckpt.supervision.pressure.AVAILABLE", 1.1)
    assert host.is_high()


def test_of_a_process_that_is_gone_nothing_is_held() -> None:
    process = subprocess.Popen(["true"])
    process.wait()
    assert held_bytes(process.pid, [process.pid]) == 0


def test_a_child_whose_name_is_no_text_is_no_template(tmp_path: Path) -> None:
    """The kernel cuts a name at 15 bytes, in the middle of a letter if need be."""
    program = tmp_path / "переводчик"
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([str(program), "60"]) as process:
        try:
            assert not Path(f"/proc/{process.pid}/comm").read_bytes().decode(errors="ignore").startswith("переводчик")
            assert templates_of(os.getpid()) == []
        finally:
            process.kill()
