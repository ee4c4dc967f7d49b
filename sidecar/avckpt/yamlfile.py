# SPDX-License-Identifier: Apache-2.0
"""YAML files with line numbers of all values.

A loaded document has lost its lines; a composed one (PyYAML's nodes) has them,
but not yet its merge keys. This module adds what is needed for messages.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml
from avckpt_hooks.shared.files import TooLong, read_bounded

NULL = "tag:yaml.org,2002:null"
_MERGE = "tag:yaml.org,2002:merge"
_PLAIN = ("int", "float", "bool", "null")


FILE_BYTES = 1 << 20
BRACKETS_MOST = 50
VALUES_MOST = 100_000
"""Most keys and values of a file after expansion of aliases."""

NO_TEXT = re.compile("[\0\ud800-\udfff]")
"""What an escape in quotes can say, and no path, argument or label can hold."""


@dataclass(frozen=True, order=True)
class Place:
    """A line of a file, counted from 1; 0: the file itself, whatever is in it."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


class Unreadable(Exception):
    """A file that cannot be read, or is not YAML."""

    def __init__(self, place: Place, why: str) -> None:
        super().__init__(f"{place}: {why}")
        self.place = place
        self.why = why


class _Loader(yaml.SafeLoader):
    """Deepest nesting: PyYAML's scanner takes time per token in proportion to the brackets around it."""

    def fetch_flow_collection_start(self, token: type[yaml.Token]) -> None:
        super().fetch_flow_collection_start(token)
        if self.flow_level > BRACKETS_MOST:
            raise RecursionError


_PIPES: dict[Path, bytes] = {}
"""What came out of each (/dev/stdin, <(...) of a shell): nothing does a second time."""


def read(path: Path) -> yaml.Node | None:
    """The root of the only document in `path`; None: the file is empty.  Raises Unreadable."""
    documents = read_all(path, several=False)
    return documents[0] if documents else None


def read_all(path: Path, *, several: bool = True) -> list[yaml.Node]:
    """The roots of the documents in `path`.  Raises Unreadable, also if there are `several` and may not be.

    The result may be walked without regard to aliases: expanded it is finite, and not larger than
    `VALUES_MOST`.
    """
    try:
        text = _content(path).decode()
    except TooLong as error:
        raise Unreadable(Place(str(path), 0), f"longer than {FILE_BYTES} bytes") from error
    except OSError as error:
        raise Unreadable(Place(str(path), 0), error.strerror or str(error)) from error
    except UnicodeDecodeError as error:
        raise Unreadable(Place(str(path), 0), f"not UTF-8: {error.reason}") from error
    try:
        if several:
            roots = list(yaml.compose_all(text, Loader=_Loader))
        else:
            root = yaml.compose(text, Loader=_Loader)
            roots = [] if root is None else [root]
        for root in roots:
            _expanded(root, path, {})
        return roots
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark is not None else 1
        why = ", ".join(part for part in (error.context, error.problem) if part)
        raise Unreadable(Place(str(path), line), f"not YAML: {why}") from error
    except yaml.YAMLError as error:
        raise Unreadable(Place(str(path), 1), f"not YAML: {error}") from error
    except RecursionError as error:
        raise Unreadable(Place(str(path), 1), "nested too deeply") from error


def _content(path: Path) -> bytes:
    if path in _PIPES:
        return _PIPES[path]
    content = read_bounded(str(path), FILE_BYTES)
    if path.is_fifo():
        _PIPES[path] = content
    return content


def _expanded(node: yaml.Node | None, path: Path, known: dict[int, int]) -> int:
    """The number of nodes after expansion; each is counted once, so that counting takes no longer than
    reading.

    Raises Unreadable where there are too many.
    """
    if node is None:
        return 0
    count = known.get(id(node))
    if count == 0:
        raise Unreadable(place_of(node, path), "an anchor that holds itself")
    if count is None:
        if isinstance(node, yaml.ScalarNode) and (wrong := NO_TEXT.search(node.value)):
            raise Unreadable(
                place_of(node, path), f"no text has the character {wrong[0].encode('unicode_escape').decode()}"
            )
        known[id(node)] = 0
        count = 1
        if isinstance(node, yaml.SequenceNode):
            count += sum(_expanded(item, path, known) for item in node.value)
        elif isinstance(node, yaml.MappingNode):
            count += sum(_expanded(each, path, known) for pair in node.value for each in pair)
        if count > VALUES_MOST:
            raise Unreadable(place_of(node, path), f"with its aliases replaced more than {VALUES_MOST} values")
        known[id(node)] = count
    return count


def place_of(node: yaml.Node, path: Path) -> Place:
    """Where `node` of the file `path` begins."""
    return Place(str(path), node.start_mark.line + 1)


def entries(node: yaml.Node | None) -> list[tuple[yaml.ScalarNode, yaml.Node]]:
    """The keys and values of a mapping, merge keys (`<<`) resolved; of anything else, none.

    A key that is written twice in one mapping is returned twice. The mapping's own keys
    come after merged ones, and override them.
    """
    if not isinstance(node, yaml.MappingNode):
        return []
    own = []
    merged: dict[str, tuple[yaml.ScalarNode, yaml.Node]] = {}
    for key, value in node.value:
        if key.tag == _MERGE:
            sources = value.value if isinstance(value, yaml.SequenceNode) else [value]
            for source in sources:
                for name, what in entries(source):
                    # Of several, the first wins.
                    merged.setdefault(name.value, (name, what))
        elif isinstance(key, yaml.ScalarNode):
            own.append((key, value))
    hidden = {key.value for key, _ in own}
    return [entry for name, entry in merged.items() if name not in hidden] + own


def repeated(node: yaml.Node | None, seen: set[int] | None = None) -> Iterator[yaml.ScalarNode]:
    """Keys in `node`, or anything below it, that their mapping has had before: programs take the last one, or
    refuse."""
    seen = set() if seen is None else seen
    if node is None or id(node) in seen or isinstance(node, yaml.ScalarNode):
        return
    seen.add(id(node))  # aliases
    had = set()
    for part in node.value:
        for each in part if isinstance(node, yaml.MappingNode) else (part,):
            yield from repeated(each, seen)
        if isinstance(node, yaml.MappingNode) and isinstance(part[0], yaml.ScalarNode):
            if part[0].value in had:
                yield part[0]
            had.add(part[0].value)


def scalars(node: yaml.Node | None) -> Iterator[yaml.ScalarNode]:
    """All keys and values in `node`, each once, however many aliases it has."""
    seen: set[int] = set()
    left = [] if node is None else [node]
    while left:
        one = left.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, yaml.ScalarNode):
            yield one
        elif isinstance(one, yaml.MappingNode):
            left += [each for pair in one.value for each in pair]
        else:
            left += one.value


def lookup(node: yaml.Node | None, key: str) -> yaml.Node | None:
    """The value of `key` in a mapping; the last one wins, as with every YAML reader."""
    found = None
    for name, value in entries(node):
        if name.value == key:
            found = value
    return found


def text_of(node: yaml.Node) -> str:
    """A single value as text, as a program would see it by loading the file and calling
    str().

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
