# SPDX-License-Identifier: Apache-2.0
"""`avckpt bundle` of a real container."""

from __future__ import annotations

import json
import os
import signal
import stat
from pathlib import Path

import pytest

from testkit.bundles import read_bundle
from testkit.harness import ContainerFactory, Sidecar, avckpt_command, run, wait_until
from testkit.local_sidecar import ON_COMMAND, LocalSidecar
from testkit.protected import told

SECRET = "a-secret-of-the-application"


@pytest.mark.shared_machine("a restore on a busy machine may take longer than the test waits")
def test_all_that_is_known_of_a_container(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    crashing = container.protected(
        *("sh", "-c", "echo it has started; while :; do sleep 1; done"),
        labels={"interval": "100ms", "core": "mini"},
        options=("--env", f"TOKEN={SECRET}", "--label", "owner=somebody"),
    )
    sidecar.wait_generation(crashing)
    os.kill(sidecar.app_pid(crashing), signal.SIGSEGV)
    sidecar.wait_restores(crashing)
    wait_until(lambda: "restored in" in sidecar.logs(), 20, "the restore is told")
    wait_until(lambda: told(sidecar, crashing, "core"), 20, "its core file is told of")
    path = tmp_path / "bundle.tar.gz"
    said = sidecar.avckpt("bundle", crashing.name, "-o", str(path))
    assert said.stdout == f"{path}\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    found = read_bundle(path)
    kinds = [json.loads(line)["kind"] for line in found["events.jsonl"].splitlines()]
    assert "died" in kinds
    assert "restored" in kinds
    assert json.loads(found["container.json"])["restores"] == 1
    assert json.loads(found["labels.json"])["avckpt.interval"] == "100ms"
    assert "owner" not in found["labels.json"]
    assert json.loads(found["inspect.json"])["State"]["Status"] == "running"
    assert "it has started" in found["container.log"]
    assert "restored in" in found["sidecar.log"]
    assert json.loads(found["sidecar.json"])["version"]
    assert "avckpt_restores_total" in found["metrics.txt"]
    assert any(check["name"] == "kernel" for check in json.loads(found["doctor.json"]))
    assert "Linux" in found["versions.txt"]
    assert SECRET not in "".join(found.values())
    # What could not be had is told, and nothing that is there is written over.
    assert ("config.yaml" in found) != ("config.yaml" in found.get("missing.txt", ""))
    with_core = tmp_path / "core.tar.gz"
    sidecar.avckpt("bundle", crashing.name, "-o", str(with_core), "--core")
    zstd = bytes.fromhex("28b52ffd")
    assert read_bundle(with_core)["core.zst"].encode("utf-8", "surrogateescape")[:4] == zstd

    # Of the first of two crashes.
    sidecar.wait_generation(crashing)
    os.kill(sidecar.app_pid(crashing), signal.SIGSEGV)
    wait_until(lambda: len(told(sidecar, crashing, "core")) == 2, 20, "its second core file is told of")
    crash, _ = told(sidecar, crashing, "crash")
    core, other = told(sidecar, crashing, "core")
    line, _ = sidecar.avckpt("events", crashing.name, "--kind", "crash", "--numbers").stdout.splitlines()
    assert line.split()[0] == str(crash["seq"]) == str(core["crash_seq"])
    assert line.endswith(crash["message"])
    first = tmp_path / "first.tar.gz"
    sidecar.avckpt("bundle", str(crash["seq"]), "-o", str(first), "--core")
    found = read_bundle(first)
    assert json.loads(found["event.json"]) == crash
    assert "it has started" in found["container.log"]
    assert "restored in" in found["sidecar.log"]
    kinds = [json.loads(line)["kind"] for line in found["events.jsonl"].splitlines()]
    assert {"registered", "died", "restored", "crash", "core"} <= set(kinds)
    kept = found["core.zst"].encode("utf-8", "surrogateescape")
    assert kept == Path(core["core"]).read_bytes() != Path(other["core"]).read_bytes()
    again = sidecar.avckpt("bundle", crashing.name, "-o", str(path), check=False)
    assert again.status == 1
    assert "cannot be written" in again.stderr
    nobody = sidecar.avckpt("bundle", "no-such-container", check=False)
    assert (nobody.status, "nothing is known of a container or an event 'no-such-container'" in nobody.stderr) == (
        4,
        True,
    )


def test_half_an_archive_does_not_stay(local: LocalSidecar, tmp_path: Path) -> None:
    local.protected("lidar", ["sleep", "1000"], ON_COMMAND)
    bundle = [*avckpt_command(), "bundle", "lidar", "-o", str(tmp_path / "lidar.tar.gz")]
    limit = ["prlimit", "--fsize=1000"]  # as if that were all that the disk holds
    said = run([*limit, *bundle], env=local.env, check=False, timeout_s=60)
    assert (said.status, "lidar.tar.gz cannot be written (File too large)" in said.stderr) == (1, True)
    assert list(tmp_path.glob("lidar.tar.gz")) == []
    (tmp_path / "lidar.tar.gz").write_text("another's")
    assert run(bundle, env=local.env, check=False, timeout_s=60).status == 1
    assert (tmp_path / "lidar.tar.gz").read_text() == "another's"
