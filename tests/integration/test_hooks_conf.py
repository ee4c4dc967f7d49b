# SPDX-License-Identifier: Apache-2.0
"""That Podman reads its configuration as avckpt says it does."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt import containers_conf
from avckpt.install import HOOKS_DIR
from harness import Podman, hooks_installed

INIT = "/run/avckpt-init"


@pytest.fixture
def installed(machine: None, podman: Podman) -> Iterator[None]:
    with hooks_installed():
        yield


@pytest.fixture
def name(podman: Podman) -> Iterator[str]:
    chosen = f"avckpt-hooks-{os.getpid()}-conf"
    yield chosen
    podman.remove(chosen)


def first_process(podman: Podman, name: str, image: str) -> str:
    """What runs first in a protected container; limits are given, for a file of ours knows none that suit."""
    limits = ["--ulimit", f"nofile={os.sysconf('SC_OPEN_MAX')}", "--ulimit", "nproc=1024"]
    return podman.run(
        *("run", "--pull=never", "--name", name, "--network=none", "--label", "avckpt.enable=true", *limits),
        *(image, "sh", "-c", "tr '\\0' ' ' </proc/1/cmdline"),
    ).stdout


def test_the_drop_in_is_in_force(
    installed: None, podman: Podman, base_image: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CONTAINERS_CONF", raising=False)
    assert containers_conf.problems(HOOKS_DIR, environ=os.environ) == []
    assert first_process(podman, name, base_image).startswith(INIT)


def test_containers_conf_in_the_environment_hides_it_and_the_remedy_helps(
    installed: None, podman: Podman, base_image: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "containers.conf"
    mine.write_text("[engine]\n")
    monkeypatch.setenv("CONTAINERS_CONF", str(mine))
    [problem] = containers_conf.problems(HOOKS_DIR, environ=os.environ)
    assert first_process(podman, name, base_image).startswith("sh -c")
    podman.remove(name)

    advice = problem.partition("write ")[2].partition(" under [engine] in ")
    assert advice[2] == str(mine)
    mine.write_text(f"[engine]\n{advice[0]}\n")
    assert containers_conf.problems(HOOKS_DIR, environ=os.environ) == []
    assert first_process(podman, name, base_image).startswith(INIT)
