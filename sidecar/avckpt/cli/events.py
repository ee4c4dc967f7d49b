# SPDX-License-Identifier: Apache-2.0
"""The commands `avckpt events` and `avckpt completion`."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from avckpt.errors import AvckptError, NoSuchContainer, SidecarUnreachable
from avckpt.events.vocabulary import Kind

if TYPE_CHECKING:
    from avckpt.cli.client import Client, Json

RETRY_S = 1.0
"""How often somebody who follows looks whether the sidecar is back."""

UNGUARDED = ("listening", "nodes")
"""States of those that have no generations of their own, and lack none (State.guarded)."""

COLOURS = {
    "restored": "yellow",
    "gave_up": "red",
    "unprotected": "red",
    "guard_lost": "red",
    "notify_failed": "red",
    "refused": "red",
    "checkpoint": "green",
    "sidecar_stopped": "red",
}

_UNITS_S = {"s": 1, "m": 60, "h": 3600, "d": 86400}


class Instant(click.ParamType):  # type: ignore[type-arg] # generic only in newer releases of click
    """A time of day: so long ago, or when."""

    name = "TIME"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """To seconds since 1970."""
        if isinstance(value, float):
            return value
        if re.fullmatch(r"(\d+(\.\d+)?[smhd])+", value, re.ASCII):
            parts = re.findall(r"([\d.]+)([smhd])", value)
            # Longer ago than anything: all there is.
            return max(time.time() - sum(float(number) * _UNITS_S[unit] for number, unit in parts), 0.0)
        try:
            return datetime.fromisoformat(value).timestamp()
        except (ValueError, OverflowError):
            self.fail(f"{value!r} is neither a time ago (30s, 10m, 2h30m, 1d) nor a date and time (2026-05-17T08:30)")


def called(container: Json) -> str:
    """How to call a container in what a person reads: its name, or the short id."""
    return str(container["name"] or container["id"][:12])


def complete_container(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Names of protected containers; none when there is no sidecar to ask."""
    try:
        names = [called(row) for row in _client().containers(memory=False)]
    except AvckptError:
        return []
    return [name for name in names if name.startswith(incomplete)]


@click.command()
@click.argument("name", required=False, shell_complete=complete_container)
@click.option("-f", "--follow", is_flag=True, help="Keep printing new events, also over a restart of the sidecar.")
@click.option("--since", type=Instant(), help="Only events since then: 10m (ago), or 2026-05-17T08:30.")
@click.option("-a", "--all", "routine", is_flag=True, help="With --follow: also every single checkpoint.")
@click.option(
    "-k", "--kind", "kinds", multiple=True, type=click.Choice([kind.value for kind in Kind]), help="Only this kind."
)
@click.option("-n", "--numbers", "form", flag_value="numbers", help="With the number of each, for avckpt bundle.")
@click.option("--json", "form", flag_value="json", help="JSON lines, one for each event.")
def events(
    name: str | None, follow: bool, since: float | None, routine: bool, kinds: tuple[str, ...], form: str | None
) -> None:
    """Show what happened: crashes, restores, what is unprotected and why.

    With NAME (a name, an id or the beginning of one) only for that container.
    The sidecar keeps the last 1000 events, also over its own restart.
    """
    if routine and not follow:
        raise click.UsageError("--all needs --follow: single checkpoints are told of when they are taken, and not kept")
    client = _client()
    try:
        for event in _followed(client, since, routine) if follow else _kept(client, name, since):
            if (name is None or _is_of(event, name)) and (not kinds or event["kind"] in kinds):
                number = f"{event['seq'] or '-':<10}  " if form == "numbers" else ""
                click.echo(json.dumps(event) if form == "json" else number + _line(event))
                sys.stdout.flush()
    except KeyboardInterrupt:
        return  # the usual way to have enough


def _is_of(event: Json, name: str) -> bool:
    return name == event["container"] or (bool(name) and event["id"].startswith(name))


def _kept(client: Client, name: str | None, since: float | None) -> list[Json]:
    """What the sidecar has kept.  Raises NoSuchContainer when it never heard of that one."""
    kept = client.history(since)
    if name is not None and not any(_is_of(event, name) for event in kept):
        known = client.containers(ended=True, memory=False)
        if not any(_is_of({"container": row["name"], "id": row["id"]}, name) for row in known):
            raise NoSuchContainer(f"no event is kept of a container {name!r}, and none is called so now")
    return kept


def _followed(client: Client, since: float | None, routine: bool) -> Iterator[Json]:
    """Events for ever.  Raises SidecarUnreachable when there is no sidecar; one that goes away is waited for."""
    client.info()
    after: int | None = None
    while True:
        try:
            for event in client.events(after, since, routine=routine):
                after = event["seq"] or after
                yield event
            problem = "the sidecar was stopped"
        except SidecarUnreachable as error:
            problem = str(error)
        click.echo(f"avckpt: {problem}; waiting for the next one", err=True)
        _wait(client)


def _wait(client: Client) -> None:
    """Returns when a sidecar answers."""
    while True:
        time.sleep(RETRY_S)
        try:
            client.info()
        except SidecarUnreachable:
            continue
        return


def _line(event: Json) -> str:
    at = datetime.fromtimestamp(event["at"]).isoformat(" ", "milliseconds")
    whose = f"{event['container']}: " if event["container"] else ""
    return f"{at}  {whose}{click.style(event['message'], fg=COLOURS.get(event['kind']))}"


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print a script that completes avckpt's commands in a shell.

    \b
    bash:  avckpt completion bash > /etc/bash_completion.d/avckpt
    zsh:   avckpt completion zsh > "${fpath[1]}/_avckpt"
    fish:  avckpt completion fish > ~/.config/fish/completions/avckpt.fish
    """
    from click.shell_completion import get_completion_class

    found = get_completion_class(shell)
    root = click.get_current_context().find_root().command
    assert found is not None
    click.echo(found(root, {}, "avckpt", "_AVCKPT_COMPLETE").source())


def _client() -> Client:
    from avckpt_hooks.shared import protocol

    from avckpt.cli.client import Client

    return Client(Path(protocol.run_dir()))
