# SPDX-License-Identifier: Apache-2.0
"""Kills a guarding process at random moments, again and again.

    python -m testkit.kill_storm CONFIG KILLS MAX_MS SEED INIT_PID...

Each round forks a process that starts an engine with a guard for every init, and kills it with
SIGKILL up to MAX_MS ms later.  Prints one line of JSON at the end: what was hit, and what was
left behind in the containers.
"""

from __future__ import annotations

import json
import mmap
import os
import random
import select
import signal
import struct
import sys
import time
from pathlib import Path
from typing import NoReturn

from avckpt.engine import Engine
from avckpt.events.vocabulary import EventKind
from avckpt.guard import GuardConfig

from testkit.guard_peer import config_of_json
from testkit.procfs import children_of

KINDS = (EventKind.ATTACHED, EventKind.CHECKPOINT, EventKind.MISSED, EventKind.UNPROTECTED)
LEAVE_S = 3.0


def guard_for_ever(guard_config: GuardConfig, inits: list[int], counts: mmap.mmap) -> NoReturn:
    """What is killed."""
    with Engine() as engine:
        for cookie, pid in enumerate(inits, 1):
            engine.start_guard(os.pidfd_open(pid), guard_config, cookie)
        seen = dict.fromkeys(KINDS, 0)
        while True:
            select.select([engine.event_fd], [], [])
            while (event := engine.next_event()) is not None:
                if event.kind in seen:
                    seen[event.kind] += 1
                    struct.pack_into(f"{len(KINDS)}Q", counts, 0, *seen.values())
                if event.kind is EventKind.UNPROTECTED:
                    print(event, file=sys.stderr, flush=True)


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


def main() -> None:
    """See above."""
    guard_config = config_of_json(sys.argv[1])
    kills, max_ms, seed = int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
    inits = [int(pid) for pid in sys.argv[5:]]
    rng = random.Random(seed)
    counts = mmap.mmap(-1, 4096)
    totals = [0] * len(KINDS)
    hit = 0
    left: list[str] = []
    for _ in range(kills):
        counts[:] = bytes(4096)
        child = os.fork()
        if child == 0:
            try:
                guard_for_ever(guard_config, inits, counts)
            finally:
                os._exit(1)
        time.sleep(rng.uniform(0.0, max_ms) / 1000)
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            raise SystemExit(f"the guarding process ended by itself, status {status:#x}")
        round_counts = struct.unpack_from(f"{len(KINDS)}Q", counts)
        totals = [total + n for total, n in zip(totals, round_counts)]
        hit += round_counts[1] > 0
        left += wait_gone(inits)
    names = [kind.name.lower() for kind in KINDS]
    print(json.dumps({"kills": kills, "hit": hit, "left": left, **dict(zip(names, totals))}))


if __name__ == "__main__":
    main()
