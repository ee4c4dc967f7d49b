# SPDX-License-Identifier: Apache-2.0
"""The wheel is all that `avckpt install` needs: no checkout, no compiler.

AVCKPT_LONG=1 (`make test-packages`) also builds the sidecar's image from it, and installs the .deb in a container.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from testkit.harness import ROOT

if TYPE_CHECKING:
    from testkit.harness import Podman

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="needs root")

long = pytest.mark.skipif(os.environ.get("AVCKPT_LONG") != "1", reason="takes minutes: make test-packages")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, unpacked as pip does it; its dependencies are those of the test environment."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(folder), "."], cwd=ROOT, check=True)
    [wheel] = folder.glob("avckpt-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    return folder / "site"


def installed(site: Path, *args: str, code: str = "from avckpt.cli.commands import main; main()") -> str:
    """Runs `avckpt ARGS` from the wheel, outside of any checkout."""
    env = {**os.environ, "PYTHONPATH": str(site)}
    done = subprocess.run(
        [sys.executable, "-c", code, *args], cwd="/", env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_what_is_installed_comes_from_the_wheel(site: Path, tmp_path: Path) -> None:
    for folder in ("usr/bin", "etc/containers"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "usr/bin/python3").symlink_to("/usr/bin/python3")
    assert str(site) in installed(site, code="import avckpt; print(avckpt.__file__)")
    installed(site, "install", "--quadlet", "--root", str(tmp_path))
    init = tmp_path / "usr/local/libexec/avckpt/avckpt-init"
    assert init.read_bytes() == (site / "avckpt/libexec/avckpt-init").read_bytes()
    unit = (tmp_path / "etc/containers/systemd/avckpt-sidecar.container").read_text()
    assert "Image=localhost/avckpt-sidecar\n" in unit
    installed(site, "install", "--root", str(tmp_path))
    assert "avckpt-sidecar.container" in installed(site, "uninstall", "--root", str(tmp_path))
    assert not (tmp_path / "etc/containers/systemd").exists()


def test_the_image_is_built_from_what_is_installed(site: Path, tmp_path: Path) -> None:
    """Up to the context for `podman build`, which the checkout's build shares."""
    code = "import sys, pathlib\nfrom avckpt.cli import sidecar_image\nsidecar_image._fill(pathlib.Path(sys.argv[1]))"
    installed(site, str(tmp_path), code=code)
    assert "aiohttp>=" in (tmp_path / "requirements.txt").read_text()
    version = installed(site, "--version")
    assert version.startswith("avckpt ")
    assert "(build " in version
    assert installed(tmp_path / "site", "--version") == version


def test_a_base_that_is_not_there_is_told_with_what_to_do(site: Path, podman: Podman) -> None:
    code = (
        "from avckpt.cli import sidecar_image\nsidecar_image.IMAGE = 'localhost/avckpt-none'\n"
        "try: sidecar_image.build('localhost/none:1', print)\n"
        "except sidecar_image.PodmanFailed as error: print(error)"
    )
    said = installed(site, code=code)
    assert "localhost/none:1" in said
    assert "--base names another image" in said
    assert podman.run("image", "exists", "localhost/avckpt-none", check=False).status == 1


@long
def test_the_sidecar_is_built_and_started(site: Path, podman: Podman, base_image: str) -> None:
    said = installed(site, "install", "--sidecar", "--base", base_image)
    try:
        assert "avckpt-sidecar: runs" in said
        inside = podman.run("exec", "avckpt-sidecar", "avckpt", "--version").stdout
        assert inside == installed(site, "--version")
        assert ": there already, of build " in installed(site, "install", "--sidecar", "--base", base_image)
    finally:
        podman.run("rm", "--force", "--time", "5", "avckpt-sidecar", check=False)
        installed(site, "uninstall")


def test_it_is_the_same_wherever_it_was_built(site: Path) -> None:
    told = {path.name for path in site.rglob("*") if path.is_file() and bytes(ROOT) in path.read_bytes()}
    assert told <= {"avckpt"}  # which pip makes: its first line names this Python


@long
def test_the_deb_comes_and_goes(podman: Podman, base_image: str) -> None:
    subprocess.run([ROOT / "scripts/make-deb.sh"], check=True)
    [deb] = (ROOT / "build").glob("avckpt_*.deb")
    script = (
        "set -e; find /usr/local /etc -type f | sort > /before; dpkg -i /avckpt.deb; avckpt --version; avckpt --help;"
        "test -x /usr/local/libexec/avckpt/avckpt-init; test -f /lib/systemd/system/avckpt-sidecar.service;"
        "dpkg -i /avckpt.deb; dpkg -r avckpt; test ! -e /usr/lib/avckpt;"
        "find /usr/local /etc -type f | sort | diff /before -"
    )
    options = ("--rm", "--pull=never", "--network=none", "--volume", f"{deb}:/avckpt.deb:ro")
    done = podman.run("run", *options, base_image, "sh", "-c", script, timeout_s=120)
    assert "(build " in done.stdout
