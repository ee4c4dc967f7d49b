# SPDX-License-Identifier: Apache-2.0
"""The command `avckpt inspect`."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from avckpt.cli.events import UNGUARDED, called, complete_container

if TYPE_CHECKING:
    from avckpt.cli.client import Json

CRASHES_SHOWN = 5


@click.command()
@click.argument("name", shell_complete=complete_container)
@click.option("--json", "as_json", is_flag=True, help="The answer as JSON.")
def inspect(name: str, as_json: bool) -> None:
    """Show everything known about container NAME: state, generations, settings, last crashes."""
    from avckpt_hooks.shared import protocol

    from avckpt.cli.client import Client

    known = Client(Path(protocol.run_dir())).inspect(name)
    click.echo(json.dumps(known, indent=2) if as_json else "\n".join(_lines(known)))


def _lines(known: Json) -> list[str]:
    container = known["container"]
    lines = [
        f"{called(container)} ({container['id'][:12]}): {container['state']}"
        f"{': ' + container['reason'] if container['reason'] else ''}"
    ]
    if container["state"] not in UNGUARDED:
        lines += _guarded(known)
    lines.append("settings: " + ", ".join(f"{key}={value}" for key, value in known["settings"].items() if value))
    crashes = known["crashes"][-CRASHES_SHOWN:]
    lines.append(f"crashes: {len(known['crashes'])} in the history{', the last:' if crashes else ''}")
    for event in crashes:
        lines.append(f"  {datetime.fromtimestamp(event['at']).isoformat(' ', 'milliseconds')}  {event['message']}")
    return lines


def _guarded(known: Json) -> list[str]:
    """What only those have that are checkpointed themselves."""
    container = known["container"]
    lines = [
        f"application {container['app_pid']} (inside {container['app_pid_inside']}), guard {container['guard_pid']}, "
        f"{container['checkpoints']} checkpoint(s), {container['missed']} missed, {container['restores']} restore(s)",
        "generations:" if known["generations"] else "generations: none is held",
    ]
    for each in known["generations"]:
        crashes = f", {each['crashes']} crash(es)" if each["crashes"] else ""
        lines.append(
            f"  {each['generation']}: {each['age_s']:.2f} s old, {each['threads']} thread(s), "
            f"frozen {each['freeze_s'] * 1000:.2f} ms{crashes}"
        )
    return lines
