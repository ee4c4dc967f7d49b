# SPDX-License-Identifier: Apache-2.0
"""What the hooks add to the start of a container.

Times `podman run --rm --network=none IMAGE true` in turns: without hooks (an empty
--hooks-dir), with the hooks installed but no label, and with the label.  The
sidecar runs all the time.

    python -m bench.startup [--cycles 30] [--json]

Needs what `make demo` needs.  Ends with 1 when something could not be measured.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile

from rich.console import Console
from rich.table import Table

from testkit.harness import (
    BASE_IMAGE,
    OURS,
    CommandFailed,
    Podman,
    machine_lock,
    running_sidecar,
)

CYCLES = 30
WARM_UP_CYCLES = 2
LIMIT_MS = 100.0
LOCK_PATIENCE_S = 600.0
RUN = ("run", "--rm", "--pull=never", "--network=none", "--label", f"{OURS}=1")

console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)


def measure(cycles: int) -> dict[str, list[float]]:
    """Milliseconds of each run.  Raises CommandFailed, TimeoutError."""
    podman = Podman()
    with machine_lock(LOCK_PATIENCE_S), running_sidecar(podman), tempfile.TemporaryDirectory() as empty:
        ways = {
            "without hooks": (Podman("--hooks-dir", empty), ()),
            "hooks, no label": (podman, ()),
            "hooks, avckpt.enable=true": (podman, ("--label", "avckpt.enable=true")),
        }
        times: dict[str, list[float]] = {name: [] for name in ways}
        for cycle in range(WARM_UP_CYCLES + cycles):
            for name, (command, options) in ways.items():
                done = command.run(*RUN, *options, BASE_IMAGE, "true")
                if cycle >= WARM_UP_CYCLES:
                    times[name].append(done.took_s * 1e3)
        return times


def main() -> int:
    parser = argparse.ArgumentParser(description="Measures what the hooks add to the start of a container.")
    parser.add_argument("--cycles", type=int, default=CYCLES, help="runs of each kind (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print the medians (ms) as JSON")
    args = parser.parse_args()
    try:
        times = measure(args.cycles)
    except (CommandFailed, TimeoutError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return 1
    medians = {name: round(statistics.median(values), 1) for name, values in times.items()}
    if args.json:
        print(json.dumps(medians, indent=1))
        return 0
    base = medians["without hooks"]
    table = Table(title=f"podman run --rm IMAGE true, ms, {args.cycles} runs each", title_justify="left")
    for heading in ("", "median", "least", "added"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, values in times.items():
        added = "" if name == "without hooks" else f"{medians[name] - base:+.0f}"
        table.add_row(name, f"{medians[name]:.0f}", f"{min(values):.0f}", added)
    console.print(table)
    holds = medians["hooks, no label"] - base <= LIMIT_MS
    console.print(f"limit for an unlabelled container: {LIMIT_MS:.0f} ms more: {'holds' if holds else 'does not hold'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
