# SPDX-License-Identifier: Apache-2.0
"""The nodes below a container's launcher (avckpt.scope=nodes), as a sidecar knows them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from testkit.harness import Container, Sidecar
from testkit.local_sidecar import LocalSidecar
from testkit.procfs import children_of, inside

SUPERVISORD = ("python3", "-m", "supervisor.supervisord", "-c")
"""In a container with `supervisor_options()`; a path follows, of a file that begins with SUPERVISORD_CONF."""
SUPERVISORD_CONF = "[supervisord]\nnodaemon=true\nuser=root\nlogfile=/dev/null\nlogfile_maxbytes=0\n"


def supervisor_options() -> list[str]:
    """Options of `podman run` that lend a container PyPI's supervisor of this environment; empty: it has none."""
    found = importlib.util.find_spec("supervisor")
    if found is None or found.origin is None:
        return []
    library = Path(found.origin).parent
    return ["-v", f"{library}:/lib/supervisor/supervisor:ro", "-e", "PYTHONPATH=/lib/supervisor"]


def nodes_of(sidecar: Sidecar | LocalSidecar, container: Container) -> dict[str, dict[str, Any]]:
    """By their names, as `avckpt ps` has them."""
    return {
        row["name"].partition("/")[2]: row
        for row in sidecar.ps()
        if row["node_of"] == container.id and not row["ended_at"]
    }


def app_pid(row: dict[str, Any]) -> int:
    """Its application now: in our namespace it has another number after each restore.  0: there is none."""
    return next((pid for pid in children_of(row["init_pid"]) if inside(pid) == row["app_pid_inside"]), 0)
