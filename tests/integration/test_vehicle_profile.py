# SPDX-License-Identifier: Apache-2.0
"""A container as vehicles confine theirs (Red Hat's QM and AutoSD), as far as this machine can have it.

Its root is read-only, its users are others outside, it has no capability, may not ask for real-time scheduling,
and gets a CPU when nobody else wants it.  AVCKPT_LONG=1: a hundred deaths of each kind.
"""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest

from testkit.harness import SLOWNESS, ContainerFactory, Sidecar
from testkit.procfs import status_of
from testkit.protected import ProtectedVictim, start_victim

pytestmark = [
    pytest.mark.shared_machine("an application that gets the CPU when nobody wants it may wait long for one"),
    pytest.mark.timeout(900),
]

DEATHS = 100 if os.environ.get("AVCKPT_LONG") == "1" else 10
LABELS = {"interval": "1h", "restore.max": "60/1s"}
PODMANS_PROFILE = Path("/usr/share/containers/seccomp.json")
SCHED_FIFO, SCHED_RR = 1, 2
PATIENCE_S = 60.0 * SLOWNESS


def no_real_time(folder: Path) -> Path:
    """Podman's seccomp profile, and sched_setscheduler(2) without SCHED_FIFO and SCHED_RR, as QM has it."""
    profile = json.loads(PODMANS_PROFILE.read_text())
    for rule in profile["syscalls"]:
        rule["names"] = [name for name in rule["names"] if name not in ("sched_setscheduler", "sched_setattr")]
    others = [
        {"index": 1, "value": policy, "op": "SCMP_CMP_EQ"}
        for policy in range(16)
        if policy not in (SCHED_FIFO, SCHED_RR)
    ]
    profile["syscalls"] += [
        {"names": ["sched_setscheduler"], "action": "SCMP_ACT_ALLOW", "args": [other]} for other in others
    ]
    path = folder / "no-real-time.json"
    path.write_text(json.dumps(profile))
    return path


def start(sidecar: Sidecar, container: ContainerFactory, folder: Path, command: str, *more: str) -> ProtectedVictim:
    options = (
        *("--read-only", "--cap-drop=all", "--security-opt=no-new-privileges", "--pids-limit=64", "--cpu-shares=2"),
        *("--uidmap=0:100000:2000", "--gidmap=0:200000:2000", "--ipc=none", "--network=none"),
        f"--security-opt=seccomp={no_real_time(folder)}",
    )
    (folder / "board").touch()
    os.chown(folder / "board", 100000, 200000)
    return start_victim(sidecar, container, folder, command, labels=LABELS, options=(*options, *more), generation=0)


def die(victim: ProtectedVictim, death: str, restores: int) -> None:
    """Of what SIGUSR1 has it do, after a checkpoint; back in the same container, with the same PID."""
    before = victim.container.inspect()["State"]
    victim.checkpoint()
    os.kill(victim.app, signal.SIGUSR1)
    after = victim.sidecar.wait_restores(victim.container, restores, PATIENCE_S)
    victim.wait_beats(timeout_s=PATIENCE_S)
    assert (after["state"], after["last_death"], after["app_pid_inside"]) == ("protected", death, 2)
    state = victim.container.inspect()["State"]
    assert (state["Status"], state["Pid"], state["StartedAt"]) == ("running", before["Pid"], before["StartedAt"])


def test_it_is_confined(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    victim = start(sidecar, container, tmp_path, "crash")
    status = status_of(victim.app)
    assert (status["Uid"].split()[0], status["Seccomp"], status["NoNewPrivs"], int(status["CapEff"], 16)) == (
        *("100000", "2", "1"),
        0,
    )
    asks = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    done = victim.container.exec("python3", "-c", asks, check=False)
    assert done.status != 0
    assert "[Errno" in done.stderr
    assert victim.container.exec("touch", "/file", check=False).status != 0


@pytest.mark.parametrize(
    ("command", "death", "options"),
    [
        ("crash", "killed by SIGSEGV", ()),
        ("leak 200 16", "killed by SIGKILL", ("--memory=100m", "--memory-swap=100m")),
    ],
    ids=["SIGSEGV", "out of memory"],
)
def test_it_comes_back_from_every_death(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, command: str, death: str, options: tuple[str, ...]
) -> None:
    """Of a null pointer; of a leak, until the container's limit has it killed."""
    victim = start(sidecar, container, tmp_path, command, *options)
    for restores in range(1, DEATHS + 1):
        die(victim, death, restores)
    assert victim.see().starts == 1
