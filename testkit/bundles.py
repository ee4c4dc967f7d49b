# SPDX-License-Identifier: Apache-2.0
"""The archives that `avckpt bundle` makes."""

from __future__ import annotations

import tarfile
from pathlib import Path


def read_bundle(path: Path) -> dict[str, str]:
    """What is in each of its files, by their names below its one folder."""
    with tarfile.open(path) as archive:
        members = archive.getmembers()
        assert len({member.name.partition("/")[0] for member in members}) == 1
        found = {}
        for member in members:
            file = archive.extractfile(member)
            assert file is not None
            found[member.name.partition("/")[2]] = file.read().decode("utf-8", "surrogateescape")
        return found
