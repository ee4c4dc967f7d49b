#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The engine's layers (engine/*): does each call, and include, only itself and those below it?

Each layer is linked with the archives of those below it and nothing else, so that the linker names
every call that goes up.  The compiler sees to the headers, for it is given the folders of those
layers only (Makefile); what is left is not to go around that.  `--write` brings the graph in
docs/architecture.md up to date; without it a graph that is not is a failure as well.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

NATIVE = Path(__file__).resolve().parent
BUILD = NATIVE / "build"
PAGE = NATIVE.parent / "docs" / "architecture.md"
GRAPH = re.compile(r"(<!-- native/layers\.py -->\n).*?(<!-- end -->)", re.DOTALL)


def layers() -> list[str]:
    """From below, as the Makefile has them."""
    for line in (NATIVE / "Makefile").read_text().splitlines():
        if line.startswith("LAYERS"):
            return line.split(":=")[1].split()
    raise SystemExit("error: native/Makefile has no LAYERS")


def link(layer: str, below: list[str]) -> list[str]:
    """What the layer calls that is neither in it nor below it."""
    archives = [str(BUILD / f"{name}.a") for name in (layer, *reversed(below))]
    command = [
        *(os.environ.get("CC") or "cc").split(),
        *("-shared", "-pthread", "-o", os.devnull, "-Wl,--no-undefined"),
        *("-Wl,--whole-archive", archives[0], "-Wl,--no-whole-archive"),
        *("-Wl,--start-group", *archives[1:], "-Wl,--end-group", "-lrt"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"LC_ALL": "C"})
    if not done.returncode:
        return []
    calls = re.findall(r"(\w+\.c):.*undefined reference to `(\w+)'", done.stderr)
    return sorted({f"{file} calls {symbol}()" for file, symbol in calls}) or [done.stderr]


def symbols(layer: str) -> tuple[set[str], set[str]]:
    """Of its archive: those that it defines, and those that it needs."""
    defined, needed = set(), set()
    listing = subprocess.run(["nm", str(BUILD / f"{layer}.a")], capture_output=True, text=True, check=True)
    for line in listing.stdout.splitlines():
        *_, kind, name = ["", *line.split()] if line.strip() else ["", "", ""]
        if kind == "U":
            needed.add(name)
        elif kind in "TDBR":
            defined.add(name)
    return defined, needed


def graph(names: list[str]) -> str:
    found = {name: symbols(name) for name in names}
    lines = []
    for i, name in reversed(list(enumerate(names))):
        below = [other for other in reversed(names[:i]) if found[name][1] & found[other][0]]
        lines.append(f"{name:<12} {' '.join(below)}".rstrip())
    return "```\n" + "\n".join(lines) + "\n```\n"


def includes() -> list[str]:
    """Paths with folders in them would be found whatever the compiler was told."""
    return [
        f"{source.relative_to(NATIVE)} includes {path}"
        for source in sorted(NATIVE.glob("engine/**/*.[ch]"))
        for path in re.findall(r'^#\s*include "(.*/.*)"', source.read_text(), re.MULTILINE)
        if not re.fullmatch(r"avckpt/\w+\.h", path)
    ]


def main() -> None:
    names = layers()
    wrong = includes()
    for i, name in enumerate(names):
        wrong += [f"{name}: {what}, which is not below it" for what in link(name, names[:i])]
    page = PAGE.read_text()
    fresh = GRAPH.sub(lambda found: found[1] + graph(names) + found[2], page)
    if "--write" in sys.argv[1:]:
        PAGE.write_text(fresh)
    elif fresh != page:
        wrong.append("docs/architecture.md: the graph of layers is not this one (native/layers.py --write)")
    if not GRAPH.search(page):
        wrong.append("docs/architecture.md: the graph of layers is missing")
    for what in wrong:
        print(f"error: {what}", file=sys.stderr)
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
