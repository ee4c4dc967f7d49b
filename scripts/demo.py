# SPDX-License-Identifier: Apache-2.0
"""`make demo`: a protected container's application is killed twice and goes on.

Installs the hooks and starts the sidecar unless they are there, starts
examples/tracker.py in a labelled container, talks to it over TCP all the time,
kills it with SIGKILL and with SIGSEGV, and shows what became of it.  Leaves the
machine as it was, also on Ctrl-C.  Ends with 1 if anything did not survive.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import statistics
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.panel import Panel
from rich.table import Table

from testkit.harness import (
    BASE_IMAGE,
    OURS,
    ROOT,
    SIDECAR_NAME,
    CommandFailed,
    Container,
    ContainerFactory,
    Podman,
    Sidecar,
    app_pid,
    free_port,
    hooks_installed,
    machine_lock,
    wait_until,
)

INTERVAL = "500ms"
NAME = "avckpt-demo"
INSIDE_PORT = 7000
ASK_EVERY_S = 0.01
ANSWER_WITHIN_S = 0.2
WORK_S = 3.0

# Lines are short enough for any terminal; a pipe must not get them broken at 80.
console = Console(highlight=False, soft_wrap=True)


class DemoFailed(Exception):
    """The story cannot be told to its end; the message says why."""


@dataclass(frozen=True)
class Answer:
    """One answer of the tracker."""

    pid: int
    tids: tuple[int, ...]
    started: float
    answers: int
    updates: int
    consistent: bool


class Client(threading.Thread):
    """Asks the tracker over one TCP connection, again and again, and remembers the longest silence."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._port = port
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self.latest: Answer | None = None
        self.answered = 0
        self.unanswered = 0
        self.broken = ""
        self._gap_s = 0.0

    def connect(self) -> None:
        """The only connection there will be.  Raises OSError while the tracker is not there yet."""
        self._socket = socket.create_connection(("127.0.0.1", self._port), timeout=ANSWER_WITHIN_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._received = b""

    def run(self) -> None:
        number = 0
        last = time.monotonic()
        try:
            while not self._ended.is_set():
                number += 1
                answer = self._ask(number)
                now = time.monotonic()
                with self._lock:
                    if answer is None:
                        self.unanswered += 1
                    else:
                        self.latest = answer
                        self.answered += 1
                        self._gap_s = max(self._gap_s, now - last)
                        last = now
                time.sleep(ASK_EVERY_S)
        except OSError as error:
            self.broken = str(error)

    def stop(self) -> None:
        """Ends the thread and the connection."""
        self._ended.set()
        self.join(timeout=5)
        self._socket.close()

    def further_than(self, earlier: Answer) -> bool:
        """Has the tracker, the same one, counted further than it had then?"""
        with self._lock:
            return self.latest is not None and self.latest.updates > earlier.updates

    def take_gap_s(self) -> float:
        """The longest time between two answers since this was called last."""
        with self._lock:
            gap_s, self._gap_s = self._gap_s, 0.0
            return gap_s

    def _ask(self, number: int) -> Answer | None:
        """None: not answered in time (a question the tracker had taken in just before it died)."""
        self._socket.sendall(b"%d\n" % number)
        deadline = time.monotonic() + ANSWER_WITHIN_S
        while True:
            line, newline, rest = self._received.partition(b"\n")
            if newline:
                self._received = rest
                said: dict[str, Any] = json.loads(line)
                # Late answers to earlier questions are passed over.
                if said.pop("question") == number:
                    said["tids"] = tuple(said["tids"])
                    return Answer(**said)
                continue
            try:
                more = self._socket.recv(65536)
            except TimeoutError:
                return None
            if not more:
                raise ConnectionResetError("the tracker closed the connection")
            self._received += more
            if time.monotonic() > deadline:
                return None


@dataclass(frozen=True)
class Killed:
    """What became of one kill."""

    what: str
    before: Answer
    after: Answer
    gap_s: float


def ms(seconds: float | None) -> str:
    return "?" if seconds is None else f"{seconds * 1000:.1f} ms"


@contextmanager
def doing(what: str) -> Iterator[None]:
    """Says what is being done now, and how long it took."""
    started = time.monotonic()
    try:
        with console.status(what):
            yield
    except BaseException:  # told here, handled where it belongs
        console.print(f"  [red]✗[/] {what} [dim]({time.monotonic() - started:.1f} s)[/]")
        raise
    console.print(f"  [green]✓[/] {what} [dim]({time.monotonic() - started:.1f} s)[/]")


def start_sidecar(podman: Podman, stack: ExitStack) -> Sidecar:
    """The machine's own sidecar if one runs, else one of ours for as long as the demo runs."""
    sidecar = Sidecar(podman)
    if podman.exists(SIDECAR_NAME):
        if sidecar.running and OURS not in (podman.inspect(SIDECAR_NAME)["Config"]["Labels"] or {}):
            console.print(f"  [green]✓[/] {SIDECAR_NAME} runs already and is used")
            return sidecar
        sidecar.stop()  # left by a run that was killed
    stack.callback(sidecar.stop)
    with doing(f"starting the sidecar: podman run --privileged --pid=host … --name {SIDECAR_NAME}"):
        sidecar.start()
    return sidecar


def start_tracker(podman: Podman, stack: ExitStack, sidecar: Sidecar) -> tuple[Container, Client]:
    """The labelled container, and a client that is connected to it."""
    factory = ContainerFactory(podman, NAME)
    stack.callback(factory.close)
    podman.remove(NAME)  # left by a demo that was killed
    port = free_port()
    # Some machines (containers, mostly) cannot make a bridge: the story is the same without.
    bridge = podman.run("run", "--rm", "--pull=never", BASE_IMAGE, "true", check=False).status == 0
    inside, network = (INSIDE_PORT, f"--publish=127.0.0.1:{port}:{INSIDE_PORT}") if bridge else (port, "--network=host")
    with doing(f"podman run --label avckpt.enable=true --label avckpt.interval={INTERVAL} … tracker.py"):
        container = factory.protected(
            *("python3", "/tracker.py", str(inside)),
            name=NAME,
            # Its client numbers its questions, and has a time limit for each.
            labels={"interval": INTERVAL, "tcp": "keep"},
            options=[network, "--volume", f"{ROOT}/examples/tracker.py:/tracker.py:ro"],
        )
        container.wait_for_log("started as PID")
        client = Client(port)
        wait_until(lambda: connected(client), 10, f"the tracker answers on port {port}")
    stack.callback(client.stop)
    client.start()
    with doing("waiting for the first checkpoint"):
        try:
            sidecar.wait_generation(container, 1, timeout_s=10)
        except TimeoutError as error:
            entry = sidecar.find(container) or {"state": "not known to the sidecar", "reason": ""}
            why = f"{entry['state']} {entry['reason']}".strip()
            raise DemoFailed(f"no checkpoint was taken; {container.name} is {why}") from error
    return container, client


def connected(client: Client) -> bool:
    try:
        client.connect()
    except OSError:
        return False
    return True


def work(sidecar: Sidecar, container: Container, client: Client) -> list[float]:
    """Lets the tracker work; returns the freeze times of checkpoints seen meanwhile."""
    freezes: dict[int, float] = {}
    with doing(
        f"letting it work for {WORK_S:g} s: 4 threads, a TCP client asking {1 / ASK_EVERY_S:.0f} times a second"
    ):
        deadline = time.monotonic() + WORK_S
        while time.monotonic() < deadline:
            entry = sidecar.find(container)
            if entry is not None and entry["last_freeze_s"] is not None:
                freezes[entry["generation"]] = entry["last_freeze_s"]
            time.sleep(0.2)
    if client.latest is None or client.broken:
        raise DemoFailed(f"the tracker does not answer: {client.broken or 'no answer yet'}")
    return list(freezes.values())


def kill(sidecar: Sidecar, container: Container, client: Client, number: signal.Signals) -> Killed:
    """Kills the application and waits until it answers again."""
    entry = sidecar.find(container)
    restores = entry["restores"] if entry is not None else 0
    before = client.latest
    assert before is not None
    client.take_gap_s()
    console.print(f"\n  [bold red]kill -{number.name.removeprefix('SIG')}[/] the tracker")
    os.kill(app_pid(container.pid), number)
    try:
        entry = sidecar.wait_restores(container, restores + 1, timeout_s=10)
        # More updates than ever before, so that nobody has to believe in small differences.
        wait_until(lambda: client.further_than(before) or client.broken, 10, "the tracker counts on")
    except TimeoutError as error:
        ended = next((entry for entry in sidecar.ps(ended=True) if entry["id"] == container.id), {"reason": str(error)})
        raise DemoFailed(f"the tracker did not come back: {ended['reason']}") from error
    if client.broken:
        raise DemoFailed(f"the TCP connection broke: {client.broken}")
    after = client.latest
    assert after is not None
    result = Killed(number.name, before, after, client.take_gap_s())
    console.print(
        f"  [green]✓[/] {entry['last_death'] or 'it died'}; "
        f"running again [bold]{ms(entry['last_restore_s'])}[/] later, "
        f"as it was {ms(entry['last_restore_age_s'])} before;\n"
        f"    its client's longest wait for an answer: {ms(result.gap_s)}"
    )
    return result


def proofs(kills: list[Killed], container: Container, client: Client, up_before: str) -> bool:
    """Shows that everything went on; False if something did not."""
    first = kills[0].before
    table = Table(title="What went on", title_justify="left", header_style="bold")
    for column in ("", "before", *(f"after {killed.what}" for killed in kills), ""):
        table.add_column(column)
    fine = True

    def row(what: str, values: list[object], holds: bool) -> None:
        nonlocal fine
        fine = fine and holds
        table.add_row(what, *(str(value) for value in values), "[green]✓[/]" if holds else "[red]✗[/]")

    states = [first, *(killed.after for killed in kills)]
    row("PID inside", [state.pid for state in states], len({state.pid for state in states}) == 1)
    tids = [" ".join(str(tid) for tid in state.tids) for state in states]
    row("thread ids", list(tids), len(set(tids)) == 1 and len(first.tids) == 5)
    row("started at", [clock_of(state.started) for state in states], len({state.started for state in states}) == 1)
    grows = all(killed.after.updates > killed.before.updates for killed in kills)
    row("updates counted", [state.updates for state in states], grows)
    row("sum agrees", ["yes" if state.consistent else "no" for state in states], all(s.consistent for s in states))
    row("TCP connection", ["the same"] * len(states), not client.broken)
    up_now = container.inspect()["State"]["StartedAt"]
    row("podman: up since", [clock(up_before), *[clock(up_now)] * len(kills)], up_now == up_before)
    log = container.logs()
    row("podman logs", [f"{log.count('started as PID')} start", *[""] * len(kills)], log.count("started as PID") == 1)
    console.print()
    console.print(table)
    console.print(f"  [dim]{client.answered} questions answered, {client.unanswered} not[/]")
    return fine


def clock(stamp: str) -> str:
    """The time of day in one of Podman's time stamps."""
    return stamp.replace("T", " ").split(" ")[1][:8] if len(stamp) > 10 else stamp


def clock_of(seconds: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(seconds)) + f"{seconds % 1:.3f}"[1:]


def tell(stack: ExitStack) -> bool:
    """The story; True if everything survived."""
    podman = Podman()
    console.print(Panel("A container whose application is killed, and goes on.", title="avckpt", expand=False))
    stack.enter_context(machine_lock(timeout_s=300))
    with doing("installing the hooks: avckpt install"):
        stack.enter_context(hooks_installed())
    sidecar = start_sidecar(podman, stack)
    container, client = start_tracker(podman, stack, sidecar)
    up_before = container.inspect()["State"]["StartedAt"]
    freezes = work(sidecar, container, client)
    if freezes:
        console.print(
            f"  [green]✓[/] {len(freezes)} checkpoints; the tracker stood still for "
            f"[bold]{ms(statistics.median(freezes))}[/] each (median)"
        )
    kills = [kill(sidecar, container, client, number) for number in (signal.SIGKILL, signal.SIGSEGV)]
    fine = proofs(kills, container, client, up_before)
    shown = podman.run("ps", "--filter", f"name=^{NAME}$", "--format", "{{.Names}}  {{.Status}}  {{.Command}}").stdout
    console.print(f"\n[bold]podman ps[/]\n  {shown.strip()}\n[bold]podman logs[/] (its end)")
    for line in container.logs().splitlines()[-3:]:
        console.print(f"  {line}", markup=False)
    return fine


def main() -> int:
    def interrupted(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, interrupted)
    if os.geteuid() != 0:
        console.print("[red]avckpt protects containers of root's Podman: run this as root[/] (sudo make demo)")
        return 1
    fine = False
    with ExitStack() as stack:
        try:
            fine = tell(stack)
        except KeyboardInterrupt:
            console.print("\n[yellow]interrupted[/]")
        except (DemoFailed, CommandFailed, TimeoutError, LookupError, OSError) as error:
            console.print(f"\n[red]the demo failed:[/] {error}", markup=True)
            show_sidecar_log()
        # A second Ctrl-C must not leave a container or a hook behind.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        console.print()
        try:
            with doing("cleaning up"):
                stack.close()
        except CommandFailed as error:
            console.print(f"[red]this could not be cleaned up:[/] {error}")
            fine = False
    if fine:
        console.print("\n[green]Nothing was lost but the moments since the last checkpoint.[/]")
    return 0 if fine else 1


def show_sidecar_log() -> None:
    """The end of the sidecar's log, if it is there to be had."""
    log = Sidecar(Podman()).logs().splitlines()[-10:]
    console.print("[bold]the sidecar's log[/] (its end)")
    for line in log:
        console.print(f"  {line}", markup=False)


if __name__ == "__main__":
    sys.exit(main())
