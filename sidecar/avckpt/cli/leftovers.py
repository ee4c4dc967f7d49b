# SPDX-License-Identifier: Apache-2.0
"""What hooks and sidecars leave behind while they work, removed when avckpt is."""

from __future__ import annotations

import contextlib
import fcntl
import stat
from collections.abc import Iterator
from pathlib import Path

_FILES = ("history.jsonl", "history.jsonl.new", "present.json")
_SOCKETS = ("api.sock", "hooks.sock", "units/units.sock")
_FOLDERS = ("containers", "health", "units")
CORES = "cores"
"""What is in it stays: somebody has asked for it, and may not have looked at it yet."""
_MOUNT_POINTS = (Path("/run/avckpt-init"), Path("/run/avckpt-units"))
"""The runtime makes them on the host for a container that has the host's /run (-v /run:/run)."""


def remove(root: Path, run_dir: Path) -> list[Path]:
    """Removes what is ours below `run_dir`, unless a sidecar runs; what was removed.

    What cannot be removed, or is not what we would have made, stays.
    """
    folder = root / run_dir.relative_to("/")
    removed: list[Path] = []
    with _no_sidecar(folder) as alone:
        if not alone:
            return []
        for name in (*_FILES, *_SOCKETS, *(f"{each}/*.json" for each in _FOLDERS), "starting", "lock"):
            for path in folder.glob(name):
                removed += _unlink(path, socket=name in _SOCKETS)
        removed += [path for each in (*_FOLDERS, CORES, "") for path in _rmdir(folder / each)]
    for point in _MOUNT_POINTS:
        place = root / point.relative_to("/")
        removed += [*_unlink(place, empty=True), *_rmdir(place)]
    return [Path("/") / path.relative_to(root) for path in removed]


@contextlib.contextmanager
def _no_sidecar(folder: Path) -> Iterator[bool]:
    try:
        with (folder / "lock").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield True
    except FileNotFoundError:
        yield True  # there was none since the machine started
    except OSError:
        yield False


def _unlink(path: Path, *, socket: bool = False, empty: bool = False) -> list[Path]:
    with contextlib.suppress(OSError):
        status = path.lstat()
        meant = stat.S_ISSOCK(status.st_mode) if socket else stat.S_ISREG(status.st_mode)
        if meant and not (empty and status.st_size):
            path.unlink()
            return [path]
    return []


def _rmdir(path: Path) -> list[Path]:
    with contextlib.suppress(OSError):
        path.rmdir()
        return [path]
    return []
