# SPDX-License-Identifier: Apache-2.0
"""The sidecar is killed while containers run: they keep running, and the next sidecar protects them."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import pytest

from testkit.harness import SIDECAR_NAME, SLOWNESS, ContainerFactory, Sidecar, wait_until
from testkit.protected import QUICK, ours, start_victim, told

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; "
    "the next sidecar is given a time to protect"
)


@pytest.mark.slow
def test_killed_and_started_again(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """Five times, while checkpoints are taken as fast as possible."""
    rng = random.Random(5)
    labels = {**QUICK, "interval": "10ms"}
    folders = [tmp_path / str(n) for n in range(2)]
    for folder in folders:
        folder.mkdir()
    threads = start_victim(
        sidecar, container, folders[0], "threads 6 4", labels=labels, options=["--user", "1000:1000"]
    )
    fpu = start_victim(sidecar, container, folders[1], "fpu 2", labels=labels, options=["--network=host"])
    victims = (threads, fpu)
    apps = [victim.app for victim in victims]
    for _ in range(5):
        time.sleep(rng.uniform(0.0, 0.1))
        daemon = sidecar.podman.inspect(SIDECAR_NAME)["State"]["Pid"]
        os.kill(daemon, signal.SIGKILL)
        for victim in victims:
            wait_until(lambda made=victim.container: ours(made) == [], 3, "templates and holder are gone")  # type: ignore[misc]
            victim.wait_beats()
        assert [victim.app for victim in victims] == apps
        sidecar.restart()
        for victim in victims:
            assert sidecar.wait_generation(victim.container, 2, timeout_s=5)["adopted"] is True
            victim.wait_beats()
    for victim in victims:
        victim.kill(signal.SIGKILL)
        assert victim.see().starts == 1
        assert victim.container.status == "running"


def test_an_adopted_container_is_protected_within_an_interval(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    victim = start_victim(sidecar, container, tmp_path, "crash", labels={**QUICK, "interval": "1s"}, generation=1)
    sidecar.kill()
    sidecar.restart()
    entry = sidecar.wait_generation(victim.container, 1)
    assert entry["adopted"] is True
    # The first attempt; where the machine stands still for a moment, another one follows soon.
    attempts = [*told(sidecar, victim.container, "missed"), *told(sidecar, victim.container, "checkpoint")]
    tried_at = min(event["at"] for event in attempts if event["at"] > entry["registered_at"])
    assert tried_at - entry["registered_at"] < 1.5
    assert entry["last_checkpoint_at"] - tried_at < 1 + entry["missed"]
    for n, signum in enumerate((signal.SIGUSR1, signal.SIGKILL), 1):
        assert victim.kill(signum)["restores"] == n
    assert victim.see().starts == 1


def test_a_crash_while_the_sidecar_is_dead_is_as_without_avckpt(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """The container ends at once, with the application's own status."""
    victim = start_victim(sidecar, container, tmp_path, "crash")
    app = victim.app
    sidecar.kill()
    started = time.monotonic()
    os.kill(app, signal.SIGUSR1)
    assert victim.container.wait() == 128 + signal.SIGSEGV
    assert time.monotonic() - started < 2 * SLOWNESS


def test_podmans_restart_policy_while_the_sidecar_is_dead(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """Podman restarts the container unprotected; a sidecar that is started later adopts it."""
    victim = start_victim(sidecar, container, tmp_path, "crash", options=["--restart=on-failure"])
    app = victim.app
    sidecar.kill()
    os.kill(app, signal.SIGUSR2)
    wait_until(lambda: victim.see().starts == 2, 15, "Podman has started it again")
    victim.wait_beats()
    sidecar.restart()
    assert sidecar.wait_generation(victim.container, 1)["adopted"] is True
    victim.kill(signal.SIGKILL)
    assert victim.see().starts == 2


def test_killed_with_its_application(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """Sidecar and application are killed at the same moment: the container ends and does not hang."""
    victim = start_victim(sidecar, container, tmp_path, "threads 4 1")
    daemon = sidecar.podman.inspect(SIDECAR_NAME)["State"]["Pid"]
    app = victim.app
    os.kill(app, signal.SIGKILL)
    os.kill(daemon, signal.SIGKILL)
    # Restored just before the sidecar died, or not restored at all.
    time.sleep(0.5)
    if victim.container.status == "running":
        victim.wait_beats()
        victim.container.stop()
    assert victim.container.status == "exited"
    assert victim.container.exit_code in (128 + signal.SIGKILL, 128 + signal.SIGTERM)


def test_stopped_in_good_order(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """`podman stop` of the sidecar: containers run on unprotected, and nothing of avckpt is left in them."""
    victim = start_victim(sidecar, container, tmp_path, "threads 4 1")
    app = victim.app
    sidecar.stop()
    assert ours(victim.container) == []
    victim.wait_beats(50)
    assert victim.app == app
    assert victim.see().starts == 1
