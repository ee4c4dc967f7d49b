# SPDX-License-Identifier: Apache-2.0
"""Paths of control groups, from /proc."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from avckpt.containers.cgroup import groups_of

MOUNT = 'mount --bind "$1" "$1" && shift && exec "$@"'
LOOK = "import os; from avckpt.containers.cgroup import groups_of; print(groups_of(os.getpid()).directories)"


@pytest.mark.skipif(os.geteuid() != 0, reason="a mount namespace needs root")
def test_a_mount_point_whose_name_is_no_text_hides_no_group(tmp_path: Path) -> None:
    """The label of a stick that somebody plugs in."""
    point = os.fsencode(tmp_path) + b"/\xff\r\xc2\x85 x"
    os.mkdir(point)
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", MOUNT, "sh", point, sys.executable, "-c", LOOK],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == str(groups_of(os.getpid()).directories), done.stderr
