# SPDX-License-Identifier: Apache-2.0
"""avckpt-runtime under Docker and containerd: a daemon of our own, in a folder, without network."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from testkit.harness import ROOT, SLOWNESS, wait_until
from testkit.local_sidecar import LocalSidecar, local_sidecar

if TYPE_CHECKING:
    from testkit.harness import Podman

DEBIANS = ROOT / "build/docker/root/usr"
COUNT = "import itertools, time\nfor n in itertools.count():\n    print(n, flush=True)\n    time.sleep(0.02)"
PATIENCE_S = 20 * SLOWNESS
LABELS = {"enable": "true", "interval": "50ms", "restore.max": "64/1s"}

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root"),
    pytest.mark.skipif(not (DEBIANS / "sbin/dockerd").exists(), reason="no dockerd: scripts/setup-docker.sh"),
    pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long"),
]


class Docker:
    """A Docker daemon, and a sidecar with which its runtime registers containers."""

    def __init__(self, folder: Path, sidecar: LocalSidecar) -> None:
        self.folder = folder
        self.sidecar = sidecar
        libraries = next(DEBIANS.glob("lib/*-linux-gnu"), DEBIANS / "lib")
        self.env = {
            **os.environ,
            "PATH": f"{DEBIANS}/bin:{DEBIANS}/sbin:{os.environ['PATH']}",
            "LD_LIBRARY_PATH": f"{libraries}:{DEBIANS.parent / 'lib' / libraries.name}",
            "DOCKER_HOST": f"unix://{folder}/docker.sock",
            "DOCKER_CONFIG": str(folder),
        }
        self.runtime = folder / "avckpt-runtime-here"
        ours = f"{ROOT}/hooks/avckpt-runtime --avckpt-run-dir={sidecar.run_dir}"
        self.runtime.write_text(f'#!/bin/sh\nexec {ours} "$@"\n')
        self.runtime.chmod(0o755)
        (folder / "daemon.json").write_text(json.dumps({"runtimes": {"avckpt": {"path": str(self.runtime)}}}))

    def start(self) -> subprocess.Popen[bytes]:
        command = ["dockerd", "--config-file", f"{self.folder}/daemon.json", "--data-root", f"{self.folder}/data"]
        command += ["--exec-root", f"{self.folder}/exec", "-H", self.env["DOCKER_HOST"], "--storage-driver", "overlay2"]
        command += ["--pidfile", f"{self.folder}/pid", "--iptables=false", "--ip6tables=false", "--bridge=none"]
        with (self.folder / "log").open("wb") as log:
            daemon = subprocess.Popen(command, env=self.env, stdout=log, stderr=log)
        wait_until(lambda: not self.run("info", check=False).startswith("?"), PATIENCE_S, "dockerd answers")
        return daemon

    def run(self, *args: str, check: bool = True) -> str:
        done = subprocess.run(
            ["docker", *args], env=self.env, capture_output=True, text=True, check=False, timeout=4 * PATIENCE_S
        )
        if check:
            assert done.returncode == 0, done.stderr
        return done.stdout.strip() if done.returncode == 0 else f"? {done.stderr}"

    def ctr(self, *args: str) -> str:
        command = ["ctr", "-a", f"{self.folder}/exec/containerd/containerd.sock", "-n", "avckpt-test", *args]
        done = subprocess.run(
            command, env=self.env, capture_output=True, text=True, check=False, timeout=4 * PATIENCE_S
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def protected(self, image: str, *command: str, options: tuple[str, ...] = ()) -> str:
        """Starts a protected container; its id."""
        labels = [word for key, value in LABELS.items() for word in ("--label", f"avckpt.{key}={value}")]
        words = ("run", "--detach", "--network=none", "--runtime=avckpt", *labels, *options, image, *command)
        return self.run(*words)

    def row(self, name: str) -> dict[str, object]:
        return next((row for row in self.sidecar.ps() if row["name"] == name), {})

    def crash(self, name: str, restores: int) -> None:
        fit = lambda: self.row(name).get("state") == "protected" and self.row(name)["restores"] == restores - 1  # noqa: E731
        wait_until(fit, PATIENCE_S, f"{name} is protected")
        os.kill(int(str(self.row(name)["app_pid"])), (signal.SIGSEGV, signal.SIGKILL)[restores % 2])
        wait_until(lambda: self.row(name).get("restores") == restores, PATIENCE_S, f"{name} is restored")


@pytest.fixture(scope="module")
def docker(tmp_path_factory: pytest.TempPathFactory, podman: Podman, base_image: str) -> Iterator[Docker]:
    folder = tmp_path_factory.mktemp("docker")
    with local_sidecar(folder) as sidecar:
        sidecar.start()
        made = Docker(folder, sidecar)
        daemon = made.start()
        try:
            podman.run("save", "-o", str(folder / "base.tar"), base_image, timeout_s=4 * PATIENCE_S)
            made.run("load", "-i", str(folder / "base.tar"))
            yield made
        finally:
            for left in made.run("ps", "-aq", check=False).split():
                made.run("rm", "-f", left, check=False)
            daemon.terminate()
            daemon.wait(PATIENCE_S)


def test_a_container_of_dockers_lives_through_crashes(docker: Docker, base_image: str) -> None:
    options = ("--name", "web", "--init", "--restart=on-failure", "--health-cmd=true", "--health-interval=1s")
    docker.protected(base_image, "python3", "-c", COUNT, options=options)
    for restores in range(1, 5):
        docker.crash("web", restores)
    state = "{{.State.Status}} {{.RestartCount}}"
    assert docker.run("inspect", "-f", state, "web") == "running 0"
    wait_until(
        lambda: docker.run("inspect", "-f", "{{.State.Health.Status}}", "web") == "healthy", PATIENCE_S, "healthy"
    )
    assert docker.run("logs", "web").split().count("0") == 1
    assert docker.run("exec", "web", "echo", "in it") == "in it"
    docker.run("restart", "-t", "5", "web")
    wait_until(lambda: docker.row("web").get("state") == "protected", PATIENCE_S, "protected after docker restart")
    docker.run("stop", "-t", "9", "web")
    assert docker.run("inspect", "-f", "{{.State.ExitCode}}", "web") == str(128 + signal.SIGTERM)
    wait_until(lambda: not docker.row("web"), PATIENCE_S, "its end is known")
    assert not list((docker.sidecar.run_dir / "containers").iterdir())


def test_labels_that_are_wrong_and_none_at_all(docker: Docker, base_image: str) -> None:
    said = docker.run(
        *("run", "--rm", "--network=none", "--runtime=avckpt", "--label", "avckpt.enable=yes-please", base_image),
        check=False,
    )
    assert "avckpt: container" in said
    assert "avckpt.enable" in said
    plain = ("run", "--rm", "--network=none", "--runtime=avckpt", base_image, "cat", "/proc/1/comm")
    assert docker.run(*plain) == "cat"


def test_a_container_of_containerds_by_its_annotations(docker: Docker, base_image: str) -> None:
    docker.ctr("images", "import", "--snapshotter", "overlayfs", str(docker.folder / "base.tar"))
    [image] = docker.ctr("images", "ls", "-q").split()
    annotations = [word for key, value in LABELS.items() for word in ("--annotation", f"avckpt.{key}={value}")]
    options = ("--detach", "--snapshotter", "overlayfs", "--runc-binary", str(docker.runtime), *annotations)
    docker.ctr("run", *options, image, "lidar", "sleep", "1000")
    try:
        for restores in range(1, 3):
            docker.crash("lidar", restores)
    finally:
        docker.ctr("tasks", "kill", "-s", "KILL", "lidar")
        wait_until(lambda: "STOPPED" in docker.ctr("tasks", "ls"), PATIENCE_S, "it has ended")
        docker.ctr("tasks", "rm", "lidar")
        docker.ctr("containers", "rm", "lidar")
