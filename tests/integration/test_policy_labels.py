# SPDX-License-Identifier: Apache-2.0
"""avckpt.keep and avckpt.restore.on, on real containers."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from testkit.harness import ContainerFactory, Sidecar, wait_until
from testkit.protected import ProtectedVictim, ended, ours, start_victim

pytestmark = pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long")

ON_COMMAND = {"interval": "1h", "restore.max": "60/60s"}


@pytest.fixture
def victim(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> Callable[..., ProtectedVictim]:
    """Starts a victim whose checkpoints are taken on command."""

    def start(command: str, **labels: str) -> ProtectedVictim:
        wanted = {**ON_COMMAND, **{key.replace("_", "."): value for key, value in labels.items()}}
        return start_victim(sidecar, container, tmp_path, command, labels=wanted, generation=0)

    return start


def templates(victim: ProtectedVictim) -> list[int]:
    return ours(victim.container, "avckpt-tmpl")


@pytest.mark.parametrize("keep", [1, 4])
def test_so_many_generations_are_held(victim: Callable[..., ProtectedVictim], keep: int) -> None:
    held = victim("crash", keep=str(keep))
    for _ in range(keep + 2):
        held.checkpoint()
    entry = held.sidecar.find(held.container)
    assert entry is not None
    assert (entry["generation"], entry["generations"]) == (keep + 2, keep)
    wait_until(lambda: len(templates(held)) == keep, 5, "as many templates")


def test_an_older_generation_is_used_when_the_newest_is_gone(victim: Callable[..., ProtectedVictim]) -> None:
    held = victim("crash", keep="3")
    for _ in range(3):
        held.checkpoint()
    for expected in (2, 1):
        newest = max(templates(held))
        os.kill(newest, signal.SIGKILL)
        held.sidecar.wait_for(held.container, lambda e: e["generations"] == expected, "a generation less")  # noqa: B023
        entry = held.kill(signal.SIGSEGV)
        assert entry["generation"] == expected
    assert held.sidecar.find(held.container)["dropped"] == 2  # type: ignore[index]


ABNORMAL = [
    ("signal", signal.SIGUSR1, True),  # SIGSEGV
    ("signal", signal.SIGHUP, False),  # exit(3)
    ("exit", signal.SIGHUP, True),
    ("exit", signal.SIGUSR2, False),  # abort()
    ("3", signal.SIGHUP, True),
    ("4,70", signal.SIGHUP, False),
    ("signal,3", signal.SIGHUP, True),
    ("signal,3", signal.SIGUSR2, True),
    ("exit,signal", signal.SIGUSR1, True),
]


@pytest.mark.parametrize(("restore_on", "how", "restored"), ABNORMAL)
def test_which_ends_are_abnormal(
    victim: Callable[..., ProtectedVictim], restore_on: str, how: signal.Signals, restored: bool
) -> None:
    crashing = victim("crash", restore_on=restore_on)
    crashing.checkpoint()
    os.kill(crashing.app, how)
    if restored:
        crashing.sidecar.wait_restores(crashing.container)
        crashing.wait_beats()
        assert crashing.see().starts == 1
        return
    status = {signal.SIGHUP: 3, signal.SIGUSR1: 139, signal.SIGUSR2: 134}[how]
    assert crashing.container.wait() == status
    assert "avckpt.restore.on does not name this end" in ended(crashing.sidecar, crashing.container)
