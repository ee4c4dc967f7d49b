# SPDX-License-Identifier: Apache-2.0
"""The prestart hook: tells the sidecar of a protected container that is about to start.

The OCI runtime runs it on the host with the container's state on standard
input, while the container's main process waits to be let go.  It never fails:
without a sidecar the container runs on, unprotected.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys

from avckpt_hooks import protocol, tell

TYPE_CHECKING = False  # typing.TYPE_CHECKING, without the 7 ms that importing it takes
if TYPE_CHECKING:
    from typing import Any


def main() -> int:
    """Writes the container's record and registers it.  Always 0."""
    name = "?"
    try:
        state = json.loads(sys.stdin.buffer.read())
        name = (state.get("annotations") or {}).get("avckpt.name") or state["id"][:12]
        why = register(state)
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here, the app runs
        why = f"{type(error).__name__}: {error}"
    if why:
        line = f"avckpt: container {name} runs unprotected: {why}"
        tell.journal(line)
        if "--told" not in sys.argv[2:]:
            # runc passes our standard error on, crun does not; both have the
            # container's as their own.
            tell.parent(line)
    return 0


def register(state: dict[str, Any]) -> str:
    """Registers the container of an OCI state.  Returns why it is not protected, or ""."""
    pid = state["pid"]
    pidfd = os.pidfd_open(pid)
    try:
        registration = protocol.Register(
            id=state["id"],
            name=state["annotations"].get("avckpt.name") or state["id"][:12],
            pid=pid,
            starttime=starttime(pid),
            bundle=state.get("bundle", ""),
            annotations=state["annotations"],
        )
        write_record(registration)
        try:
            refusal = protocol.exchange(registration.encode(), pidfd)
        except TimeoutError:
            return f"the sidecar did not answer within {protocol.TIMEOUT_S:g} s"
        except OSError as error:
            return f"no sidecar listens on {protocol.hooks_socket()} ({error.strerror})"
        except protocol.ProtocolError as error:
            return f"the sidecar's answer makes no sense: {error}"
        return f"the sidecar said: {refusal}" if refusal else ""
    finally:
        os.close(pidfd)


def starttime(pid: int) -> int:
    """Field 22 of /proc/PID/stat: clock ticks from boot to the process's start."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        # The second field is the name in brackets, and may hold anything.
        return int(file.read().rpartition(b")")[2].split()[19])


def write_record(registration: protocol.Register) -> None:
    """Writes the container's record, at once or not at all.

    With the PID namespace that its PID is of: a sidecar without --pid=host is in
    another one, and must not take the container for one that has ended.
    """
    path = protocol.record_path(registration.id)
    os.makedirs(os.path.dirname(path), mode=0o755, exist_ok=True)
    temporary = f"{path}.{os.getpid()}"
    record = {**registration.record(), "pid_namespace": os.stat("/proc/self/ns/pid").st_ino}
    try:
        with open(temporary, "w") as file:
            json.dump(record, file)
            file.write("\n")
        os.replace(temporary, path)
    except OSError:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise
