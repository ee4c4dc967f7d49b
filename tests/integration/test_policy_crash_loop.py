# SPDX-License-Identifier: Apache-2.0
"""avckpt.restore.max: a poisoned state is not restored forever."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from testkit.harness import SLOWNESS, ContainerFactory, Sidecar, wait_until
from testkit.protected import ProtectedVictim, ended, start_victim

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; restores within a time are counted"
)


@pytest.fixture
def poison(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> Any:
    """A victim that crashes that many ms after SIGUSR1, and again as long after each restore of a state since."""

    def start(fuse_ms: int, labels: dict[str, str], *options: str, generation: int = 0) -> ProtectedVictim:
        return start_victim(
            sidecar, container, tmp_path, f"poison {fuse_ms}", labels=labels, options=options, generation=generation
        )

    return start


def test_a_poisoned_generation_is_left_for_an_older_one(poison: Any) -> None:
    victim = poison(int(1000 * SLOWNESS), {"interval": "1h", "restore.max": "4/60s"})
    victim.checkpoint()
    os.kill(victim.app, signal.SIGUSR1)
    victim.checkpoint()  # before it crashes: this image is poisoned
    entry = victim.sidecar.wait_restores(victim.container, 3)
    # Half of the four for the newest, then the clean one: and it lives.
    assert entry["generation"] == 1
    assert entry["generations"] == 1
    assert "generation 2: what is restored from it keeps crashing" in entry["reason"]
    victim.wait_beats(600, timeout_s=15)
    assert victim.sidecar.find(victim.container)["restores"] == 3
    assert victim.see().starts == 1
    dropped = victim.events("dropped")
    assert [(event["generation"], event["attempt"]) for event in dropped] == [(2, 2)]
    assert [event["generation"] for event in victim.events("restored")] == [2, 2, 1]


def test_checkpoints_in_between_do_not_keep_a_crash_loop_alive(poison: Any) -> None:
    victim = poison(300, {"interval": "50ms", "restore.max": "4/60s"}, "--restart", "on-failure:1", generation=3)
    os.kill(victim.app, signal.SIGUSR1)
    # Every generation is poisoned by then, and more are taken after each restore.
    wait_until(lambda: victim.see().starts == 2, 30, "Podman's restart policy starts it anew")
    victim.wait_beats()
    reason = ended(victim.sidecar, victim.container)
    assert reason.startswith("killed by SIGABRT; the restores of avckpt.restore.max are used up")
    restored = victim.events("restored")
    # The four, and one more if there was a generation that had not been tried.
    assert len(restored) in (4, 5), restored
    assert [event["outcome"] for event in victim.events("gave_up")] == ["limit"]
    victim.sidecar.wait_generation(victim.container)  # and the new run is protected


def test_a_roll_back_on_command_does_not_count(poison: Any) -> None:
    victim = poison(100000, {"interval": "1h", "restore.max": "2/60s"})
    victim.checkpoint()
    for _ in range(4):
        victim.sidecar.avckpt("restore", victim.container.name)
    victim.wait_beats()
    victim.kill(signal.SIGKILL)
    victim.kill(signal.SIGKILL)
    os.kill(victim.app, signal.SIGKILL)
    assert victim.container.wait() == 137
