# SPDX-License-Identifier: Apache-2.0
"""The poststop hook: a protected container has stopped.

The OCI runtime runs it on the host with the container's state on standard
input. It never fails; a sidecar that is not running finds out by itself (the
record is gone, and so is the process).
"""

from __future__ import annotations

import contextlib
import json
import os
import sys

from avckpt_hooks.shared import protocol, tell

PATIENCE_S = 0.1
"""For the sidecar's answer: it sees the end of the process anyway."""


def main() -> int:
    """Removes the container's record and tells the sidecar.  Always 0."""
    try:
        state = json.loads(sys.stdin.buffer.read())
        container = (state.get("annotations") or {}).get("avckpt.id") or state["id"]
        if not protocol.is_container_id(container):
            return 0
        for path in (protocol.record_path(container), protocol.health_path(container)):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(path)
        protocol.exchange(protocol.Deregister(id=container).encode(), timeout_s=PATIENCE_S)
    except (ConnectionRefusedError, FileNotFoundError, TimeoutError):
        pass  # no sidecar, or a stuck one
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here, the container is cleaned up
        tell.journal(f"avckpt: poststop: {type(error).__name__}: {error}")
    return 0
