# SPDX-License-Identifier: Apache-2.0
"""Where applications in real containers died, when nothing of them is left."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from avckpt.cli.client import Client

from testkit.harness import ContainerFactory, Podman, wait_until
from testkit.local_sidecar import QUICK, LocalSidecar, hooked_podman

pytestmark = pytest.mark.shared_machine("a sidecar, its guards and containers have to get CPU time within seconds")

# Faults, and leaks, in C: with frame pointers of its own interpreter there are none in Debian's.
VICTIM = """
import ctypes, os, signal, time
wanted = []
for each in (signal.SIGUSR1, signal.SIGUSR2):
    signal.signal(each, lambda signum, frame: wanted.append(signum))
held = []
print("ready", flush=True)
while True:
    time.sleep(0.01)
    if wanted == [signal.SIGUSR1]:
        ctypes.string_at(0x10)
    elif wanted:
        held.append(b"x" * 50_000_000)
"""


@pytest.fixture
def factory(podman: Podman, base_image: str, local: LocalSidecar) -> Iterator[ContainerFactory]:
    made = ContainerFactory(hooked_podman(local), f"avckpt-evidence-{os.getpid()}")
    yield made
    made.close()


def row(local: LocalSidecar, name: str) -> dict[str, Any]:
    """What the sidecar knows of it."""
    found = [each for each in Client(local.run_dir).containers(ended=True) if each["name"] == name]
    return found[-1] if found else {}


def crash_of(local: LocalSidecar, factory: ContainerFactory, signum: int, labels: dict[str, str]) -> dict[str, Any]:
    """Has a victim die that leaks or faults, with these labels for the last time; the event that says of what."""
    options = ["--memory", "200m", "--memory-swap", "200m"]
    made = factory.protected("python3", "-c", VICTIM, labels={**QUICK, **labels}, options=options)
    wait_until(lambda: "ready" in made.logs(), 20, "it is ready", every_s=0.1)
    ready = row(local, made.name).get("checkpoints", 0)
    wait_until(lambda: row(local, made.name).get("checkpoints", 0) > ready + 2, 20, "it is protected", every_s=0.1)

    def told() -> dict[str, Any]:
        crashes = local.events(made.name, "crash")
        event = crashes[-1] if crashes else {}
        known = row(local, made.name)
        if event.get("outcome") == "restored" and labels and known["state"] == "protected":
            os.kill(known["app_pid"], signum)
        return {} if event.get("outcome") == "restored" and labels else event

    os.kill(row(local, made.name)["app_pid"], signum)
    return wait_until(told, 20, "the crash is told of", every_s=0.1)


@pytest.mark.parametrize("labels", [{"avckpt.restore.on": "exit"}, {"avckpt.restore.max": "1/60s"}], ids=["not", "max"])
def test_a_final_death_has_a_place(local: LocalSidecar, factory: ContainerFactory, labels: dict[str, str]) -> None:
    for _ in range(3):
        event = crash_of(local, factory, signal.SIGUSR1, labels)
        assert event["outcome"] in ("policy", "limit", "loop")
        crash = event["crash"]
        assert crash["module"].endswith("/libc.so.6")
        assert "_ctypes" in crash["backtrace"]
        assert crash["command"].endswith("python3")


@pytest.mark.parametrize("labels", [{}, {"avckpt.restore.on": "exit"}], ids=["restored", "final"])
def test_a_kill_by_the_oom_killer_has_a_place(
    local: LocalSidecar, factory: ContainerFactory, labels: dict[str, str]
) -> None:
    """By the mappings of the last checkpoint: its own memory is gone at once.  The killer may take that, too."""
    for _ in range(4):
        crash = crash_of(local, factory, signal.SIGUSR2, labels)["crash"]
        assert (crash["signal"], crash["sender"]) == ("SIGKILL", "kernel")
        if "at" in crash:
            break
    assert crash["at"].startswith(("python3", "libc.so.6"))
    assert crash["build_id"]
    assert crash["command"].endswith("python3")
