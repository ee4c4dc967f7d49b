# SPDX-License-Identifier: Apache-2.0
"""Whether a container's guard delays the checkpoints and restores of another container.

    .venv/bin/python -m bench.neighbours [--rounds 100]

A quiet program (tests/victims/idle.c, 4 threads) is checkpointed and restored beside one that forks
all the time (brood.c), one that opens thousands of descriptors again and again (openings.c) and one
that sits on a pipe's lock, as on a file server that does not answer (splicer.c).  The neighbour is
in turns unprotected and protected every 50 ms, so that what it takes of the CPUs by itself is in
both.  Prints medians and 95 % in ms: from the command to its answer, and of the restore.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import statistics
import tempfile
import time
from pathlib import Path

from bench.subjects import build
from testkit.guarded import GuardProcess, Victim, config

NEIGHBOURS = ("brood", "openings 5000 pair --again", "splicer")
TURNS = 5


def rounds_ms(neighbour: str, protected: bool, rounds: int, folder: Path) -> tuple[list[float], list[float]]:
    """Of checkpoints, and of restores."""
    checkpoints, restores = [], []
    with contextlib.ExitStack() as stack:
        other = stack.enter_context(Victim(neighbour, folder))
        quiet = stack.enter_context(Victim("idle 10 4", folder))
        if protected:
            stack.enter_context(GuardProcess(config(0.05), [other.pid])).wait("attached")
        guard = stack.enter_context(GuardProcess(config(), [quiet.pid]))
        if "openings" in neighbour:
            other.kill_app(signal.SIGUSR1)
        for _ in range(rounds):
            began = time.monotonic()
            if guard.command("checkpoint")["kind"] != "checkpoint":
                continue
            checkpoints.append(1000 * (time.monotonic() - began))
            answer = guard.command("restore")
            assert answer["kind"] == "restored", answer
            restores.append(1000 * answer["restore_s"])
            quiet.wait_beats(2)
    return checkpoints, restores


def show(values: list[float]) -> str:
    """Median and 95 %."""
    values.sort()
    return f"{statistics.median(values):7.2f} {values[len(values) * 95 // 100]:7.2f}"


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=100, help="of each kind (%(default)s)")
    asked = parser.parse_args()
    build()
    print("neighbour                   protected   checkpoint 95 %   restore 95 %")
    for neighbour in NEIGHBOURS:
        found: dict[bool, tuple[list[float], list[float]]] = {False: ([], []), True: ([], [])}
        for _ in range(TURNS):
            for protected, (checkpoints, restores) in found.items():
                with tempfile.TemporaryDirectory() as folder:
                    more = rounds_ms(neighbour, protected, asked.rounds // TURNS, Path(folder))
                checkpoints += more[0]
                restores += more[1]
        for protected, (checkpoints, restores) in found.items():
            print(
                f"{neighbour:27} {'yes' if protected else 'no':9} {show(checkpoints)} {show(restores)}"
                f"   ({len(checkpoints)} of {asked.rounds})",
                flush=True,
            )


if __name__ == "__main__":
    main()
