# SPDX-License-Identifier: Apache-2.0
"""Talks to the sidecar's API (see api.py).  Standard library only, so that commands start fast."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import socket
from collections.abc import Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote, urlencode

from avckpt.errors import Denied, NoSuchContainer, ProtocolError, SidecarUnreachable, from_json
from avckpt.guard import Command

Json = dict[str, Any]

COMMAND_S = 40.0
"""How long to wait for what the sidecar has to say of a command; longer than it waits for the engine itself."""
ANSWER_S = 10.0
"""The same for what it knows without asking anybody; a busy machine may take some of that."""

NAME_MOST = 500
"""Characters of a name; the sidecar does not read longer paths than some 8000 bytes."""

LOG = "its log (podman logs avckpt-sidecar)"
SERVICE = "avckpt-sidecar.service"
CONFIG_DIR = Path("/etc/avckpt")
"""Made by `avckpt install`, as is the runtime directory."""
UNITS = tuple(
    map(Path, ("/run/systemd/generator", "/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system"))
)
"""Where systemd has it: of a Quadlet, the administrator's, and the Debian package's."""


def start_it(run_dir: Path) -> str:
    """How to start the sidecar here, as a clause: as a service of systemd where it is one, or else its container."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    if not CONFIG_DIR.is_dir():  # it is mounted, and Podman starts nothing without it
        return f"install and start it with: {sudo}avckpt install && {sudo}{run_it(run_dir)}"
    if is_service():
        return f"start it with: {sudo}systemctl start {SERVICE}"
    return f"start it with: {sudo}{run_it(run_dir)}"


def is_service() -> bool:
    """Whether it is one of systemd here."""
    return any((folder / SERVICE).exists() for folder in UNITS) and os.path.isdir("/run/systemd/system")


CPU_SHARES = 4096
"""Of the sidecar's container, with all guards: four times those of another, for it is needed when there is no CPU
left."""


def run_it(run_dir: Path) -> str:
    """The command that starts its container.  With --replace one of that name that is stopped, or hangs, is no
    obstacle."""
    return (
        "podman run -d --replace --restart=always --name avckpt-sidecar --privileged --pid=host --network=none "
        f"--cpu-shares={CPU_SHARES} -v {run_dir}:/run/avckpt -v /etc/avckpt:/etc/avckpt:ro localhost/avckpt-sidecar"
    )


class Client:
    """The sidecar whose run-time directory is `run_dir`.

    Every method raises SidecarUnreachable without an answer, Denied without
    permission, and the sidecar's own error as the original exception.
    """

    def __init__(self, run_dir: Path) -> None:
        self._path = run_dir / "api.sock"

    def info(self) -> Json:
        """Version and state of the sidecar."""
        return self._request("GET", "/v1/info")

    def pid(self) -> int:
        """The sidecar's PID as it is here; in `info()` it is that of its own PID namespace."""
        from avckpt.containers.units import credentials

        with self._connected(ANSWER_S) as connection:
            connection.connect()
            return credentials(connection.sock)[0]

    def containers(self, *, ended: bool = False, memory: bool = True) -> list[Json]:
        """The protected containers, with `ended` also the last few that are gone.

        Who looks often does without `memory`, of which the kernel walks page tables.
        """
        answer = self._request("GET", f"/v1/containers?all={int(ended)}&memory={int(memory)}")
        return cast("list[Json]", answer["containers"])

    def inspect(self, name: str) -> Json:
        """All that is known about a container; returns {"container": ..., "settings": ..., "generations":
        ..., ...}."""
        return self._request("GET", f"/v1/containers/{_quoted(name)}")

    def command(self, name: str, command: Command, generation: int = 0) -> Json:
        """Carries out a command; returns {"container": ..., "event": ...}."""
        query = f"?generation={generation}" if generation else ""
        return self._request("POST", f"/v1/containers/{_quoted(name)}/{command.name.lower()}{query}")

    def reload(self) -> Json:
        """Has the configuration file read again; returns {"config": ..., "containers": [...]}."""
        return self._request("POST", "/v1/reload")

    def metrics(self) -> str:
        """The metrics, as Prometheus reads them."""
        with self._connected(ANSWER_S) as connection:
            connection.request("GET", "/metrics")
            return connection.getresponse().read().decode("utf-8", "replace")

    def history(self, since: float | None = None) -> list[Json]:
        """The events that are kept, oldest first, with `since` (seconds since 1970) those from then on."""
        query = "" if since is None else f"?{urlencode({'since': repr(since)})}"
        return cast("list[Json]", self._request("GET", f"/v1/history{query}")["events"])

    def events(self, after: int | None = None, since: float | None = None, *, routine: bool = False) -> Iterator[Json]:
        """Events as they come, those that are kept first; ends when the sidecar is told to stop.

        With `after` only those with a greater "seq", with `since` only those
        from that time of day on; with `routine` also those that are not kept.
        """
        query = {"all": "1"} if routine else {}
        if after is not None:
            query["after"] = str(after)
        if since is not None:
            query["since"] = repr(since)
        with self._connected(COMMAND_S) as connection:
            connection.request("GET", f"/v1/events?{urlencode(query)}")
            response = connection.getresponse()
            if response.status != HTTPStatus.OK:
                _decode(response.read())
                raise ProtocolError(f"the sidecar answered with HTTP status {response.status}")
            for line in response:
                # One line of data per event, which is all that the sidecar makes of the format.
                if line.startswith(b"data: "):
                    yield _decode(line[len(b"data: ") :])

    def _request(self, method: str, target: str) -> Json:
        with self._connected(COMMAND_S if method == "POST" else ANSWER_S) as connection:
            connection.request(method, target)
            body = connection.getresponse().read()
        return _decode(body)

    @contextlib.contextmanager
    def _connected(self, patience_s: float) -> Iterator[_UnixConnection]:
        """A connection; its errors in the body are converted to ours."""
        connection = _UnixConnection(self._path, patience_s)
        try:
            yield connection
        except (FileNotFoundError, ConnectionRefusedError) as error:
            why = f"no {self._path}" if isinstance(error, FileNotFoundError) else f"nobody listens on {self._path}"
            raise SidecarUnreachable(f"the sidecar is not running ({why}): {start_it(self._path.parent)}") from error
        except PermissionError as error:
            raise Denied(f"{self._path} is for root only: use sudo") from error
        except TimeoutError as error:
            raise SidecarUnreachable(
                f"the sidecar did not answer within {patience_s:g} s: is it paused (podman unpause avckpt-sidecar)? "
                f"See {LOG}"
            ) from error
        except (OSError, http.client.HTTPException) as error:
            # http.client's own errors have no errno, and a text that says it.
            why = getattr(error, "strerror", None) or str(error)
            raise SidecarUnreachable(f"the sidecar went away ({why.lower()}): see {LOG}") from error
        finally:
            connection.close()


def _quoted(name: str) -> str:
    """A name in a path.  Raises NoSuchContainer for what none can be called, and what would be another path."""
    if not name:
        raise NoSuchContainer("no container's name is empty: avckpt ps lists those there are")
    if len(name) > NAME_MOST:
        raise NoSuchContainer(f"no container is called {name[:20]!r}..., {len(name)} characters: see avckpt ps")
    return quote(os.fsencode(name), safe="")


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: Path, patience_s: float) -> None:
        super().__init__("localhost", timeout=patience_s)
        self._path, self._patience_s = path, patience_s

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self._patience_s)
        self.sock.connect(str(self._path))


def _decode(body: bytes) -> Json:
    try:
        answer = json.loads(body)
    except ValueError as error:
        raise ProtocolError(f"the sidecar's answer is not JSON: {body[:80]!r}") from error
    if not isinstance(answer, dict):
        raise ProtocolError(f"the sidecar's answer is invalid: {body[:80]!r}")
    # An event may have an error of its own, and always has a kind.
    if isinstance(answer.get("error"), dict) and "kind" not in answer:
        raise from_json(answer["error"])
    return answer
