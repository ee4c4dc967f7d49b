# SPDX-License-Identifier: Apache-2.0
"""The precreate hook: puts avckpt-init in front of a protected container's command.

Podman runs it on the host for *every* container it starts, with the OCI
configuration on standard input, and takes the configuration from its standard
output. The configuration of any other container passes unchanged, byte for byte.

It is the only hook in Podman's hooks directory. It adds the other two to the
configuration of a protected container itself: Podman matches hooks before this one
has stamped its annotations, so otherwise they would run for every container, mostly
in vain.
"""

from __future__ import annotations

import errno
import os
import stat
import sys

from avckpt_hooks import VERSION, podman
from avckpt_hooks.shared import tell

TYPE_CHECKING = False  # typing.TYPE_CHECKING, without the 7 ms that importing it takes
if TYPE_CHECKING:
    from typing import Any

INIT_PATH = "/run/avckpt-init"
"""Where a protected container has its init."""

WAIT_MS = 2000
"""How long init waits for a sidecar that lives but does not answer."""

IO_URING = ("io_uring_setup", "io_uring_enter", "io_uring_register", "io_setup")
"""Also kernel AIO: what has to do without the one falls back on the other, and neither is protected."""

HOOK_TIMEOUT_S = 120
"""After this the OCI runtime kills our hooks, and the container does not start: a last resort. They bound
their own waits to seconds, but on an overloaded machine, for example while it boots, starting Python alone
may take as long as that."""

LOOKALIKES_TOLD = 16
"""An image may have as many as it likes, and each takes time."""

_MARK = b'"avckpt.'
"""A JSON text without it contains no label or annotation of ours."""
_LOOKALIKES = [b'"' + name for name in b"avckpt vckpt ackpt avkpt avcpt avckt avckp vackpt acvkpt avkcpt avcpk".split()]
"""A JSON text that, in lower case, lacks them contains none that was meant for us, but for a letter that was forgotten
or two that were exchanged."""


class Refused(Exception):
    """The container must not start; the text is one line for the user."""


def main() -> int:
    """Standard input to standard output.  Non-zero: the container must not start."""
    config = sys.stdin.buffer.read()
    parent = os.getppid()
    try:
        config = rewrite(config, parent)
    except Refused as refused:
        line = tell.printable(f"avckpt: {refused}")
        tell.journal(line)
        if not podman.is_service(parent):
            tell.parent(line, parent)
            return 1
        config = spoil(config, line)
    except Exception as error:  # noqa: BLE001 - whatever goes wrong here, the app runs
        warn(f"a container runs unprotected: {type(error).__name__}: {error}", parent)
    sys.stdout.buffer.write(config)
    sys.stdout.buffer.flush()
    return 0


def rewrite(config: bytes, parent: int) -> bytes:
    """The configuration a container is to be started with.  Raises Refused."""
    container, spec = "", b"{}"
    try:
        container = podman.container_id(config)
        spec = podman.generate_spec(container, parent)
    except podman.Unknown as unknown:
        if _MARK not in config:
            warn(
                f"cannot read a container's labels ({unknown}): if avckpt.enable is one of them, it runs unprotected",
                parent,
            )
    both = spec.lower() + config.lower()
    if not any(name in both for name in _LOOKALIKES):
        return config
    return rewrite_labelled(config, container, spec, parent)


def rewrite_labelled(config: bytes, container: str, spec: bytes, parent: int, bundle: str = "") -> bytes:
    """The same, of a container whose name and labels are in `spec`. `parent` 0: there is no Podman
    (runtime.py), and the path of the root file system may be relative to `bundle`."""
    import json

    from avckpt_hooks.shared import labels

    data = json.loads(config)
    about = json.loads(spec)
    name = about.get("name") or container[:12] or "?"
    annotations = labels.of_container(data.get("annotations") or {}, name)
    given = about.get("labels") or {}
    try:
        wanted = labels.merge(given, annotations)
        policy = labels.parse_policy(wanted)
    except labels.LabelError as error:
        raise Refused(f"container {name}: {error}") from error
    strange = (key for key in {*given, *annotations} if labels.LOOKALIKE.match(key))
    for key in sorted(key for key in strange if not key.startswith(labels.PREFIX))[:LOOKALIKES_TOLD]:
        meant = labels.meant_by(key)
        if not meant and not key.lower().startswith("avckpt"):
            continue
        hint = f"did you mean {meant}?" if meant else f"avckpt's begin with {labels.PREFIX}"
        warn(f"container {name}: the label {key} means nothing; {hint}", parent)
    if not policy.enable and not (policy.listens and _is_ours()):
        return config
    annotations = {**annotations, **wanted, "avckpt.name": name, "avckpt.version": VERSION}
    annotations.pop("avckpt.id", None)  # only avckpt-runtime may set it
    if not policy.enable:
        # Left unchanged: the sidecar only has to know that it runs.
        data["annotations"] = annotations
        add_hooks(data, told=True)
        return json.dumps(data, separators=(",", ":")).encode()
    # The hook is in two directories.
    if any(map(_is_init, data.get("mounts") or [])):
        return config
    reason = _unprotectable(data, container, policy.scope) or _occupied(data, bundle, policy.scope)
    if reason:
        warn(f"container {name} runs unprotected: {reason}", parent)
        return config
    told = _tell_if_alone(name, parent)
    if policy.scope == "nodes":
        lend_init(data)
    else:
        put_init_in_front(data)
    if not policy.io_uring:
        take_io_uring_away(data)
    data["annotations"] = annotations
    add_hooks(data, told)
    if policy.scope == "nodes":
        return json.dumps(data, separators=(",", ":")).encode()
    # Always: the sidecar's configuration may say avckpt.restore.on=unhealthy, now or later.
    if parent:
        _ask_for_health(container, name, parent)
    return json.dumps(data, separators=(",", ":")).encode()


def _ask_for_health(container: str, name: str, parent: int) -> None:
    from avckpt_hooks import health

    try:
        health.ask_later(container, parent)
    except (OSError, podman.Unknown) as error:
        tell.journal(f"avckpt: container {name}: its health check cannot be determined: {error}")


def put_init_in_front(data: dict[str, Any]) -> None:
    """Makes avckpt-init the container's main process.  Changes `data`."""
    from avckpt_hooks.shared.programs import OTHER_INITS

    args = data["process"]["args"]
    # --init's own init would only get between ours and the app.
    if args[0] in OTHER_INITS:
        args = args[2:] if args[1:2] == ["--"] else args[1:]
    stop_signal = (data.get("annotations") or {}).get("org.opencontainers.image.stopSignal", "15")
    if not stop_signal.isdecimal():
        stop_signal = "15"
    data["process"]["args"] = [
        INIT_PATH,
        "--wait-ms",
        str(WAIT_MS),
        "--stop-signal",
        stop_signal,
        "--",
        *args,
    ]
    _mount(data, init_binary(), INIT_PATH)


def lend_init(data: dict[str, Any]) -> None:
    """Leaves the main process, a launcher, as it is, and gives it what it needs to start units. Changes
    `data`."""
    from avckpt_hooks.shared import protocol

    # Not the socket itself: each sidecar creates a new one.
    os.makedirs(protocol.units_dir(), mode=0o755, exist_ok=True)
    _mount(data, init_binary(), INIT_PATH)
    _mount(data, protocol.units_dir(), protocol.UNITS_IN_CONTAINER)
    process = data["process"]
    ours = ("AVCKPT_INIT=", "AVCKPT_UNIT=", "AVCKPT_UNITS=")
    kept = [entry for entry in process.get("env") or [] if not entry.startswith(ours)]
    process["env"] = [*kept, f"AVCKPT_INIT={INIT_PATH}"]


def _mount(data: dict[str, Any], source: str, destination: str) -> None:
    # Last, so that no mount on /run (a tmpfs of --read-only, say) hides it.
    data.setdefault("mounts", []).append(
        {
            "destination": destination,
            "type": "bind",
            "source": source,
            "options": ["bind", "ro", "nosuid", "nodev", "rprivate"],
        }
    )


def take_io_uring_away(data: dict[str, Any]) -> None:
    """Makes io_uring and AIO fail as on a kernel without them, by the container's seccomp profile.  Changes `data`."""
    linux = data.setdefault("linux", {})
    # A container without a profile (--privileged, seccomp=unconfined) gets one that allows all else.
    profile = linux.get("seccomp") or {"defaultAction": "SCMP_ACT_ALLOW"}
    rules = []
    for rule in profile.get("syscalls") or []:
        # One call with two answers is an error to libseccomp.
        names = [name for name in rule.get("names") or [] if name not in IO_URING]
        if names:
            rules.append({**rule, "names": names})
    rules.append({"names": list(IO_URING), "action": "SCMP_ACT_ERRNO", "errnoRet": errno.ENOSYS})
    linux["seccomp"] = {**profile, "syscalls": rules}


def add_hooks(data: dict[str, Any], told: bool) -> None:
    """Has the OCI runtime call our other two hooks.  Changes `data`."""
    env = [f"{name}={os.environ[name]}" for name in ("PATH", "AVCKPT_RUN_DIR") if name in os.environ]
    hooks = data.get("hooks") or {}
    for stage, more in (("prestart", ["--told"] if told else []), ("poststop", [])):
        hook = {
            "path": os.path.join(os.path.dirname(os.path.abspath(sys.argv[0])), "avckpt-hook"),
            "args": ["avckpt-hook", stage, *more],
            "env": env,
            "timeout": HOOK_TIMEOUT_S,
        }
        hooks[stage] = [*(hooks.get(stage) or []), hook]
    data["hooks"] = hooks


def spoil(config: bytes, line: str) -> bytes:
    """A configuration that cannot start, so that `line` is the reason given.

    A client of Podman's REST service sees Podman's message, which for a
    failed precreate hook has the exit status only. For a missing hook,
    runtimes report the path.
    """
    import json

    data = json.loads(config)
    hooks = data.get("hooks") or {}
    hooks["prestart"] = [{"path": line, "args": ["avckpt"]}]
    data["hooks"] = hooks
    return json.dumps(data).encode()


def init_binary() -> str:
    """The avckpt-init that belongs to this hook.  "" if there is none."""
    beside = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
    for path in (f"{beside}/avckpt-init", f"{beside}/../native/build/avckpt-init"):
        if os.access(path, os.X_OK):
            return os.path.realpath(path)
    return ""


def warn(line: str, parent: int) -> bool:
    """Tells the user and the journal.  True if the user can see it."""
    line = f"avckpt: {line}"
    tell.journal(line)
    if not parent:
        print(tell.printable(line), file=sys.stderr)
        return False
    return tell.parent(line, parent) and not podman.is_service(parent)


def _is_init(mount: dict[str, Any]) -> bool:
    return mount.get("destination") == INIT_PATH and os.path.basename(mount.get("source") or "") == "avckpt-init"


def _occupied(data: dict[str, Any], bundle: str, scope: str) -> str:
    """What the container itself has where we mount something; "" if there is nothing.

    It would be hidden, or mounted over where a link leads; or the runtime could not mount anything
    there, and the container would not start.
    """
    from avckpt_hooks.shared import protocol

    if _has(data, bundle, INIT_PATH, stat.S_IFREG):
        return f"it has a {INIT_PATH} of its own"
    if scope == "nodes" and _has(data, bundle, protocol.UNITS_IN_CONTAINER, stat.S_IFDIR):
        return f"it has a {protocol.UNITS_IN_CONTAINER} of its own"
    return ""


def _has(data: dict[str, Any], bundle: str, path: str, kind: int) -> bool:
    """Whether there is anything but an empty file, or a directory, which an earlier start may have left."""
    folder, name = os.path.split(path)
    root = os.path.join(bundle, (data.get("root") or {}).get("path") or "")
    where = f"{root}{folder}"
    for mount in data.get("mounts") or []:
        at = os.path.normpath(mount.get("destination") or "")
        if at == path:
            return True
        if at == folder:
            # Of a new tmpfs (--read-only) the source is no path.
            where = str(mount.get("source") or "")
    if not os.path.isabs(where) or os.path.islink(where):
        return False
    try:
        found = os.lstat(f"{where}/{name}")
    except OSError:
        return False
    return stat.S_IFMT(found.st_mode) != kind or (kind == stat.S_IFREG and found.st_size > 0)


def _unprotectable(data: dict[str, Any], container: str, scope: str) -> str:
    """Why a container is better left as it is; "" if it can be protected."""
    from avckpt_hooks.shared.programs import must_be_pid_1

    if not _is_ours():
        return "only containers of root can be protected, and this Podman is rootless"
    if not init_binary():
        return "avckpt-init is missing; run `avckpt install` again"
    if scope == "nodes":
        return ""  # no init stands in front of its main process
    process = data.get("process") or {}
    command = (process.get("args") or [""])[0]
    if must_be_pid_1(command):
        return (
            f"its command is {command}, which must itself be PID 1; "
            "to protect its program, start that without it (--entrypoint)"
        )
    # What Podman sets for systemd only (--systemd, by default for some commands).
    if container and f"container_uuid={container[:32]}" in (process.get("env") or []):
        return "Podman starts it as systemd, which must itself be PID 1; if it is none, give --systemd=false"
    return ""


def _is_ours() -> bool:
    """Whether this is root's Podman."""
    if os.environ.get("_CONTAINERS_ROOTLESS_UID") or os.geteuid() != 0:
        return False
    with open("/proc/self/uid_map") as file:
        return file.read().split() == ["0", "0", "4294967295"]


def _tell_if_alone(name: str, parent: int) -> bool:
    """Warns when no sidecar listens.  True if the user has been told so.  Waits for one that is starting."""
    import time

    from avckpt_hooks.shared import protocol

    deadline = time.monotonic() + protocol.START_S
    problem = _not_listening()
    while problem and time.monotonic() < deadline and _is_starting():
        time.sleep(0.02)
        problem = _not_listening()
    if not problem:
        return False
    line = f"container {name} runs unprotected until the sidecar is started ({protocol.hooks_socket()}: {problem})"
    return warn(line, parent)


def _not_listening() -> str:
    """Why no sidecar can be reached, or ""."""
    import socket

    from avckpt_hooks.shared import protocol

    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as connection:
            connection.setblocking(False)
            connection.connect(protocol.hooks_socket())
    except BlockingIOError:  # it listens, and is busy
        return ""
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _is_starting() -> bool:
    """A sidecar lives that may listen in a moment."""
    import fcntl

    from avckpt_hooks.shared import protocol

    try:
        fd = os.open(protocol.starting_lock(), os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(fd)
    return False
