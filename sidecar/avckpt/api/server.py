# SPDX-License-Identifier: Apache-2.0
"""The sidecar's HTTP API, on a Unix socket that only root may connect to.

The paths, and what they take and give, are described in openapi.py, which is
served as /v1/openapi.json.  Errors are {"error": AvckptError.to_json()} with a
status that fits.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import os
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Protocol

from aiohttp import web
from avckpt_hooks.shared.tell import printable

from avckpt import __version__, engine
from avckpt.api.openapi import document
from avckpt.config import Configuration
from avckpt.containers.listener import MAX_WAITING, bind_socket
from avckpt.containers.protected import Protected
from avckpt.containers.registry import Registry
from avckpt.errors import (
    Ambiguous,
    AvckptError,
    Busy,
    ConfigError,
    DeadlineMissed,
    NoSuchContainer,
    NothingToRestore,
    Paused,
    TargetGone,
    Unprotected,
    Unsupported,
)
from avckpt.events.feed import Feed
from avckpt.events.history import History
from avckpt.events.metrics import CONTENT_TYPE, Metrics
from avckpt.events.record import EventRecord
from avckpt.guard import Command
from avckpt.lock import identity
from avckpt.policy import Reloaded
from avckpt.supervision.pressure import measure

log = logging.getLogger("avckpt")

STATUS: dict[type[AvckptError], int] = {
    NoSuchContainer: 404,
    Ambiguous: 409,
    Unprotected: 409,
    Unsupported: 409,
    Busy: 409,
    NothingToRestore: 409,
    ConfigError: 422,
    TargetGone: 410,
    DeadlineMissed: 504,
    Paused: 409,
}
"""HTTP status of an error; 500 for those that are not here."""

HTTP_KINDS = {400: "bad_request", 404: "not_found", 405: "method_not_allowed"}
"""`kind` of an error that is the request's own."""

FLAGS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}
"""Values of a parameter that is a boolean."""

KEEP_ALIVE_S = 15.0
"""A stream of events says something at least this often, so that either end notices when the other has gone."""


class Backend(Protocol):
    """What the API needs of the daemon."""

    registry: Registry
    feed: Feed
    history: History
    metrics: Metrics
    started_at: float
    configuration: Configuration

    async def command(self, name: str, command: Command, generation: int = 0) -> tuple[Protected, EventRecord]:
        """Gives a command to a container and waits for the answer.  Raises AvckptError."""

    async def inspect(self, name: str) -> dict[str, object]:
        """All that is known of a container.  Raises AvckptError."""

    def reload(self) -> list[Reloaded]:
        """Takes a new configuration file; for whom it changes something.  Raises ConfigError."""


class ApiServer:
    """Serves a backend on the socket at `path`."""

    def __init__(self, backend: Backend, path: Path) -> None:
        self._backend = backend
        self._path = path
        self.app = app = web.Application(middlewares=[_errors_as_json, _known_parameters])
        app.add_routes(
            [
                web.get("/v1/info", self._info),
                web.get("/v1/containers", self._containers),
                web.get("/v1/containers/{name}", self._inspect),
                web.post("/v1/containers/{name}/{command:checkpoint|restore}", self._command),
                web.post("/v1/reload", self._reload),
                web.get("/v1/events", self._events, allow_head=False),  # it would wait for a body that is none
                web.get("/v1/history", self._history),
                web.get("/v1/openapi.json", self._openapi),
                web.get("/metrics", self._metrics),
            ]
        )
        self._runner = web.AppRunner(app, handle_signals=False, access_log=None, shutdown_timeout=1.0)

    async def start(self) -> None:
        """Starts to serve.  Raises OSError when the socket cannot be made."""
        await self._runner.setup()
        await self._listen()

    async def keep(self) -> bool:
        """Makes the socket again if its file was removed or replaced; whether it was.  Raises OSError."""
        if identity(self._path) == self._file:
            return False
        before = self._site
        await self._listen()
        await before.stop()
        return True

    async def _listen(self) -> None:
        listening = bind_socket(self._path, socket.SOCK_STREAM)
        # asyncio accepts so many at a time; and where descriptors are short, it fails, tells, and tries again
        # after a second for each of them, all of them at once.
        self._site = web.SockSite(self._runner, listening, backlog=1)
        self._file = identity(self._path)
        await self._site.start()
        listening.listen(MAX_WAITING)

    async def close(self) -> None:
        """Ends what is under way, within a second, and removes the socket."""
        await self._runner.cleanup()
        self._path.unlink(missing_ok=True)

    async def _info(self, request: web.Request) -> web.Response:
        return web.json_response(
            {
                "version": __version__,
                "native_version": engine.version(),
                "pid": os.getpid(),
                "started_at": self._backend.started_at,
                "containers": len(self._backend.registry.live()),
                "config": self._backend.configuration.to_json(),
            }
        )

    async def _containers(self, request: web.Request) -> web.Response:
        registry = self._backend.registry
        containers = registry.ended() if _flag(request, "all") else []
        containers += registry.live()
        if _flag(request, "memory", "1"):
            await measure(containers)
        rows = [container.to_json() for container in containers]
        return web.json_response({"containers": rows})

    async def _inspect(self, request: web.Request) -> web.Response:
        return web.json_response(await self._backend.inspect(request.match_info["name"]))

    async def _command(self, request: web.Request) -> web.Response:
        command = Command[request.match_info["command"].upper()]
        number = request.query.get("generation", "0")
        if not number.isdecimal() or not number.isascii() or len(number) > 18:
            raise web.HTTPBadRequest(reason=f"generation is {printable(number)[:40]}, not the number of one")
        container, event = await self._backend.command(request.match_info["name"], command, int(number))
        return web.json_response({"container": container.to_json(), "event": event.to_json()})

    async def _reload(self, request: web.Request) -> web.Response:
        outcomes = self._backend.reload()
        return web.json_response(
            {
                "config": self._backend.configuration.to_json(),
                "containers": [outcome.to_json() for outcome in outcomes],
            }
        )

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """Server-sent events: what is kept, then what comes, until either end has enough."""
        wants_all = _flag(request, "all")
        after, since = _after(request), _since(request)
        # Follow first, then tell what was: nothing falls between the two.
        with self._backend.feed.follow() as queue:
            kept = self._backend.history.after(after, since)
            response = web.StreamResponse(
                headers={"Content-Type": "text/event-stream", "Cache-Control": "no-store", "X-Accel-Buffering": "no"}
            )
            await response.prepare(request)
            clock = asyncio.get_running_loop().time
            try:
                await response.write(b"retry: 1000\n\n" + b"".join(map(_sse, kept)))
                said_at = clock()
                while True:
                    try:
                        # What is not passed on says nothing to the other side, however often it comes.
                        record = await asyncio.wait_for(queue.get(), said_at + KEEP_ALIVE_S - clock())
                    except asyncio.TimeoutError:
                        await response.write(b": nothing new\n\n")
                        said_at = clock()
                        continue
                    if record is None:
                        break
                    if record.seq or wants_all:
                        await response.write(_sse(record))
                        said_at = clock()
            except ConnectionError:
                pass  # it has gone
        return response

    async def _history(self, request: web.Request) -> web.Response:
        kept = self._backend.history.after(_after(request), _since(request))
        return web.json_response({"events": [record.to_json() for record in kept]})

    async def _openapi(self, request: web.Request) -> web.Response:
        return web.json_response(document())

    async def _metrics(self, request: web.Request) -> web.Response:
        measured = await measure(self._backend.registry.live())
        text = self._backend.metrics.render(self._backend.registry.live(), measured)
        return web.Response(body=text, headers={"Content-Type": CONTENT_TYPE})


def _sse(record: EventRecord) -> bytes:
    """An event of the HTML standard's event stream.  What is not kept has no id: nobody can resume after it."""
    number = f"id: {record.seq}\n" if record.seq else ""
    return f"{number}data: {json.dumps(record.to_json())}\n\n".encode()


def _after(request: web.Request) -> int | None:
    """The number of the last event that the other side has: the header, or for those who cannot set one, `after`."""
    text = request.headers.get("Last-Event-ID") or request.query.get("after")
    if text is None:
        return None
    if not text.isdecimal() or not text.isascii() or len(text) > 18:
        raise web.HTTPBadRequest(
            reason=f"after (or Last-Event-ID) is {printable(text)[:40]}, not the number of an event"
        )
    return int(text)


def _since(request: web.Request) -> float | None:
    text = request.query.get("since")
    if text is None:
        return None
    try:
        since = float(text)
    except ValueError:
        since = math.nan
    if not math.isfinite(since):
        raise web.HTTPBadRequest(reason=f"since is {printable(text)[:40]}, not seconds since 1970")
    return since


def _flag(request: web.Request, name: str, default: str = "0") -> bool:
    text = request.query.get(name, default)
    if text.lower() not in FLAGS:
        raise web.HTTPBadRequest(reason=f"{name} is {printable(text)[:40]}, neither true nor false")
    return FLAGS[text.lower()]


@web.middleware
async def _known_parameters(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Refuses a query with a parameter that the path does not take: nobody is to believe that it did something."""
    resource = request.match_info.route.resource
    path = "" if resource is None else resource.canonical.replace("{command}", request.match_info.get("command", ""))
    operation = document()["paths"].get(path, {}).get(request.method.lower(), {})
    known = [each["name"] for each in operation.get("parameters", []) if each["in"] == "query"]
    for name in request.query:
        if operation and name not in known:
            takes = f"it takes {', '.join(known)}" if known else "it takes none"
            raise web.HTTPBadRequest(reason=f"there is no parameter {printable(name)[:40]}; {takes}")
    return await handler(request)


@web.middleware
async def _errors_as_json(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    try:
        return await handler(request)
    except AvckptError as error:
        return web.json_response({"error": error.to_json()}, status=STATUS.get(type(error), 500))
    except web.HTTPException as error:
        refused = _request_error(f"{request.method} {request.path}: {error.reason}", error.status)
        if "Allow" in error.headers:
            refused.headers["Allow"] = error.headers["Allow"]
        return refused
    except Exception:
        log.exception("%s %s", request.method, request.path)
        return _request_error(f"{request.method} {request.path}: a bug of the sidecar's, see its log", 500)


def _request_error(message: str, status: int) -> web.Response:
    problem = AvckptError(message).to_json()
    problem["kind"] = HTTP_KINDS.get(status, "failed")
    return web.json_response({"error": problem}, status=status)
