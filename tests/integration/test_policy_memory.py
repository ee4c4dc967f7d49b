# SPDX-License-Identifier: Apache-2.0
"""Generations are dropped before an application suffers, on real containers with little memory."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from testkit.harness import SLOWNESS, Container, ContainerFactory, Sidecar, wait_until
from testkit.protected import ours, start_hoard, start_victim, told, write_hoard

pytestmark = pytest.mark.shared_machine(
    "whether a generation is given up in time before memory is short is a race with the application"
)

MB = 1 << 20
IMAGES = ["fork", "auto"]
"""Copies have one template more, and must not cost an application anything either."""


def held(sidecar: Sidecar, container: Container) -> dict[str, Any]:
    entry = sidecar.find(container)
    assert entry is not None
    return entry


@pytest.mark.parametrize("images", IMAGES)
@pytest.mark.skipif(SLOWNESS > 1, reason="the sidecar is quicker there than the kernel's OOM killer")
def test_the_oom_killer_takes_templates_first(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, images: str
) -> None:
    victim = start_hoard(sidecar, container, tmp_path, 60, 160, images)
    app = victim.app
    for _ in range(2):
        victim.checkpoint()
        # At once: nobody but the kernel is quick enough to do something about it.
        write_hoard(victim, signal.SIGUSR1, 60)
    sidecar.wait_for(victim.container, lambda e: e["dropped"] >= 1, "a generation is lost")
    victim.wait_beats()
    assert victim.app == app
    assert held(sidecar, victim.container)["restores"] == 0
    assert victim.see().starts == 1
    assert any("its template was killed" in event["detail"] for event in told(sidecar, victim.container, "dropped"))
    # Protection comes back by itself.
    victim.checkpoint()
    assert held(sidecar, victim.container)["state"] == "protected"
    victim.kill(signal.SIGKILL)


@pytest.mark.parametrize("images", IMAGES)
def test_near_its_limit_a_container_gives_the_oldest_generation_up(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, images: str
) -> None:
    victim = start_hoard(sidecar, container, tmp_path, 60, 190, images)
    oldest = victim.checkpoint()
    write_hoard(victim, signal.SIGUSR1, 60)
    victim.checkpoint()
    # 120 MB are used, 60 more would be 180 of 190: it comes slowly.
    os.kill(victim.app, signal.SIGUSR2)
    entry = sidecar.wait_for(victim.container, lambda e: e["dropped"] >= 1, "a generation is given up")
    assert entry["last_dropped"] == f"generation {oldest}: memory is short"
    assert (entry["state"], entry["generations"]) == ("protected", 1)
    wait_until(lambda: len(templates(victim.container)) == 1, 5, "one template")
    assert entry["restores"] == 0
    # What is given up is free again, and nothing was killed.
    assert [event["generation"] for event in told(sidecar, victim.container, "dropped")] == [oldest]
    # One is held as long as memory is short, two when it is not.
    victim.checkpoint()
    assert held(sidecar, victim.container)["generations"] == 1

    def two() -> bool:
        victim.checkpoint()
        return bool(held(sidecar, victim.container)["generations"] == 2)

    wait_until(two, 40, "two generations again", every_s=1.0)
    victim.kill(signal.SIGKILL)


@pytest.mark.skipif(SLOWNESS > 1, reason="the sidecar is quicker there than the kernel's OOM killer")
@pytest.mark.parametrize("images", IMAGES)
def test_one_that_has_no_room_for_templates_is_left_alone(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, images: str
) -> None:
    """140 of 256 MB, all written all the time: each template is killed at once, until the limit is raised."""
    victim = start_victim(
        sidecar,
        container,
        tmp_path,
        "hoard 140 always",
        labels={"images": images},
        options=["--memory", "256m", "--memory-swap", "256m"],
        generation=0,
    )
    app = victim.app
    entry = sidecar.wait_for(victim.container, lambda e: "no other is made for 8 s" in e["reason"], "it is left alone")
    assert (entry["state"], entry["generations"]) == ("unprotected", 0)
    assert any("no other is made for 8 s" in str(event) for event in told(sidecar, victim.container, "dropped"))
    taken = entry["checkpoints"]
    victim.container.podman.run("update", "--memory", "1g", "--memory-swap", "1g", victim.container.name)
    sidecar.wait_for(
        victim.container,
        lambda e: e["state"] == "protected" and e["checkpoints"] >= taken + 5,
        "it is protected for good",
        timeout_s=7,
    )
    assert held(sidecar, victim.container)["dropped"] == entry["dropped"]
    victim.wait_beats()
    assert victim.app == app
    assert victim.see().starts == 1


def templates(container: Container) -> list[int]:
    return ours(container, "avckpt-tmpl")


@pytest.mark.parametrize("images", IMAGES)
@pytest.mark.parametrize("held_mb", [60])
def test_memory_held_is_shown(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, held_mb: int, images: str
) -> None:
    victim = start_hoard(sidecar, container, tmp_path, held_mb, 1000, images)
    victim.checkpoint()
    assert held(sidecar, victim.container)["memory_bytes"] < 5 * MB
    write_hoard(victim, signal.SIGUSR1, held_mb)
    # A page that somebody else has for a moment counts as half a page.
    assert (held_mb - 1) * MB < held(sidecar, victim.container)["memory_bytes"] < (held_mb + 5) * MB
    victim.checkpoint()
    # Forks share it with each other, and no longer with the application: counted once.  Copies need not.
    victim.checkpoint()
    write_hoard(victim, signal.SIGUSR1, held_mb)
    most = held_mb * (1 if images == "fork" else 2)
    assert (held_mb - 1) * MB < held(sidecar, victim.container)["memory_bytes"] < (most + 10) * MB
