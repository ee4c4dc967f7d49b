# SPDX-License-Identifier: Apache-2.0
"""What a container has written can be of any size: `avckpt bundle` keeps its end."""

from __future__ import annotations

import subprocess
import sys

import pytest
from avckpt.cli import bundle
from avckpt.errors import AvckptError

WITHIN = """
import resource
from avckpt.cli import bundle
resource.setrlimit(resource.RLIMIT_DATA, (256 << 20, 256 << 20))
said = bundle._program("sh", "-c", "head -c 600000000 /dev/zero; echo the end")
assert len(said) == bundle.MOST_BYTES and said.endswith("the end\\n"), len(said)
"""


def test_a_log_without_end_is_not_held_in_memory() -> None:
    subprocess.run([sys.executable, "-c", WITHIN], check=True, timeout=60)


def test_a_program_that_does_not_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "COMMAND_TIMEOUT_S", 0.2)
    with pytest.raises(AvckptError, match="took more than"):
        bundle._program("sleep", "30")


def test_one_that_fails_says_why() -> None:
    with pytest.raises(AvckptError, match="^no such thing$"):
        bundle._program("sh", "-c", "echo no such thing; exit 3")
