# SPDX-License-Identifier: Apache-2.0
"""Runs podman-compose, a program of its own, and bounds what it leaves unbounded.

podman-compose 1.6 waits for a dependency with `podman wait --condition=running`
and no end: one service that cannot start hangs everything that depends on it.
While that is all it does, no container will change any more: if what it waits for does not run,
it is ended.
The same goes for `--condition=healthy`, with more patience: where nobody runs
the health checks, no container ever becomes healthy.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import psutil
import yaml
from avckpt_hooks.shared.labels import LabelError, merge, parse_policy

from avckpt.cli.podman import podman
from avckpt.errors import AvckptError

STUCK_S = 5.0
"""How long podman-compose may do nothing but wait for containers to run."""
UNHEALTHY_S = 300.0
"""The same where it waits for one to become healthy."""
LOOK_EVERY_S = 0.2
QUERY_TIMEOUT_S = 60.0
PULL_S = 86400.0
"""Images of robots are large, and their networks slow: whoever has enough presses Ctrl-C."""

Say = Callable[[str], None]
"""Receives a line for the waiting user."""

_HEALTHY = "--condition=healthy"
_WAITS = {"--condition=running": "running", _HEALTHY: "healthy"}
_ONE_WORD = re.compile(r"[\w.-]+")
_NOT_THERE = ("Error: no container with name or ID", "Error: no pod with name or ID")
_OF_HOOKS = "avckpt: container "
_HOOK_FAILED = "executing [avckpt-hook "
_WARNING = re.compile(r'(?:time="[^"]*" )?(level=warning .*)')
_EXCEPTION = re.compile(r"(?:ValueError|RuntimeError): |(?=\w+(?:Error|Exception): )")
"""The first two have words for a user; others need their name."""
_TRACEBACKS = ("Traceback (most recent call last):", "During handling of the above", "The above exception was")


@dataclass(frozen=True)
class Started:
    """A container of the project, as Podman knows it."""

    id: str
    name: str
    service: str
    status: str
    """As `podman ps` has it: "running", "exited", "created", ..."""
    exit_code: int
    error: str
    """Why it could not be started; often empty, also when it could not."""
    wanted: bool
    """Its labels or annotations, the image's included, ask for protection."""
    command: str
    """Its first process: avckpt-init, where the hooks have put it in front."""


class Compose:
    """A project: files that belong together, named as podman-compose wants them."""

    def __init__(
        self, files: Sequence[Path], project: str = "", *, profiles: Sequence[str] = (), env_file: Path | None = None
    ) -> None:
        self._files = " ".join(map(str, files))
        self._command = [sys.executable, "-m", "podman_compose"]
        for path in files:
            self._command += ["-f", str(path)]
        if project:
            self._command += ["-p", project]
        for profile in profiles:
            self._command += ["--profile", profile]
        if env_file is not None:
            self._command += ["--env-file", str(env_file)]

    def up(self, services: Sequence[str], say: Say) -> str:
        """`up -d`.  What it prints goes to `say`.

        Returns the last error in it: podman-compose 1.6 ends with 0 also where Podman refuses to make a container.
        Raises AvckptError when it fails or hangs; containers may have been started all the same.
        """
        return self._run(["up", "-d", *services], say)

    def fetch_images(self, services: Sequence[str], say: Say) -> None:
        """Pulls images that are missing here.  Raises AvckptError, with service and image, when one cannot be had.

        With Podman before 5.6 podman-compose removes what runs before it looks for the new image.
        """
        defined = yaml.safe_load(self._ask([*self._command, "config"]))["services"]
        users: dict[tuple[str, bool], list[str]] = {}
        for name in _with_dependencies(services, defined) if services else defined:
            service = defined.get(name) or {}
            image = service.get("image")
            if image and "build" not in service and "platform" not in service:
                users.setdefault((str(image), service.get("pull_policy") != "never"), []).append(name)
        failures = []
        for (image, may_pull), names in users.items():
            if podman("image", "exists", image, check=False).returncode == 0:
                continue
            whose = f"service {', '.join(names)}"
            why = _pull(image, whose, say) if may_pull else "its pull_policy is never"
            if why:
                failures.append(f"{whose}: the image {image} is not here, and cannot be pulled ({why})")
        if failures:
            raise AvckptError(f"{'; '.join(failures)}: build it, or correct its name; nothing was started or stopped")

    def down(self, services: Sequence[str], volumes: bool, say: Say) -> str:
        """`down`.  Returns and raises as `up` does: it ends with 0 also where Podman refuses to remove a container."""
        return self._run(["down", *(["--volumes"] if volumes else []), *services], say)

    def services(self) -> list[str]:
        """Those that `up` would start; not those of a profile that nobody asks for.  Raises AvckptError."""
        return self._ask([*self._command, "config", "--services"]).split()

    def containers(self) -> list[Started]:
        """All containers of the project, running or not.  Raises AvckptError."""
        ids = self._ask([*self._command, "ps", "-q"]).split()
        if not ids:
            return []
        # One may be removed at this moment; the others count.
        found: list[dict[str, Any]] = json.loads(
            self._ask(["podman", "inspect", "--type", "container", *ids], lenient=True) or "[]"
        )
        return [_started(entry) for entry in found]

    def _run(self, args: list[str], say: Say) -> str:
        words = _Words(say)
        # A file, not a pipe: what a container's monitor inherits of a pipe would
        # have to be read until the container ends.
        with tempfile.NamedTemporaryFile() as written, open(written.name, errors="replace") as output:
            process = subprocess.Popen(
                [*self._command, *args], stdin=subprocess.DEVNULL, stdout=written, stderr=subprocess.STDOUT
            )
            try:
                stuck = _watch(process, lambda: words.take(output))
            finally:
                if process.poll() is None:
                    _end(process)
            words.take(output)
        command = f"podman-compose {args[0]}"
        if stuck:
            raise AvckptError(f"{command} was ended: it waited in vain for {', '.join(stuck)}")
        if process.returncode != 0:
            raise self._failed(command, words.last or f"exit status {process.returncode}")
        return words.error

    def _ask(self, command: list[str], *, lenient: bool = False) -> str:
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=QUERY_TIMEOUT_S)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise AvckptError(f"{_called(command)}: {error}") from error
        if done.returncode != 0 and not lenient:
            lines = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
            raise self._failed(_called(command), lines[-1])
        return done.stdout

    def _failed(self, command: str, why: str) -> AvckptError:
        """An exception of its own is about the files, and it does not say which."""
        exception = _EXCEPTION.match(why)
        where = f"{self._files}: " if exception else ""
        return AvckptError(f"{where}{command} failed: {why[exception.end() :] if exception else why}")


def _with_dependencies(names: Sequence[str], services: dict[str, Any]) -> list[str]:
    found: dict[str, None] = {}
    todo = list(names)
    while todo:
        name = todo.pop(0)
        if name not in found:
            found[name] = None
            todo += (services.get(name) or {}).get("depends_on") or ()
    return list(found)


def _pull(image: str, whose: str, say: Say) -> str:
    """Returns why it cannot be pulled, or ""."""
    say(f"{whose}: pulling the image {image}")
    done = podman("pull", "--quiet", image, check=False, timeout_s=PULL_S)
    if done.returncode == 0:
        return ""
    return (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1].removeprefix("Error: ")


def _called(command: Sequence[str]) -> str:
    """What a user would call it."""
    return f"podman-compose {command[-2]}" if "podman_compose" in command else " ".join(command[:2])


def _watch(process: subprocess.Popen[bytes], look: Callable[[], None]) -> list[str]:
    """Waits for podman-compose's end; the containers it hangs on if it hangs, else none."""
    waiting_since: float | None = None
    awaited: dict[str, str] = {}
    while True:
        try:
            process.wait(LOOK_EVERY_S)
            return []
        except subprocess.TimeoutExpired:
            look()
        seen = _awaited(process.pid)
        now = time.monotonic()
        if seen is None:
            waiting_since, awaited = None, {}
            continue
        awaited = seen or awaited
        waiting_since = waiting_since or now
        patience_s = UNHEALTHY_S if _HEALTHY in awaited.values() else STUCK_S
        if now - waiting_since > patience_s:
            # A Podman that is slow to answer, the machine being busy, waits for one that has been running for long.
            unmet = sorted(name for name in awaited if awaited[name] == _HEALTHY or not _runs(name))
            if unmet or not awaited:
                names = [f"{name} to become {_WAITS[awaited[name]]}" for name in unmet]
                return names or ["a container that does not exist"]
            waiting_since, awaited = None, {}


def _runs(name: str) -> bool:
    return podman("container", "inspect", "--format", "{{.State.Running}}", name, check=False).stdout.strip() == "true"


def _awaited(pid: int) -> dict[str, str] | None:
    """Containers it waits for, and for what; None: it does something else too; empty: nothing at this moment."""
    awaited: dict[str, str] = {}
    try:
        parent = psutil.Process(pid)
        own, children = parent.cmdline(), parent.children()
        # For a container that does not exist it asks each second: Podman says at once that there is none.
        if not children and parent.status() != psutil.STATUS_SLEEPING:
            return None
    except psutil.NoSuchProcess:
        return None
    for child in children:
        try:
            command = child.cmdline()
            if child.status() == psutil.STATUS_ZOMBIE or command in ([], own):  # it is ending, or starting
                continue
        except psutil.NoSuchProcess:
            continue
        condition = next((word for word in command if word in _WAITS), None)
        if condition is None or "wait" not in command:
            return None
        awaited.update(dict.fromkeys(command[command.index(condition) + 1 :], condition))
    return awaited


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ends podman-compose and the Podman commands it waits for.  Containers are nobody's children here."""
    try:
        ours = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        ours = []
    for one in ours:
        try:
            one.terminate()
        except psutil.NoSuchProcess:
            continue
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class _Words:
    """The relevant output of podman-compose.

    Left out are names and ids of what was made or removed, that something was not there to be removed, a warning
    that Podman repeats for each container, that a hook failed that has said why, and of a traceback all but its
    last line.
    """

    def __init__(self, say: Say) -> None:
        self._say = say
        self._in_traceback = False
        self._warnings: set[str] = set()
        self._refusal = ""
        """What the hooks said last of a container; Podman adds no more to it than that a hook has failed."""
        self.last = ""
        self.error = ""
        """The last line that is an error of Podman's."""

    def take(self, output: IO[str]) -> None:
        """Passes on the whole lines that have come."""
        while True:
            at = output.tell()
            line = output.readline()
            if not line.endswith("\n"):
                output.seek(at)
                return
            text = line.rstrip()
            if text.startswith(_OF_HOOKS):
                self._refusal = text.removeprefix("avckpt: ")
            if self._refusal and _HOOK_FAILED in text:
                self.last = self._refusal
                self.error = f"Error: {self._refusal}"
            elif text and not self._is_noise(text):
                self.last = text
                self.error = text if text.startswith("Error: ") else self.error
                self._say(text)

    def _is_noise(self, text: str) -> bool:
        if text.startswith(_TRACEBACKS):
            self._in_traceback = True
        elif self._in_traceback:
            self._in_traceback = text[0].isspace()
            return self._in_traceback
        warning = _WARNING.match(text)
        if warning:
            repeated = warning.group(1) in self._warnings
            self._warnings.add(warning.group(1))
            return repeated
        return self._in_traceback or _ONE_WORD.fullmatch(text) is not None or text.startswith(_NOT_THERE)


def _started(entry: dict[str, Any]) -> Started:
    config, state = entry["Config"], entry["State"]
    labels = config.get("Labels") or {}
    try:
        wanted = parse_policy(merge(labels, config.get("Annotations") or {})).enable
    except LabelError:
        wanted = True  # it does not start, and the person who wrote it meant something
    return Started(
        id=str(entry["Id"]),
        name=str(entry["Name"]),
        service=str(labels.get("io.podman.compose.service", "")),
        status=str(state["Status"]),
        exit_code=int(state["ExitCode"]),
        error=str(state.get("Error") or ""),
        wanted=wanted,
        command=str(entry.get("Path") or ""),
    )
