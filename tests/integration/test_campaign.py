# SPDX-License-Identifier: Apache-2.0
"""The campaign distinguishes outcomes: an oracle that sees nothing would count everything as recovered."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from testkit.harness import run

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine("programs have to be protected, and to go on, within seconds"),
]

# A signal that comes just before a checkpoint is in it, and kills twice.
SURVIVED = "killed from outside"
EXPECTED = {
    "wrong value, no crash": "wrong",
    "lost wake-up": "stuck",
    "corruption before the checkpoint": "cold",
}


@pytest.mark.usefixtures("base_image")
def test_what_becomes_of_four_faults(tmp_path: Path) -> None:
    output = tmp_path / "campaign.json"
    command = [sys.executable, "-m", "bench.campaign", "--runs", "1", "--seconds", "6", "--language", "Python"]
    faults = [word for fault in (SURVIVED, *EXPECTED) for word in ("--fault", fault)]
    run([*command, *faults, "--output", str(output)], timeout_s=100)
    cells = {cell["fault"]: cell for cell in json.loads(output.read_text())}
    outcomes = {
        fault: [name for name in ("recovered", "recrashed", "wrong", "cold", "stuck") if cells[fault][name]]
        for fault in EXPECTED
    }
    assert outcomes == {fault: [outcome] for fault, outcome in EXPECTED.items()}
    assert cells[SURVIVED]["recovered"] + cells[SURVIVED]["recrashed"] == 1
