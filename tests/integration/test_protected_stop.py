# SPDX-License-Identifier: Apache-2.0
"""`podman stop` ends a protected container, whatever state the sidecar is in (with one exception)."""

from __future__ import annotations

import os
import signal

import pytest

from testkit.harness import SIDECAR_NAME, SLOWNESS, Container, ContainerFactory, Sidecar
from testkit.procfs import children_of

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; podman stop kills after ten seconds"
)

QUICK = {"interval": "100ms"}
# Much less than the 20 s after which Podman kills it.
STOP_S = min(3.0 * SLOWNESS, 15.0)


def stop(made: Container) -> float:
    """Runs `podman stop`; how long it took, in seconds."""
    return made.stop(timeout_s=20).took_s


def test_stopped_while_protected(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("sleep", "1000", labels=QUICK)
    sidecar.wait_generation(made, 2)
    assert stop(made) < STOP_S
    assert (made.status, made.exit_code) == ("exited", 128 + signal.SIGTERM)
    assert sidecar.find(made) is None


def test_stopped_after_a_restore(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("python3", "-c", "import time; time.sleep(1000)", labels=QUICK)
    sidecar.wait_generation(made, 2)
    os.kill(sidecar.app_pid(made), signal.SIGKILL)
    sidecar.wait_restores(made)
    assert stop(made) < STOP_S
    assert made.exit_code == 128 + signal.SIGTERM


def test_an_application_may_take_its_time_to_end(sidecar: Sidecar, container: ContainerFactory) -> None:
    """It shuts down in its own time, and is not restored in the middle of that."""
    script = (
        "import signal, sys, time\n"
        "def end(*_):\n"
        "    time.sleep(1)\n"
        "    print('bye', flush=True)\n"
        "    sys.exit(4)\n"
        "signal.signal(signal.SIGTERM, end)\n"
        "while True:\n"
        "    time.sleep(0.01)\n"
    )
    made = container.protected("python3", "-c", script, labels=QUICK)
    sidecar.wait_generation(made, 2)
    assert 1 < stop(made) < 1 + STOP_S
    assert made.logs().split() == ["bye"]
    assert made.exit_code == 4


def test_stopped_when_the_sidecar_is_dead(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("sleep", "1000", labels=QUICK)
    sidecar.wait_generation(made, 2)
    sidecar.kill()
    assert made.status == "running"
    assert stop(made) < STOP_S
    assert made.exit_code == 128 + signal.SIGTERM


def test_stopped_when_there_never_was_a_sidecar(sidecar: Sidecar, container: ContainerFactory) -> None:
    sidecar.stop()
    made = container.protected("sleep", "1000", labels=QUICK)
    assert stop(made) < STOP_S
    assert made.exit_code == 128 + signal.SIGTERM


def test_stopped_while_the_sidecar_is_stopped(sidecar: Sidecar, container: ContainerFactory) -> None:
    """Stopping the sidecar's process (SIGSTOP, a debugger) does not stop guards: the container ends as it should."""
    made = container.protected("sleep", "1000", labels=QUICK)
    sidecar.wait_generation(made, 2)
    (daemon,) = children_of(sidecar.podman.inspect(SIDECAR_NAME)["State"]["Pid"])
    os.kill(daemon, signal.SIGSTOP)
    try:
        sidecar.podman.run("stop", "--time", "2", made.name)
    finally:
        os.kill(daemon, signal.SIGCONT)
    assert made.status == "exited"
