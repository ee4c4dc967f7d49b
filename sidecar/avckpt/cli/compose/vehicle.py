# SPDX-License-Identifier: Apache-2.0
"""`avckpt up` and `avckpt down`: podman-compose, with hooks and sidecar seen to, and protection waited for."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from avckpt_hooks.shared.programs import must_be_pid_1

from avckpt.cli import doctor, install, sidecar_container
from avckpt.cli.client import Client, Json
from avckpt.cli.compose.podman_compose import Compose, Started
from avckpt.cli.doctor import Check, Status
from avckpt.errors import AvckptError, ConfigError, Denied
from avckpt.guard import Command

log = logging.getLogger("avckpt")

Say = Callable[[str], None]

INSTALLABLE = frozenset({"hooks", "init", "hooks_dir"})
"""Checks of `avckpt doctor` that `avckpt install` makes good."""
LOOK_EVERY_S = 0.5
GONE = ("exited", "stopped", "dead")


@dataclass(frozen=True)
class Protection:
    """How one container came out."""

    container: Started
    protected: bool
    why: str
    """Empty when it is protected, or was never meant to be."""
    may_change: bool = False
    """Waiting may help."""

    @property
    def state(self) -> str:
        """One word."""
        if self.protected:
            return "protected"
        return "unprotected" if self.container.wanted else "not asked for"

    def to_json(self) -> dict[str, object]:
        """For programs."""
        container = self.container
        return {
            "service": container.service,
            "name": container.name,
            "id": container.id,
            "status": container.status,
            "asked_for": container.wanted,
            "protected": self.protected,
            "reason": self.why,
        }


def prepare(run_dir: Path, *, install_hooks: bool, say: Say) -> None:
    """Sees to hooks and sidecar.

    Raises Denied, ConfigError or SidecarUnreachable with what is missing and
    what is to be done about it.
    """
    if os.geteuid() != 0:
        raise Denied("avckpt protects containers of root's Podman: use sudo")
    missing = _missing()
    if install_hooks and any(check.name in INSTALLABLE for check in missing):
        for line in install.install():
            say(line)
        missing = _missing()
    failed = [check for check in missing if check.status is Status.FAIL]
    if failed:
        remedy = "; or have it done by avckpt up --install" if any(c.name in INSTALLABLE for c in failed) else ""
        raise ConfigError("; ".join(f"{c.name}: {c.detail} ({c.remedy})" for c in failed) + remedy)
    for check in missing:
        if check.name in INSTALLABLE:
            say(f"warning: {check.name}: {check.detail} ({check.remedy})")
    sidecar_container.ensure(run_dir, say)
    problem = Client(run_dir).info().get("config", {}).get("problem")
    if problem:
        say(f"warning: the sidecar goes by older or built-in defaults: {problem}")


def up(compose: Compose, services: Sequence[str], run_dir: Path, wait_s: float, say: Say) -> list[Protection]:
    """Brings services up (none named: all) and waits until the containers that ask for it are protected.

    Waits `wait_s` at most.  Returns how every container of these services came
    out; where nobody asks for protection, nobody is waited for.  Raises
    AvckptError when podman-compose fails; what is up stays up.
    """
    failure: AvckptError | None = None
    complaint = ""
    try:
        complaint = _up(compose, services, say)
    except AvckptError as error:
        failure = error
    started = [one for one in compose.containers() if not services or one.service in services or _runs(one)]
    if failure is not None or complaint:
        there = {one.service for one in started}
        lacking = ", ".join(name for name in services or compose.services() if name not in there)
        if failure is not None:
            reasons = [f"{one.name} {_why_not_running(one)}" for one in started if _may_be_why(one, str(failure))]
            if lacking:
                reasons.append(f"without a container: {lacking}")
            raise AvckptError("; ".join([str(failure), *reasons]))
        # Of some errors podman-compose says nothing in its status; without one there may be none on purpose (scale: 0).
        if lacking:
            raise AvckptError(f"{lacking} has no container: {complaint.removeprefix('Error: ')}")
    return wait_protected(compose, Client(run_dir), started, wait_s)


def _up(compose: Compose, services: Sequence[str], say: Say) -> str:
    before = {one.name for one in compose.containers()}
    try:
        return compose.up(services, say)
    except AvckptError:
        # Of what depends on a changed service podman-compose 1.6 removes all, and makes only what was running.
        if before <= {one.name for one in compose.containers()}:
            raise
        return compose.up(services, say)


def wait_protected(compose: Compose, client: Client, started: Sequence[Started], wait_s: float) -> list[Protection]:
    """Looks until nothing is left to wait for, or for `wait_s`.

    A first checkpoint is asked for as soon as there can be one: it does not wait for the interval.
    """
    deadline = time.monotonic() + wait_s
    asked: set[str] = set()
    while True:
        known = client.containers(memory=False) if any(c.wanted for c in started) else []
        entries = {str(entry["id"]): entry for entry in known}
        for one in entries.values():
            if one["state"] == "starting" and one["app_pid"] and one["id"] not in asked:
                asked.add(one["id"])
                _ask_for_checkpoint(client, one["id"])
        found = [judge(one, entries.get(one.id)) for one in started]
        if not any(one.may_change for one in found) or time.monotonic() > deadline:
            return found
        time.sleep(LOOK_EVERY_S)
        now = {one.id: one for one in compose.containers()}
        started = [now.get(one.id, one) for one in started]


def _ask_for_checkpoint(client: Client, container_id: str) -> None:
    try:
        client.command(container_id, Command.CHECKPOINT)
    except AvckptError as error:
        log.debug("%s: %s", container_id, error)  # the next look tells its state, with the reason


def judge(container: Started, entry: Json | None) -> Protection:
    """Is it protected, and if not, why?  `entry` is the sidecar's; None: it does not know it."""
    if not container.wanted:
        return Protection(container, False, "")
    if entry is not None and entry["state"] == "protected":
        return Protection(container, True, "")
    if not _runs(container):
        return Protection(container, False, f"it {_why_not_running(container)}")
    if entry is None and must_be_pid_1(container.command):
        why = f"its command is {container.command}, which must itself be PID 1; name its program as entrypoint"
        return Protection(container, False, why)
    if entry is None:
        why = "the sidecar does not know it; was it started without the hooks? (avckpt down, then avckpt up)"
        return Protection(container, False, why, may_change=True)
    return Protection(container, False, str(entry["reason"] or entry["state"]), may_change=True)


def _missing() -> list[Check]:
    """What `avckpt doctor` does not like; the sidecar is seen to elsewhere."""
    return [check for check in doctor.checks() if check.status is not Status.OK and check.name != "sidecar"]


def _runs(container: Started) -> bool:
    return container.status in ("running", "paused")


def _may_be_why(container: Started, failure: str) -> bool:
    """A job that is done is no reason, unless it is what was waited for."""
    if container.status in GONE and container.exit_code == 0:
        return container.name in failure
    return not _runs(container)


def _why_not_running(container: Started) -> str:
    if container.status in GONE:
        return f"has exited with status {container.exit_code} (podman logs {container.name})"
    reason = container.error or f"podman start {container.name} says why"
    return f"did not start and is {container.status}: {reason}"
