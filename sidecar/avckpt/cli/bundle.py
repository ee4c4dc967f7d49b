# SPDX-License-Identifier: Apache-2.0
"""`avckpt bundle`: one archive with all that is known about a container, or a crash, to find out why."""

from __future__ import annotations

import io
import json
import os
import platform
import subprocess
import tarfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from avckpt import __version__
from avckpt.cli.events import called, complete_container
from avckpt.errors import AvckptError, NoSuchContainer

if TYPE_CHECKING:
    from avckpt.cli.client import Client, Json

COMMAND_TIMEOUT_S = 30.0
LOG_LINES = 2000
MOST_BYTES = 8 << 20
"""Of what one program says; the end is what matters."""
CHUNK_BYTES = 1 << 20
CORE_MOST_BYTES = 256 << 20
AROUND_S = 600.0
"""What happened so long before and after an event may have to do with it."""
README = """What avckpt knows of {name}, {at}.

event.json        the event that was asked for, if one was
events.jsonl      what happened to it, one JSON object a line, oldest first; with an event, also to its
                  group, at that time
container.json    how it is now (avckpt ps --json)
labels.json       its avckpt.* labels
inspect.json      image, state, restarts and mounts, as Podman has them; no environment, no command
container.log     the last {lines} lines that it wrote (with an event: of that time)
journal.txt       the last {lines} lines of systemd's journal about it, where there is one (with an event: of
                  that time)
sidecar.json      the sidecar: version, configuration in force
sidecar.log       the last {lines} lines of its log (with an event: of that time)
metrics.txt       the sidecar's metrics
doctor.json       what avckpt doctor says of the machine
config.yaml       defaults for all containers, where there are any
versions.txt      kernel, Podman, runtime
core.zst          with --core: its newest core file, or that of the event (zstd -d, gdb)
missing.txt       what could not be collected, and why, if anything
"""
INSPECTED = ("Id", "Name", "Image", "ImageName", "Created", "State", "RestartCount", "Mounts")
"""What of `podman inspect` is taken: nothing that could hold a secret, as environment and command can."""


@click.command()
@click.argument("name", metavar="NAME|NUMBER", shell_complete=complete_container)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Output file; default avckpt-NAME-TIME.tar.gz here.",
)
@click.option(
    "--core",
    is_flag=True,
    help="With its newest core file (avckpt.core), or that of the event: all its memory, secrets included.",
)
def bundle(name: str, output: Path | None, core: bool) -> None:
    """Collect everything known about container NAME, or event NUMBER, in one archive.

    Events, state, labels, logs, metrics, versions and what "avckpt doctor" says; no
    environment and no command lines.  Look through it before you pass it on: logs
    contain what the container wrote.

    "avckpt events --numbers" lists the events of the last days.
    """
    from avckpt_hooks.shared import protocol

    from avckpt.cli.client import Client

    run_dir = Path(protocol.run_dir())
    client = Client(run_dir)
    rows, history = client.containers(ended=True), client.history()
    event = find_event(rows, history, name)
    container, events = find(rows, history, event["id"] if event else name)
    if event:
        events = [each for each in history if _is_around(each, event)]
    stem = f"avckpt-{_plain(container)}-{time.strftime('%Y%m%d-%H%M%S')}"
    path = output or Path(f"{stem}.tar.gz")
    try:
        # Only its owner may read it: a log may say more than others should know.
        file = open(path, "xb", opener=_open_private)  # noqa: SIM115 - if it cannot be made, it is not ours to remove
        try:
            with file:
                missing = write(file, stem, list(contents(client, container, events, event=event, core=core)))
        except BaseException:
            path.unlink(missing_ok=True)  # half an archive is none, and the next one could not have its name
            raise
    except OSError as error:
        raise AvckptError(f"{path} cannot be written", errno=error.errno or 0) from error
    for each in missing:
        click.echo(f"warning: without {each}", err=True)
    click.echo(str(path))


def find(rows: list[Json], history: list[Json], name: str) -> tuple[Json, list[Json]]:
    """The container of that name, id or beginning of an id, its last run first, and its events.

    Raises NoSuchContainer.
    """
    rows = [row for row in rows if name == row["name"] or (name and row["id"].startswith(name))]
    names = {row["id"] for row in rows}
    events = [event for event in history if event["id"] in names or name == event["container"]]
    if not rows and not events:
        raise NoSuchContainer(f"nothing is known of a container or an event {name!r}")
    if rows:
        return max(rows, key=lambda row: row["registered_at"]), events
    return {"name": events[-1]["container"], "id": events[-1]["id"], "state": "ended"}, events


def find_event(rows: list[Json], history: list[Json], number: str) -> Json:
    """The event of that number; empty when it is no number, or a container is called so.

    Raises NoSuchContainer when it is not about one.
    """
    if not number.isdecimal() or any(number == row["name"] for row in rows):
        return {}
    event: Json = next((each for each in history if each["seq"] == int(number)), {})
    if event and not event["id"]:
        raise NoSuchContainer(f"event {number} is not about a container: {event['message']}")
    return event


def _is_around(other: Json, event: Json) -> bool:
    ours = other["id"] == event["id"] or (event["group"] and other["group"] == event["group"])
    return bool(ours or not other["id"]) and abs(other["at"] - event["at"]) <= AROUND_S


def contents(
    client: Client, container: Json, events: list[Json], *, event: Json, core: bool = False
) -> Iterator[tuple[str, Callable[[], str | bytes]]]:
    """Names of the files, and how to get what is in them; this may raise AvckptError or OSError."""
    from avckpt.cli import doctor, sidecar_container
    from avckpt.events import system_journal

    at = time.strftime("%Y-%m-%d %H:%M:%S %Z")
    yield "README.txt", lambda: README.format(name=called(container), at=at, lines=LOG_LINES)
    if event:
        yield "event.json", lambda: _pretty(event)
    yield "events.jsonl", lambda: "".join(json.dumps(event) + "\n" for event in events)
    yield "container.json", lambda: _pretty(container)
    inspected: list[Json] = []
    whose = container.get("node_of") or container["id"]  # a node's container is what Podman knows
    logs = ["podman", "logs", "--tail", str(LOG_LINES)]
    journal = ["journalctl", "--no-pager", "--quiet", "--output", "short-iso-precise"]
    if event:
        begin, end = event["at"] - AROUND_S, event["at"] + AROUND_S
        logs = ["podman", "logs", "--since", _rfc3339(begin), "--until", _rfc3339(end)]
        journal += ["--since", f"@{begin:.0f}", "--until", f"@{end:.0f}"]
    else:
        journal += ["--lines", str(LOG_LINES)]

    def inspect() -> str:
        inspected.extend(json.loads(_program("podman", "container", "inspect", whose)))
        return _pretty({key: inspected[0].get(key) for key in INSPECTED})

    def labels() -> str:
        if not inspected:
            raise AvckptError("Podman does not know it (any more)")
        labels = inspected[0]["Config"]["Labels"] or {}
        return _pretty({key: value for key, value in labels.items() if key.startswith("avckpt.")})

    if whose != "host":
        yield "inspect.json", inspect
        yield "labels.json", labels
        yield "container.log", lambda: _program(*logs, whose)
    if system_journal.SOCKET.exists():
        yield "journal.txt", lambda: _program(*journal, f"CONTAINER_NAME={called(container)}")
    yield "sidecar.json", lambda: _pretty(client.info())
    yield "sidecar.log", lambda: _program(*logs, sidecar_container.NAME)
    yield "metrics.txt", client.metrics
    yield "doctor.json", lambda: _pretty([asdict(check) for check in doctor.checks()])
    yield "config.yaml", lambda: _config(client)
    yield "versions.txt", versions
    if core:
        yield "core.zst", lambda: _core(events, event)


def _config(client: Client) -> str:
    """Raises AvckptError when there is none."""
    path = Path(client.info()["config"]["path"])
    if not path.exists():
        raise AvckptError(f"there is no {path}, the built-in defaults hold")
    return _tail(path.read_bytes())


def _core(events: list[Json], event: Json) -> bytes:
    """That of the event, or the newest that is still there.

    Raises AvckptError when there is none, or it is too large to send on.
    """
    numbers = {event.get("seq"), event.get("crash_seq")} - {None}
    wanted = [each for each in events if not numbers or numbers & {each["seq"], each.get("crash_seq")}]
    paths = [Path(each["core"]) for each in wanted if "core" in each]
    for path in reversed(paths):
        if path.is_file():
            if path.stat().st_size > CORE_MOST_BYTES:
                raise AvckptError(f"{path} is too large, send it by itself")
            return path.read_bytes()
    raise AvckptError("there is none: avckpt.core=mini or on makes one of each crash that is undone")


def write(file: io.BufferedIOBase, folder: str, files: list[tuple[str, Callable[[], str | bytes]]]) -> list[str]:
    """Writes the archive; returns what could not be had, with the reasons, which missing.txt has, too."""
    missing = []
    with tarfile.open(fileobj=file, mode="w:gz") as archive:

        def add(name: str, said: str | bytes) -> None:
            data = said.encode("utf-8", "backslashreplace") if isinstance(said, str) else said
            entry = tarfile.TarInfo(f"{folder}/{name}")
            entry.size, entry.mtime, entry.mode = len(data), int(time.time()), 0o600
            archive.addfile(entry, io.BytesIO(data))

        for name, get in files:
            try:
                add(name, get())
            except (AvckptError, OSError, ValueError) as error:
                missing.append(f"{name}: {error}")
        if missing:
            add("missing.txt", "".join(f"{each}\n" for each in missing))
    return missing


def versions() -> str:
    """Of all that takes part."""
    lines = [f"avckpt {__version__}", f"{platform.system()} {platform.release()} {platform.machine()}"]
    for program in ("podman", "crun", "runc", "conmon"):
        try:
            lines.append(_program(program, "--version").partition("\n")[0])
        except AvckptError as error:
            lines.append(f"{program}: {error}")
    return "\n".join(lines) + "\n"


def _program(*argv: str) -> str:
    """What a program says on both of its outputs; the end of it, as a container may have written gigabytes.

    Raises AvckptError when it fails.
    """
    try:
        process = subprocess.Popen(
            argv, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, bufsize=0
        )
    except FileNotFoundError:
        raise AvckptError(f"there is no {argv[0]}") from None
    except OSError as error:
        raise AvckptError(f"{argv[0]}: {error}") from error
    end = bytearray()
    with process:
        assert process.stdout is not None
        over = threading.Timer(COMMAND_TIMEOUT_S, process.kill)
        over.start()
        try:
            while chunk := process.stdout.read(CHUNK_BYTES):
                end += chunk
                if len(end) > 2 * MOST_BYTES:
                    del end[:-MOST_BYTES]
        finally:
            late = not over.is_alive()
            over.cancel()
    said = _tail(end)
    if late:
        raise AvckptError(f"{argv[0]} took more than {COMMAND_TIMEOUT_S:.0f} s")
    if process.returncode != 0:
        raise AvckptError(said.strip().rpartition("\n")[2] or f"{argv[0]} ended with status {process.returncode}")
    return said


def _rfc3339(at: float) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(at))


def _tail(data: bytes | bytearray) -> str:
    return data[-MOST_BYTES:].decode("utf-8", "replace")


def _pretty(data: object) -> str:
    return json.dumps(data, indent=2, default=str) + "\n"


def _plain(container: Json) -> str:
    """Its name, usable in a file name."""
    return "".join(each if each.isalnum() or each in "-_." else "_" for each in called(container))


def _open_private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
