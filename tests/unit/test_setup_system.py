# SPDX-License-Identifier: Apache-2.0
"""scripts/setup-system.sh on other systems: their programs are replaced, the script is real."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from testkit.harness import ROOT, Completed, run

TOOLS = ("bash", "cat", "cut", "dirname", "head", "mkdir", "mktemp", "rm", "sed", "sleep", "sort", "tail", "tr", "env")


class System:
    """A folder with all the programs that there are."""

    def __init__(self, path: Path) -> None:
        self._path = path
        for name in TOOLS:
            found = shutil.which(name)
            assert found is not None
            (path / name).symlink_to(found)
        self.installed = path / "installed"
        self.program("podman", 'echo "podman version 4.3.1"')
        self.program("uname", "echo 6.1.0-18-amd64")
        self.program("id", "echo 0")
        self.program("apt-cache", "exit 0")
        self.program("apt-get", f'if [ "$1" != update ]; then echo "$@" >{self.installed}; fi')

    def program(self, name: str, script: str) -> None:
        (self._path / name).write_text(f"#!/bin/sh\n{script}\n")
        (self._path / name).chmod(0o755)

    def set_up(self) -> Completed:
        script = ROOT / "scripts" / "setup-system.sh"
        return run(["bash", str(script)], env={"PATH": str(self._path), "PYTHON": "no-python"}, check=False)


@pytest.fixture
def system(tmp_path: Path) -> System:
    return System(tmp_path)


def test_an_optional_package_that_there_is_not_keeps_nobody_from_the_others(system: System) -> None:
    system.program("apt-cache", "case $2 in cyclonedds-*) exit 100 ;; esac")
    done = system.set_up()
    assert done.status == 0, done
    packages = system.installed.read_text().split("--no-install-recommends ")[1].split()
    assert {"gcc", "libc6-dev", "python3", "g++"} <= set(packages)
    assert not any(package.startswith("cyclonedds") for package in packages)
    assert "warning: this system has no package cyclonedds-dev; going on without" in done.stderr


def test_who_is_not_root_is_told_what_is_needed(system: System) -> None:
    system.program("id", "echo 1000")
    done = system.set_up()
    assert done.status == 1
    assert "sudo apt-get install gcc libc6-dev" in done.stderr.replace("conmon ", "").replace("crun ", "")
    assert "cyclonedds" not in done.stderr


@pytest.mark.parametrize(
    ("program", "says", "why"),
    [
        ("podman", "podman version 3.4.4", "Podman 3.4.4 is too old: avckpt needs 4.3 or newer"),
        ("uname", "5.10.0-28-amd64", "Linux 5.10.0-28-amd64 is too old: avckpt needs 5.13 or newer"),
    ],
)
def test_what_is_too_old_is_told_at_once(system: System, program: str, says: str, why: str) -> None:
    system.program(program, f"echo {says}")
    done = system.set_up()
    assert (done.status, done.stderr.startswith(f"error: {why}")) == (1, True)
    assert not system.installed.exists()


def test_a_podman_that_is_installed_and_too_old_is_told(system: System) -> None:
    (system.installed.parent / "podman").unlink()
    install = f'echo "#!/bin/sh\necho podman version 3.4.4" >{system.installed.parent}/podman'
    system.program("apt-get", f'if [ "$1" != update ]; then {install}; chmod 755 {system.installed.parent}/podman; fi')
    system.program("chmod", '/bin/chmod "$@"')
    done = system.set_up()
    assert done.status == 1
    assert "error: Podman 3.4.4 is too old" in done.stderr
