# SPDX-License-Identifier: Apache-2.0
"""`--pids-limit`: templates count, too, but clone(2) of the application does not fail because of them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.containers.cgroup import groups_of

from testkit.harness import SLOWNESS, Container, ContainerFactory, wait_until
from testkit.local_sidecar import LocalSidecar, hooked_podman

pytestmark = pytest.mark.shared_machine("checkpoints of 20 processes take their time, and are missed without a CPU")

PATIENCE_S = 30 * SLOWNESS
CHILDREN = 20
TIGHT, WIDE = 26, 200
FORKS = f"""
import os, signal, time
children = []
while True:
    try:
        pid = os.fork()
    except OSError as error:
        print("refused:", error, flush=True)
        time.sleep(0.01)
        continue
    if pid == 0:
        signal.pause()
    children.append(pid)
    if len(children) == {CHILDREN}:
        print("all are there", flush=True)
        oldest = children.pop(0)
        os.kill(oldest, signal.SIGKILL)
        os.waitpid(oldest, 0)
    time.sleep(0.01)
"""


@pytest.fixture
def factory(local: LocalSidecar, podman: object, base_image: str) -> Iterator[ContainerFactory]:
    """Containers that this sidecar protects."""
    factory = ContainerFactory(hooked_podman(local), f"avckpt-tasks-{os.getpid()}")
    yield factory
    factory.close()


def wait_state(local: LocalSidecar, container: Container, state: str) -> str:
    """Its note in `avckpt ps`."""

    def look() -> dict[str, str]:
        rows = (row for row in local.ps() if row["id"] == container.id and row["state"] == state)
        return next(rows, {})

    return str(wait_until(look, PATIENCE_S, f"{container.name} is {state}; log:\n{local.log}")["reason"])


def test_the_application_can_always_fork(local: LocalSidecar, factory: ContainerFactory) -> None:
    """With no room for templates it runs unprotected, which is told; with more room it is protected."""
    one = factory.protected(
        "python3", "-c", FORKS, labels={"interval": "300ms"}, options=[f"--pids-limit={TIGHT}", "--network=none"]
    )
    limit = groups_of(one.pid).pids
    assert limit is not None
    assert f"may have {TIGHT} tasks (pids limit)" in wait_state(local, one, "unprotected")
    one.wait_for_log("all are there", count=100)
    for tasks in (WIDE, TIGHT):
        Path(limit, "pids.max").write_text(str(tasks))
        wait_state(local, one, "protected" if tasks == WIDE else "unprotected")
        beats = one.logs().count("all are there")
        one.wait_for_log("all are there", count=beats + 100)
        # Where a limit is lowered below what there is, until that is noticed.
        assert "refused" not in one.logs() or tasks == TIGHT, local.log
    refused = one.logs().count("refused")
    one.wait_for_log("all are there", count=one.logs().count("all are there") + 100)
    assert one.logs().count("refused") == refused
