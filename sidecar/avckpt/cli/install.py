# SPDX-License-Identifier: Apache-2.0
"""Puts hooks, hook JSON, avckpt-init and Podman's configuration in place, and takes them away again.

Everything written is listed in a manifest, and `uninstall()` removes what the
manifest lists and nothing else.  Every file is written beside its place and
renamed into it: running containers have avckpt-init mounted, and a hook may be
starting at any moment.  They are renamed when all are written: a disk that is
full leaves the installation as it was, and not one of two versions mixed, whose
hooks could keep containers from starting.  What is there already stays untouched.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import psutil
from avckpt_hooks.shared import protocol
from avckpt_hooks.shared.files import write_at_once

import avckpt
from avckpt import artifacts
from avckpt.cli import containers_conf, leftovers
from avckpt.containers.process import age_s, command_line
from avckpt.containers.records import Records
from avckpt.errors import ConfigError, Denied, TargetGone

LIBEXEC = Path("/usr/local/libexec/avckpt")
SHARE = Path("/usr/local/share/avckpt")
HOOKS_DIR = SHARE / "oci-hooks.d"
MANIFEST = SHARE / "manifest.json"
DROP_IN = Path("/etc/containers/containers.conf.d/50-avckpt.conf")
TMPFILES = Path("/etc/tmpfiles.d/avckpt.conf")
QUADLET = Path("/etc/containers/systemd/avckpt-sidecar.container")
CONFIG_DIR = Path("/etc/avckpt")
"""For the user's config.yaml; made here because the sidecar's container mounts it."""

HOOK_PROGRAM = LIBEXEC / "avckpt-hook"
RUNTIME_PROGRAM = LIBEXEC / "avckpt-runtime"
"""For Docker and containerd."""
RUNTIME_USERS = (
    "/etc/docker/daemon.json",
    "/etc/containerd/config.toml",
    "/etc/crio/crio.conf",
    "/etc/crio/crio.conf.d/*",
)
INIT_PROGRAM = LIBEXEC / "avckpt-init"
_PACKAGE = LIBEXEC / "avckpt_hooks"
_CACHES = (_PACKAGE / "__pycache__", _PACKAGE / "shared/__pycache__")

_PYTHONS = ("/usr/bin/python3", "/usr/local/bin/python3", "/bin/python3")
_HOST = Path("/")


@dataclass(frozen=True)
class Manifest:
    """What an installation put in place; paths as they are on the host."""

    version: str
    files: tuple[Path, ...] = ()
    directories: tuple[Path, ...] = ()
    """Those that had to be made, parents first."""

    @classmethod
    def read(cls, root: Path = _HOST) -> Manifest | None:
        """The installation's manifest; None if nothing is installed.  Raises ConfigError."""
        path = under(root, MANIFEST)
        try:
            data = json.loads(path.read_text())
            return cls(
                str(data["version"]),
                tuple(Path(name) for name in data["files"]),
                tuple(Path(name) for name in data["directories"]),
            )
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(
                f"{path} is damaged, so what is installed is not known: remove {LIBEXEC}, {SHARE} and {DROP_IN}"
            ) from error


@dataclass(frozen=True)
class _File:
    """One that is installed; `path` as on the host."""

    path: Path
    content: bytes
    mode: int = 0o644
    """0: a symbolic link to `content`."""

    def write(self, to: Path) -> None:
        """Raises OSError."""
        if self.mode:
            to.write_bytes(self.content)
            to.chmod(self.mode)
        else:
            to.symlink_to(self.content.decode())

    def is_at(self, place: Path) -> bool:
        """Whether the installed file equals it."""
        try:
            if place.is_symlink():
                return not self.mode and os.readlink(place).encode() == self.content
            return place.read_bytes() == self.content and stat.S_IMODE(place.stat().st_mode) == self.mode
        except OSError:
            return False


class _Writer:
    """Writes files under `root`: beside their places, until `put_in_place()`."""

    def __init__(self, root: Path, undo: contextlib.ExitStack) -> None:
        self._root = root
        self._undo = undo
        self._written: list[tuple[Path, Path]] = []
        self.files: list[Path] = []
        self.directories: list[Path] = []
        """Those that had to be made, parents first."""

    def directory(self, path: Path) -> None:
        """Makes `path` and its parents, as far as they are missing."""
        missing = [p for p in (path, *path.parents) if not under(self._root, p).exists()]
        for p in reversed(missing):
            under(self._root, p).mkdir(mode=0o755)
            self._undo.callback(_remove_if_empty, under(self._root, p))
            under(self._root, p).chmod(0o755)  # whatever the umask says: users inside containers come here
            self.directories.append(p)

    def file(self, file: _File) -> None:
        """Writes it beside its place, unless it is there."""
        self.files.append(file.path)
        self.directory(file.path.parent)
        place = under(self._root, file.path)
        if file.is_at(place):
            return
        temporary = place.with_name(f".{place.name}.{os.getpid()}.new")
        try:
            temporary.unlink(missing_ok=True)
            self._undo.callback(temporary.unlink, missing_ok=True)
            file.write(temporary)
        except OSError as error:  # of a full disk it names no file
            raise OSError(error.errno, error.strerror, str(place)) from error
        self._written.append((temporary, place))

    def put_in_place(self) -> None:
        """Renames them into their places, in order; then there is nothing to be undone."""
        for temporary, place in self._written:
            os.replace(temporary, place)
        self._undo.pop_all()


def install(root: Path = _HOST, *, quadlet: bool = False) -> list[str]:
    """Installs, or brings an installation up to date.

    `root` is where the host's file system is (`/host` in a container that has
    it mounted there).  With `quadlet` also a systemd unit for the sidecar; one
    that an earlier installation has put in place stays.  Returns what was done, a line each; a line that starts
    with "warning: " needs the user.  Raises ConfigError, Denied.
    """
    if os.geteuid() != 0:
        raise Denied("this needs root (sudo avckpt install)")
    before = Manifest.read(root) or Manifest(avckpt.__version__)
    python = _hook_python(root)
    files = _own_files(python)
    done = [
        f"{INIT_PROGRAM}: the init of protected containers",
        f"{HOOK_PROGRAM}: the hooks, run by {python}",
        f"{HOOKS_DIR}: tells Podman when to call them",
    ]
    if under(root, TMPFILES.parent).is_dir():
        line = f"# avckpt: where hooks and sidecar meet\nd {_run_dir()} 0755 root root -\n"
        files.append(_File(TMPFILES, line.encode()))
        done.append(f"{TMPFILES}: makes {_run_dir()} when the machine starts")
    if quadlet or QUADLET in before.files:
        files.append(_File(QUADLET, artifacts.packaging(QUADLET.name).read_bytes()))
        done.append(f"{QUADLET}: the sidecar as a unit of systemd (Podman 4.4 or newer; systemctl daemon-reload)")
    # Last: from here on Podman calls the hooks.
    directories = containers_conf.with_directory(root, HOOKS_DIR, without=DROP_IN)
    files.append(_File(DROP_IN, _drop_in(directories).encode()))
    done.append(f"{DROP_IN}: hooks_dir of every Podman command, restarts included")
    state = "nothing was changed"
    try:
        with contextlib.ExitStack() as undo:
            writer = _Writer(root, undo)
            for file in files:
                if file.path == QUADLET and (aside := _set_aside(root, file, undo)):
                    done.append(
                        f"warning: {QUADLET} was another, which is kept as {aside.name}: yours may have changes"
                    )
                writer.file(file)
            for path in (_run_dir(), CONFIG_DIR, *_CACHES):
                writer.directory(path)
            # It names all that is there from now on, however far we come.
            new = [path for path in writer.files if path not in before.files]
            made = [*before.directories, *(path for path in writer.directories if path not in before.directories)]
            _record(root, [*new, *before.files], made)
            state = "only a part is in place: mend that, and run avckpt install again"
            writer.put_in_place()
        installed = [*_compile(root, python), *writer.files]
        for path in before.files:
            if path not in installed and _remove(under(root, path)):
                done.append(f"removed {path}: this version has no use for it")
        _record(root, installed, made)
    except OSError as error:
        where = error.filename2 or error.filename  # of a rename, the new name
        raise ConfigError(f"{where} cannot be written: {error.strerror}; {state}") from error
    environ = os.environ if root == _HOST else {}
    problems = containers_conf.problems(HOOKS_DIR, root, environ) + (service_problems() if root == _HOST else [])
    return done + [f"warning: {line}" for line in problems]


def _set_aside(root: Path, file: _File, undo: contextlib.ExitStack) -> Path | None:
    """Copies what is in its place, and is not the same, beside it.  Raises OSError."""
    place = under(root, file.path)
    try:
        content = place.read_bytes()
    except FileNotFoundError:
        return None
    if content == file.content:
        return None
    aside = place.with_name(f"{place.name}.old")  # a suffix that Quadlet does not read
    undo.callback(aside.unlink, missing_ok=True)
    write_at_once(str(aside), content, 0o644)
    return aside


def outdated(root: Path = _HOST) -> list[Path]:
    """Installed files that are not as this avckpt has them, also those that are gone.  Raises ConfigError.

    A version number does not tell: between two releases all builds have the same.
    """
    return [file.path for file in _own_files(_hook_python(root)) if not file.is_at(under(root, file.path))]


def service_problems() -> list[str]:
    """A line with a remedy for each Podman service of root's that calls no hooks: it is older than the drop-in file.

    hooks_dir is read when a Podman starts.
    """
    try:
        installed_at = DROP_IN.stat().st_mtime
    except OSError:
        return []
    found = []
    for pid in psutil.pids():
        try:
            command = command_line(pid)
            if Path(command[0]).name != "podman" or ("system", "service") not in zip(command, command[1:]):
                continue
            is_roots = psutil.Process(pid).uids().real == 0
        except (OSError, psutil.Error):
            continue  # it has just ended
        chosen = any(word.startswith("--hooks-dir") for word in command)
        if not chosen and is_roots and _is_older(pid, installed_at):
            found.append(
                f"Podman's service (process {pid}) is older than the installation and calls no hooks: "
                "sudo systemctl restart podman.service, or end it and start it again as you did"
            )
    return found


def _is_older(pid: int, than: float) -> bool:
    """psutil's create_time() is up to a second early: the kernel tells when it booted in whole seconds."""
    with contextlib.suppress(TargetGone):
        return age_s(pid) > time.time() - than
    return False


def uninstall(root: Path = _HOST) -> list[str]:
    """Removes exactly what `install()` put in place.

    Returns what was done, a line each.  Containers that run go on, and are not
    protected any more when they are started again.  Those that run with our
    hooks call them once more, when they end: until then the program stays, for
    crun can die of one that is not there (SIGPIPE: it writes to the hook without
    knowing whether that could be started), and `podman stop` fails.  What cannot
    be removed leaves all in place.  Raises ConfigError.
    """
    if os.geteuid() != 0:
        raise Denied("this needs root (sudo avckpt uninstall)")
    manifest = Manifest.read(root)
    callers = _callers(root)
    if manifest is None:
        return ["nothing is installed", *([] if callers else _remove_leftovers(root))]
    naming = _naming_the_runtime(root)
    programs = (HOOK_PROGRAM, RUNTIME_PROGRAM)
    kept = [path for path in manifest.files if (callers or naming) and (path in programs or _PACKAGE in path.parents)]
    left = [*kept, MANIFEST] if kept else []
    # Backwards: Podman forgets the hooks before they are gone.
    doomed = [path for path in (*reversed(manifest.files), MANIFEST) if path not in left]
    done = [f"removed {path}" for path in _remove_all(root, doomed)]
    if not callers:
        done += _remove_leftovers(root)
    if kept:
        try:
            _record(root, kept, list(manifest.directories))
        except OSError as error:
            raise ConfigError(f"{MANIFEST} cannot be written: {error.strerror}; run avckpt uninstall again") from error
        if callers:
            who = ", ".join(callers)
            done.append(f"left {HOOK_PROGRAM}: {who} will call it when ended; run avckpt uninstall again then")
        if naming:
            what = f"left {RUNTIME_PROGRAM}: {naming} names it, and containers started by it end by it"
            done.append(f"{what}; take it out there, make them anew, and run avckpt uninstall again")
    in_use = {folder for path in left for folder in path.parents}
    for path in reversed(manifest.directories):
        if path in in_use:
            continue
        try:
            under(root, path).rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            done.append(f"left {path}: it holds other files")
        else:
            done.append(f"removed {path}")
    return done


def _remove_leftovers(root: Path) -> list[str]:
    """What was done about what hooks and sidecars have left, a line each."""
    done = [f"removed {path}" for path in leftovers.remove(root, _run_dir())]
    cores = _run_dir() / leftovers.CORES
    count = len(list(under(root, cores).glob("*")))
    if count:
        done.append(f"left {cores}: it holds {count} core file(s), with all that the programs knew")
    return done


def _naming_the_runtime(root: Path) -> str:
    """The configuration file of Docker, containerd or CRI-O that has avckpt-runtime; "" if none has."""
    for pattern in RUNTIME_USERS:
        for path in sorted(root.glob(pattern.lstrip("/"))):
            with contextlib.suppress(OSError):
                if RUNTIME_PROGRAM.name.encode() in path.read_bytes():
                    return f"/{path.relative_to(root)}"
    return ""


def _remove_all(root: Path, paths: list[Path]) -> list[Path]:
    """Removes files, all or none; those that were there.  Raises ConfigError."""
    aside: dict[Path, Path] = {}
    with contextlib.ExitStack() as undo:
        for path in paths:
            place = under(root, path)
            temporary = place.with_name(f".{place.name}.{os.getpid()}.old")
            try:
                os.rename(place, temporary)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                raise ConfigError(f"{path} cannot be removed: {error.strerror}; nothing was changed") from error
            undo.callback(os.rename, temporary, place)
            aside[path] = temporary
        undo.pop_all()
    for temporary in aside.values():
        _remove(temporary)
    return list(aside)


def _callers(root: Path) -> list[str]:
    """The names of running containers that were started with our hooks."""
    names = []
    for container, pidfd in Records(under(root, Path(protocol.records_dir()).absolute())).adoptable(lambda _: False):
        os.close(pidfd)
        names.append(container.name or container.id[:12])
    return names


def under(root: Path, path: Path) -> Path:
    """Where a path of the host is, seen from here."""
    return root / path.relative_to("/")


def _own_files(python: str) -> list[_File]:
    """What this avckpt installs on every machine.  Raises ConfigError."""
    files = [_File(INIT_PROGRAM, artifacts.init_binary().read_bytes(), 0o755)]
    package = artifacts.hooks_source()
    for source in sorted(package.glob("**/*.py")):
        content = source.read_bytes()
        name = source.relative_to(package)
        executable = name == Path("__main__.py")
        if executable:
            content = content.replace(b"/usr/bin/python3", python.encode(), 1)
        files.append(_File(_PACKAGE / name, content, 0o755 if executable else 0o644))
    files += [_File(path, f"{_PACKAGE.name}/__main__.py".encode(), 0) for path in (HOOK_PROGRAM, RUNTIME_PROGRAM)]
    files += [
        _File(HOOKS_DIR / path.name, _hook_json(path)) for path in sorted(artifacts.oci_hooks_source().glob("*.json"))
    ]
    return files


def _run_dir() -> Path:
    """Where hooks and sidecar are to meet: our environment says it, as it does to the sidecar."""
    return Path(protocol.run_dir()).absolute()


def _hook_json(source: Path) -> bytes:
    """A hook's description.  Podman gives a hook no environment but the one in there."""
    if not os.environ.get("AVCKPT_RUN_DIR"):
        return source.read_bytes()
    data = json.loads(source.read_bytes())
    data["hook"]["env"].append(f"AVCKPT_RUN_DIR={_run_dir()}")
    return json.dumps(data, indent=2).encode() + b"\n"


def _record(root: Path, files: list[Path], directories: list[Path]) -> None:
    """Writes the manifest, at once or not at all.  Raises OSError."""
    content = {
        "version": avckpt.__version__,
        "files": [str(path) for path in files],
        "directories": [str(path) for path in directories],
    }
    with contextlib.ExitStack() as undo:
        writer = _Writer(root, undo)
        writer.file(_File(MANIFEST, json.dumps(content, indent=1).encode() + b"\n"))
        writer.put_in_place()


def _remove_if_empty(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.rmdir()


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"{path} cannot be removed: {error.strerror}") from error
    return True


def _hook_python(root: Path) -> str:
    """The host's own Python: hooks must run whatever becomes of a virtual environment.

    A hook whose interpreter is missing fails every `podman run` of the machine.
    """
    for name in _PYTHONS:
        if os.access(under(root, Path(name)), os.X_OK):
            break
    else:
        raise ConfigError(f"the hooks need the system's Python, and none of {', '.join(_PYTHONS)} is there")
    if root == _HOST:
        script = "import sys; sys.exit(sys.version_info < (3, 9))"
        if subprocess.run([name, "-IBS", "-c", script], check=False).returncode != 0:
            raise ConfigError(f"the hooks need Python 3.9 or newer, and {name} is older or does not work")
    return name


def _compile(root: Path, python: str) -> list[Path]:
    """Byte code for the hooks: they start for every container, and run with -B."""
    if root != _HOST:
        return []  # the host's Python cannot be run from here
    # Not fatal: without byte code the hooks are slower, no more.
    subprocess.run([python, "-IS", "-m", "compileall", "-q", str(_PACKAGE)], check=False, stdout=subprocess.DEVNULL)
    return sorted(path for cache in _CACHES for path in cache.glob("*.pyc"))


def _drop_in(directories: list[str]) -> str:
    listed = ", ".join(json.dumps(directory) for directory in directories)
    return (
        "# Written by `avckpt install`, removed by `avckpt uninstall`.\n"
        "# The directories that were in force before, and avckpt's.\n"
        f"[engine]\nhooks_dir = [{listed}]\n"
    )
