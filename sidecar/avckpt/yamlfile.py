# SPDX-License-Identifier: Apache-2.0
"""YAML files whose every value still knows its line.

A loaded document has lost its lines; a composed one (PyYAML's nodes) has them,
but not yet its merge keys.  Here is what reading it for messages takes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

_MERGE = "tag:yaml.org,2002:merge"
_PLAIN = ("int", "float", "bool", "null")


@dataclass(frozen=True, order=True)
class Place:
    """A line of a file, counted from 1."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


class Unreadable(Exception):
    """A file that can not be read, or is not YAML."""

    def __init__(self, place: Place, why: str) -> None:
        super().__init__(f"{place}: {why}")
        self.place = place
        self.why = why


def read(path: Path) -> yaml.Node | None:
    """The root of the only document in `path`; None: the file is empty.  Raises Unreadable."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise Unreadable(Place(str(path), 1), error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise Unreadable(Place(str(path), 1), f"not UTF-8: {error.reason}") from error
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark is not None else 1
        why = ", ".join(part for part in (error.context, error.problem) if part)
        raise Unreadable(Place(str(path), line), f"not YAML: {why}") from error
    except yaml.YAMLError as error:
        raise Unreadable(Place(str(path), 1), f"not YAML: {error}") from error
    except RecursionError as error:
        raise Unreadable(Place(str(path), 1), "nested too deeply") from error


def place_of(node: yaml.Node, path: Path) -> Place:
    """Where `node` of the file `path` begins."""
    return Place(str(path), node.start_mark.line + 1)


def entries(node: yaml.Node | None) -> list[tuple[yaml.ScalarNode, yaml.Node]]:
    """The keys and values of a mapping, merge keys (`<<`) resolved; of anything else, none.

    A key that is written twice in one mapping comes twice.  What the mapping
    says itself comes after what it merges in, and hides it.
    """
    return _entries(node, ())


def lookup(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """The value of `key` in a mapping; the last one wins, as with every YAML reader."""
    found = None
    for name, value in entries(node):
        if name.value == key:
            found = value
    return found


def text_of(node: yaml.Node) -> str:
    """A single value as text, as a program sees it that loads the file and calls str().

    Raises ValueError for a list or a mapping.
    """
    if not isinstance(node, yaml.ScalarNode):
        kind = "a list" if isinstance(node, yaml.SequenceNode) else "a mapping"
        raise ValueError(f"{kind}, not a single value")
    if node.tag.rpartition(":")[2] not in _PLAIN:
        return str(node.value)
    try:
        value = yaml.SafeLoader("").construct_object(node)
    except (yaml.YAMLError, ValueError):
        return str(node.value)
    return "" if value is None else str(value)


def _entries(node: yaml.Node | None, above: tuple[int, ...]) -> list[tuple[yaml.ScalarNode, yaml.Node]]:
    # An anchor may be merged into itself, and nobody else would notice.
    if not isinstance(node, yaml.MappingNode) or id(node) in above:
        return []
    above = (*above, id(node))
    own = []
    merged: dict[str, tuple[yaml.ScalarNode, yaml.Node]] = {}
    for key, value in node.value:
        if key.tag == _MERGE:
            sources = value.value if isinstance(value, yaml.SequenceNode) else [value]
            for source in sources:
                for name, what in _entries(source, above):
                    # Of several, the first wins.
                    merged.setdefault(name.value, (name, what))
        elif isinstance(key, yaml.ScalarNode):
            own.append((key, value))
    hidden = {key.value for key, _ in own}
    return [entry for name, entry in merged.items() if name not in hidden] + own
