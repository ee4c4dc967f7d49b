# SPDX-License-Identifier: Apache-2.0
"""Kills guards at random moments, again and again.

    python -m testkit.kill_storm CONFIG KILLS REACH SEED INIT_PID...

Each round starts a guard for every init, and kills them with SIGKILL up to REACH times later than they take, here and
now, until one has taken a checkpoint.  Prints one line of JSON at the end: what was hit, and what was left behind in
the containers.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
import statistics
import sys
import time
from collections import Counter
from pathlib import Path

from avckpt.engine import Engine
from avckpt.events.vocabulary import Kind
from avckpt.guard import GuardConfig

from testkit.guard_peer import config_of_json
from testkit.procfs import children_of

KINDS = (Kind.ATTACHED, Kind.CHECKPOINT, Kind.MISSED, Kind.UNPROTECTED)
LEAVE_S = 3.0
MEASURED = 5
MEASURED_EVERY = 50


def ours_below(init: int) -> list[str]:
    """Templates and holders of a container."""
    found = []
    for pid in children_of(init):
        try:
            name = Path(f"/proc/{pid}/comm").read_text().strip()
        except OSError:
            continue
        if name.startswith("avckpt-"):
            found.append(f"{name} {pid}")
    return found


def wait_gone(inits: list[int]) -> list[str]:
    """What is still there some time after the process that traced it died."""
    deadline = time.monotonic() + LEAVE_S
    while True:
        left = [task for init in inits for task in ours_below(init)]
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(0.001)


def round_of_guards(
    engine: Engine, guard_config: GuardConfig, inits: list[int], patience_s: float | None = None
) -> tuple[Counter[Kind], float]:
    """Guards of all of them, killed after some time, or when one has taken a checkpoint.

    Returns what they said, and how long they were there.
    """
    guards, began = [], time.monotonic()
    for cookie, pid in enumerate(inits, 1):
        pidfd = os.pidfd_open(pid)
        guards.append(engine.start_guard(pidfd, guard_config, cookie))
        os.close(pidfd)
    seen: Counter[Kind] = Counter()

    def listen() -> None:
        select.select([engine.event_fd], [], [], 10.0)
        while (event := engine.next_event()) is not None:
            seen[event.kind] += 1
            if event.kind is Kind.UNPROTECTED:
                print(event, file=sys.stderr, flush=True)

    if patience_s is None:
        while not seen[Kind.CHECKPOINT]:
            listen()
    else:
        time.sleep(patience_s)
    lived_s = time.monotonic() - began
    for guard in guards:
        os.kill(guard.pid, signal.SIGKILL)  # our children, not reaped yet
    while seen[Kind.GUARD_LOST] < len(guards):
        listen()
    for guard in guards:
        guard.stop()
    return seen, lived_s


def first_checkpoints_s(engine: Engine, guard_config: GuardConfig, inits: list[int]) -> float:
    """How long they take until one of them has one."""
    took = []
    for _ in range(MEASURED):
        took.append(round_of_guards(engine, guard_config, inits)[1])
        wait_gone(inits)
    return statistics.median(took)


def main() -> None:
    """See above."""
    guard_config = config_of_json(sys.argv[1])
    kills, reach, seed = int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    inits = [int(pid) for pid in sys.argv[5:]]
    rng = random.Random(seed)
    totals: Counter[Kind] = Counter()
    hit = 0
    left: list[str] = []
    with Engine() as engine:
        for n in range(kills):
            if n % MEASURED_EVERY == 0:  # others take more or less of the CPU than before
                longest_s = reach * first_checkpoints_s(engine, guard_config, inits)
            seen, _ = round_of_guards(engine, guard_config, inits, rng.uniform(0.0, longest_s))
            totals += seen
            hit += seen[Kind.CHECKPOINT] > 0
            left += wait_gone(inits)
    said = {kind.name.lower(): totals[kind] for kind in KINDS}
    print(json.dumps({"kills": kills, "hit": hit, "left": left, **said}))


if __name__ == "__main__":
    main()
