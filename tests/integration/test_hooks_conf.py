# SPDX-License-Identifier: Apache-2.0
"""Podman reads its configuration as avckpt assumes."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.cli import containers_conf, doctor
from avckpt.cli.install import DROP_IN, HOOKS_DIR

from testkit.harness import Podman, avckpt_command, hooks_installed, run, wait_until

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
    """Command line of process 1 of a protected container; limits are given, since no configuration here sets any."""
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


@pytest.mark.shared_machine("Podman's service is given a time to start")
def test_a_service_that_runs_already_calls_no_hooks(
    installed: None, podman: Podman, base_image: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from podman import PodmanClient

    monkeypatch.delenv("CONTAINERS_CONF", raising=False)
    path = tmp_path / "podman.sock"

    @contextlib.contextmanager
    def running_service() -> Iterator[str]:
        """Runs Podman's API service; yields the beginning of its error, if it has one."""
        service = subprocess.Popen([*podman.command, "system", "service", "--time", "0", f"unix://{path}"])
        try:
            wait_until(path.exists, 10, "Podman's service")
            yield f"Podman's service (process {service.pid}) is older than the installation"
        finally:
            service.terminate()
            service.wait(timeout=10)
            path.unlink(missing_ok=True)

    def first_word() -> str:
        with PodmanClient(base_url=f"unix://{path}") as client:
            labels = {"avckpt.enable": "true"}
            made = client.containers.create(base_image, ["sleep", "60"], name=name, labels=labels, network_mode="none")
            made.start()
        pid = podman.inspect(name)["State"]["Pid"]
        return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[0].decode()

    DROP_IN.unlink()
    with running_service() as problem:
        done = run([*avckpt_command(), "install"])
        assert f"warning: {problem}" in done.stderr
        assert first_word() == "sleep"
        podman.remove(name)
    with running_service() as problem:
        done = run([*avckpt_command(), "install"])  # again: nothing new
        assert problem not in done.stderr
        assert first_word() == INIT
        assert doctor.service_facts(path) == doctor.podman_facts()


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
