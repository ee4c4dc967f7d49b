# SPDX-License-Identifier: Apache-2.0
"""The list of a process's children, by which an application's processes are found."""

from __future__ import annotations

import subprocess
from pathlib import Path

from testkit.engine_program import link_with_engine


def test_no_child_is_left_out_while_others_are_reaped(tmp_path: Path, init_built: None) -> None:
    """children.c: one read of /proc/PID/task/TID/children leaves out some, a dozen times a second."""
    program = link_with_engine("children", tmp_path)
    out = subprocess.run([program], check=True, capture_output=True, text=True, timeout=100).stdout
    lists, lacking = map(int, out.split())
    assert lists > 100
    assert lacking == 0
