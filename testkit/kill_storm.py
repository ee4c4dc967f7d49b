# SPDX-License-Identifier: Apache-2.0
"""Kills guards at random moments, again and again.

    python -m testkit.kill_storm CONFIG KILLS MAX_MS SEED INIT_PID...

Each round starts a guard for every init, and kills them with SIGKILL up to MAX_MS ms later.
Prints one line of JSON at the end: what was hit, and what was left behind in the containers.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
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


def round_of_guards(engine: Engine, guard_config: GuardConfig, inits: list[int], patience_s: float) -> Counter[Kind]:
    """Guards of all of them, killed after some time; what they said until then."""
    guards = []
    for cookie, pid in enumerate(inits, 1):
        pidfd = os.pidfd_open(pid)
        guards.append(engine.start_guard(pidfd, guard_config, cookie))
        os.close(pidfd)
    time.sleep(patience_s)
    for guard in guards:
        os.kill(guard.pid, signal.SIGKILL)  # our children, not reaped yet
    seen: Counter[Kind] = Counter()
    while seen[Kind.GUARD_LOST] < len(guards):
        select.select([engine.event_fd], [], [], 10.0)
        while (event := engine.next_event()) is not None:
            seen[event.kind] += 1
            if event.kind is Kind.UNPROTECTED:
                print(event, file=sys.stderr, flush=True)
    for guard in guards:
        guard.stop()
    return seen


def main() -> None:
    """See above."""
    guard_config = config_of_json(sys.argv[1])
    kills, max_ms, seed = int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    inits = [int(pid) for pid in sys.argv[5:]]
    rng = random.Random(seed)
    totals: Counter[Kind] = Counter()
    hit = 0
    left: list[str] = []
    with Engine() as engine:
        for _ in range(kills):
            seen = round_of_guards(engine, guard_config, inits, rng.uniform(0.0, max_ms) / 1000)
            totals += seen
            hit += seen[Kind.CHECKPOINT] > 0
            left += wait_gone(inits)
    said = {kind.name.lower(): totals[kind] for kind in KINDS}
    print(json.dumps({"kills": kills, "hit": hit, "left": left, **said}))


if __name__ == "__main__":
    main()
