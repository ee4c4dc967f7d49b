# SPDX-License-Identifier: Apache-2.0
"""What a precreate hook can learn about the container it is called for.

Podman passes it neither the container's id nor its labels, and holds the
container's lock meanwhile, so that most queries would never return. `podman
generate spec` takes no lock.
"""

from __future__ import annotations

import os
import select
import time

TYPE_CHECKING = False  # typing.TYPE_CHECKING, without the 7 ms that importing it takes
if TYPE_CHECKING:
    from collections.abc import Callable

_ID_LENGTH = 64
_TIMEOUT_S = 20.0
_MOST_BYTES = 16 << 20
"""Limit for a program's output: labels and health checks come from an image, which is not trusted."""
_SIGKILL = 9  # importing signal takes 4 ms
_DEFAULT_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

_STORE_FLAGS = {
    "--db-backend",
    "--imagestore",
    "--module",
    "--root",
    "--runroot",
    "--storage-driver",
    "--storage-opt",
    "--tmpdir",
    "--volumepath",
}
"""Global options with a value that decide where Podman finds a container."""

_STORE_SWITCHES = {"--transient-store"}
"""The same, without a value or with one behind "="."""

_OTHER_FLAGS = {
    "--cdi-spec-dir",
    "--cgroup-manager",
    "--conmon",
    "--config",
    "--connection",
    "-c",
    "--default-mounts-file",
    "--events-backend",
    "--hooks-dir",
    "--identity",
    "--log-level",
    "--namespace",
    "--network-backend",
    "--network-cmd-path",
    "--network-config-dir",
    "--out",
    "--registries-conf",
    "--runtime",
    "--runtime-flag",
    "--ssh",
    "--url",
}
"""Global options with a value that do not."""


class Unknown(Exception):
    """The answer cannot be found out; the text says why."""


def container_id(config: bytes) -> str:
    """The container's id from its OCI configuration.  Raises Unknown.

    The configuration does not name it: the cgroup does, and with
    --cgroups=disabled the paths of files that Podman mounts.
    """
    # Searched, not parsed: reading 25 kB of JSON is half of what an unlabelled
    # container would pay for this hook. From the end: annotations, whose names
    # the user chooses, come before.
    start, end = b'"cgroupsPath":"', b'"'
    at = config.rfind(start)
    if at >= 0:
        at += len(start)
        found = _last_id(config[at : config.find(end, at)].decode(errors="replace"))
        if found:
            return found
    import json

    try:
        data = json.loads(config)
        for mount in data.get("mounts") or []:
            # Other mounts may be another container's: /dev/shm of a pod is its
            # infra container's, /etc/hosts that of the owner of the network.
            if mount.get("destination") in ("/run/.containerenv", "/etc/hostname"):
                found = _last_id(mount.get("source", ""))
                if found:
                    return found
    except (ValueError, AttributeError) as error:
        raise Unknown("its configuration is not what was expected") from error
    raise Unknown("its configuration does not contain its id")


def generate_spec(container: str, parent_pid: int) -> bytes:
    """What `podman generate spec` prints for a container, labels included.

    Asks the Podman that is `parent_pid` for it: the same program, environment
    and store.  Raises Unknown.
    """
    argv = _cmdline(parent_pid)
    env = _environment(parent_pid)
    program = _program(parent_pid, env)
    attempts = [store_flags(argv)]
    anywhere = store_flags(argv, anywhere=True)
    if anywhere != attempts[0]:
        attempts.append(anywhere)
    error = Unknown("podman could not be run")
    deadline = time.monotonic() + _TIMEOUT_S
    for flags in attempts:
        command = ["podman", *flags, "generate", "spec", "-c", "-n=false", container]
        try:
            return _run(program, command, env, deadline)
        except Unknown as failed:
            error = failed
    raise error


def inspector(container: str, parent_pid: int) -> Callable[[float], bytes]:
    """A function of a deadline (CLOCK_MONOTONIC, s) that returns what `podman inspect` prints for a container.

    It asks as `generate_spec()` does, and may be called when the parent has exited. It waits for the
    container's lock: never call it in a hook. Raises Unknown.
    """
    argv = _cmdline(parent_pid)
    env = _environment(parent_pid)
    program = _program(parent_pid, env)
    if program.startswith("/proc/"):
        program = os.path.realpath(program)
    attempts = {tuple(store_flags(argv)): None, tuple(store_flags(argv, anywhere=True)): None}

    def ask(deadline: float) -> bytes:
        error = Unknown("podman could not be run")
        for flags in attempts:
            try:
                return _run(program, ["podman", *flags, "inspect", "--type", "container", container], env, deadline)
            except Unknown as failed:
                error = failed
        raise error

    return ask


def is_service(pid: int) -> bool:
    """True if `pid` is Podman's REST service, whose standard error no user reads."""
    argv = _cmdline(pid)
    return "system" in argv and "service" in argv


def store_flags(argv: list[str], anywhere: bool = False) -> list[str]:
    """The options of a Podman command line that decide where containers are.

    Searches before the subcommand; with `anywhere` the whole line, which may
    mistake an option of the container's own command for one of Podman's.
    """
    flags: list[str] = []
    words = iter(argv[1:])
    for word in words:
        name, has_value, _ = word.partition("=")
        if not word.startswith("-"):
            if not anywhere:
                break
        elif has_value or name in _STORE_SWITCHES:
            if name in _STORE_FLAGS | _STORE_SWITCHES:
                flags.append(word)
        elif name in _STORE_FLAGS | _OTHER_FLAGS:
            value = next(words, None)
            if name in _STORE_FLAGS and value is not None:
                flags.append(f"{name}={value}")
    return flags


def _asked(argv: list[str]) -> str:
    return "inspect" if "inspect" in argv else "generate spec"


def _last_id(path: str) -> str | None:
    """The last run of exactly 64 hex digits in `path`."""
    word = ""
    found = None
    for c in path + "/":
        if c in "0123456789abcdef":
            word += c
        else:
            if len(word) == _ID_LENGTH:
                found = word
            word = ""
    return found


def _cmdline(pid: int) -> list[str]:
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return [os.fsdecode(word) for word in file.read(_MOST_BYTES).split(b"\0")[:-1]]
    except OSError:
        return []


def _environment(pid: int) -> dict[str, str]:
    """The parent's environment: it says which configuration and store it uses."""
    env: dict[str, str] = {}
    try:
        with open(f"/proc/{pid}/environ", "rb") as file:
            for entry in file.read(_MOST_BYTES).split(b"\0"):
                name, equals, value = os.fsdecode(entry).partition("=")
                if equals and name and value:
                    env[name] = value
    except OSError:
        pass
    # These would make it a client of another Podman.
    env.pop("CONTAINER_HOST", None)
    env.pop("CONTAINER_CONNECTION", None)
    env.setdefault("PATH", os.environ.get("PATH") or _DEFAULT_PATH)
    return env


def _program(pid: int, env: dict[str, str]) -> str:
    """The parent's own executable if it is a Podman, else the one in PATH."""
    try:
        target = os.readlink(f"/proc/{pid}/exe")
        if os.path.basename(target).startswith("podman"):
            # After an upgrade the name is "... (deleted)" but the link still works.
            return target if os.path.exists(target) else f"/proc/{pid}/exe"
    except OSError:
        pass
    for folder in env["PATH"].split(":"):
        path = os.path.join(folder, "podman")
        if os.access(path, os.X_OK):
            return path
    raise Unknown("podman is not in PATH")


def _run(program: str, argv: list[str], env: dict[str, str], deadline: float) -> bytes:
    """Standard output of a program.  Raises Unknown when it fails or is late."""
    # subprocess would cost more to import than all of the rest of this hook.
    out, out_end = os.pipe()
    err, err_end = os.pipe()
    try:
        pid = os.posix_spawn(
            program,
            argv,
            env,
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, "/dev/null", os.O_RDONLY, 0),
                (os.POSIX_SPAWN_DUP2, out_end, 1),
                (os.POSIX_SPAWN_DUP2, err_end, 2),
            ],
        )
    except OSError as error:
        os.close(out)
        os.close(err)
        raise Unknown(f"{program} cannot be run: {error.strerror}") from error
    finally:
        os.close(out_end)
        os.close(err_end)
    texts = {out: bytearray(), err: bytearray()}
    poll = select.poll()
    for fd in texts:
        poll.register(fd, select.POLLIN)
    open_fds = len(texts)
    try:
        while open_fds:
            wait_s = deadline - time.monotonic()
            ready = poll.poll(wait_s * 1000) if wait_s > 0 else []
            if not ready:
                os.kill(pid, _SIGKILL)  # our child, which only we reap: the PID cannot have been reused
                raise Unknown(f"podman {_asked(argv)} took too long")
            for fd, _ in ready:
                part = os.read(fd, 65536)
                texts[fd] += part
                if len(texts[fd]) > _MOST_BYTES:
                    os.kill(pid, _SIGKILL)
                    raise Unknown(f"podman {_asked(argv)} printed too much")
                if not part:
                    poll.unregister(fd)
                    open_fds -= 1
    finally:
        os.close(out)
        os.close(err)
        _, status = os.waitpid(pid, 0)
    if status != 0:
        lines = texts[err].decode(errors="replace").strip().splitlines()
        raise Unknown(f"podman {_asked(argv)}: {lines[-1] if lines else 'failed'}")
    return bytes(texts[out])
