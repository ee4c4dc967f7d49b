# SPDX-License-Identifier: Apache-2.0
"""The prestart hook: tells the sidecar of a protected container that is about to start.

The OCI runtime runs it on the host with the container's state on standard input, while
the container's main process waits to be started. It never fails: without a sidecar the
container runs on, unprotected.
"""

from __future__ import annotations

import json
import os
import sys

from avckpt_hooks.shared import files, protocol, tell

TYPE_CHECKING = False  # typing.TYPE_CHECKING, without the 7 ms that importing it takes
if TYPE_CHECKING:
    from typing import Any


def main() -> int:
    """Writes the container's record and registers it.  Always 0."""
    name = "?"
    try:
        state = json.loads(sys.stdin.buffer.read())
        name = (state.get("annotations") or {}).get("avckpt.name") or state["id"][:12]
        problem = register(state)
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here, the app runs
        problem = f"runs unprotected: {type(error).__name__}: {error}"
    if problem:
        line = f"avckpt: container {name} {problem}"
        tell.journal(line)
        if "--told" not in sys.argv[2:]:
            # runc passes our standard error on, crun does not; the standard error of both is the container's.
            tell.parent(line)
    return 0


def register(state: dict[str, Any]) -> str:
    """Registers the container of an OCI state.  Returns what is wrong with its protection, in a clause, or ""."""
    container = state["annotations"].get("avckpt.id") or state["id"]  # the former is avckpt-runtime's
    if not protocol.is_container_id(container):  # which names files
        raise ValueError("its id is not one of Podman's")
    pid = state["pid"]
    pidfd = os.pidfd_open(pid)
    try:
        registration = protocol.Register(
            id=container,
            name=state["annotations"].get("avckpt.name") or state["id"][:12],
            pid=pid,
            starttime=starttime(pid),
            bundle=state.get("bundle", ""),
            # Those of others may be longer than a packet.
            annotations={key: value for key, value in state["annotations"].items() if key.startswith("avckpt.")},
        )
        try:
            packet = registration.encode()
        except protocol.ProtocolError as error:  # no sidecar would read such a record, either
            return f"runs unprotected: its labels are too large for the sidecar: {error}"
        unwritten = ""
        try:
            write_record(registration)
        except OSError as error:
            unwritten = f"{protocol.records_dir()} cannot be written ({error.strerror})"
        refusal = ask(packet, pidfd)
    finally:
        os.close(pidfd)
    if refusal:
        return f"runs unprotected: {refusal}" + (f"; and {unwritten}" if unwritten else "")
    return f"is not known to a sidecar that starts later: {unwritten}" if unwritten else ""


def ask(packet: bytes, pidfd: int) -> str:
    """Asks the sidecar to protect the container.  Returns why it does not, or ""."""
    try:
        refusal = protocol.exchange(packet, pidfd)
    except TimeoutError:
        return f"the sidecar did not answer within {protocol.TIMEOUT_S:g} s"
    except OSError as error:
        return f"no sidecar listens on {protocol.hooks_socket()} ({error.strerror})"
    except protocol.ProtocolError as error:
        return f"the sidecar's answer is invalid: {error}"
    return f"the sidecar said: {refusal}" if refusal else ""


def starttime(pid: int) -> int:
    """Field 22 of /proc/PID/stat: clock ticks from boot to the process's start."""
    with open(f"/proc/{pid}/stat", "rb") as file:
        # The second field is the name in brackets, and may hold anything.
        return int(file.read().rpartition(b")")[2].split()[19])


def write_record(registration: protocol.Register) -> None:
    """Writes the container's record, at once or not at all."""
    files.write_private(protocol.record_path(registration.id), registration.to_record())
