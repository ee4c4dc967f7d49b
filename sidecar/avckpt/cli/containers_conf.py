# SPDX-License-Identifier: Apache-2.0
"""Which hook directories Podman uses: the part of containers.conf(5) that avckpt lives by.

Podman reads its own defaults, then each file below; a later `hooks_dir` takes
the place of an earlier one, or is added to it from `{append=true}` in one of
them on, until `{append=false}` (newer Podman only).  With CONTAINERS_CONF in
the environment it reads that file only, and no drop-in.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

DEFAULT = ("/usr/share/containers/oci/hooks.d",)
_MAIN = (Path("/usr/share/containers/containers.conf"), Path("/etc/containers/containers.conf"))
_DROP_INS = Path("/etc/containers/containers.conf.d")
_HOST = Path("/")


@dataclass(frozen=True)
class HooksDirs:
    """The directories in force, and the file that says so (None: Podman's default)."""

    directories: tuple[str, ...]
    source: Path | None


def read(root: Path = _HOST, environ: Mapping[str, str] | None = None, without: Path | None = None) -> HooksDirs:
    """What Podman's configuration under `root` comes to, as if the file `without` were not there."""
    found = HooksDirs(DEFAULT, None)
    append = False
    for path in _files(root, environ or {}):
        said = None if path == without else _hooks_dir(root, path)
        if said is not None:
            append = append if said.append is None else said.append
            found = HooksDirs((*found.directories, *said.directories) if append else said.directories, path)
    return found


def with_directory(root: Path, directory: Path, without: Path) -> list[str]:
    """The directories in force without our own file, and `directory` behind them."""
    directories = list(read(root, without=without).directories)
    if str(directory) not in directories:
        directories.append(str(directory))
    return directories


def problems(directory: Path, root: Path = _HOST, environ: Mapping[str, str] | None = None) -> list[str]:
    """Why Podman would not look into `directory`, and what to do; empty if it does."""
    environ = environ or {}
    override = environ.get("CONTAINERS_CONF")
    lines = []
    if override and str(directory) not in (now := read(root, environ)).directories:
        lines.append(
            f"CONTAINERS_CONF is set, so Podman reads {override} and no other configuration: "
            f"{_advice(now, directory, now.source or Path(override))}"
        )
    plain = read(root)
    if str(directory) not in plain.directories:
        where = plain.source or _DROP_INS / "50-avckpt.conf"
        lines.append(f"Podman does not look into {directory}: {_advice(plain, directory, where)}")
    return lines


def _advice(now: HooksDirs, directory: Path, file: Path) -> str:
    listed = ", ".join(f'"{name}"' for name in (*now.directories, str(directory)))
    return f"write hooks_dir = [{listed}] under [engine] in {file}"


def _files(root: Path, environ: Mapping[str, str]) -> Iterator[Path]:
    """The files that Podman reads, in its order; paths as on the host."""
    override = environ.get("CONTAINERS_CONF")
    if override:
        yield Path(override).absolute()
    else:
        yield from _MAIN
        for path in sorted(_seen(root, _DROP_INS).glob("*.conf")):
            yield _DROP_INS / path.name
    if environ.get("CONTAINERS_CONF_OVERRIDE"):  # since Podman 4.6
        yield Path(environ["CONTAINERS_CONF_OVERRIDE"]).absolute()


def _seen(root: Path, path: Path) -> Path:
    return root / path.relative_to("/")


@dataclass(frozen=True)
class _HooksDir:
    """What one file says."""

    directories: tuple[str, ...]
    append: bool | None
    """To what was said before, here and later; None: as it was."""


def _hooks_dir(root: Path, path: Path) -> _HooksDir | None:
    """`hooks_dir` of the table [engine] in a file; None if it does not say.

    TOML as far as this key needs it: Python has a reader since 3.11 only.
    """
    try:
        text = _seen(root, path).read_text(errors="replace")
    except OSError:
        return None
    # Comments first; a # within a string stays.
    text = re.sub(r"""("[^"\n]*"|'[^'\n]*')|#[^\n]*""", lambda found: found[1] or "", text)
    table = ""
    value = None
    for found in re.finditer(
        r"^[ \t]*(?:\[(?P<table>[^\[\]\n]+)\][ \t]*$|(?P<key>[\w.\"' ]*?)[ \t]*=[ \t]*\[(?P<list>[^\]]*)\])",
        text,
        re.MULTILINE,
    ):
        if found["table"] is not None:
            table = found["table"].strip()
        elif ".".join(filter(None, (table, found["key"].strip()))) == "engine.hooks_dir":
            strings = tuple(a or b for a, b in re.findall(r""""([^"\n]*)"|'([^'\n]*)'""", found["list"]))
            append = re.findall(r"\{\s*append\s*=\s*(true|false)\s*\}", found["list"])
            value = _HooksDir(strings, append[-1] == "true" if append else None)
    return value
