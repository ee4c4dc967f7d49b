# SPDX-License-Identifier: Apache-2.0
"""`podman stop` of a protected container ends it, whatever has become of the sidecar (but one thing)."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from testkit.harness import SIDECAR_NAME, SLOWNESS, Container, ContainerFactory, Sidecar, wait_until

QUICK = {"interval": "100ms"}
# Much less than the 20 s after which Podman kills it.
STOP_S = min(3.0 * SLOWNESS, 15.0)


def stop(made: Container) -> float:
    """`podman stop`; how long it took, in seconds."""
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
    """It ends in its own way, and is not taken back by a restore."""
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


def states(pid: int) -> set[str]:
    """Of all its threads, as in proc(5)."""
    stats = [entry.read_text() for entry in Path(f"/proc/{pid}/task").glob("*/stat")]
    return {stat.rpartition(")")[2].split()[0] for stat in stats}


def stop_between_checkpoints(daemon: int, app: int) -> None:
    """SIGSTOP to the sidecar, at a moment in which it has not stopped the application (t)."""
    while True:
        os.kill(daemon, signal.SIGSTOP)
        wait_until(lambda: states(daemon) == {"T"}, 5, "the sidecar is stopped")
        if "t" not in states(app):
            return
        os.kill(daemon, signal.SIGCONT)


@pytest.mark.parametrize("then", [signal.SIGCONT, signal.SIGKILL])
def test_stopped_while_the_sidecar_is_stopped(
    sidecar: Sidecar, container: ContainerFactory, then: signal.Signals
) -> None:
    """The one case that hangs: a process that is traced is not gone before its tracer has reaped it.

    While the sidecar's process is stopped (SIGSTOP, a debugger) the container's templates stay zombies, and the
    container stays in "stopping".  It ends at once when the sidecar goes on, and when it is killed.
    """
    made = container.protected("sleep", "1000", labels=QUICK)
    sidecar.wait_generation(made, 2)
    daemon = sidecar.podman.inspect(SIDECAR_NAME)["State"]["Pid"]
    app = sidecar.app_pid(made)
    stop_between_checkpoints(daemon, app)
    with subprocess.Popen(["podman", "stop", "--time", "2", made.name], stdout=subprocess.DEVNULL) as stopping:
        try:
            # The application itself ends as it was told, by that alone.
            wait_until(lambda: not Path(f"/proc/{app}").exists(), 2, "the application has ended")
            with pytest.raises(subprocess.TimeoutExpired):
                stopping.wait(4)
        finally:
            os.kill(daemon, then)
        started = time.monotonic()
        assert stopping.wait(20) == 0
        assert time.monotonic() - started < STOP_S
    assert made.status == "exited"
