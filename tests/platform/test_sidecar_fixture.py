# SPDX-License-Identifier: Apache-2.0
"""The fixtures around the sidecar, on one container that is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from testkit.harness import ROOT, ContainerFactory, Sidecar

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; the sidecar is given a time to protect"
)


def test_a_killed_app_is_there_again(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("sleep", "1000", labels={"interval": "200ms"})
    sidecar.wait_generation(made, at_least=2)
    first = sidecar.app_pid(made)
    os.kill(first, signal.SIGKILL)
    entry = sidecar.wait_restores(made)
    # The same number again: the container's own PID namespace gave it out anew.
    assert entry["app_pid_inside"] > 1
    assert made.exec("pgrep", "-x", "sleep").stdout.split() == [str(entry["app_pid_inside"])]
    assert made.status == "running"


def test_a_sidecar_that_a_test_has_killed(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("sleep", "1000", labels={"interval": "200ms"})
    sidecar.wait_generation(made)
    app = sidecar.app_pid(made)
    sidecar.kill()
    assert not sidecar.running
    assert Path(f"/proc/{app}").exists()
    sidecar.restart()
    assert sidecar.wait_generation(made)["adopted"] is True
    assert sidecar.app_pid(made) == app


def test_a_failed_test_shows_its_containers(tmp_path: Path, container: ContainerFactory) -> None:
    (tmp_path / "test_fails.py").write_text(
        "def test_fails(container):\n"
        "    made = container('sh', '-c', 'echo a word of farewell')\n"
        "    made.wait()\n"
        "    assert not 'broken'\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-c", ROOT / "pyproject.toml", tmp_path],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 1, done.stdout
    assert "podman logs avckpt-test-" in done.stdout
    assert "a word of farewell\n" in done.stdout
