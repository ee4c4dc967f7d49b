# SPDX-License-Identifier: Apache-2.0
"""Podman's current names of containers: `podman rename` calls no hook."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import psutil
from avckpt_hooks.shared.files import read_bounded

LIST = "containers.json"
"""Of containers/storage, which replaces it by rename(2) at every change, so that reading it takes no lock."""
LIST_BYTES = 32 << 20


class Names:
    """Reads the storage's list of containers again when it has changed."""

    def __init__(self) -> None:
        self._read: dict[Path, tuple[tuple[int, int, int], dict[str, str]]] = {}
        self._lists: dict[tuple[str, int], tuple[Path, Path]] = {}
        """The folder, and the list as conmon sees it, by container and init."""

    def of(self, container_id: str, bundle: str, init_pid: int) -> str:
        """Its current name; "" if unknown. A bundle of Podman is FOLDER/ID/userdata."""
        path, run = Path(bundle), (container_id, init_pid)
        if path.name != "userdata" or path.parent.name != container_id:
            return ""
        with contextlib.suppress(OSError, ValueError, RecursionError, psutil.Error):
            if run not in self._lists:
                # conmon's files are on the host.
                host = Path(f"/proc/{psutil.Process(init_pid).ppid()}/root")
                folder = path.parents[1].relative_to("/")
                self._lists[run] = (folder, host / folder / LIST)
            return self._names(*self._lists[run]).get(container_id, "")
        self._lists.pop(run, None)
        return ""

    def forget(self, container_id: str, init_pid: int) -> None:
        """It has ended."""
        self._lists.pop((container_id, init_pid), None)

    def _names(self, folder: Path, path: Path) -> dict[str, str]:
        """Raises OSError, ValueError, RecursionError."""
        status = path.stat()
        seen = (status.st_ino, status.st_mtime_ns, status.st_size)
        if folder not in self._read or self._read[folder][0] != seen:
            self._read[folder] = (seen, {})  # after an error, retry only when it has changed
            self._read[folder] = (seen, _parse(read_bounded(str(path), LIST_BYTES)))
        return self._read[folder][1]


def _parse(text: bytes) -> dict[str, str]:
    """Names by id.  Raises ValueError, RecursionError."""
    rows = json.loads(text)
    if not isinstance(rows, list):
        raise ValueError("not a list")
    found = {}
    for row in rows:
        names = row.get("names") if isinstance(row, dict) else None
        if isinstance(names, list) and names and isinstance(names[0], str) and isinstance(row.get("id"), str):
            found[row["id"]] = names[0]
    return found
