# SPDX-License-Identifier: Apache-2.0
"""Containers and the sidecar as units of systemd, made by Podman's Quadlet (4.4 or newer).

make test-machine MACHINE_TESTS=tests/integration/test_quadlet.py
"""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from testkit.harness import SLOWNESS, Container, Podman, Sidecar, avckpt_command, run, take_checkpoint, wait_until

GENERATOR = Path("/usr/lib/systemd/system-generators/podman-system-generator")
UNITS = Path("/run/containers/systemd")
KILLS = 200 if os.environ.get("AVCKPT_LONG") == "1" else 20
PATIENCE_S = 20 * SLOWNESS
NUMBERS = itertools.count()
"""A unit's name is used once: its journal is kept."""

pytestmark = [
    pytest.mark.skipif(not Path("/run/systemd/system").is_dir(), reason="systemd does not run here: make test-machine"),
    pytest.mark.skipif(not GENERATOR.exists(), reason="Podman has no Quadlet here: make test-machine"),
]

APP = """
import os, socket, time

systemd = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
systemd.connect(os.environ["NOTIFY_SOCKET"])
systemd.send(b"READY=1")
n = 0
while True:
    n += 1
    print("counted", n, flush=True)
    systemd.send(b"WATCHDOG=1")
    with open("/dev/shm/beat", "w") as beat:
        beat.write(str(n))
    if os.path.exists("/app/hang"):
        print("hangs", flush=True)
        time.sleep(1e6)
    if os.path.exists("/app/leak") and not os.path.exists("/dev/shm/leaked"):
        open("/dev/shm/leaked", "w").close()  # once, also when it has gone back
        leaked = b"x" * (1 << 30)
    time.sleep(0.2)
"""

UNIT = """
[Container]
Image=localhost/avckpt-base:latest
ContainerName={name}
Exec=python3 /app/app.py
Volume={folder}:/app:ro
Network=none
Pull=never
Notify=true
Label=avckpt.enable=true
Label=avckpt.interval=300ms
Label=avckpt.restore.max={restores}
{container}

[Service]
Restart=always
RestartSec=1
TimeoutStartSec=300
{service}
"""

CHECKED = f"""
Label=avckpt.restore.on=signal,exit,unhealthy
HealthCmd=find /dev/shm/beat -newermt "-{2 * SLOWNESS:g} seconds" | grep . >>/dev/shm/passed
HealthInterval={SLOWNESS:g}s
HealthTimeout=60s
HealthRetries=2
"""
"""Podman and the sidecar both run it; it notices within five intervals that there are no signs of life."""

LIMITED = "PodmanArgs=--memory=120m --memory-swap=120m"


def systemctl(*args: str) -> str:
    return run(["systemctl", "--no-ask-password", *args], timeout_s=300).stdout.strip()


def journal(unit: str, *args: str) -> str:
    return run(["journalctl", "--no-pager", "--output=cat", "--unit", unit, *args]).stdout


@dataclass
class Service(Container):
    """A container that systemd has started."""

    @property
    def unit(self) -> str:
        return f"{self.name}.service"

    def shown(self, name: str) -> str:
        return systemctl("show", "--property", name, "--value", self.unit)

    @property
    def counted(self) -> int:
        """The last number that the application has written."""
        lines = [line for line in journal(self.unit, "--lines=50").splitlines() if line.startswith("counted ")]
        return int(lines[-1].split()[1]) if lines else 0


@pytest.fixture(scope="module")
def sidecar_unit(session_sidecar: Sidecar) -> Iterator[Sidecar]:
    """The sidecar as `avckpt install --quadlet` has it started; the tests' own stops meanwhile."""
    session_sidecar.stop()
    run([*avckpt_command(), "install", "--quadlet"])
    try:
        systemctl("daemon-reload")
        systemctl("start", "avckpt-sidecar.service")
        wait_until(session_sidecar.answers, PATIENCE_S, "the sidecar answers", every_s=0.2)
        yield session_sidecar
        systemctl("stop", "avckpt-sidecar.service")
    finally:
        run([*avckpt_command(), "uninstall"])
        systemctl("daemon-reload")
        run([*avckpt_command(), "install"])


@pytest.fixture
def service(sidecar_unit: Sidecar, podman: Podman, tmp_path: Path) -> Iterator[Callable[..., Service]]:
    """Starts the application as a unit."""
    tmp_path.chmod(0o755)
    (tmp_path / "app.py").write_text(APP)
    UNITS.mkdir(parents=True, exist_ok=True)
    made: list[Service] = []

    def start(restores: str = "64/1s", container: str = "", watchdog_s: float = 0, more: str = "") -> Service:
        name = f"avckpt-quadlet-{os.getpid()}-{next(NUMBERS)}"
        (UNITS / f"{name}.container").write_text(
            UNIT.format(
                name=name,
                folder=tmp_path,
                restores=restores,
                container=container,
                service=f"WatchdogSec={watchdog_s:g}\n{more}",
            )
        )
        made.append(Service(podman, name, ""))
        systemctl("daemon-reload")
        systemctl("start", f"{name}.service")
        made[-1].id = podman.inspect(name)["Id"]
        return made[-1]

    yield start
    for one in made:
        systemctl("stop", one.unit)
        (UNITS / f"{one.name}.container").unlink()
    systemctl("daemon-reload")


def crash(service: Service, sidecar: Sidecar, number: int) -> None:
    """Kills the application by SIGSEGV when there is a checkpoint to go back to, and waits for restore `number`."""
    generation = (sidecar.find(service) or {"generation": 0})["generation"]
    sidecar.wait_generation(service, generation + 1, PATIENCE_S)
    os.kill(sidecar.app_pid(service), signal.SIGSEGV)
    sidecar.wait_restores(service, number, PATIENCE_S)


def answer(sidecar: Sidecar, service: Service, deaths: int) -> str:
    """What came of so many deaths: "restored" or "ended"; "" as long as it is not known."""
    [row] = [row for row in sidecar.ps(ended=True) if row["id"] == service.id]
    if row["state"] == "ended":
        return "ended"
    return "restored" if row["restores"] >= deaths else ""


def test_crashes_are_no_restarts(service: Callable[..., Service], sidecar_unit: Sidecar) -> None:
    """A label is all that the unit needs; its own journal tells each recovery."""
    one = service()
    container, main = one.id, one.shown("MainPID")
    for number in range(1, KILLS + 1):
        crash(one, sidecar_unit, number)
    assert one.shown("NRestarts") == "0"
    assert one.shown("ActiveState") == "active"
    assert one.shown("MainPID") == main
    assert one.inspect()["Id"] == container
    wait_until(lambda: one.counted > KILLS / 2, PATIENCE_S, "it goes on counting")
    recoveries = [line for line in journal(one.unit, "--identifier=avckpt").splitlines() if "restored in" in line]
    assert len(recoveries) == KILLS, recoveries


def test_systemd_restarts_what_is_not_undone(service: Callable[..., Service], sidecar_unit: Sidecar) -> None:
    """`Restart=` is for what avckpt leaves, and the new container is protected again."""
    one = service("1/1h")
    first = one.id
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)
    # One restore, and one more from each older generation (docs/policy.md), before it gives up.
    for number in itertools.count(1):
        os.kill(sidecar_unit.app_pid(one), signal.SIGSEGV)
        if (
            wait_until(partial(answer, sidecar_unit, one, number), PATIENCE_S, f"an answer to death {number}")
            == "ended"
        ):
            break
    wait_until(lambda: one.shown("NRestarts") == "1", PATIENCE_S, "systemd starts it once more", every_s=0.5)
    wait_until(lambda: one.shown("ActiveState") == "active", PATIENCE_S, "it is ready", every_s=0.5)
    one.id = one.inspect()["Id"]
    assert one.id != first
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)


def hang(service: Service, folder: Path) -> None:
    """The application stops giving signs of life; one that goes back to a checkpoint does not do it again."""
    (folder / "hang").touch()
    wait_until(lambda: "hangs" in journal(service.unit).splitlines(), PATIENCE_S, "it hangs", every_s=0.2)
    (folder / "hang").unlink()


def test_what_hangs_is_back_before_systemds_watchdog(
    service: Callable[..., Service], sidecar_unit: Sidecar, tmp_path: Path
) -> None:
    """`WatchdogSec=` is for what the health check leaves; signs of life after a restore count."""
    one = service(container=CHECKED, watchdog_s=30 * SLOWNESS)
    main = one.shown("MainPID")
    passed = Path(f"/proc/{one.pid}/root/dev/shm/passed")
    wait_until(lambda: passed.exists() and passed.read_text().count("\n") > 5, PATIENCE_S, "it is healthy", every_s=0.5)
    hang(one, tmp_path)
    sidecar_unit.wait_restores(one, 1, 2 * PATIENCE_S)
    last = int(one.shown("WatchdogTimestampMonotonic"))
    wait_until(
        lambda: int(one.shown("WatchdogTimestampMonotonic")) > last, PATIENCE_S, "another sign of life", every_s=0.5
    )
    assert (one.shown("NRestarts"), one.shown("MainPID")) == ("0", main)


def test_systemds_watchdog_restarts_what_nobody_else_notices(
    service: Callable[..., Service], sidecar_unit: Sidecar, tmp_path: Path
) -> None:
    """It kills conmon, and then everything of the unit at once; that is the container's end, and no crash."""
    one = service(watchdog_s=4 * SLOWNESS)
    first = one.id
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)
    hang(one, tmp_path)
    wait_until(lambda: one.shown("NRestarts") == "1", 2 * PATIENCE_S, "systemd starts it once more", every_s=0.5)
    wait_until(lambda: one.shown("ActiveState") == "active", PATIENCE_S, "it is ready", every_s=0.5)
    one.id = one.inspect()["Id"]
    assert one.id != first
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)
    assert [row["id"] for row in sidecar_unit.ps()] == [one.id]
    assert "restored in" not in journal(one.unit, "--identifier=avckpt")


def test_a_kill_for_memory_is_no_restart(
    service: Callable[..., Service], sidecar_unit: Sidecar, tmp_path: Path
) -> None:
    """The image is of before the leak: one of its middle would be killed again at once, as often as may be."""
    one = service(container=f"{LIMITED}\nLabel=avckpt.interval=1h")
    take_checkpoint(sidecar_unit.client, one.name, PATIENCE_S)
    (tmp_path / "leak").touch()
    sidecar_unit.wait_restores(one, 1, PATIENCE_S)
    counted = one.counted
    wait_until(lambda: one.counted > counted + 10, PATIENCE_S, "it counts on", every_s=0.5)
    assert one.shown("NRestarts") == "0"
    assert one.inspect()["Id"] == one.id
    assert [row["restores"] for row in sidecar_unit.ps()] == [1]


def test_a_unit_that_is_to_end_when_memory_is_short_does(
    service: Callable[..., Service], sidecar_unit: Sidecar, tmp_path: Path
) -> None:
    """systemd sees that one of its processes was killed, and asks nobody whether that has been undone."""
    one = service(container=LIMITED, more="OOMPolicy=kill")
    first = one.id
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)
    (tmp_path / "leak").touch()
    wait_until(lambda: one.shown("NRestarts") != "0", PATIENCE_S, "systemd has ended it", every_s=0.1)
    (tmp_path / "leak").unlink()
    wait_until(lambda: one.shown("ActiveState") == "active", PATIENCE_S, "it is started anew", every_s=0.5)
    assert "'oom-kill'" in journal(one.unit)
    one.id = one.inspect()["Id"]
    assert one.id != first
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)


def test_stopping_a_unit_is_no_crash(service: Callable[..., Service], sidecar_unit: Sidecar) -> None:
    one = service()
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)
    systemctl("stop", one.unit)
    assert one.shown("ActiveState") in ("inactive", "failed")
    assert not one.podman.exists(one.name)
    assert "restored in" not in journal(one.unit, "--identifier=avckpt")


def test_a_restarted_sidecar_adopts_units(service: Callable[..., Service], sidecar_unit: Sidecar) -> None:
    one = service()
    sidecar_unit.wait_generation(one, 1, PATIENCE_S)
    systemctl("restart", "avckpt-sidecar.service")
    wait_until(sidecar_unit.answers, PATIENCE_S, "the sidecar answers", every_s=0.2)
    crash(one, sidecar_unit, 1)
    assert one.shown("NRestarts") == "0"
