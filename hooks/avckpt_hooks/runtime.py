# SPDX-License-Identifier: Apache-2.0
"""The OCI runtime avckpt-runtime: does the precreate hook's work for engines that call no such
hook.

Docker, containerd and CRI-O call it as they call runc. For `create` and `run` it rewrites the
bundle's config.json if the container's labels or annotations ask for protection; then it
executes the real runtime in this process. Whatever goes wrong here, the container starts as
without us, except for a wrong label: that is an error, reported like the runtime's own errors.

Its own options come before the command: --avckpt-runtime=PROGRAM (otherwise
runc or crun, whichever is found first) and --avckpt-run-dir=DIRECTORY.
"""

from __future__ import annotations

import json
import os
import sys
import time

from avckpt_hooks import precreate
from avckpt_hooks.shared import files, protocol, tell

TYPE_CHECKING = False  # typing.TYPE_CHECKING, without the 7 ms that importing it takes
if TYPE_CHECKING:
    from typing import Any

_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_RUNTIMES = ("runc", "crun")
_WITH_VALUE = ("--root", "--log", "--log-format", "--criu", "--rootless", "--cgroup-manager")
"""Global options of runc and crun whose value is the next word."""
_CONFIG_BYTES = 16 << 20


def main() -> int:
    """Executes the real runtime; returns only when that fails."""
    own, argv = _split(sys.argv[1:])
    if own.get("run-dir"):
        os.environ["AVCKPT_RUN_DIR"] = own["run-dir"]
    at = _command_at(argv)
    if argv[at : at + 1] in (["create"], ["run"]):
        bundle = _option(argv[at + 1 :], "--bundle", "-b") or "."
        try:
            _rewrite(os.path.join(bundle, "config.json"), argv[-1])
        except precreate.Refused as refused:
            line = tell.printable(f"avckpt: {refused}")
            tell.journal(line)
            _complain(line, _option(argv[:at], "--log"))
            return 1
        except Exception as error:  # noqa: BLE001 - whatever goes wrong here, the app runs
            precreate.warn(f"container {argv[-1][:12]} runs unprotected: {type(error).__name__}: {error}", 0)
    program = own.get("runtime") or _found()
    try:
        os.execvpe(program, [program, *argv], {"PATH": _PATH, **os.environ})
    except OSError as error:
        _complain(f"avckpt: the runtime {program} cannot be run: {error.strerror}", _option(argv[:at], "--log"))
    return 1


def _split(words: list[str]) -> tuple[dict[str, str], list[str]]:
    """Our own options, and the words without them."""
    own, rest = {}, []
    for word in words:
        name, equals, value = word.partition("=")
        if equals and name in ("--avckpt-runtime", "--avckpt-run-dir"):
            own[name[len("--avckpt-") :]] = value
        else:
            rest.append(word)
    return own, rest


def _command_at(argv: list[str]) -> int:
    """Where the command stands, behind the global options."""
    at = 0
    while at < len(argv) and argv[at].startswith("-"):
        at += 2 if argv[at] in _WITH_VALUE else 1
    return at


def _option(words: list[str], *names: str) -> str:
    """The value of an option; "" without it."""
    for n, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name in names:
            return value if equals else "".join(words[n + 1 : n + 2])
    return ""


def _found() -> str:
    for name in _RUNTIMES:
        for folder in os.environ.get("PATH", _PATH).split(":"):
            if os.access(f"{folder}/{name}", os.X_OK):
                return f"{folder}/{name}"
    return _RUNTIMES[0]


def _rewrite(path: str, container: str) -> None:
    """Puts avckpt-init in front of the command in a bundle's config.json.  Raises Refused, OSError, ValueError."""
    config = files.read_bounded(path, _CONFIG_BYTES)
    docker = _docker(config, container)
    if b"avckpt" not in config.lower() and docker is None:
        return
    data = json.loads(config)
    annotations = data.get("annotations") or {}
    if annotations.get("io.kubernetes.cri.container-type") == "sandbox" or (
        annotations.get("io.kubernetes.cri-o.ContainerType") == "sandbox"
    ):
        return  # it has the pod's annotations, too, but runs only a pause program
    key = protocol.key_of(container)
    about: dict[str, Any] = {"name": _name(annotations) or (container if key != container else ""), "labels": {}}
    if docker is not None:
        about = {"name": docker.get("Name", "").lstrip("/"), "labels": docker["Config"].get("Labels") or {}}
        number = _signal_number(docker["Config"].get("StopSignal") or "")
        if number:
            data["annotations"] = {"org.opencontainers.image.stopSignal": number, **annotations}
    before = json.dumps(data).encode()
    bundle = os.path.abspath(os.path.dirname(path))
    after = precreate.rewrite_labelled(before, key, json.dumps(about).encode(), 0, bundle)
    if after == before:
        return
    data = json.loads(after)
    data["annotations"]["avckpt.id"] = key
    if docker is not None and docker["Config"].get("Healthcheck"):
        answer = {"healthcheck": docker["Config"]["Healthcheck"], "startup_healthcheck": None}
        files.write_private(protocol.health_path(key), json.dumps(answer).encode())
    # Keep its mode.
    files.write_at_once(path, json.dumps(data, separators=(",", ":")).encode(), os.stat(path).st_mode & 0o777)


def _docker(config: bytes, container: str) -> dict[str, Any] | None:
    """What Docker knows of the container, with its labels; None: it is not Docker's.

    The root file system is below Docker's data directory, and so is config.v2.json.
    """
    if not protocol.is_container_id(container):
        return None
    folder = str((json.loads(config).get("root") or {}).get("path", ""))
    while len(folder) > 1 and folder.startswith("/"):
        folder = os.path.dirname(folder)
        try:
            text = files.read_bounded(f"{folder}/containers/{container}/config.v2.json", _CONFIG_BYTES)
        except (FileNotFoundError, NotADirectoryError):
            continue
        found = json.loads(text)
        return found if isinstance(found, dict) and isinstance(found.get("Config"), dict) else None
    return None


def _name(annotations: dict[str, str]) -> str:
    """Its name in Kubernetes or nerdctl; "" if there is none."""
    for sandbox, container in (
        ("io.kubernetes.cri.sandbox-name", "io.kubernetes.cri.container-name"),
        ("io.kubernetes.pod.name", "io.kubernetes.container.name"),
    ):
        if annotations.get(container):
            return "/".join(part for part in (annotations.get(sandbox), annotations[container]) if part)
    return annotations.get("nerdctl/name") or ""


def _signal_number(text: str) -> str:
    """ "3" for SIGQUIT, QUIT or 3; "" for what is none."""
    import signal

    if text.isdecimal():
        return text
    name = text.upper() if text.upper().startswith("SIG") else f"SIG{text.upper()}"
    number = getattr(signal, name, None)
    return str(int(number)) if isinstance(number, signal.Signals) else ""


def _complain(line: str, log: str) -> None:
    """Reports an error as runc does: on standard error, and in the caller's log file."""
    print(line, file=sys.stderr)
    if log:
        entry = {"level": "error", "msg": line, "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
        try:
            with open(log, "a") as file:
                file.write(json.dumps(entry) + "\n")
        except OSError:
            pass  # it has the exit status
