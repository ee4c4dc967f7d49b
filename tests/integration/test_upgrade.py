# SPDX-License-Identifier: Apache-2.0
"""The Debian packages on a machine that is only there for that (systemd, dpkg): make test-machine."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.harness import (
    DROP_IN,
    ROOT,
    SLOWNESS,
    ContainerFactory,
    Podman,
    Sidecar,
    avckpt_command,
    run,
    wait_until,
)

pytestmark = pytest.mark.skipif(
    os.environ.get("AVCKPT_DISPOSABLE") != "1", reason="installs packages on this machine: make test-machine"
)

PATIENCE_S = 20 * SLOWNESS
INTERVAL_S = 1.0


def package(kind: str) -> Path:
    found = sorted((ROOT / "build").glob(f"{kind}_*.deb"))
    if not found:
        pytest.fail(f"no build/{kind}_*.deb: make deb deb-image")
    return found[-1]


def dpkg(*args: str) -> str:
    return run(["dpkg", *args], timeout_s=60 * SLOWNESS).stdout


@pytest.fixture
def before(tmp_path: Path) -> Path:
    """The same package as an earlier version, whose files are other files."""
    folder = tmp_path / "before"
    run(["dpkg-deb", "-R", str(package("avckpt")), str(folder)], timeout_s=60 * SLOWNESS)
    control = folder / "DEBIAN/control"
    lines = control.read_text().splitlines()
    control.write_text("".join("Version: 0.0.1\n" if line.startswith("Version:") else f"{line}\n" for line in lines))
    for name in ("avckpt-init", "avckpt-guard"):
        [program] = folder.glob(f"usr/lib/avckpt/lib/python*/site-packages/avckpt/libexec/{name}")
        program.write_bytes(program.read_bytes() + b"before")
    run(["dpkg-deb", "-Znone", "-b", str(folder), str(tmp_path / "before.deb")], timeout_s=60 * SLOWNESS)
    shutil.rmtree(folder)
    return tmp_path / "before.deb"


@pytest.fixture
def no_other(machine: None, podman: Podman) -> Iterator[Sidecar]:
    """No sidecar and no hooks but the package's; the tests' own hooks are put back."""
    had = DROP_IN.exists()
    sidecar = Sidecar(podman)
    sidecar.stop()
    if had:
        run([*avckpt_command(), "uninstall"])
    yield sidecar
    run(["dpkg", "-r", "avckpt-sidecar-image", "avckpt"], check=False, timeout_s=60 * SLOWNESS)
    if had:
        run([*avckpt_command(), "install"])


def test_an_upgrade_leaves_containers_protected(
    before: Path, no_other: Sidecar, container: ContainerFactory, base_image: str
) -> None:
    dpkg("-i", str(before))
    run(["systemctl", "start", "avckpt-sidecar.service"])
    wait_until(no_other.answers, PATIENCE_S, "the sidecar answers", every_s=0.2)
    program = "import itertools, time\nfor n in itertools.count():\n    print(n, flush=True); time.sleep(0.1)"
    labels = {"interval": f"{INTERVAL_S:g}s"}
    one = container.protected("python3", "-c", program, labels=labels, options=("--network=none",))
    no_other.wait_generation(one, 1, PATIENCE_S)
    app, started = no_other.app_pid(one), one.inspect()["State"]["StartedAt"]

    dpkg("-i", str(package("avckpt")))
    wait_until(no_other.answers, PATIENCE_S, "the new sidecar answers", every_s=0.05)
    answered = time.monotonic()
    no_other.wait_generation(one, 1, PATIENCE_S)
    took_s = time.monotonic() - answered
    assert took_s < INTERVAL_S * SLOWNESS, f"protected again after {took_s:.2f} s"
    assert no_other.app_pid(one) == app
    os.kill(app, signal.SIGSEGV)
    no_other.wait_restores(one, 1, PATIENCE_S)
    assert one.inspect()["State"]["StartedAt"] == started
    # And what starts now is of the new version.
    two = container.protected("sleep", "1000", labels=labels, options=("--network=none",))
    no_other.wait_generation(two, 1, PATIENCE_S)
    assert "(build " in run(["/usr/bin/avckpt", "--version"], timeout_s=PATIENCE_S).stdout

    dpkg("-r", "avckpt")
    assert (one.status, two.status) == ("running", "running")


def test_the_image_comes_with_its_package(no_other: Sidecar) -> None:
    dpkg("-i", str(package("avckpt")))
    no_other.podman.run("rmi", "--force", "localhost/avckpt-sidecar:latest", check=False)
    dpkg("-i", str(package("avckpt-sidecar-image")))
    assert no_other.podman.run("image", "exists", "localhost/avckpt-sidecar:latest", check=False).status == 0
    run(["/usr/bin/avckpt", "install", "--sidecar", "--archive", "/usr/share/avckpt/avckpt-sidecar.tar"], timeout_s=600)
    wait_until(no_other.answers, PATIENCE_S, "the sidecar answers", every_s=0.2)
    no_other.stop()
