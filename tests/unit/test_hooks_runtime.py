# SPDX-License-Identifier: Apache-2.0
"""avckpt-runtime in front of a program that prints its arguments."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
POD = {
    "io.kubernetes.cri.container-type": "container",
    "io.kubernetes.cri.sandbox-name": "drive",
    "io.kubernetes.cri.container-name": "lidar",
}
IDS = ("ab" * 32, "lidar")
ours = pytest.mark.skipif(os.geteuid() != 0, reason="only containers of root are protected")


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    (tmp_path / "runc").write_text('#!/bin/sh\necho "$@"\n')
    (tmp_path / "runc").chmod(0o755)
    return tmp_path


def called(bundle: Path, *args: str) -> subprocess.CompletedProcess[str]:
    command = [f"{ROOT}/hooks/avckpt-runtime", f"--avckpt-run-dir={bundle}/run", f"--avckpt-runtime={bundle}/runc"]
    return subprocess.run([*command, *args], capture_output=True, text=True, check=False)


def created(bundle: Path, annotations: dict[str, str], container: str = IDS[0]) -> dict[str, object]:
    """The bundle's configuration when the real runtime reads it."""
    config = {"process": {"args": ["node"]}, "annotations": annotations, "root": {"path": "rootfs"}}
    (bundle / "config.json").write_text(json.dumps(config))
    args = ("--root", "create", "--log", f"{bundle}/log", "create", "--bundle", str(bundle), container)
    assert called(bundle, *args).stdout.split() == list(args)
    after: dict[str, object] = json.loads((bundle / "config.json").read_text())
    assert sorted(path.name for path in bundle.glob("config*")) == ["config.json"]
    return after


@ours
@pytest.mark.parametrize("container", IDS)
def test_annotations_put_init_in_front(bundle: Path, container: str) -> None:
    after = created(bundle, {"avckpt.enable": "true", **POD}, container)
    assert after["process"]["args"][0] == "/run/avckpt-init"  # type: ignore[index]
    annotations = after["annotations"]
    assert isinstance(annotations, dict)
    assert annotations["avckpt.name"] == "drive/lidar"
    assert (annotations["avckpt.id"] == container) == (container == IDS[0])
    hooks = after["hooks"]
    assert isinstance(hooks, dict)
    for stage in ("prestart", "poststop"):
        [hook] = hooks[stage]
        assert hook["path"] == str(ROOT / "hooks/avckpt-hook")


@pytest.mark.parametrize(
    "annotations",
    [{}, {"other": "1"}, {"avckpt.enable": "true", "io.kubernetes.cri.container-type": "sandbox"}],
)
def test_others_are_left_as_they_are(bundle: Path, annotations: dict[str, str]) -> None:
    assert created(bundle, annotations) == {
        "process": {"args": ["node"]},
        "annotations": annotations,
        "root": {"path": "rootfs"},
    }


def test_other_commands_and_what_is_no_bundle_pass(bundle: Path) -> None:
    for args in (("--version",), ("--root", "/x", "kill", "create", "9"), ("create", "-b", "/nowhere", "x")):
        assert called(bundle, *args).stdout.split() == list(args)


def test_a_wrong_label_is_the_runtimes_error(bundle: Path) -> None:
    (bundle / "config.json").write_text(json.dumps({"annotations": {"avckpt.intervall": "1s"}}))
    done = called(bundle, "--log", f"{bundle}/log", "create", f"--bundle={bundle}", "x")
    assert done.returncode == 1
    assert done.stdout == ""
    entry = json.loads((bundle / "log").read_text())
    assert entry["level"] == "error"
    assert "did you mean avckpt.interval" in entry["msg"]
