# SPDX-License-Identifier: Apache-2.0
"""The nodes below a container's launcher (avckpt.scope=nodes), as a sidecar knows them."""

from __future__ import annotations

from typing import Any

from testkit.harness import Container, Sidecar
from testkit.procfs import children_of, inside


def nodes_of(sidecar: Sidecar, container: Container) -> dict[str, dict[str, Any]]:
    """By their names, as `avckpt ps` has them."""
    return {
        row["name"].partition("/")[2]: row
        for row in sidecar.ps()
        if row["node_of"] == container.id and not row["ended_at"]
    }


def app_pid(row: dict[str, Any]) -> int:
    """Its application now: in our namespace it has another number after each restore.  0: there is none."""
    return next((pid for pid in children_of(row["init_pid"]) if inside(pid) == row["app_pid_inside"]), 0)
