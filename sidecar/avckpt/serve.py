# SPDX-License-Identifier: Apache-2.0
"""The sidecar as a process: one for each runtime directory, with the limits and namespaces that it needs."""

from __future__ import annotations

import asyncio
import logging
import os
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from avckpt.containers import cgroup
from avckpt.containers.records import keep_hooks_folders
from avckpt.daemon import Daemon
from avckpt.engine import probe
from avckpt.errors import AvckptError, Busy, Denied
from avckpt.lock import Lock

KILLED_S = 2.0


@contextmanager
def only_one(run_dir: Path) -> Iterator[Lock]:
    """Holds the lock that says there is a sidecar.  Raises Busy when another one holds it.

    One that was killed a moment ago holds it for as long as one of its threads waits for a disk.
    """
    lock = Lock(run_dir)
    end = time.monotonic() + KILLED_S
    while True:
        try:
            lock.take()
            break
        except Busy:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)
    try:
        yield lock
    finally:
        lock.release()


def raise_descriptor_limit() -> None:
    """Raises this process's descriptor limit as far as it may: each container takes a dozen or two."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def is_cut_off(run_dir: Path) -> bool:
    """Whether this is a container of Podman's that has a folder of its own where the host's should be."""
    mounted = (os.path.ismount(path) for path in (run_dir, *run_dir.parents) if path != Path("/"))
    return "container" in os.environ and not any(mounted)


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
        with only_one(run_dir) as lock:
            keep_hooks_folders(run_dir)
            if is_cut_off(run_dir):
                logging.warning(
                    "%s is this container's own: no hook reaches it; start it with -v %s:%s", *(run_dir,) * 3
                )
            asyncio.run(Daemon(run_dir, config_path, beat_fd, lock).run())
    except OSError as error:
        kind = Denied if isinstance(error, PermissionError) else AvckptError
        raise kind(f"{error.filename or run_dir} cannot be used", errno=error.errno or 0) from error
