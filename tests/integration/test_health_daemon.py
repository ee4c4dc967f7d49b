# SPDX-License-Identifier: Apache-2.0
"""Health checks over a restart of the sidecar and over a new configuration: a real daemon, without Podman."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.cli.client import Client
from avckpt.supervision.pressure import templates_of

from testkit.harness import wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="PID namespaces and ptrace need root"),
    pytest.mark.shared_machine("health checks have time limits"),
]

NAP = [sys.executable, "-c", "import time\nwhile True: time.sleep(0.1)"]
QUICK = {"avckpt.enable": "true", "avckpt.interval": "100ms", "avckpt.restore.max": "60/1s"}
UNHEALTHY = {**QUICK, "avckpt.restore.on": "signal,unhealthy"}


@pytest.fixture
def sidecar(tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as made:
        yield made


@pytest.fixture
def sick(tmp_path: Path) -> Path:
    """The file whose presence makes health checks fail."""
    return tmp_path / "sick"


def checked(
    sidecar: LocalSidecar, name: str, sick: Path, labels: dict[str, str], state: str = "protected", **more: object
) -> Container:
    """A container with a health check, as the hook's process leaves it for the sidecar, once it is in that state.

    `more`: further fields of the check.
    """
    made = sidecar.protected(name, NAP, labels)
    health = sidecar.run_dir / "health"
    health.mkdir(exist_ok=True)
    check = {
        "Test": ["CMD-SHELL", f"touch {sick}.looked; test ! -e {sick}"],
        "Interval": 200_000_000,
        "Timeout": 5_000_000_000,
        "Retries": 2,
        **more,
    }
    (health / f"{made.id}.json").write_text(json.dumps({"healthcheck": check}))
    sidecar.wait_for(made, state=state)
    return made


def unhealthy(sidecar: LocalSidecar) -> int:
    """How many times a container was rolled back because of its health check."""
    return sum(e.get("reason") == "unhealthy" and e["kind"] == "restored" for e in sidecar.client.history())


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGKILL])
def test_an_adopted_container_is_checked_again(sidecar: LocalSidecar, sick: Path, signum: signal.Signals) -> None:
    sidecar.start()
    made = checked(sidecar, "node", sick, UNHEALTHY)
    app = made.app_pid
    sidecar.stop(signum)
    sick.touch()  # nobody looks now
    time.sleep(1)
    sick.unlink()
    sidecar.start()
    sidecar.wait_for(made, adopted=True, state="protected", restores=0)
    assert made.app_pid == app
    sick.touch()
    wait_until(lambda: unhealthy(sidecar), 20, "it is rolled back")
    sick.unlink()
    wait_until(lambda: "its health check passes again" in sidecar.log, 20, "it is healthy again")


def test_the_start_period_is_the_containers_and_not_the_sidecars(sidecar: LocalSidecar, sick: Path) -> None:
    sidecar.start()
    started = time.monotonic()
    sick.touch()
    checked(sidecar, "node", sick, UNHEALTHY, StartPeriod=4_000_000_000)
    time.sleep(max(started + 3 - time.monotonic(), 0))
    assert unhealthy(sidecar) == 0
    sidecar.stop()
    time.sleep(max(started + 4 - time.monotonic(), 0))
    sidecar.start()
    restarted = time.monotonic()
    wait_until(lambda: unhealthy(sidecar), 20, "it is rolled back")
    assert time.monotonic() - restarted < 4


def test_a_check_that_is_switched_off_is_not_run(sidecar: LocalSidecar, sick: Path) -> None:
    sidecar.start()
    sick.touch()
    checked(sidecar, "node", sick, UNHEALTHY, Interval=0)
    wait_until(lambda: "no health check is run: it is switched off" in sidecar.log, 10, "it is said")
    assert not Path(f"{sick}.looked").exists()


def test_a_new_configuration_begins_and_ends_checks(sidecar: LocalSidecar, sick: Path) -> None:
    sidecar.start()
    made = checked(sidecar, "node", sick, QUICK)
    sick.touch()
    time.sleep(1)
    assert unhealthy(sidecar) == 0
    sick.unlink()

    sidecar.config.write_text("defaults: {restore.on: 'signal,unhealthy'}\n")
    assert "node: restore.on signal,exit -> signal,unhealthy" in sidecar.avckpt("reload").stdout
    sidecar.wait_for(made, generations=3)  # one more than avckpt.keep
    time.sleep(1)  # it has been healthy a few times
    sick.touch()
    wait_until(lambda: unhealthy(sidecar), 20, "it is rolled back")
    sick.unlink()
    wait_until(lambda: "its health check passes again" in sidecar.log, 20, "it is healthy again")

    sidecar.config.unlink()
    assert "node: restore.on signal,unhealthy -> signal,exit" in sidecar.avckpt("reload").stdout
    held, before = set(templates_of(made.init_pid)), unhealthy(sidecar)
    sick.touch()
    # What a check has vouched for is no longer held back: newer ones take its place.
    wait_until(lambda: not held & set(templates_of(made.init_pid)), 20, "every generation is a new one")
    assert unhealthy(sidecar) == before
    assert sidecar.row(made)["generations"] <= 2


def test_a_check_works_with_many_descriptors(sidecar: LocalSidecar, sick: Path) -> None:
    """select(2) is limited to descriptors below 1024, which some sixty containers use up."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    sidecar.start()
    with contextlib.ExitStack() as undo:
        for _ in range(1050):
            client = undo.enter_context(socket.socket(socket.AF_UNIX))
            client.connect(str(sidecar.run_dir / "api.sock"))
        checked(sidecar, "node", sick, UNHEALTHY)
        sick.touch()
        wait_until(lambda: unhealthy(sidecar), 20, "it is rolled back")


def test_what_goes_wrong_with_a_check_is_told_once_and_does_not_end_them(sidecar: LocalSidecar, sick: Path) -> None:
    sidecar.start()
    checked(sidecar, "node", sick, UNHEALTHY)
    wait_until(Path(f"{sick}.looked").exists, 10, "it is checked")
    assert sidecar.process is not None
    pid = sidecar.process.pid
    before = resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    wait_until(lambda: "its health check cannot be run: the kernel said no" in sidecar.log, 10, "it is said")
    time.sleep(1)  # some more of them
    resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
    wait_until(lambda: "its health check passes again" in sidecar.log, 10, "it goes on")
    assert sidecar.log.count("its health check cannot be run") == 1
    sick.touch()
    wait_until(lambda: unhealthy(sidecar), 20, "it is rolled back")


def test_a_check_that_keeps_failing_fills_no_history(sidecar: LocalSidecar, sick: Path) -> None:
    sidecar.start()
    # No checkpoint, and so no roll back, which could end it.
    checked(sidecar, "node", sick, {**UNHEALTHY, "avckpt.interval": "1h"}, state="starting")
    for _ in range(2):
        sick.touch()
        time.sleep(1.5)
        sick.unlink()
        time.sleep(0.6)
    told = [event["message"] for event in Client(sidecar.run_dir).history() if event["kind"] == "health"]
    assert told == ["its health check failed 1 time(s) of 2: status 1", "its health check passes again"]
