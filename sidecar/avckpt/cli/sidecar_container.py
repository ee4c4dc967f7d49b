# SPDX-License-Identifier: Apache-2.0
"""Sees to it that the sidecar's container runs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

from avckpt_hooks.shared.protocol import STATE_DIR

from avckpt.cli.client import CPU_SHARES, Client, is_service, start_it
from avckpt.cli.podman import PodmanFailed, podman
from avckpt.errors import SidecarUnreachable
from avckpt.events.system_journal import SOCKET

NAME = "avckpt-sidecar"
IMAGE = "localhost/avckpt-sidecar"
CONFIG_DIR = Path("/etc/avckpt")
JOURNAL = SOCKET.parent
OUTDATED = f"the container {NAME} is of another build than the image {IMAGE}"
ANSWERS_WITHIN_S = 20.0


def ensure(run_dir: Path, say: Callable[[str], None]) -> None:
    """Returns when a sidecar answers; starts its container if none does.

    Raises SidecarUnreachable with what is to be done when that cannot be.
    """
    try:
        _ensure(run_dir, say)
        outdated = is_outdated()
    except PodmanFailed as error:
        raise SidecarUnreachable(
            f"the container {NAME} cannot be started: {error}; "
            f"mend that, or remove it (podman rm -f {NAME}) and try again"
        ) from error
    if outdated:
        say(f"warning: {OUTDATED} (sudo podman rm -f {NAME}, then sudo avckpt up)")


def is_outdated() -> bool:
    """Its container was made of another image than there is now.

    A version number does not tell: between two releases all builds have the
    same.  Raises PodmanFailed.
    """
    runs = podman("container", "inspect", "--format", "{{.Image}}", NAME, check=False).stdout
    there = podman("image", "inspect", "--format", "{{.Id}}", IMAGE, check=False).stdout
    return bool(runs and there and runs != there)


def _ensure(run_dir: Path, say: Callable[[str], None]) -> None:
    client = Client(run_dir)
    if answers(client):
        return
    status = _status()
    if status == "paused":
        raise SidecarUnreachable(f"the container {NAME} is paused, and nothing is protected: podman unpause {NAME}")
    if status == "running":
        # It may have been started a moment ago.
        _wait(client, f"the container {NAME} runs, and does not answer on {run_dir}/api.sock")
        return
    if status:
        say(f"starting the container {NAME} again")
        podman("start", NAME)
    elif podman("image", "exists", IMAGE, check=False).returncode == 0:
        say(f"starting the container {NAME}")
        run_dir.mkdir(mode=0o755, parents=True, exist_ok=True)
        podman("run", "--detach", "--pull=never", "--name", NAME, *options(run_dir), IMAGE)
    else:
        how = start_it(run_dir) if is_service() else "run sudo avckpt install --sidecar"
        raise SidecarUnreachable(f"no sidecar is running, and there is no image {IMAGE} to start one from: {how}")
    _wait(client, f"the container {NAME} was started, and does not answer on {run_dir}/api.sock")


def options(run_dir: Path) -> list[str]:
    """What `podman run` has to be told for a sidecar."""
    config = ["--volume", f"{CONFIG_DIR}:{CONFIG_DIR}:ro"] if CONFIG_DIR.is_dir() else []
    journal = ["--volume", f"{JOURNAL}:{JOURNAL}"] if JOURNAL.is_dir() else []
    history = ["--volume", f"{STATE_DIR}:{STATE_DIR}"] if Path(STATE_DIR).is_dir() else []
    volumes = ["--volume", f"{run_dir}:/run/avckpt", *config, *journal, *history]
    return ["--restart=always", "--privileged", "--pid=host", "--network=none", f"--cpu-shares={CPU_SHARES}", *volumes]


def answers(client: Client) -> bool:
    """Is there a sidecar?"""
    try:
        client.info()
    except SidecarUnreachable:
        return False
    return True


def _wait(client: Client, otherwise: str) -> None:
    deadline = time.monotonic() + ANSWERS_WITHIN_S
    while not answers(client):
        if time.monotonic() > deadline or _status() != "running":
            lines = podman("logs", "--tail", "1", NAME, check=False)
            last = (lines.stderr or lines.stdout).strip()
            raise SidecarUnreachable(f"{otherwise}: {last or 'see podman logs ' + NAME}")
        time.sleep(0.2)


def _status() -> str:
    """As `podman ps` has it; empty: there is no such container."""
    done = podman("inspect", "--type", "container", NAME, check=False)
    return str(json.loads(done.stdout)[0]["State"]["Status"]) if done.returncode == 0 else ""
