# SPDX-License-Identifier: Apache-2.0
"""The time of day is set between a checkpoint and a restore, as that of a vehicle is after its start."""

from __future__ import annotations

from pathlib import Path

from testkit.engine_program import link_with_engine
from testkit.harness import run


def test_a_file_is_not_taken_for_a_newer_one(tmp_path: Path) -> None:
    """Writes to files that were created since a checkpoint do not keep a database's memory from going back to it."""
    said = run([str(link_with_engine("clocks", tmp_path)), str(tmp_path / "file")]).stdout
    assert said.splitlines() == ["created since: 0", "set forward since: 1", "set back since: 1"]
