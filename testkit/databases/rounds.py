# SPDX-License-Identifier: Apache-2.0
"""Kills a bank in a protected container at random moments, and asks its database each time."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client

from testkit.databases.observer import Audit, Observer, audit
from testkit.harness import RUN_DIR, Container, ContainerFactory, wait_until

PROGRAM = Path(__file__).with_name("bank.py")
LOAD = ("--burst", "0.8", "--idle", "0.4", "--think", "0.01")
WRONG = ("error", "disagree")


@dataclass(frozen=True)
class Round:
    """One death, and what was there afterwards."""

    phase: str
    """What the bank was doing, as far as it had told: "busy" or "idle"."""
    outcome: str
    """`restored`, `cold` (avckpt gave up, Podman started it anew) or `ended`."""
    detail: str
    """Why it was not restored."""
    age_s: float
    """Of the generation that was restored."""
    forgotten: int
    """Transactions told between that generation and the death."""
    told: int
    """Transactions told up to now."""
    said: list[str]
    """The bank's own complaints."""
    audit: Audit

    @property
    def damage(self) -> list[str]:
        """Everything that is wrong."""
        return self.said + self.audit.damage


class Bank:
    """The container, its observer and its database."""

    def __init__(
        self,
        factory: ContainerFactory,
        observer: Observer,
        folder: Path,
        files: str,
        arguments: Sequence[str],
        *,
        restart: str = "no",
        interval: str = "100ms",
    ) -> None:
        folder.chmod(0o755)
        self.observer = observer
        self.database = folder / "bank.db"
        self.is_loaded = "--burst" in arguments
        self.client = Client(RUN_DIR)
        since = self._mark = observer.mark()
        self.container: Container = factory.protected(
            *("python3", "/databases/bank.py", "127.0.0.1", str(observer.port), "/data/bank.db", *arguments),
            # What the bank ends by itself has told why, and is not to be hidden by a restore.
            labels={
                "interval": interval,
                "files": files,
                "restore.on": "signal",
                "restore.max": "60/60s",
                "tcp": "keep",
            },
            options=[
                *("--network=host", f"--restart={restart}", "--volume", f"{PROGRAM.parent}:/databases:ro"),
                *("--volume", f"{folder}:/data"),
            ],
        )
        observer.wait("start", since=since)

    def entry(self) -> dict[str, Any] | None:
        """What `avckpt ps` says of it, while it runs."""
        return next((entry for entry in self.client.containers() if entry["id"] == self.container.id), None)

    def wait_generation(self, timeout_s: float = 30.0) -> dict[str, Any]:
        """Waits until there is one; but a host that is short of memory may not give any for a while.

        Raises LookupError when it has ended by itself, and is not started anew.
        """
        deadline = time.monotonic() + timeout_s

        def look() -> dict[str, Any] | None:
            entry = self.entry()
            if entry is None and not self.restarts and self.container.status == "exited":
                raise LookupError(f"it has ended: {self.container.logs()[-300:]}")
            if entry is None or not entry["app_pid"] or entry["state"] == "restoring":
                return None
            return entry if entry["generations"] or time.monotonic() > deadline else None

        found = wait_until(look, timeout_s + 60, "a generation", 0.02)
        assert found is not None
        return found

    def events(self, after: int, *kinds: str) -> list[dict[str, Any]]:
        """What the sidecar has kept of it."""
        return [
            event
            for event in self.client.history()
            if event["seq"] > after and event["id"] == self.container.id and event["kind"] in kinds
        ]

    def kill(self) -> Round:
        """One death now; or it turns out that it has not got over the one before."""
        try:
            entry = self.wait_generation()
        except LookupError as gone:
            return Round(
                "busy", "ended", str(gone), 0.0, 0, len(self.observer.told()), ["error it has ended"], self.audit()
            )
        seen = max((event["seq"] for event in self.client.history()), default=0)
        since = self._mark = self.observer.mark()
        said = self.observer.lines("busy", "idle", "start")[-1]
        os.kill(entry["app_pid"], signal.SIGKILL)
        (ending,) = wait_until(
            lambda: self.events(seen, "restored", "gave_up")[:1], 30, f"the end of a death of {self.container.name}"
        )
        died = self.events(seen, "died")[0]
        error = ending.get("error") or {}
        age_s, forgotten = 0.0, 0
        if ending["kind"] == "restored":
            outcome = "restored"
            age_s = ending["age_s"]
            taken_s = died["monotonic_s"] - age_s
            forgotten = sum(1 for at_s in self.observer.committed_s() if taken_s < at_s < died["monotonic_s"])
        else:
            outcome = "cold" if self.restarts else "ended"
        # It has to work again: until it rests, or says what is wrong.
        if outcome == "cold":
            self.observer.wait("start", since=since, timeout_s=60)
        if outcome != "ended" and self.is_loaded:
            self.observer.wait("idle", *WRONG, since=since, timeout_s=60)
        told = self.observer.told()
        return Round(
            phase="idle" if said.word == "idle" else "busy",
            outcome=outcome,
            detail=str(error.get("message") or error or ending.get("detail", "")),
            age_s=age_s,
            forgotten=forgotten,
            told=len(told),
            said=self.complaints(),
            audit=self.audit(),
        )

    def complaints(self) -> list[str]:
        """The bank's own, since the last death."""
        return [f"{line.word} {line.rest}" for line in self.observer.lines(*WRONG, since=self._mark)]

    def audit(self) -> Audit:
        """What the database is like now."""
        return audit(self.database, self.observer.told())

    @property
    def restarts(self) -> bool:
        """Does Podman start it anew?"""
        policy: str = self.container.inspect()["HostConfig"]["RestartPolicy"]["Name"]
        return policy not in ("", "no")


def kill_at_random(bank: Bank, rng: random.Random) -> Round:
    """After a random time of work and rest."""
    time.sleep(rng.uniform(0.0, 1.8))
    return bank.kill()
