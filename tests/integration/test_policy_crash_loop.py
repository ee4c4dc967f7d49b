# SPDX-License-Identifier: Apache-2.0
"""avckpt.restore.max: a poisoned state is not restored forever."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from testkit.harness import SLOWNESS, ContainerFactory, Sidecar, take_checkpoint, wait_until
from testkit.protected import ProtectedVictim, ended, start_victim

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; restores within a time are counted"
)


@pytest.fixture
def poison(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> Any:
    """A victim that crashes that many ms after SIGUSR1, and again as long after each restore of a state since."""

    def start(fuse_ms: int, labels: dict[str, str], *options: str, generation: int = 0) -> ProtectedVictim:
        return start_victim(
            sidecar, container, tmp_path, f"poison {fuse_ms}", labels=labels, options=options, generation=generation
        )

    return start


def test_a_poisoned_generation_is_left_for_an_older_one(poison: Any) -> None:
    victim = poison(int(1000 * SLOWNESS), {"interval": "1h", "restore.max": "4/60s"})
    clean = victim.checkpoint()
    os.kill(victim.app, signal.SIGUSR1)
    poisoned = victim.checkpoint()  # before it crashes
    entry = victim.sidecar.wait_restores(victim.container, 3)
    # Half of the four for the newest, then the clean one: and it lives.
    assert entry["generation"] == clean
    assert entry["generations"] == 1
    assert f"generation {poisoned}: what is restored from it keeps crashing" in entry["reason"]
    victim.wait_beats(600, timeout_s=15)
    assert victim.sidecar.find(victim.container)["restores"] == 3
    assert victim.see().starts == 1
    dropped = victim.events("dropped")
    assert [(event["generation"], event["attempt"]) for event in dropped] == [(poisoned, 2)]
    assert [event["generation"] for event in victim.events("restored")] == [poisoned, poisoned, clean]


def test_checkpoints_in_between_do_not_keep_a_crash_loop_alive(poison: Any) -> None:
    victim = poison(300, {"interval": "50ms", "restore.max": "4/60s"}, "--restart", "on-failure:1", generation=3)
    os.kill(victim.app, signal.SIGUSR1)
    # Every generation is poisoned by then, and more are taken after each restore.
    wait_until(lambda: victim.see().starts == 2, 30, "Podman's restart policy starts it anew")
    victim.wait_beats()
    reason = ended(victim.sidecar, victim.container)
    # The second, if no checkpoint could be taken between two deaths: then nothing has to count them.
    assert re.match(
        r"killed by SIGABRT; "
        r"(the restores of avckpt\.restore\.max are used up|it died the same way within a second of each)",
        reason,
    ), reason
    restored = victim.events("restored")
    # The four, and one more if there was a generation that had not been tried.
    assert len(restored) in (4, 5), restored
    assert [event["outcome"] for event in victim.events("gave_up")] in (["limit"], ["loop"])
    victim.sidecar.wait_generation(victim.container)  # and the new run is protected


def test_a_roll_back_on_command_does_not_count(poison: Any) -> None:
    victim = poison(100000, {"interval": "1h", "restore.max": "2/60s"})
    victim.checkpoint()
    for _ in range(4):
        victim.sidecar.avckpt("restore", victim.container.name)
    victim.wait_beats()
    victim.kill(signal.SIGKILL)
    victim.kill(signal.SIGKILL)
    os.kill(victim.app, signal.SIGKILL)
    assert victim.container.wait() == 137


# SIGUSR1 puts five jobs in a queue, one of which is done each half a second; the last one kills.
WORKER = """
import contextlib, os, signal, time
jobs, queue = os.pipe()
os.set_blocking(jobs, False)
signal.signal(signal.SIGUSR1, lambda *_: os.write(queue, b"....x"))
print("ready", flush=True)
while True:
    time.sleep(0.5)
    with contextlib.suppress(BlockingIOError):
        if os.read(jobs, 1) == b"x":
            os.abort()
"""


def test_a_job_that_kills_is_dropped_with_the_queue_it_is_in(sidecar: Sidecar, container: ContainerFactory) -> None:
    labels = {"interval": "1h", "restore.again": "drop-input,stagger"}
    worker = container.protected("python3", "-c", WORKER, labels=labels)
    wait_until(lambda: "ready" in worker.logs(), 20, "the worker is ready")
    os.kill(sidecar.app_pid(worker), signal.SIGUSR1)
    take_checkpoint(sidecar.client, worker.name)
    sidecar.wait_restores(worker, 2, timeout_s=40)
    told = [event for event in sidecar.client.history(0) if event["container"] == worker.name]
    first, second = (event for event in told if event["kind"] == "restored")
    assert "again" not in first
    assert (second["again"], second["input_dropped"]) == ("drop-input,stagger", 1)
    assert "with drop-input (of 1 descriptor(s)), stagger" in second["message"]
    # The job would kill within two and a half seconds again.
    time.sleep(4)
    entry = sidecar.find(worker)
    assert entry is not None
    assert (entry["state"], entry["restores"]) == ("protected", 2)
