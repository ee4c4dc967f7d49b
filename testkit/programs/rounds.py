# SPDX-License-Identifier: Apache-2.0
"""Rounds of checkpoint, random wait, SIGKILL, restore on one program under load."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from avckpt.cli.client import Client, Json
from avckpt.errors import AvckptError, DeadlineMissed
from avckpt.guard import Command

from testkit.harness import RUN_DIR, Container, ContainerFactory, Podman, wait_until
from testkit.programs.load import CLIENTS, Load
from testkit.programs.registry import Program, place
from testkit.programs.wire import Closed, Garbled, Inconsistent, NoAnswer

MODES = ("keep", "reset-moved")
INTERVAL = "100ms"
WAIT_S = 0.3
"""The longest random wait between checkpoint and kill."""
GIVE_UP = 20
"""So many failed rounds are enough."""
PATIENCE_S = 60.0
START_S = 120.0


class RoundFailed(Exception):
    """Why a round is no success."""


@dataclass
class Outcome:
    """What came of all rounds of a program in one mode.  Times in ms."""

    program: str
    version: str
    mode: str
    rounds: int
    successes: int = 0
    failures: list[str] = field(default_factory=list)
    seen: Counter[str] = field(default_factory=Counter)
    """What its clients met."""
    checkpoints: int = 0
    missed: int = 0
    threads: int = 0
    freeze_ms: list[float] = field(default_factory=list)
    restore_ms: list[float] = field(default_factory=list)
    seconds: float = 0.0


class Trial:
    """One container with a program, and its clients."""

    def __init__(self, program: Program, mode: str, factory: ContainerFactory, seed: int) -> None:
        image, options = place(program, factory.podman)
        self.program = program
        self.client = Client(RUN_DIR)
        self.rng = random.Random(seed)
        self.restores = 0
        labels = {"interval": INTERVAL, "restore.max": "60/1s", "tcp": mode}
        self.container: Container = factory.protected(*program.command, labels=labels, options=options, image=image)
        self.load = Load(program.session, self.container.ip, limited=mode == "keep", seed=seed)

    def start(self) -> None:
        """Starts the clients as soon as the program answers."""

        def answers() -> bool:
            with contextlib.suppress(Closed, NoAnswer):
                self.program.session(self.load.host, "first", PATIENCE_S).close()
                return True
            return False

        wait_until(answers, START_S, f"{self.program.title} answers", every_s=0.1)
        self.load.start()
        self._wait(lambda: self.load.served(5), START_S, "every client is served")
        self._wait(lambda: self.row()["generation"] >= 1, START_S, "the first checkpoint")

    def stop(self) -> None:
        self.load.stop()
        self.container.remove()

    def row(self) -> Json:
        """The container's entry of `avckpt ps`, which it must have.  Raises RoundFailed."""
        rows = [row for row in self.client.containers(ended=True) if row["id"] == self.container.id]
        if not rows:
            raise RoundFailed("the sidecar knows nothing of the container")
        if rows[0]["state"] == "ended":
            raise RoundFailed(f"ended: {rows[0]['reason']}")
        return rows[0]

    def round(self) -> Json:
        """One round; `avckpt ps` after it.  Raises RoundFailed."""
        self.checkpoint()
        time.sleep(self.rng.uniform(0, WAIT_S))
        row = self.row()
        self._expect_restores(row)
        pidfd = os.pidfd_open(row["app_pid"])
        self.load.epoch += 1
        try:
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)
        finally:
            os.close(pidfd)
        self.restores += 1
        self._wait(lambda: self.row()["restores"] >= self.restores, PATIENCE_S, "the restore")
        self.load.epoch += 1
        self._wait(lambda: self.load.served(2), PATIENCE_S, "every client is served again")
        self.check()
        row = self.row()
        self._expect_restores(row)
        return row

    def checkpoint(self) -> None:
        """A checkpoint on command, beside those on the interval; what clients know before is safe after it."""
        deadline = time.monotonic() + PATIENCE_S
        # A machine short of memory may be without protection for a while (docs/policy.md).
        self._wait(lambda: self.row()["state"] == "protected", PATIENCE_S, "protection")
        self.load.mark()
        while True:
            try:
                self.client.command(self.container.name, Command.CHECKPOINT)
                break
            except DeadlineMissed as error:
                if time.monotonic() > deadline:
                    raise RoundFailed(f"no checkpoint: {error}") from error
            except AvckptError as error:
                raise RoundFailed(f"no checkpoint: {type(error).__name__}: {error}") from error
        self.load.commit()

    def check(self) -> None:
        """The program's own check over a new connection, until it has no connection too many or too few."""

        connections = 0

        def ask() -> bool:
            nonlocal connections
            connections = session.check()
            return connections == CLIENTS + 1

        try:
            session = self.program.session(self.load.host, "check", PATIENCE_S)
            try:
                self._wait(ask, PATIENCE_S, "as many connections as there are")
            finally:
                session.close()
        except (Closed, NoAnswer, Garbled, Inconsistent) as error:
            raise RoundFailed(f"check: {type(error).__name__}: {error}") from error
        except RoundFailed as error:
            raise RoundFailed(f"{error}; it believes to have {connections}, there are {CLIENTS + 1}") from error

    def _expect_restores(self, row: Json) -> None:
        if row["restores"] != self.restores:
            raise RoundFailed(f"it died by itself ({row['last_death']}) and was restored {row['restores']} times")

    def _wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Until it is so, or a client has found something wrong."""

        def look() -> bool:
            if self.load.failures:
                raise RoundFailed("; ".join(self.load.failures))
            return condition()

        try:
            wait_until(look, timeout_s, what)
        except TimeoutError as error:
            # A program that has ended by itself answers nobody.
            row = self.row()
            self._expect_restores(row)
            raise RoundFailed(f"{error} ({row['state']}, {row['reason']})") from error

    def evidence(self) -> str:
        """What a person wants to see of a failed round."""
        events = [event for event in self.client.history() if event.get("id") == self.container.id][-6:]
        told = "\n".join(f"{event['monotonic_s']:.3f} {event['kind']}: {event['message']}" for event in events)
        return f"{told}\n{self.container.logs()[-3000:]}"


def run(
    program: Program,
    mode: str,
    rounds: int,
    podman: Podman,
    *,
    seed: int = 1,
    tell: Callable[[str], Any] = lambda text: None,
) -> Outcome:
    """All rounds of one program in one mode; a container that has failed is replaced by a new one."""
    started = time.monotonic()
    image, _ = place(program, podman)
    version = podman.run("run", "--rm", "--network=none", image, *program.version, check=False)
    text = (version.stdout + version.stderr).strip()
    outcome = Outcome(program.name, text.splitlines()[0] if text else "", mode, rounds)
    factory = ContainerFactory(podman, f"avckpt-program-{program.name}-{mode}-{os.getpid()}")
    try:
        while (done := outcome.successes + len(outcome.failures)) < rounds and len(outcome.failures) < GIVE_UP:
            trial = Trial(program, mode, factory, seed + done)
            try:
                _some_rounds(trial, outcome)
            except (RoundFailed, TimeoutError) as error:
                n = outcome.successes + len(outcome.failures) + 1
                outcome.failures.append(f"round {n}: {error}")
                tell(f"{program.name} {mode}, round {n}: {error}\n{trial.evidence()}")
            finally:
                trial.stop()
                outcome.seen += trial.load.seen
    finally:
        factory.close()
    outcome.seconds = round(time.monotonic() - started, 1)
    return outcome


def _some_rounds(trial: Trial, outcome: Outcome) -> None:
    """Rounds until all are done.  Raises RoundFailed and TimeoutError with the first that fails."""
    row: Json = {}
    try:
        trial.start()
        while outcome.successes + len(outcome.failures) < outcome.rounds:
            row = trial.round()
            outcome.successes += 1
            outcome.freeze_ms.append(round(row["last_freeze_s"] * 1000, 2))
            outcome.restore_ms.append(round(row["last_restore_s"] * 1000, 2))
            outcome.threads = max(outcome.threads, row["threads"])
    finally:
        outcome.checkpoints += row.get("checkpoints", 0)
        outcome.missed += row.get("missed", 0)
