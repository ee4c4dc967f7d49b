# SPDX-License-Identifier: Apache-2.0
"""Makes the sidecar's image from this installation, or loads it, and starts the container."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

from avckpt import artifacts
from avckpt.cli import sidecar_container
from avckpt.cli.podman import PodmanFailed, podman
from avckpt.cli.sidecar_container import IMAGE, NAME
from avckpt.errors import ConfigError

BUILD_LABEL = "io.avckpt.build"
BUILD_S = 1800.0


def build(base: str, say: Callable[[str], None]) -> str:
    """Builds the image, unless there is one of this build; what was done.  Raises PodmanFailed, ConfigError."""
    wanted = artifacts.build_id()
    label = f'{{{{index .Labels "{BUILD_LABEL}"}}}}'
    if podman("image", "inspect", "--format", label, IMAGE, check=False).stdout.strip() == wanted:
        return f"{IMAGE}: there already, of build {wanted}"
    say(f"building {IMAGE} (this takes a minute or two)")
    with tempfile.TemporaryDirectory(prefix="avckpt-image-") as name:
        folder = Path(name)
        needs = _fill(folder)
        options = ["--build-arg", f"BASE={base}", "--pull=missing"] if base else []
        wheels = folder / "wheels"
        if base and _fetch(base, needs, wheels):
            options += ["--volume", f"{wheels}:/wheels:ro"]
        options += ["--network=host", "--label", f"{BUILD_LABEL}={wanted}", "-t", IMAGE]
        try:
            podman("build", *options, str(folder), timeout_s=BUILD_S)
        except PodmanFailed as error:
            raise PodmanFailed(
                f"{error}; --base names another image to build from, --archive loads a built one"
            ) from None
    return f"{IMAGE}: built, build {wanted}"


def load(archive: Path) -> str:
    """Loads the image from what `podman save` has written; what was done.  Raises PodmanFailed, ConfigError."""
    said = podman("load", "-i", str(archive), timeout_s=BUILD_S).stdout
    # Not whether there is one of that name: an older one would run instead.
    if IMAGE not in (word.removesuffix(":latest") for word in said.replace(",", " ").split()):
        raise ConfigError(f"{archive} was loaded, and holds no image {IMAGE}")
    return f"{IMAGE}: loaded from {archive}"


def start(run_dir: Path, *, by_quadlet: bool) -> list[str]:
    """Has the container run from that image; lines of what was done.  Raises PodmanFailed, SidecarUnreachable."""
    if by_quadlet:
        return ["start the sidecar with: systemctl daemon-reload && systemctl start avckpt-sidecar.service"]
    lines: list[str] = []
    if sidecar_container.is_outdated():
        podman("rm", "--force", NAME)
        lines.append(f"removed the container {NAME}: it was of another build")
    sidecar_container.ensure(run_dir, lines.append)
    return [*lines, f"{NAME}: runs"]


def _fill(folder: Path) -> list[str]:
    """What the image is built from, without what Podman fetches; the packages that it needs.  Raises ConfigError."""
    shutil.copy(artifacts.packaging("Containerfile"), folder / "Containerfile")
    site = folder / "site"
    unwanted = shutil.ignore_patterns("__pycache__", "_native.c")
    shutil.copytree(artifacts.PACKAGE, site / "avckpt", ignore=unwanted)
    shutil.copytree(artifacts.hooks_source(), site / "avckpt_hooks", ignore=unwanted)
    for kind, paths in (
        ("libexec", (artifacts.init_binary(), artifacts.inside_binary(), artifacts.guard_binary())),
        ("oci-hooks.d", tuple(artifacts.oci_hooks_source().glob("*.json"))),
        ("packaging", tuple(artifacts.packaging(name) for name in ("Containerfile", "avckpt-sidecar.container"))),
    ):
        # They are beside the package in a checkout.
        (site / "avckpt" / kind).mkdir(exist_ok=True)
        for path in paths:
            shutil.copy(path, site / "avckpt" / kind)
    needs = [need for need in metadata.requires("avckpt") or [] if not re.search(r";.*extra", need)]
    (folder / "requirements.txt").write_text("".join(f"{need}\n" for need in needs))
    return needs


def _fetch(base: str, needs: list[str], folder: Path) -> bool:
    """Fetches the Python packages with our own pip, which knows how to reach them; False: the build has to."""
    code = "import platform, sys; print('%d.%d' % sys.version_info[:2], platform.machine())"
    said = podman("run", "--rm", "--network=none", base, "python3", "-c", code, check=False, timeout_s=BUILD_S)
    if said.returncode != 0 or len(said.stdout.split()) != 2:
        return False  # its Python comes with the build
    version, machine = said.stdout.split()
    platforms = (f"manylinux_2_28_{machine}", f"manylinux_2_17_{machine}", f"manylinux2014_{machine}")
    command = [sys.executable, "-m", "pip", "download", "-q", "-d", str(folder), "--only-binary=:all:"]
    command += ["--implementation", "cp", "--python-version", version]
    for abi in (f"cp{version.replace('.', '')}", "abi3", "none"):
        command += ["--abi", abi]
    for name in platforms:
        command += ["--platform", name]
    # By name: pip looks at the markers of its own Python here.
    done = subprocess.run([*command, "typing_extensions", *needs], capture_output=True, check=False)
    return done.returncode == 0
