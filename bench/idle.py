# SPDX-License-Identifier: Apache-2.0
"""What protection costs while nothing happens: CPU and memory, at an interval of 3 s.

For a minute the same program (tests/victims/idle.c, 100 MB, 20 threads, awake
once a second) runs in a container without a label, in a container with
`avckpt.enable=true`, and under `avckpt run`; all at once, so that other load of the
machine affects all of them.  CPU times are the scheduler's own
(/proc/PID/task/TID/schedstat, ns), also those of templates that came and went.

    python -m bench.idle [--seconds 60] [--json]

Needs what `make demo` needs.  Ends with 1 when something could not be measured.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from avckpt.supervision.pressure import held_bytes, templates_of
from rich.console import Console
from rich.table import Table

from bench.subjects import VICTIMS, BenchFailed, build, eventually
from testkit.harness import (
    SIDECAR_NAME,
    CommandFailed,
    ContainerFactory,
    Podman,
    avckpt_command,
    machine_lock,
    running_sidecar,
)
from testkit.procfs import below, figures

MEGABYTES, THREADS = 100, 20
PROGRAM = ["idle", str(MEGABYTES), str(THREADS), "--beat-us", "1000000"]
INTERVAL = "3s"
SETTLE_S = 7.0
"""Before it counts: the first checkpoints bring the engine's code into the program."""
LOOK_EVERY_S = 0.25
LIMIT_PERCENT = 1.0
LOCK_PATIENCE_S = 600.0

console = Console(highlight=False, width=None if sys.stdout.isatty() else 110)


@dataclass
class Meter:
    """CPU time of a changing set of processes, since begin()."""

    name: str
    pids: Callable[[], list[int]]
    _seen: dict[tuple[int, int], int] = field(default_factory=dict)
    total_ns: int = 0
    _counts: bool = False

    def begin(self) -> None:
        """Counts from now on."""
        self.look()
        self.total_ns = 0
        self._counts = True

    def look(self) -> None:
        """To be called often: what a task used after the last look before its end is lost."""
        for pid in self.pids():
            with contextlib.suppress(OSError):
                for task in map(int, os.listdir(f"/proc/{pid}/task")):
                    used = int(Path(f"/proc/{pid}/task/{task}/schedstat").read_text().split()[0])
                    before = self._seen.get((pid, task), 0 if self._counts else used)
                    # Less than before: a new task with an old number.
                    self.total_ns += used - before if used >= before else used
                    self._seen[pid, task] = used


def app_of(init_pid: int) -> int:
    """The program below an avckpt-init."""
    for pid in below(init_pid):
        with contextlib.suppress(OSError):
            if Path(f"/proc/{pid}/comm").read_text().strip() == PROGRAM[0]:
                return pid
    raise BenchFailed("the program is not there any more")


@contextlib.contextmanager
def avckpt_run() -> Iterator[int]:
    """The program under `avckpt run`; the PID of the latter."""
    command = [*avckpt_command(), "run", "--label", f"avckpt.interval={INTERVAL}", "--"]
    process = subprocess.Popen([*command, str(VICTIMS / "build" / PROGRAM[0]), *PROGRAM[1:]], stdout=subprocess.DEVNULL)

    def protects() -> bool:
        # Its init is a child of it.
        return any(templates_of(pid) for pid in [process.pid, *below(process.pid)])

    try:
        eventually(lambda: protects() or process.poll() is not None, "avckpt run protects")
        if process.poll() is not None:
            raise BenchFailed(f"avckpt run ended with {process.returncode}")
        yield process.pid
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        process.wait(10)


@dataclass(frozen=True)
class Idle:
    """Percent of one core, and sizes in MB."""

    seconds: float
    sidecar_percent: float
    container_protected_percent: float
    container_plain_percent: float
    run_percent: float
    run_program_percent: float
    templates: int
    templates_mb: float
    page_tables_mb: float
    sidecar_rss_mb: float

    @property
    def added_percent(self) -> float:
        """By protecting one container: the sidecar's, and what the container uses more."""
        return self.sidecar_percent + self.container_protected_percent - self.container_plain_percent

    @property
    def run_added_percent(self) -> float:
        """The same for `avckpt run`, against the plain container's program."""
        return self.run_percent + self.run_program_percent - self.container_plain_percent


def measure(seconds: float) -> Idle:
    """Raises BenchFailed, CommandFailed, TimeoutError."""
    podman = Podman()
    factory = ContainerFactory(podman, "avckpt-bench-idle")
    options = ["--network=none", "--volume", f"{VICTIMS / 'build'}:/victims:ro"]
    command = [f"/victims/{PROGRAM[0]}", *PROGRAM[1:]]
    with machine_lock(LOCK_PATIENCE_S), running_sidecar(podman) as sidecar, contextlib.ExitStack() as undo:
        undo.callback(factory.close)
        plain = factory(*command, options=options).pid
        protected = factory.protected(*command, options=options, labels={"interval": INTERVAL})
        sidecar.wait_generation(protected)
        init = protected.pid
        sidecar_pid = podman.inspect(SIDECAR_NAME)["State"]["Pid"]
        run_pid = undo.enter_context(avckpt_run())
        meters = {
            "sidecar": Meter("sidecar", lambda: [sidecar_pid, *below(sidecar_pid)]),
            "protected": Meter("protected", lambda: [init, *below(init)]),
            "plain": Meter("plain", lambda: [plain, *below(plain)]),
            "run": Meter("run", lambda: [run_pid]),
            "program": Meter("program", lambda: below(run_pid)),
        }
        time.sleep(SETTLE_S)
        for meter in meters.values():
            meter.begin()
        started = time.monotonic()
        while time.monotonic() - started < seconds:
            time.sleep(LOOK_EVERY_S)
            for meter in meters.values():
                meter.look()
        took_s = time.monotonic() - started
        templates = templates_of(init)
        if not templates:
            raise BenchFailed("the container has no template any more")
        percent = {name: meter.total_ns / 1e9 / took_s * 100 for name, meter in meters.items()}
        return Idle(
            seconds=round(took_s, 1),
            sidecar_percent=round(percent["sidecar"], 3),
            container_protected_percent=round(percent["protected"], 3),
            container_plain_percent=round(percent["plain"], 3),
            run_percent=round(percent["run"], 3),
            run_program_percent=round(percent["program"], 3),
            templates=len(templates),
            templates_mb=round(held_bytes(app_of(init), templates) / 2**20, 2),
            page_tables_mb=round(sum(figures(pid)["VmPTE"] for pid in templates) / 1024, 2),
            sidecar_rss_mb=round(sum(figures(pid)["Rss"] for pid in [sidecar_pid, *below(sidecar_pid)]) / 1024, 1),
        )


def show(idle: Idle) -> None:
    table = Table(title=f"percent of one core over {idle.seconds:.0f} s, interval {INTERVAL}", title_justify="left")
    for heading in ("program", "of avckpt", "of program", "added", f"limit {LIMIT_PERCENT:g}"):
        table.add_column(heading, justify="right")
    table.add_row("not protected", "", f"{idle.container_plain_percent:.3f}", "", "")
    for name, ours, program, added in (
        ("container, sidecar", idle.sidecar_percent, idle.container_protected_percent, idle.added_percent),
        ("avckpt run", idle.run_percent, idle.run_program_percent, idle.run_added_percent),
    ):
        verdict = "[green]holds[/]" if added < LIMIT_PERCENT else "[red]does not hold[/]"
        table.add_row(name, f"{ours:.3f}", f"{program:.3f}", f"{added:.3f}", verdict)
    console.print(table)
    console.print(
        f"{idle.templates} templates of {MEGABYTES} MB that was not written to since: {idle.templates_mb} MB of "
        f"their own, {idle.page_tables_mb} MB page tables; the sidecar's RSS: {idle.sidecar_rss_mb} MB"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description="Measures what protection costs while nothing happens.")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    args = parser.parse_args()
    try:
        build()
        idle = measure(args.seconds)
    except (BenchFailed, CommandFailed, TimeoutError) as error:
        print(f"bench: {error}", file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps({**idle.__dict__, "added_percent": round(idle.added_percent, 3)}, indent=1))
    else:
        show(idle)
    return 0


if __name__ == "__main__":
    sys.exit(main())
