# SPDX-License-Identifier: Apache-2.0
"""examples/kubernetes/ against the schema of Kubernetes' API (kubernetes_schema.json), and avckpt check."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from avckpt.cli.compose import pods

FOLDER = Path(__file__).parents[2] / "examples/kubernetes"
FILES = sorted(FOLDER.glob("*.yaml"))
SCHEMA = json.loads((Path(__file__).parent / "kubernetes_schema.json").read_text())


def validate(thing: dict[str, Any]) -> None:
    jsonschema.validate(thing, {**SCHEMA, "$ref": f"#/$defs/V1{thing['kind']}"})


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_an_example_is_what_the_api_takes(path: Path) -> None:
    [thing] = yaml.safe_load_all(path.read_text())
    validate(thing)
    assert pods.check([path]).problems == []


def test_the_schema_knows_what_there_is_not() -> None:
    pod = yaml.safe_load((FOLDER / "pod.yaml").read_text())
    pod["spec"]["runtimeClass"] = pod["spec"].pop("runtimeClassName")
    with pytest.raises(jsonschema.ValidationError, match="runtimeClass"):
        validate(pod)


def test_pod_and_runtime_class_name_the_same_runtime() -> None:
    named = {path.stem: yaml.safe_load(path.read_text()) for path in FILES}
    assert named["pod"]["spec"]["runtimeClassName"] == named["runtimeclass"]["metadata"]["name"]
    assert pods.check([FOLDER / "pod.yaml"]).services["Pod/drive"].enabled


def test_annotations_of_one_container(tmp_path: Path) -> None:
    pod = yaml.safe_load((FOLDER / "pod.yaml").read_text())
    pod["metadata"]["annotations"] = {
        "avckpt.enable/lidar": "true",
        "avckpt.keep/lidar": "99",
        "avckpt.keep/radar": "2",
    }
    path = tmp_path / "pod.yaml"
    path.write_text(yaml.safe_dump(pod))
    found = pods.check([path])
    assert found.services["Pod/drive/lidar"].enabled
    assert "Pod/drive" not in found.services  # it has no other container
    said = [problem.message for problem in found.problems]
    assert len(said) == 2, said
    assert "avckpt.keep/radar: the pod has no container 'radar'" in said
    assert any("avckpt.keep=99" in line for line in said)


@pytest.mark.parametrize(
    ("annotation", "more", "words"),
    [
        ("avckpt.keep", {"resources": {"limits": {"nvidia.com/gpu": 1}}}, ["nvidia.com/gpu: a process"]),
        ("avckpt.keep/lidar", {"resources": {"limits": {"amd.com/gpu": 1}}}, ["amd.com/gpu: a process"]),
        ("avckpt.restore.on", {}, ["unhealthy needs a healthcheck"]),
        ("avckpt.restore.on", {"livenessProbe": {"exec": {"command": ["true"]}}}, []),
        ("avckpt.group", {}, ["no other service here is in the group"]),
        ("avckpt.group/lidar", {}, ["no other service here is in the group"]),
    ],
)
def test_what_is_hardly_meant(annotation: str, more: dict[str, Any], words: list[str], tmp_path: Path) -> None:
    values = {"avckpt.keep": "3", "avckpt.restore.on": "unhealthy", "avckpt.group": "drive"}
    pod = yaml.safe_load((FOLDER / "pod.yaml").read_text())
    pod["metadata"]["annotations"][annotation] = values[annotation.partition("/")[0]]
    pod["spec"]["containers"][0].update(more)
    path = tmp_path / "pod.yaml"
    path.write_text(yaml.safe_dump(pod))
    said = [problem.message for problem in pods.check([path]).problems]
    assert len(said) == len(words), said
    assert all(line.startswith(words[0]) for line in said), said


def test_containers_of_a_pod_are_a_group(tmp_path: Path) -> None:
    pod = yaml.safe_load((FOLDER / "pod.yaml").read_text())
    pod["metadata"]["annotations"]["avckpt.group"] = "drive"
    pod["spec"]["containers"].append({**pod["spec"]["containers"][0], "name": "radar"})
    path = tmp_path / "pod.yaml"
    path.write_text(yaml.safe_dump(pod))
    assert pods.check([path]).problems == []


def test_what_is_written_as_in_compose_is_no_annotation(tmp_path: Path) -> None:
    path = tmp_path / "pod.yaml"
    path.write_text(
        "apiVersion: v1\nkind: Pod\nmetadata:\n  name: car\n  annotations:\n  - avckpt.enable=true\n"
        "spec:\n  containers: []\n  containers: [{name: node, image: node}]\n"
    )
    none, twice = pods.check([path]).problems
    assert str(none).startswith(f"{path}:6: service Pod/car: annotations and labels are a mapping")
    assert str(twice).startswith(f"{path}:9: warning: containers is given twice")
    path.write_text("apiVersion: v1\nkind: Pod\nmetadata:\n  name: car\n  annotations: ~\n")
    assert pods.check([path]).problems == []
