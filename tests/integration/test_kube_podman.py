# SPDX-License-Identifier: Apache-2.0
"""Pods by `podman kube play`, also of what `podman generate kube` has written."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from testkit.harness import BASE_IMAGE, SLOWNESS, Container, ContainerFactory, Podman, Sidecar, avckpt_command, run

POD = f"""
apiVersion: v1
kind: Pod
metadata:
  name: avckpt-kube
  labels: {{avckpt.enable: "true", avckpt.interval: 200ms}}
  annotations: {{avckpt.keep/one: "3"}}
spec:
  hostNetwork: true
  containers:
  - {{name: one, image: {BASE_IMAGE}, imagePullPolicy: Never, command: [sleep, "1000"]}}
  - {{name: two, image: {BASE_IMAGE}, imagePullPolicy: Never, command: [sleep, "1000"]}}
"""


@pytest.fixture
def play(podman: Podman, tmp_path: Path) -> Iterator[Callable[[str], None]]:
    """Starts what a text says."""
    played: list[str] = []

    def start(text: str) -> None:
        path = tmp_path / f"{len(played)}.yaml"
        path.write_text(text)
        played.append(str(path))
        podman.run("kube", "play", str(path), timeout_s=120 * SLOWNESS)

    yield start
    for path in played:
        podman.run("kube", "down", path, timeout_s=120 * SLOWNESS, shielded=True)


def found(podman: Podman, name: str) -> Container:
    return Container(podman, name, podman.inspect(name)["Id"])


def crash(container: Container, sidecar: Sidecar) -> None:
    sidecar.wait_generation(container)
    os.kill(sidecar.app_pid(container), signal.SIGSEGV)
    sidecar.wait_restores(container)
    assert container.status == "running"


def test_labels_of_a_pod_hold_for_its_containers(
    play: Callable[[str], None], podman: Podman, sidecar: Sidecar, tmp_path: Path
) -> None:
    play(POD)
    for name in ("one", "two"):
        crash(found(podman, f"avckpt-kube-{name}"), sidecar)
    told = run([*avckpt_command(), "check", str(tmp_path / "0.yaml")], check=False)
    assert "avckpt.enable: Kubernetes tells a runtime of annotations, and not of labels" in told.stdout + told.stderr


def test_annotations_survive_generate_and_play(
    play: Callable[[str], None], podman: Podman, sidecar: Sidecar, container: ContainerFactory
) -> None:
    options = ("--annotation", "avckpt.enable=true", "--annotation", "avckpt.interval=200ms", "--network=host")
    first = container("sleep", "1000", options=options, name="avckpt-kube-first")
    crash(first, sidecar)
    text = podman.run("generate", "kube", first.name).stdout
    first.remove()
    [pod] = yaml.safe_load_all(text)
    [played] = pod["spec"]["containers"]
    played["imagePullPolicy"] = "Never"
    play(yaml.safe_dump(pod))
    crash(found(podman, f"{pod['metadata']['name']}-{played['name']}"), sidecar)
