# SPDX-License-Identifier: Apache-2.0
"""The commands `avckpt check`, `avckpt up` and `avckpt down`."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from avckpt_hooks.shared.tell import printable

from avckpt.errors import AvckptError, ConfigError, Denied, ExitCode

if TYPE_CHECKING:
    from avckpt.cli.compose.manifest import Manifest
    from avckpt.cli.compose.podman_compose import Compose
    from avckpt.cli.compose.vehicle import Protection

FILE = click.Path(readable=False, path_type=Path)
"""Whoever reads it says why that cannot be done: no wrong usage, but a wrong file."""

files_option = click.option(
    *("-f", "--file", "files"),
    multiple=True,
    type=FILE,
    help="Compose file; default vehicle.yaml, or those that podman-compose reads.",
)
project_option = click.option("-p", "--project-name", "project", default="", help="As for podman-compose.")
profiles_option = click.option("--profile", "profiles", multiple=True, help="Also the services of this profile.")
env_file_option = click.option(
    "--env-file",
    type=click.Path(exists=True, dir_okay=False, resolve_path=True, path_type=Path),
    help="As for podman-compose; default .env.",
)


@click.command()
@click.argument("files", nargs=-1, type=FILE, metavar="[FILE...]")
@click.option("-f", "--file", "more", multiple=True, type=FILE, help="As for avckpt up.")
@click.option("--config", "is_config", is_flag=True, help="The sidecar's; default /etc/avckpt/config.yaml.")
@click.option("--json", "as_json", is_flag=True, help="A JSON object instead of text.")
def check(files: tuple[Path, ...], more: tuple[Path, ...], is_config: bool, as_json: bool) -> None:
    """Check every avckpt.* label and annotation of Compose files, or of Kubernetes' YAML.

    Without FILE, those of COMPOSE_FILE, or vehicle.yaml of this folder, or all
    that podman-compose reads: compose.yaml, compose.override.yaml and so on.
    Several files are one manifest, later ones over earlier ones.  Prints "FILE:LINE: service NAME:
    what is wrong" and ends with 1 if anything is wrong, with 0 if there are only
    warnings or nothing.
    """
    files = (*more, *files)
    sys.exit(check_config(files, as_json) if is_config else check_manifest(files, as_json))


@click.command()
@files_option
@project_option
@profiles_option
@env_file_option
@click.option("--install", "install_hooks", is_flag=True, help="Install the hooks if they are missing.")
@click.option("--wait", "wait_s", type=click.FloatRange(min=0), default=30.0, show_default=True, help="Seconds.")
@click.option("--json", "as_json", is_flag=True, help="The containers as JSON.")
@click.argument("services", nargs=-1)
def up(
    *,
    files: tuple[Path, ...],
    project: str,
    profiles: tuple[str, ...],
    env_file: Path | None,
    install_hooks: bool,
    wait_s: float,
    as_json: bool,
    services: tuple[str, ...],
) -> None:
    """Bring up the services of Compose files and wait until they are protected.

    Checks the files as "avckpt check" does, prepares hooks and sidecar, then runs
    podman-compose.  Ends with 5 if a container that asks for protection
    has none after --wait seconds.
    """
    from avckpt_hooks.shared import protocol

    from avckpt.cli.compose import manifest, vehicle
    from avckpt.cli.compose.podman_compose import Compose

    run_dir = Path(protocol.run_dir())
    paths = _compose_files(files, services)
    found = manifest.check(paths)
    print_problems(found, err=True)
    if found.errors:
        sys.exit(ExitCode.FAILED)
    _expect(found, services)
    compose = Compose(paths, project, profiles=profiles, env_file=env_file)
    passed_over = _passed_over(found, services, compose)
    if services and passed_over:
        raise ConfigError("; ".join(passed_over))
    for line in passed_over:
        _say(line)
    if found.wants_protection:
        vehicle.prepare(run_dir, install_hooks=install_hooks, say=_say)
    compose.fetch_images(services, _say)
    try:
        came_out = vehicle.up(compose, services, run_dir, wait_s, _say)
    except KeyboardInterrupt:
        _say("what was started stays: avckpt up continues, avckpt down removes it")
        raise
    others = sorted(one.container.name for one in came_out if one.container.service not in found.services)
    if others:
        _say(f"{', '.join(others)}: of another manifest of this project, or of a service that was removed; stays")
    if as_json:
        click.echo(json.dumps([one.to_json() for one in came_out], indent=2))
    else:
        _print_protection(came_out)
    if any(one.container.wanted and not one.protected for one in came_out):
        sys.exit(ExitCode.UNPROTECTED)


@click.command()
@files_option
@project_option
@profiles_option
@env_file_option
@click.option("-v", "--volumes", is_flag=True, help="Also remove the project's volumes.")
@click.option("--json", "as_json", is_flag=True, help="The removed containers as JSON.")
@click.argument("services", nargs=-1)
def down(
    *,
    files: tuple[Path, ...],
    project: str,
    profiles: tuple[str, ...],
    env_file: Path | None,
    volumes: bool,
    as_json: bool,
    services: tuple[str, ...],
) -> None:
    """Stop and remove what "avckpt up" brought up.  Hooks and sidecar stay."""
    from avckpt import yamlfile
    from avckpt.cli.compose import manifest
    from avckpt.cli.compose.podman_compose import Compose

    paths = _compose_files(files, services)
    for path in paths:
        try:
            yamlfile.read(path)
        except yamlfile.Unreadable as error:
            raise ConfigError(str(error)) from error
    found = manifest.check(paths)  # for its services: wrong labels keep nobody from stopping what runs
    if not found.services and found.problems:
        raise ConfigError(str(found.problems[0]))
    _expect(found, services)
    if found.wants_protection and os.geteuid() != 0:
        raise Denied("protected containers are those of root's Podman: use sudo")
    compose = Compose(paths, project, profiles=profiles, env_file=env_file)
    before = compose.containers() if as_json else []
    complaint = compose.down(services, volumes, _say)
    staying = compose.containers() if as_json or not services or complaint else []
    if staying and complaint:
        meant = services or compose.services()
        names = ", ".join(sorted(one.name for one in staying if one.service in meant))
        if names:
            raise AvckptError(f"{names} not removed: {complaint.removeprefix('Error: ')}")
    if staying and not services:
        names = ", ".join(sorted(one.name for one in staying))
        _say(f"{names}: of another manifest of this project; stays, with the project's pod and networks")
    if as_json:
        left = {one.id for one in staying}
        gone = [{"service": one.service, "name": one.name, "id": one.id} for one in before if one.id not in left]
        click.echo(json.dumps(gone, indent=2))


def check_manifest(files: Sequence[Path], as_json: bool) -> ExitCode:
    """Checks files that belong together.  Raises ConfigError when none is named and none is here, or both kinds."""
    from avckpt.cli.compose import manifest, pods

    paths = manifest.files_meant(files, os.environ)
    of_pods = [path for path in paths if pods.is_pods(path)]
    others = [path for path in paths if path not in of_pods]
    if of_pods and others:
        raise ConfigError(f"{of_pods[0]} is for Kubernetes, and {others[0]} is not: check them one after the other")
    found = pods.check(paths) if of_pods else manifest.check(paths)
    if as_json:
        click.echo(json.dumps(found.to_json(), indent=2))
    else:
        print_problems(found)
        click.echo(summary(found))
    return ExitCode.FAILED if found.errors else ExitCode.OK


def check_config(files: Sequence[Path], as_json: bool) -> ExitCode:
    """Checks the sidecar's configuration files, each by itself.  Raises ConfigError when a named one is not there."""
    from avckpt import config

    for path in files:
        if not path.exists():
            raise ConfigError(f"{path}: no such file")
    paths = files or [config.default_path()]
    problems = [problem for path in paths for problem in config.examine(path)[1]]
    if as_json:
        listed = [{"file": p.place.file, "line": p.place.line, "message": p.message} for p in problems]
        click.echo(json.dumps({"problems": listed}, indent=2))
    else:
        for problem in problems:
            click.echo(f"{click.style(printable(str(problem.place)), fg='red')}: {printable(problem.message)}")
        absent = [f"no {path}: the built-in defaults hold" for path in paths if not os.path.exists(path)]
        click.echo(_count(len(problems), "problem") if problems else "\n".join(absent or ["no problems"]))
    return ExitCode.FAILED if problems else ExitCode.OK


def print_problems(found: Manifest, err: bool = False) -> None:
    """A line for each."""
    for problem in found.problems:
        colour = "red" if problem in found.errors else "yellow"
        place = str(problem.place)
        click.echo(click.style(printable(place), fg=colour) + printable(str(problem)[len(place) :]), err=err)


def summary(found: Manifest) -> str:
    """One line: who is to be protected, and whether anything is wrong."""
    wanted = [
        service.name + (f" (profile {'/'.join(service.profiles)})" if service.profiles else "")
        for service in found.services.values()
        if service.enabled
    ]
    open_ones = [service.name for service in found.services.values() if service.enabled is None]
    text = f"{_count(len(found.services), 'service')}, to be protected: {', '.join(wanted) or 'none'}"
    if open_ones:
        text += f"; depends on the environment: {', '.join(open_ones)}"
    problems = len(found.problems) - len(found.errors)
    counts = [_count(n, what) for n, what in ((len(found.errors), "problem"), (problems, "warning")) if n]
    return printable(f"{text}; {' and '.join(counts) or 'no problems'}")


def _compose_files(files: Sequence[Path], services: Sequence[str]) -> tuple[Path, ...]:
    """Those that are meant.  Raises ConfigError when there is none, or one of Kubernetes."""
    from avckpt.cli.compose import manifest, pods

    try:
        paths = manifest.files_meant(files, os.environ)
    except ConfigError as error:
        raise ConfigError(f"{error}{_file_hint(services)}") from None
    for path in paths:
        # podman-compose opens them once more, with a standard input of its own.
        if path.is_fifo() or str(path).startswith(("/dev/", "/proc/")):
            raise ConfigError(f"{path} can be read once only, and podman-compose reads it again: write it to a file")
        if pods.is_pods(path):
            raise ConfigError(f"{path} is for Kubernetes: use podman kube play {path} (and podman kube down)")
    return paths


def _expect(found: Manifest, services: Sequence[str]) -> None:
    """Raises ConfigError for services that are not in the files."""
    unknown = [name for name in services if name not in found.services]
    if unknown:
        there = ", ".join(sorted(found.services))
        raise ConfigError(f"no such service: {', '.join(unknown)}; there are {there}{_file_hint(unknown)}")


def _file_hint(services: Sequence[str]) -> str:
    """For whoever names a file as other commands take it."""
    return next((f"; a file is named with -f {name}" for name in services if os.path.isfile(name)), "")


def _passed_over(found: Manifest, named: Sequence[str], compose: Compose) -> list[str]:
    """A line for each service whose profile nobody asks for: of those named, or else of those to be protected."""
    meant = [one for one in found.services.values() if (one.name in named if named else one.enabled)]
    if not any(one.profiles for one in meant):
        return []
    # The environment may ask for it, too.
    there = compose.services()
    return [
        f"service {one.name} is not started: that takes --profile {' or '.join(one.profiles)}"
        for one in meant
        if one.profiles and one.name not in there
    ]


def _say(line: str) -> None:
    """Progress; standard output is for the outcome."""
    click.echo(line, err=True)


def _print_protection(came_out: Sequence[Protection]) -> None:
    width = max((len(one.container.name) for one in came_out), default=0)
    for one in came_out:
        colour = "green" if one.protected else "red" if one.container.wanted else None
        line = f"{one.container.name:<{width}}  {click.style(one.state, fg=colour)}"
        click.echo(f"{line}: {one.why}" if one.why else line)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"
