# SPDX-License-Identifier: Apache-2.0
"""avckpt.restore.on=unhealthy, on real containers, on a machine without other health checks."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from testkit.harness import RUN_DIR, Container, ContainerFactory, Sidecar, wait_until
from testkit.protected import ProtectedVictim, ended, start_victim, told

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; health checks have time limits"
)

FRESH = "test -n \"$(find /tmp/alive -newermt '-1 seconds')\""
"""The victim `poison` touches that file as long as it does not hang."""


def check(command: str, retries: int = 2, timeout: str = "2s") -> list[str]:
    return [
        *("--health-cmd", command, "--health-interval", "1s", "--health-timeout", timeout),
        *("--health-retries", str(retries)),
    ]


def wait_told(sidecar: Sidecar, container: Container, kind: str, text: str) -> dict[str, Any]:
    def look() -> dict[str, Any] | None:
        return next((event for event in told(sidecar, container, kind) if text in event["message"]), None)

    found = wait_until(look, 20, f"an event that says {text!r}", every_s=0.3)
    assert found is not None
    return found


@pytest.mark.parametrize("user", ["0", "1000"])
def test_a_hung_application_is_rolled_back(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, user: str
) -> None:
    victim: ProtectedVictim = start_victim(
        sidecar,
        container,
        tmp_path,
        "poison 1 --alive /tmp/alive",
        # So often that all that is held when the hang is noticed would hang, too.
        labels={"interval": "200ms", "restore.on": "signal,unhealthy"},
        options=["--user", user, *check(FRESH)],
    )
    wait_until(lambda: (RUN_DIR / "health" / f"{victim.container.id}.json").exists(), 10, "the health check is known")
    time.sleep(3.5)  # two checks have passed, and vouched for what was held at the first
    assert told(sidecar, victim.container, "health") == []
    os.kill(victim.app, signal.SIGUSR2)
    wait_until(lambda: time.monotonic_ns() - victim.see().beat_ns > 200_000_000, 5, "it hangs")
    sidecar.wait_restores(victim.container)
    victim.wait_beats(200)
    assert victim.see().starts == 1
    (restored,) = told(sidecar, victim.container, "restored")
    assert restored["reason"] == "unhealthy"
    assert restored["age_s"] > 1
    assert any(
        "failed 2 time(s) of 2: rolled back (status 1)" in e["message"]
        for e in told(sidecar, victim.container, "health")
    )
    time.sleep(3)
    assert sidecar.find(victim.container)["restores"] == 1  # type: ignore[index]


def test_a_check_that_hangs_has_failed(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    victim = start_victim(
        sidecar,
        container,
        tmp_path,
        "crash",
        labels={"interval": "200ms", "restore.on": "unhealthy"},
        options=check("test ! -e /tmp/stuck || sleep 1000", timeout="1s"),
    )
    victim.container.exec("touch", "/tmp/stuck")
    sidecar.wait_restores(victim.container)
    victim.container.exec("rm", "/tmp/stuck")
    wait_told(sidecar, victim.container, "health", "rolled back (no answer within 1 s)")

    # One more may have begun to hang before it was unstuck.
    def left() -> str:
        return victim.container.exec("pgrep", "-f", "sleep 1000", check=False).stdout

    # With systemd, Podman checks as well, and leaves behind what hangs.
    if not os.path.isdir("/run/systemd/system"):
        wait_until(lambda: left() == "", 5, "nothing of the checks is left")
    wait_told(sidecar, victim.container, "health", "passes again")
    victim.wait_beats()


def test_an_application_that_is_never_healthy_is_given_up(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    victim = start_victim(
        sidecar,
        container,
        tmp_path,
        "crash",
        labels={"interval": "200ms", "restore.on": "unhealthy", "restore.max": "2/60s"},
        options=[*check("echo no good; false", retries=1), "--restart", "on-failure:1"],
    )
    wait_until(lambda: victim.see().starts == 2, 40, "Podman's restart policy starts it anew")
    assert "avckpt.restore.max are used up" in ended(sidecar, victim.container)
    assert 1 <= len(told(sidecar, victim.container, "restored")) <= 4
    wait_told(sidecar, victim.container, "health", "status 1: no good")


def test_a_container_without_a_health_check_says_so(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    victim = start_victim(
        sidecar, container, tmp_path, "crash", labels={"restore.on": "signal,unhealthy"}, generation=0
    )
    wait_told(sidecar, victim.container, "health", "names unhealthy, but no health check is run: it has none")


def test_a_paused_container_is_not_unhealthy(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    victim = start_victim(
        sidecar,
        container,
        tmp_path,
        "crash",
        labels={"interval": "200ms", "restore.on": "unhealthy"},
        options=check("true", retries=1, timeout="1s"),
    )
    time.sleep(2)
    sidecar.podman.run("pause", victim.container.name)
    try:
        time.sleep(5)
    finally:
        sidecar.podman.run("unpause", victim.container.name)
    victim.wait_beats(200)
    assert told(sidecar, victim.container, "health") == []
    assert told(sidecar, victim.container, "restored") == []


def test_one_generation_is_too_few(sidecar: Sidecar, container: ContainerFactory) -> None:
    with pytest.raises(AssertionError, match=r"avckpt.keep=1: too few for avckpt.restore.on=unhealthy"):
        container.protected("sleep", "1", labels={"keep": "1", "restore.on": "unhealthy"})


def test_the_check_is_known_whatever_the_labels_say(sidecar: Sidecar, container: ContainerFactory) -> None:
    """The sidecar's configuration may turn health checks on, now or later."""
    made = container.protected("sleep", "60", options=check("exit 3"))
    path = RUN_DIR / "health" / f"{made.id}.json"
    wait_until(path.exists, 20, "the health check is known")
    assert json.loads(path.read_text())["healthcheck"]["Test"] == ["CMD-SHELL", "exit 3"]
    made.remove()
    assert not path.exists()


def test_one_that_has_ended_leaves_nothing_behind(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = [container.protected("true") for _ in range(3)]
    for each in made:
        each.wait()
    time.sleep(3)  # for those who still ask
    left = {path.name for path in (RUN_DIR / "health").glob("*")}
    assert not left & {f"{each.id}.json" for each in made}
