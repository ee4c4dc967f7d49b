# SPDX-License-Identifier: Apache-2.0
"""The sidecar as a process: one for each runtime directory, with the limits and namespaces that it needs."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avckpt.containers import cgroup
from avckpt.containers.records import keep_private
from avckpt.daemon import Daemon
from avckpt.engine import probe
from avckpt.errors import AvckptError, Busy, Denied


@contextmanager
def only_one(run_dir: Path) -> Iterator[None]:
    """Holds the lock that says there is a sidecar.  Raises Busy when another one holds it."""
    fd = os.open(run_dir / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(fd, 32, 0).decode("ascii", "replace").strip()
            raise Busy(
                f"a sidecar is running already (pid {holder or 'unknown'}, {run_dir}): stop it first, or use that one"
            ) from error
        with contextlib.suppress(OSError):  # a full disk: another one is not told whom it finds
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(fd)  # which unlocks; the file stays, or two sidecars could lock different files


def raise_descriptor_limit() -> None:
    """Raises this process's descriptor limit as far as it may: each container takes a dozen or two."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def serve(run_dir: Path, config_path: Path, beat_fd: int = -1) -> None:
    """Runs the sidecar in the foreground until it is asked to stop; gives signs of life on `beat_fd`, if
    given.

    Raises Denied or Unsupported when this process or machine cannot run it, Busy when there is a sidecar
    already.
    """
    probe()
    cgroup.see_whole_tree()
    raise_descriptor_limit()
    try:
        run_dir.mkdir(mode=0o755, parents=True, exist_ok=True)
        with only_one(run_dir):
            for name in ("containers", "health"):
                keep_private(run_dir / name)
            asyncio.run(Daemon(run_dir, config_path, beat_fd).run())
    except OSError as error:
        kind = Denied if isinstance(error, PermissionError) else AvckptError
        raise kind(f"{error.filename or run_dir} cannot be used", errno=error.errno or 0) from error
