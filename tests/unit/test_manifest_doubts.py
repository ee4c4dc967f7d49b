# SPDX-License-Identifier: Apache-2.0
"""avckpt check: valid settings that are hardly intended, and Kubernetes' YAML."""

from __future__ import annotations

from pathlib import Path

import pytest
from avckpt.cli.compose import manifest, pods

PROTECTED = 'labels: {avckpt.enable: "true"'


def said(tmp_path: Path, text: str, *, of: str = "services:\n") -> list[str]:
    """Every problem, without its place."""
    path = tmp_path / "file.yaml"
    path.write_text(of + text)
    found = pods.check([path]) if pods.is_pods(path) else manifest.check([path])
    return [str(problem).partition(": ")[2] for problem in found.problems]


@pytest.mark.parametrize(
    ("service", "words"),
    [
        (f"{PROTECTED}, avckpt.restore.on: 'signal,unhealthy'}}", "unhealthy needs a healthcheck"),
        (f"{PROTECTED}, avckpt.restore.on: unhealthy}}, healthcheck: {{disable: true}}", "and the service has none"),
        (f"{PROTECTED}}}, devices: ['/dev/nvidia0:/dev/nvidia0']", "/dev/nvidia0:/dev/nvidia0: a process that uses"),
        (f"{PROTECTED}}}, gpus: all", "gpus: a process that uses a GPU"),
        (f"{PROTECTED}}}, runtime: nvidia", "runtime nvidia: a process that uses a GPU"),
        (
            f"{PROTECTED}}}, deploy: {{resources: {{reservations: {{devices: [{{capabilities: [gpu]}}]}}}}}}",
            "deploy.resources.reservations.devices: a process that uses a GPU",
        ),
        (f"{PROTECTED}, avckpt.group: drive}}", "no other service here is in the group drive"),
    ],
)
def test_a_service_that_is_hardly_meant(tmp_path: Path, service: str, words: str) -> None:
    [problem] = said(tmp_path, f"  node: {{image: x, {service}}}\n")
    assert problem.startswith("service node: warning: ")
    assert words in problem


@pytest.mark.parametrize(
    "service",
    [
        f"{PROTECTED}, avckpt.restore.on: unhealthy}}, healthcheck: {{test: 'true'}}",
        "devices: [/dev/dri]",
        f"{PROTECTED}}}, devices: [/dev/ttyUSB0]",
    ],
)
def test_and_one_that_is_meant(tmp_path: Path, service: str) -> None:
    assert said(tmp_path, f"  node: {{image: x, {service}}}\n") == []


def test_who_waits_for_itself_is_told_and_nobody_else(tmp_path: Path) -> None:
    text = "  a: {depends_on: [b]}\n  b: {depends_on: {c: {condition: service_started}}}\n  c: {depends_on: [a]}\n"
    assert said(tmp_path, f"{text}  d: {{depends_on: [a, e]}}\n  e: {{}}\n") == [
        "service a: waits for itself (depends_on): a -> b -> c -> a"
    ]
    # Many ways to the same place are no round, and are not walked one by one.
    layers = [f"  s{n}: {{depends_on: [s{n + 2 - n % 2}, s{n + 3 - n % 2}]}}\n" for n in range(200)]
    assert said(tmp_path, "".join([*layers, "  s200: {}\n", "  s201: {}\n"])) == []


def test_a_service_that_is_awaited_and_not_there(tmp_path: Path) -> None:
    text = "  a: {depends_on: [b, c]}\n  b: {depends_on: {d: {required: false}, e: {condition: service_started}}}\n"
    assert said(tmp_path, text) == [
        "service a: depends_on c, and there is no such service",
        "service b: depends_on e, and there is no such service",
    ]
    # The file that the environment names may have it.
    assert said(tmp_path, f"{text}include: ['${{MORE}}']\n") == []


def test_pods(tmp_path: Path) -> None:
    text = """
kind: Deployment
metadata: {name: d, annotations: {avckpt.enable: "true"}}
spec:
  template:
    metadata: {annotations: {avckpt.enable: true, avckpt.interval: 5x, avckpt_keep: "2"}}
---
apiVersion: v1
kind: Pod
metadata: {name: p, annotations: {avckpt.enable: "true"}, labels: {avckpt.keep: "3"}}
---
apiVersion: v1
kind: Pod
metadata: {name: right, annotations: {avckpt.enable: "true", avckpt.keep: "3"}}
spec: {runtimeClassName: avckpt}
"""
    problems = said(tmp_path, text, of="apiVersion: apps/v1")
    for words in (
        "service Deployment/d: avckpt.enable is no annotation of its pods",
        "service Deployment/d: annotation avckpt.interval=5x: not a duration",
        "did you mean avckpt.keep?",
        'avckpt.enable: Kubernetes takes strings only, write "true"',
        "service Pod/p: warning: without a runtimeClassName",
        "service Pod/p: warning: avckpt.keep: Kubernetes tells a runtime of annotations",
    ):
        assert any(words in problem for problem in problems), words
    assert len(problems) == 6
