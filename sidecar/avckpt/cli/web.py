# SPDX-License-Identifier: Apache-2.0
"""The command `avckpt web`."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import click

from avckpt.errors import ConfigError, SidecarUnreachable

PORT = 8467
TOKEN_LEAST = 16
"""Characters of a token of the user's own."""


@click.command()
@click.option("--listen", metavar="ADDRESS", default="127.0.0.1", show_default=True, help="Where to listen.")
@click.option("--port", type=click.IntRange(0, 65535), default=PORT, show_default=True, help="0: any free port.")
@click.option("--name", "names", multiple=True, help="Also answer under this host name.")
@click.option(
    "--token-file",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File with the token, readable only by its owner; default: a new token each time.",
)
@click.option("--control", is_flag=True, help="Let the page take checkpoints and roll containers back.")
def web(listen: str, port: int, names: tuple[str, ...], token_file: Path | None, control: bool) -> None:
    """Serve a page about all protected containers, for a browser.

    It prints the page's URL, with a token; anyone who has the URL may read.  It is read-only
    unless started with --control, needs no other host, and ends on Ctrl-C.

    A dashboard, or Prometheus, may read /metrics and, of the API, /v1/info, /v1/containers,
    /v1/events and /v1/history, with the header "Authorization: Bearer TOKEN".
    """
    import asyncio
    import secrets

    from avckpt_hooks.shared import protocol

    from avckpt.cli.client import start_it
    from avckpt.web import server

    token = secrets.token_urlsafe(24) if token_file is None else read_token(token_file)
    access = server.Access(token, server.own_names(listen, names), control)

    async def serve() -> None:
        runner = await server.start(Path(protocol.run_dir()), listen, port, access)
        try:
            where = runner.addresses[0]
            host = f"[{where[0]}]" if ":" in where[0] else where[0]
            click.echo(f"http://{host}:{where[1]}/#token={token}")
            await asyncio.Event().wait()
        finally:
            await runner.cleanup()

    try:
        asyncio.run(serve())
    except KeyboardInterrupt:
        pass
    except SidecarUnreachable as error:
        raise SidecarUnreachable(f"{error}: {start_it(Path(protocol.run_dir()))}") from None


def read_token(path: Path) -> str:
    """The token in a file.  Raises ConfigError when others may read it, or when it is none."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        how = f"; make one: (umask 077; openssl rand -hex 24 > {path})" if error.errno == errno.ENOENT else ""
        raise ConfigError(f"the token cannot be read from {path} ({error.strerror}){how}") from error
    with os.fdopen(fd, encoding="utf-8", errors="replace") as file:
        if stat.S_IMODE(os.fstat(fd).st_mode) & 0o077:
            raise ConfigError(f"others may read {path}: chmod 600 {path}")
        token = file.read(1025).strip()
    if not TOKEN_LEAST <= len(token) <= 1024 or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(f"{path} holds no token: {TOKEN_LEAST} or more characters, without spaces")
    return token
