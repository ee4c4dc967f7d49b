# SPDX-License-Identifier: Apache-2.0
"""A page about a sidecar, for a browser: files, and some paths of the API behind a token.

The API's socket is for root only, and gives the right to roll containers back.  A browser runs
foreign code beside ours, so this server

- passes on what PASSED names and nothing else, and commands only if it was started so;
- wants the token in the header Authorization, which no other site's page can set for us
  (there are no cookies that a browser would add by itself);
- answers only to its own names (Host), or a stranger's name that resolves to this machine
  would make their page the same origin as ours ("DNS rebinding").

The page itself has no secrets and is served to everybody who reaches the port.  It gets the token
from the part of the URL after #, which browsers do not send.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import os
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import aiohttp
from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from avckpt.containers.listener import SHORT_OF
from avckpt.errors import AvckptError, Denied, SidecarUnreachable

PASSED = ("/v1/info", "/v1/containers", "/v1/events", "/v1/history", "/metrics")
"""Paths of the API that only tell something."""
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
CONNECT_TIMEOUT_S = 5.0
IDLE_S = 10.0
"""A connection without a request is closed: anybody can make as many as we have descriptors."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


@dataclass(frozen=True)
class Access:
    """Who may ask what."""

    token: str
    names: frozenset[str]
    """What may stand in a request's Host, without the port."""
    control: bool = False
    """Whether commands are passed on, too."""


def host_name(host: str) -> str:
    """A Host header's name without the port, and without the brackets of an IPv6 address."""
    if host.startswith("["):
        return host[1:].partition("]")[0].lower()
    return host.partition(":")[0].lower()


def own_names(listen: str, more: tuple[str, ...]) -> frozenset[str]:
    """The names under which a server on address `listen` answers, beside literal addresses, which nobody can rebind."""
    return frozenset({"localhost", "127.0.0.1", "::1", listen.lower(), *(name.lower() for name in more)})


class WebServer:
    """Serves the page and passes requests on to the API's socket in `run_dir`."""

    def __init__(self, run_dir: Path, access: Access) -> None:
        self._socket = run_dir / "api.sock"
        self._access = access
        self._session: aiohttp.ClientSession | None = None
        self.app = app = web.Application(middlewares=[self._guarded])
        app.router.add_get("/", self._page)
        app.router.add_get("/{name:[a-z_]+\\.(?:css|js)}", self._page)
        for path in PASSED:
            app.router.add_get(path, self._pass_on, allow_head=path != "/v1/events")
        app.router.add_get("/v1/access", self._tell_access)
        app.router.add_post("/v1/containers/{name}/{command:checkpoint|restore}", self._command)
        app.cleanup_ctx.append(self._connect)

    async def _connect(self, app: web.Application) -> AsyncIterator[None]:
        connector = aiohttp.UnixConnector(path=str(self._socket), limit=0)
        timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_TIMEOUT_S)
        async with aiohttp.ClientSession(connector=connector, timeout=timeout) as self._session:
            yield

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Whether the other side may ask at all; and no answer without the headers."""
        try:
            self._check(request)
            response = await handler(request)
        except web.HTTPException as error:
            response = _refusal(error)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    def _check(self, request: web.Request) -> None:
        name = host_name(request.host)
        if name not in self._access.names and not _is_address(name):
            raise web.HTTPForbidden(reason="this server has another name: give it with --name")
        origin = request.headers.get("Origin")
        if origin is not None and origin.partition("://")[2] != request.host:
            raise web.HTTPForbidden(reason="another site asks")
        if request.path.startswith("/v1/") or request.path == "/metrics":
            given = request.headers.get("Authorization", "")
            if not hmac.compare_digest(
                given.encode("utf-8", "surrogateescape"), f"Bearer {self._access.token}".encode()
            ):
                raise web.HTTPUnauthorized(
                    reason="the token is missing or wrong", headers={"WWW-Authenticate": "Bearer"}
                )

    async def _page(self, request: web.Request) -> web.Response:
        name = request.match_info.get("name", "index.html")
        file = files(__package__).joinpath("page", name)
        if not file.is_file():
            raise web.HTTPNotFound
        return web.Response(
            text=file.read_text(encoding="utf-8"), content_type=TYPES[Path(name).suffix], charset="utf-8"
        )

    async def _tell_access(self, request: web.Request) -> web.Response:
        return web.json_response({"control": self._access.control})

    async def _command(self, request: web.Request) -> web.StreamResponse:
        if not self._access.control:
            raise web.HTTPForbidden(reason="read only: start it with --control")
        return await self._pass_on(request)

    async def _pass_on(self, request: web.Request) -> web.StreamResponse:
        assert self._session is not None
        headers = {name: request.headers[name] for name in ("Last-Event-ID",) if name in request.headers}
        try:
            async with self._session.request(
                request.method, f"http://sidecar{request.rel_url.raw_path_qs}", headers=headers
            ) as answer:
                response = web.StreamResponse(status=answer.status, headers=HEADERS)
                response.headers["Content-Type"] = answer.headers["Content-Type"]  # with its version and charset
                await response.prepare(request)
                async for chunk in answer.content.iter_any():
                    await response.write(chunk)
                await response.write_eof()
                return response
        except aiohttp.ClientConnectorError:
            raise web.HTTPBadGateway(reason="the sidecar is not running") from None
        except (aiohttp.ClientError, asyncio.TimeoutError):
            raise web.HTTPBadGateway(reason="the sidecar went away") from None


def _is_our_fault(record: logging.LogRecord) -> bool:
    """Whether it is to be logged: not what strangers send, nor that they have taken all descriptors."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, HttpProcessingError) and getattr(error, "errno", None) not in SHORT_OF


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _refusal(error: web.HTTPException) -> web.Response:
    headers = {name: error.headers[name] for name in ("Allow", "WWW-Authenticate") if name in error.headers}
    return web.json_response({"error": {"kind": "web", "message": error.reason}}, status=error.status, headers=headers)


async def start(run_dir: Path, listen: str, port: int, access: Access) -> web.AppRunner:
    """Serves until the runner's cleanup().

    Raises AvckptError when it cannot listen there, Denied when this user may
    not speak to the sidecar, SidecarUnreachable when there is none.
    """
    if not _may_speak(run_dir / "api.sock"):
        raise Denied(f"{run_dir / 'api.sock'} is for root only: use sudo")
    for name in ("aiohttp.server", "asyncio"):
        logging.getLogger(name).addFilter(_is_our_fault)
    app = WebServer(run_dir, access).app
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0, keepalive_timeout=IDLE_S)
    await runner.setup()
    try:
        await web.TCPSite(runner, listen, port).start()
    except OSError as error:
        await runner.cleanup()
        # A name that is not found has a number of the resolver's, and not of the kernel's.
        why = error.strerror if isinstance(error, socket.gaierror) else os.strerror(error.errno or 0)
        raise AvckptError(f"cannot listen on {listen} port {port} ({why})") from error
    return runner


def _may_speak(path: Path) -> bool:
    """Whether we may connect to the sidecar's socket.  Raises SidecarUnreachable when there is none."""
    try:
        path.stat()
    except FileNotFoundError:
        raise SidecarUnreachable(f"the sidecar is not running (no {path})") from None
    except PermissionError:
        return False
    return os.access(path, os.W_OK)
