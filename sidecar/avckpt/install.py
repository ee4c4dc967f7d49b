# SPDX-License-Identifier: Apache-2.0
"""Puts hooks, hook JSON, avckpt-init and Podman's configuration in place, and takes them away again.

Everything written is listed in a manifest, and `uninstall()` removes what the
manifest lists and nothing else.  Every file is written beside its place and
renamed into it: running containers have avckpt-init mounted, and a hook may be
starting at any moment.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import avckpt
from avckpt import artifacts, containers_conf
from avckpt.errors import ConfigError, Denied

LIBEXEC = Path("/usr/local/libexec/avckpt")
SHARE = Path("/usr/local/share/avckpt")
HOOKS_DIR = SHARE / "oci-hooks.d"
MANIFEST = SHARE / "manifest.json"
DROP_IN = Path("/etc/containers/containers.conf.d/50-avckpt.conf")
TMPFILES = Path("/etc/tmpfiles.d/avckpt.conf")
RUN_DIR = Path("/run/avckpt")
CONFIG_DIR = Path("/etc/avckpt")
"""For the user's config.yaml; made here because the sidecar's container mounts it."""

HOOK_PROGRAM = LIBEXEC / "avckpt-hook"
INIT_PROGRAM = LIBEXEC / "avckpt-init"

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


@dataclass
class _Writer:
    """Writes files under `root` and remembers what it made."""

    root: Path
    files: list[Path] = field(default_factory=list)
    directories: list[Path] = field(default_factory=list)

    def directory(self, path: Path) -> None:
        """Makes `path` and its parents, as far as they are missing."""
        missing = [p for p in (path, *path.parents) if not under(self.root, p).exists()]
        for p in reversed(missing):
            under(self.root, p).mkdir(mode=0o755)
            under(self.root, p).chmod(0o755)  # whatever the umask says: users inside containers come here
            self.directories.append(p)

    def file(self, path: Path, content: bytes, mode: int = 0o644) -> None:
        """Writes `content` to `path`, at once or not at all."""
        self.directory(path.parent)
        with _renamed_into(under(self.root, path)) as temporary:
            temporary.write_bytes(content)
            temporary.chmod(mode)
        self.files.append(path)

    def link(self, path: Path, target: str) -> None:
        """Makes `path` a symbolic link to `target`."""
        self.directory(path.parent)
        with _renamed_into(under(self.root, path)) as temporary:
            temporary.symlink_to(target)
        self.files.append(path)


def install(root: Path = _HOST) -> list[str]:
    """Installs, or brings an installation up to date.

    `root` is where the host's file system is (`/host` in a container that has
    it mounted there).  Returns what was done, a line each; a line that starts
    with "warning: " needs the user.  Raises ConfigError, Denied.
    """
    if os.geteuid() != 0:
        raise Denied("this needs root (sudo avckpt install)")
    before = Manifest.read(root)
    python = _hook_python(root)
    init = artifacts.init_binary().read_bytes()
    package = artifacts.hooks_source()
    writer = _Writer(root)
    done = []
    try:
        writer.file(INIT_PROGRAM, init, 0o755)
        done.append(f"{INIT_PROGRAM}: the init of protected containers")
        for source in sorted(package.glob("*.py")):
            content = source.read_bytes()
            executable = source.name == "__main__.py"
            if executable:
                content = content.replace(b"/usr/bin/python3", python.encode(), 1)
            writer.file(LIBEXEC / package.name / source.name, content, 0o755 if executable else 0o644)
        _compile(writer, python, package.name)
        writer.link(HOOK_PROGRAM, f"{package.name}/__main__.py")
        done.append(f"{HOOK_PROGRAM}: the hooks, run by {python}")
        for source in sorted(artifacts.oci_hooks_source().glob("*.json")):
            writer.file(HOOKS_DIR / source.name, source.read_bytes())
        done.append(f"{HOOKS_DIR}: tells Podman when to call them")
        writer.directory(RUN_DIR)
        writer.directory(CONFIG_DIR)
        if under(root, TMPFILES.parent).is_dir():
            writer.file(TMPFILES, b"# avckpt: where hooks and sidecar meet\nd /run/avckpt 0755 root root -\n")
            done.append(f"{TMPFILES}: makes {RUN_DIR} when the machine starts")
        # Last: from here on Podman calls the hooks.
        directories = containers_conf.with_directory(root, HOOKS_DIR, without=DROP_IN)
        writer.file(DROP_IN, _drop_in(directories).encode())
        done.append(f"{DROP_IN}: hooks_dir of every Podman command, restarts included")
        done += _finish(writer, before)
    except OSError as error:
        if writer.files:
            _finish(writer, before)  # so that uninstall finds what there is
        raise ConfigError(f"{error.filename} can not be written: {error.strerror}") from error
    environ = os.environ if root == _HOST else {}
    return done + [f"warning: {line}" for line in containers_conf.problems(HOOKS_DIR, root, environ)]


def uninstall(root: Path = _HOST) -> list[str]:
    """Removes exactly what `install()` put in place.

    Returns what was done, a line each.  Containers that run go on.  Raises
    ConfigError.
    """
    if os.geteuid() != 0:
        raise Denied("this needs root (sudo avckpt uninstall)")
    manifest = Manifest.read(root)
    if manifest is None:
        return ["nothing is installed"]
    done = []
    # Backwards: Podman forgets the hooks before they are gone.
    for path in (*reversed(manifest.files), MANIFEST):
        if _remove(under(root, path)):
            done.append(f"removed {path}")
    for path in reversed(manifest.directories):
        try:
            under(root, path).rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            done.append(f"left {path}: it holds other files")
        else:
            done.append(f"removed {path}")
    return done


def under(root: Path, path: Path) -> Path:
    """Where a path of the host is, seen from here."""
    return root / path.relative_to("/")


def _finish(writer: _Writer, before: Manifest | None) -> list[str]:
    """Writes the manifest, and removes what only an older version had."""
    done = []
    directories = list(before.directories if before else ())
    stale = [path for path in (before.files if before else ()) if path not in writer.files]
    for path in stale:
        if _remove(under(writer.root, path)):
            done.append(f"removed {path}: this version has no use for it")
    writer.directory(MANIFEST.parent)
    directories += [path for path in writer.directories if path not in directories]
    content = {
        "version": avckpt.__version__,
        "files": [str(path) for path in writer.files],
        "directories": [str(path) for path in directories],
    }
    writer.file(MANIFEST, json.dumps(content, indent=1).encode() + b"\n")
    return done


@contextlib.contextmanager
def _renamed_into(path: Path) -> Iterator[Path]:
    """A name beside `path`; what the block puts there takes the place of `path` at once."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    temporary.unlink(missing_ok=True)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"{path} can not be removed: {error.strerror}") from error
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


def _compile(writer: _Writer, python: str, package: str) -> None:
    """Byte code for the hooks: they start for every container, and run with -B."""
    if writer.root != _HOST:
        return  # the host's Python can not be run from here
    folder = LIBEXEC / package
    cache = folder / "__pycache__"
    writer.directory(cache)
    # Not fatal: without byte code the hooks are slower, no more.
    subprocess.run([python, "-IS", "-m", "compileall", "-q", str(folder)], check=False, stdout=subprocess.DEVNULL)
    writer.files += sorted(cache.glob("*.pyc"))


def _drop_in(directories: list[str]) -> str:
    listed = ", ".join(json.dumps(directory) for directory in directories)
    return (
        "# Written by `avckpt install`, removed by `avckpt uninstall`.\n"
        "# The directories that were in force before, and avckpt's.\n"
        f"[engine]\nhooks_dir = [{listed}]\n"
    )
