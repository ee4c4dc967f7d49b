# SPDX-License-Identifier: Apache-2.0
"""The command `avckpt`.

Every command imports what it needs when it runs: `avckpt run` and `avckpt ps`
should start at once.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click
from avckpt_hooks.shared.tell import printable

from avckpt import __version__
from avckpt.cli.bundle import bundle
from avckpt.cli.compose.commands import check, down, up
from avckpt.cli.events import UNGUARDED, called, complete_container, completion, events
from avckpt.cli.inspect import inspect
from avckpt.cli.web import web
from avckpt.errors import AvckptError, ExitCode

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

    from avckpt.cli.client import Client, Json

EPILOG = """
Exit status: 0 done, 1 failed, 2 wrong usage, 3 the sidecar cannot be reached,
4 no such container, 5 the container is unprotected or has nothing to restore.
"avckpt run" ends with its program's status, 128+N if signal N killed it, 127 if
there is no such program, 126 if it cannot be executed, 125 if avckpt failed.
"""


START_AGAIN_S = 3.0
"""How long a sidecar that could not start waits before it ends, in a container."""
STATE_STYLES = {"protected": "green", "starting": "yellow", "restoring": "yellow", "unprotected": "bold red"}


class Cli(click.Group):
    """Turns our errors, and an output that cannot be written, into one line on stderr and the exit status that fits."""

    def main(self, *args: Any, **more: Any) -> Any:
        """Runs the command line."""
        _keep_standard_numbers()
        if sys.stdout is None:  # the caller has closed it
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        if sys.__stderr__ is not None and sys.stderr is sys.__stderr__:
            sys.stderr = _unfailing(sys.__stderr__)
        try:
            return super().main(*args, **more)
        except OSError as error:
            what = "the output cannot be written" if error.filename is None else printable(str(error.filename))
            click.echo(f"avckpt: {what}: {error.strerror or error}", err=True)
            with contextlib.suppress(OSError):  # Python would try once more to write what is left
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(int(ExitCode.FAILED))

    def make_context(self, *args: Any, **more: Any) -> click.Context:
        """Reads the arguments, and carries out --help and --version."""
        with _reported():
            return super().make_context(*args, **more)

    def invoke(self, ctx: click.Context) -> Any:
        """Runs the command."""
        with _reported():
            return super().invoke(ctx)


@contextlib.contextmanager
def _reported() -> Iterator[None]:
    try:
        yield
    except AvckptError as error:
        click.echo(f"avckpt: {printable(str(error))}", err=True)
        sys.exit(int(error.exit_code))
    except KeyboardInterrupt:
        click.echo("avckpt: interrupted", err=True)
        _end_by(signal.SIGINT)
    except BrokenPipeError:  # a reader such as head(1) has enough
        _end_by(signal.SIGPIPE)


class _Unfailing(io.FileIO):
    """A file that takes all that is written, also what is lost."""

    def write(self, data: ReadableBuffer) -> int:
        """Writes what can be."""
        try:
            return super().write(data) or len(bytes(data))
        except OSError:
            return len(bytes(data))


def _unfailing(stderr: TextIO) -> TextIO:
    """The same, where a message that cannot be written (a full disk) stops nothing, and leaves the status alone."""
    raw = _Unfailing(stderr.fileno(), "w", closefd=False)
    return io.TextIOWrapper(io.BufferedWriter(raw), stderr.encoding, stderr.errors, line_buffering=True)


def _keep_standard_numbers() -> None:
    """What we open gets no number of a standard descriptor that the caller has closed: messages would go there.

    What we execute has it closed, as the caller wanted it.
    """
    with contextlib.suppress(OSError):
        while (fd := os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)) <= 2:
            pass
        os.close(fd)


def _end_by(signum: signal.Signals) -> None:
    """Ends this process as a program ends that leaves the signal alone: shells then know why."""
    signal.signal(signum, signal.SIG_DFL)
    os.kill(os.getpid(), signum)


@click.group(cls=Cli, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=lambda *a: _print_version(*a),
    help="Version and build.",
)
def main() -> None:
    """Keeps Podman containers alive through crashes.

    A container started with --label avckpt.enable=true is checkpointed in
    memory every few seconds; when its application dies, the checkpoint takes
    over within milliseconds.
    """


main.add_command(events)
main.add_command(completion)
main.add_command(inspect)
for command in (check, up, down, web, bundle):
    main.add_command(command)


def _print_version(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    from avckpt import artifacts

    if wanted and not ctx.resilient_parsing:
        try:
            build = artifacts.build_id()
        except (AvckptError, OSError):
            build = "unknown"  # a checkout that is not compiled
        click.echo(f"avckpt {__version__} (build {build})")
        ctx.exit()


root_option = click.option(
    "--root",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default="/",
    help="Root of the host's file system; for use in a container.",
)


@main.command()
@root_option
@click.option("--sidecar", is_flag=True, help="Also build the sidecar's image, and start it.")
@click.option(
    "--archive",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="With --sidecar: load the image from this file (podman save).",
)
@click.option("--base", default="", metavar="IMAGE", help="With --sidecar: the Debian or Ubuntu image to build from.")
@click.option("--quadlet", is_flag=True, help="Also install a systemd unit for the sidecar's container.")
@click.option("--json", "as_json", is_flag=True, help="A JSON list of what was done.")
def install(*, root: Path, sidecar: bool, archive: Path | None, base: str, quadlet: bool, as_json: bool) -> None:
    """Put hooks and avckpt-init in place on this host.

    With --sidecar, all that protection needs is set up: the sidecar's image is
    built from this installation (which needs no checkout) or loaded, and its
    container is started, or replaced if it is of another build.
    """
    from avckpt.cli import install as installer

    if (archive or base) and not sidecar:
        raise click.UsageError("--archive and --base say how --sidecar gets its image")
    if sidecar and root != Path("/"):
        raise click.UsageError("--sidecar is for this host, and --root names another one's file system")
    lines = installer.install(root, quadlet=quadlet)
    if sidecar:
        from avckpt.cli import sidecar_image

        if not as_json:  # what is done is done, also if the next step fails
            _print_lines(lines, as_json)
            lines = []
        image = (
            sidecar_image.load(archive)
            if archive
            else sidecar_image.build(base, lambda line: click.echo(line, err=True))
        )
        lines += [image, *sidecar_image.start(_run_dir(), by_quadlet=quadlet)]
    _print_lines(lines, as_json)


@main.command()
@root_option
@click.option("--json", "as_json", is_flag=True, help="A JSON list of what was done.")
def uninstall(root: Path, as_json: bool) -> None:
    """Remove exactly what "avckpt install" put in place."""
    from avckpt.cli import install as installer
    from avckpt.cli import sidecar_container
    from avckpt.cli.client import SERVICE, is_service

    lines = installer.uninstall(root)
    if root == Path("/") and sidecar_container.answers(_client()):
        how = f"systemctl disable --now {SERVICE}" if is_service() else f"podman rm -f {sidecar_container.NAME}"
        lines.append(f"left the sidecar, which runs: {how}")
    _print_lines(lines, as_json)


@main.command()
@click.option("-v", "--verbose", is_flag=True, help="Also log every checkpoint.")
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    envvar="AVCKPT_CONFIG",
    default="/etc/avckpt/config.yaml",
    show_default=True,
    help="Defaults for all containers.",
)
@click.option(
    "--watchdog",
    is_flag=True,
    default="container" in os.environ,  # podman-run(1)
    help="Kill a daemon that hangs, and start another; always on in the sidecar's container.",
)
def sidecar(verbose: bool, config: Path, watchdog: bool) -> None:
    """Run the sidecar's daemon in the foreground (in its container, or as a service)."""
    starting = _say_that_it_starts()  # noqa: F841 - open, and locked, as long as this process lives
    import logging

    from avckpt.messages import Messages

    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(message)s",
        handlers=[logging.StreamHandler(Messages(2))],
    )
    logging.getLogger("asyncio").setLevel(logging.WARNING)
    if not watchdog:
        sys.exit(_serve(config, -1))
    from avckpt.supervision.watchdog import keep_alive

    status = keep_alive(lambda beat_fd: _serve(config, beat_fd))
    if status == ExitCode.FAILED:
        # Podman starts its container again at once, for ever (--restart=always).
        time.sleep(START_AGAIN_S)
    sys.exit(status)


def _say_that_it_starts() -> int:
    """Locks `starting_lock()`, shared: whoever starts a container now waits a moment for this sidecar.

    Without that folder, which Podman mounts, there is nobody to wait.  Returns the descriptor, or -1.
    """
    import fcntl

    from avckpt_hooks.shared import protocol

    try:
        flags = os.O_RDONLY | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW
        fd = os.open(protocol.starting_lock(), flags, 0o600)
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return -1
    return fd


def _serve(config: Path, beat_fd: int) -> int:
    try:
        from avckpt.serve import serve

        serve(_run_dir(), config, beat_fd)
    except AvckptError as error:
        click.echo(f"avckpt: {error}", err=True)
        return int(ExitCode.FAILED)
    return int(ExitCode.OK)


@main.command()
@click.option("-a", "--all", "ended", is_flag=True, help="Also the last few ended ones.")
@click.option("--json", "as_json", is_flag=True, help="A JSON list instead of a table.")
def ps(ended: bool, as_json: bool) -> None:
    """List protected containers: state, generations, last freeze, restores."""
    containers = _client().containers(ended=ended)
    if as_json:
        click.echo(json.dumps(containers, indent=2))
        return
    _print_table(containers)


@main.command()
def top() -> None:
    """Watch all protected containers live; "?" lists the keys."""
    from avckpt.cli.top import Top

    client = _client()
    client.info()
    # The screen is drawn on standard error, and a terminal without a name is as good as none.
    if not all(map(os.isatty, range(3))) or os.environ.get("TERM", "") in ("", "dumb"):
        raise click.UsageError("it needs a terminal; avckpt ps and avckpt events write to a pipe")
    app = Top(client)
    app.run()
    sys.exit(app.return_code)


@main.command()
@click.argument("name", shell_complete=complete_container)
@click.option("--json", "as_json", is_flag=True, help="The answer as JSON.")
def checkpoint(name: str, as_json: bool) -> None:
    """Take a checkpoint of container NAME now."""
    from avckpt.guard import Command

    answer = _client().command(name, Command.CHECKPOINT)
    event = answer["event"]
    if as_json:
        click.echo(json.dumps(answer, indent=2))
        return
    click.echo(
        f"{called(answer['container'])}: generation {event.get('generation', 0)}, "
        f"{event.get('threads', 0)} thread(s), frozen {event.get('freeze_s', 0.0) * 1000:.2f} ms"
    )


@main.command()
@click.argument("name", shell_complete=complete_container)
@click.option("-g", "--generation", type=click.IntRange(1), help="Its number, as listed by avckpt inspect.")
@click.option("--json", "as_json", is_flag=True, help="The answer as JSON.")
def restore(name: str, generation: int | None, as_json: bool) -> None:
    """Roll the running container NAME back to its newest checkpoint.

    With --generation, back to an older one; newer ones are dropped.
    """
    from avckpt.guard import Command

    answer = _client().command(name, Command.RESTORE, generation or 0)
    event = answer["event"]
    if as_json:
        click.echo(json.dumps(answer, indent=2))
        return
    click.echo(
        f"{called(answer['container'])}: back at generation {event.get('generation', 0)}, "
        f"{event.get('age_s', 0.0):.1f} s old, in {event.get('restore_s', 0.0) * 1000:.1f} ms"
    )


@main.command()
@click.option("--json", "as_json", is_flag=True, help="The answer as JSON.")
def reload(as_json: bool) -> None:
    """Have the sidecar read /etc/avckpt/config.yaml again.

    It applies to running containers, too; changes are reported.  If anything in it
    is wrong, it is refused and the old one stays in force.
    """
    answer = _client().reload()
    if as_json:
        click.echo(json.dumps(answer, indent=2))
        return
    config = answer["config"]
    click.echo(f"{config['path']}: {'in force' if config['found'] else 'not there, the built-in defaults hold'}")
    for one in answer["containers"]:
        changes = ", ".join(f"{c['setting']} {c['before'] or 'none'} -> {c['after'] or 'none'}" for c in one["changes"])
        click.echo(f"{one['container']}: {changes or 'goes on as before: ' + one['problem']}")
    if not answer["containers"]:
        click.echo("it changes nothing for the containers that run")


@main.command()
@click.option("--json", "as_json", is_flag=True, help="A JSON list instead of text.")
def doctor(as_json: bool) -> None:
    """Check kernel, Podman, hooks and privileges, and suggest what to do.

    Ends with 1 when something is missing.
    """
    from dataclasses import asdict

    from avckpt.cli import doctor as doctor_checks

    checks = [asdict(check) for check in doctor_checks.checks()]
    if as_json:
        click.echo(json.dumps(checks, indent=2, default=str))
    else:
        for check in checks:
            _print_check(check)
    if any(_status(check) == "fail" for check in checks):
        sys.exit(int(ExitCode.FAILED))


@main.command(
    context_settings={"allow_interspersed_args": False},
    options_metavar="[--label avckpt.KEY=VALUE ...] [-v] --",
)
@click.option("-l", "--label", "labels", multiple=True, metavar="avckpt.KEY=VALUE", help="As for a container.")
@click.option("-v", "--verbose", is_flag=True, help="Report more than deaths and restores.")
@click.argument("argv", nargs=-1, required=True, type=click.UNPROCESSED, metavar="PROGRAM [ARGS...]")
def run(labels: tuple[str, ...], verbose: bool, argv: tuple[str, ...]) -> None:
    """Protect a plain program: no Podman, no sidecar.

    PROGRAM runs in a PID namespace of its own; its input, output and exit
    status are untouched, avckpt's own messages go to stderr.

    With --label avckpt.scope=nodes PROGRAM is a launcher, which is left alone:
    what it starts as $AVCKPT_INIT -- NODE [ARGS...] is protected.
    """
    from avckpt.errors import LabelsWrong

    try:
        from avckpt.cli import run as runner

        settings = runner.settings_of_run(dict(_split_label(label) for label in labels))
        status = runner.run(settings, list(argv), verbose=verbose)
    except LabelsWrong as error:
        click.echo(f"avckpt: {printable(str(error))}", err=True)
        status = int(ExitCode.USAGE)
    except AvckptError as error:
        click.echo(printable(f"avckpt: {argv[0]} was not started: {error}"), err=True)
        status = 125
    sys.exit(status)


def _print_lines(lines: Iterable[str], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(list(lines), indent=2))
        return
    for line in lines:
        click.echo(line, err=line.startswith("warning: "))


def _status(check: dict[str, Any]) -> str:
    status = check["status"]
    return str(getattr(status, "value", status))


def _print_check(check: dict[str, Any]) -> None:
    colour = {"ok": "green", "warn": "yellow", "fail": "red"}.get(_status(check))
    click.echo(f"{click.style(f'{_status(check):<4}', fg=colour)}  {check['name']}: {check['detail']}")
    if check["remedy"]:
        click.echo(f"      {check['remedy']}")


def _split_label(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise click.UsageError(f"--label {text}: write it as KEY=VALUE")
    return key, value


def _run_dir() -> Path:
    from avckpt_hooks.shared import protocol

    return Path(protocol.run_dir())


def _client() -> Client:
    from avckpt.cli.client import Client

    return Client(_run_dir())


def _print_table(containers: list[Json]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, header_style="bold")
    rows = [_row(container) for container in containers]
    widths = [max(map(len, column)) for column in zip(COLUMNS, *rows)]
    for name, width in zip(COLUMNS[:-1], widths):
        table.add_column(name, no_wrap=True, min_width=width)
    table.add_column(COLUMNS[-1], overflow="fold")
    for name, state, *others in rows:
        table.add_row(name, Text(state, style=STATE_STYLES.get(state, "")), *others)
    # Into a pipe nothing is wrapped: a line is a container.  On a terminal only the
    # note is; where even the rest is too wide, the terminal wraps it and nothing is lost.
    width = max(Console().width, sum(widths[:-1]) + 2 * len(widths) + NOTE_LEAST) if sys.stdout.isatty() else 1000
    console = Console(width=width, highlight=False, markup=False)
    with console.capture() as printed:  # it would end with a status of its own when it cannot write
        console.print(table)
    for line in printed.get().splitlines():
        click.echo(line.rstrip())


COLUMNS = ("NAME", "STATE", "GENS", "MEMORY", "INTERVAL", "CHECKPOINT", "FREEZE", "RESTORES", "RESTORE", "NOTE")
"""Generations, what they hold, time between two; age and freeze time of the newest, and whether it was copied (dirty)
or forked where that is chosen; restores, the last one's time."""
NOTE_LEAST = 16


def _row(c: Json) -> tuple[str, ...]:
    age_s = None if c["last_checkpoint_at"] is None else max(time.time() - c["last_checkpoint_at"], 0)
    return (
        called(c),
        c["state"],
        "-" if c["state"] in UNGUARDED else f"{c['generations']}/{c['keep']}",
        f"{c['memory_bytes'] / 1e6:.1f} MB" if c["generations"] else "-",
        "-" if c["state"] in UNGUARDED else _interval(c),
        "-" if age_s is None else _ago(age_s),
        f"{_ms(c['last_freeze_s'])} {c['last_images']}".rstrip(),
        str(c["restores"]),
        _ms(c["last_restore_s"]),
        "; ".join(filter(None, (_line(c), c["reason"] or _why_forked(c)))),
    )


def _line(c: Json) -> str:
    """Which one of its group it would go back to."""
    return f"line {c['line']} of {c['group']}" if c["line"] else ""


def _why_forked(c: Json) -> str:
    return f"forked: {c['last_fork_reason']}" if c["last_fork_reason"] else ""


def _interval(c: Json) -> str:
    s = c["interval_s"]
    text = f"{s:g} s" if s >= 1 and not c["automatic"] else f"{s:.1f} s" if s >= 1 else f"{s * 1000:.0f} ms"
    return f"auto, {text}" if c["automatic"] else text


def _ago(seconds: float) -> str:
    """In the largest unit of which there are two."""
    for unit, unit_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * unit_s:
            return f"{seconds // unit_s:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"


def _ms(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds * 1000:.2f} ms"


if __name__ == "__main__":
    main()
