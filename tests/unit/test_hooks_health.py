# SPDX-License-Identifier: Apache-2.0
"""What the hooks record of a container's health checks."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest
from avckpt_hooks import health
from avckpt_hooks.shared import protocol

ID = "d" * 64
CHECK = {"Test": ["CMD-SHELL", "true"], "Interval": 30_000_000_000}


@pytest.fixture(autouse=True)
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container that lives."""
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path))
    Path(protocol.records_dir()).mkdir()
    Path(protocol.record_path(ID)).touch()


@pytest.mark.parametrize("startup", [None, {**CHECK, "Successes": 1}])
def test_both_checks_are_written_down(startup: dict[str, object] | None) -> None:
    """As `podman inspect` has them; it leaves out what there is none of."""
    config = {"Healthcheck": CHECK, **({"StartupHealthCheck": startup} if startup else {})}
    health.write_answer(ID, lambda deadline: json.dumps([{"Config": config}]).encode())
    assert json.loads(Path(protocol.health_path(ID)).read_bytes()) == {
        "healthcheck": CHECK,
        "startup_healthcheck": startup,
    }


def test_they_are_for_root_only() -> None:
    """They are commands; also where an earlier version has left them readable."""
    path = Path(protocol.health_path(ID))
    path.parent.mkdir(mode=0o755)
    path.touch(mode=0o644)
    health.write_answer(ID, lambda deadline: json.dumps([{"Config": {"Healthcheck": CHECK}}]).encode())
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_one_that_is_too_long_is_not_taken_over() -> None:
    check = {"Test": ["CMD-SHELL", "x" * 200_000]}
    health.write_answer(ID, lambda deadline: json.dumps([{"Config": {"Healthcheck": check}}]).encode())
    said = json.loads(Path(protocol.health_path(ID)).read_bytes())
    assert said == {"healthcheck": None, "error": "its health check is too long"}
