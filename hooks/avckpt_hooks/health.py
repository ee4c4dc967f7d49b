# SPDX-License-Identifier: Apache-2.0
"""Finds out a container's health check for the sidecar, after the container has started.

`restore.on` with `unhealthy`, in a label or in the sidecar's configuration, needs the
container's health check as Podman has it, from the command line, the image, Compose or
the API. Only `podman inspect` reports it, and that waits for the container's lock, which
is held while a hook runs. So the precreate hook leaves a process behind that asks when
the lock is free, and writes the answer to `protocol.health_path()`.
"""

from __future__ import annotations

import contextlib
import json
import os
import time

from avckpt_hooks import podman
from avckpt_hooks.shared import files, protocol, tell

TYPE_CHECKING = False  # typing.TYPE_CHECKING, without the 7 ms that importing it takes
if TYPE_CHECKING:
    from collections.abc import Callable

GIVE_UP_S = 60.0
"""How long to wait for the answer: as long as a slow image may take to start."""


def ask_later(container: str, parent: int) -> None:
    """Returns at once; the answer comes when the container has started.  Raises OSError."""
    ask = podman.inspector(container, parent)  # while the parent is still there to be examined
    first = os.fork()
    if first:
        os.waitpid(first, 0)
        return
    # An orphan that shares nothing with Podman, which must wait neither for us nor for our output.
    status = 1
    try:
        os.setsid()
        if os.fork() == 0:
            null = os.open("/dev/null", os.O_RDWR)
            for fd in range(3):
                os.dup2(null, fd)
            os.closerange(3, 256)
            write_answer(container, ask)
        status = 0
    finally:
        os._exit(status)


def write_answer(container: str, ask: Callable[[float], bytes]) -> None:
    """Asks, and writes the answer: the health checks as `podman inspect` has them, or null."""
    try:
        config = json.loads(ask(time.monotonic() + GIVE_UP_S))[0]["Config"]
        # The latter since Podman 4.5.
        answer = {
            "healthcheck": config.get("Healthcheck"),
            "startup_healthcheck": config.get("StartupHealthCheck"),
        }
    except (podman.Unknown, ValueError, LookupError, AttributeError, RecursionError) as error:
        answer = {"healthcheck": None, "error": str(error)}
        if _has_ended(container):
            return
        tell.journal(f"avckpt: container {container[:12]}: its health check cannot be determined: {error}")
    path = protocol.health_path(container)
    content = json.dumps(answer).encode()
    if len(content) > protocol.MAX_BYTES:
        content = json.dumps({"healthcheck": None, "error": "its health check is too long"}).encode()
    files.write_private(path, content)
    if _has_ended(container):  # and the poststop hook has run already
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)


def _has_ended(container: str) -> bool:
    """Its record is there from before its start until the poststop hook."""
    return not os.path.exists(protocol.record_path(container))
