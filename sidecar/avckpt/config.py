# SPDX-License-Identifier: Apache-2.0
"""/etc/avckpt/config.yaml: what holds for containers whose labels do not say otherwise.

    defaults:
      interval: 500ms
      restore.max: 10/60s
    names:
      "*_lidar_*":
        interval: 100ms

Keys are those of the labels, without their prefix.  pydantic checks the shape,
the labels' own parser every value, so that the file and a label can never
disagree on what is allowed.
"""

from __future__ import annotations

import difflib
import fnmatch
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Optional

import yaml
from avckpt_hooks.shared.labels import LABELS, PREFIX, LabelError, parse_policy
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, ValidationError, create_model

from avckpt import yamlfile
from avckpt.errors import ConfigError
from avckpt.yamlfile import Place, Unreadable

PATH = Path("/etc/avckpt/config.yaml")
ENABLE = f"{PREFIX}enable"
GROUP = f"{PREFIX}group"
NOTIFY = f"{PREFIX}notify"


def default_path() -> Path:
    """The file of this machine; AVCKPT_CONFIG in the environment names another one."""
    return Path(os.environ.get("AVCKPT_CONFIG") or PATH)


@dataclass(frozen=True)
class Defaults:
    """What a configuration file says.  Keys have their prefix; the empty one changes nothing."""

    common: Mapping[str, str] = field(default_factory=dict)
    by_name: tuple[tuple[str, Mapping[str, str]], ...] = ()
    """Patterns of container names, in the order of the file."""

    def under(self, labels: Mapping[str, str], name: str) -> dict[str, str]:
        """What holds for a container.

        Its labels win; then the patterns that fit its name, later over earlier; then `common`.
        """
        merged = dict(self.common)
        for pattern, settings in self.by_name:
            if fnmatch.fnmatchcase(name, pattern):
                merged.update(settings)
        merged.update(labels)
        # Without a group there is nobody to hear of; who writes that into a label is told so.
        if GROUP not in merged and NOTIFY not in labels:
            merged.pop(NOTIFY, None)
        return merged


@dataclass(frozen=True)
class Problem:
    """Something in the file that can not be honoured."""

    place: Place
    message: str

    def __str__(self) -> str:
        return f"{self.place}: {self.message}"


class Configuration:
    """The file a sidecar goes by, and what it said when it was read last."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.defaults = Defaults()
        self.problem = ""
        """Why the file as it is now was refused; empty: it is in force."""
        self.loaded_at: float | None = None
        """When what is in force was read; None: nothing was, the built-in defaults hold."""
        self.found = False
        """Whether there was a file then."""

    def load(self) -> None:
        """Takes the file as it is now; a file that is not there says nothing.

        Raises ConfigError, and all stays as it was, when anything in it is wrong.
        """
        found = self.path.exists()
        try:
            self.defaults = read(self.path)
        except ConfigError as error:
            self.problem = str(error)
            raise
        self.found = found
        self.problem = ""
        self.loaded_at = time.time()

    def to_json(self) -> dict[str, object]:
        """For the API."""
        return {"path": str(self.path), "found": self.found, "loaded_at": self.loaded_at, "problem": self.problem}


def read(path: Path) -> Defaults:
    """What the file says.  Raises ConfigError with every problem, one after the other, in one line."""
    defaults, problems = examine(path)
    if problems:
        raise ConfigError("; ".join(str(problem) for problem in problems))
    return defaults


def examine(path: Path) -> tuple[Defaults, list[Problem]]:
    """What the file says, and what is wrong with it, in the order of the lines."""
    try:
        root = yamlfile.read(path)
    except Unreadable as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return Defaults(), []
        return Defaults(), [Problem(error.place, error.why)]
    try:
        document = {} if root is None else _plain(root)
    except RecursionError:
        return Defaults(), [Problem(Place(str(path), 1), "nested too deeply")]
    problems = list(_repetitions(root, path))
    try:
        checked = _model().model_validate(document)
    except ValidationError as error:
        problems += [_problem(dict(found), root, path) for found in error.errors()]
        return Defaults(), sorted(problems, key=lambda problem: problem.place)
    said = checked.model_dump(by_alias=True, exclude_unset=True)
    defaults = Defaults(
        _prefixed(said.get("defaults")),
        tuple((pattern, _prefixed(settings)) for pattern, settings in (said.get("names") or {}).items()),
    )
    problems += _contradictions(defaults, root, path)
    return defaults, sorted(problems, key=lambda problem: problem.place)


@lru_cache(maxsize=1)
def _model() -> type[BaseModel]:
    """The shape of the file; made from the table of labels, so that it knows them all."""
    fields: dict[str, Any] = {}
    for number, key in enumerate(sorted(LABELS)):
        if key != ENABLE:
            value = Annotated[str, StringConstraints(strip_whitespace=True), AfterValidator(partial(_check, key))]
            fields[f"label_{number}"] = (Optional[value], Field(None, alias=key[len(PREFIX) :]))
    settings = create_model("Settings", __config__=ConfigDict(extra="forbid", strict=True), **fields)
    whole: dict[str, Any] = {
        "defaults": (Optional[settings], None),
        "names": (Optional[dict[str, Optional[settings]]], None),  # type: ignore[valid-type]
    }
    return create_model("File", __config__=ConfigDict(extra="forbid", strict=True), **whole)


def _check(key: str, value: str) -> str:
    """Has a value parsed as that of the label `key`."""
    try:
        parse_policy({key: value})
    except LabelError as error:
        raise ValueError(f"{error.why}; {error.allowed}") from None
    return value


def _plain(node: yaml.Node) -> object:
    """The document as dictionaries, lists and text: a value is what a label would say."""
    if isinstance(node, yaml.MappingNode):
        return {key.value: _plain(value) for key, value in yamlfile.entries(node)}
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item) for item in node.value]
    return None if node.tag.endswith(":null") else str(node.value)


def _prefixed(settings: Mapping[str, str | None] | None) -> dict[str, str]:
    return {PREFIX + key: value for key, value in (settings or {}).items() if value is not None}


def _repetitions(root: yaml.Node | None, path: Path) -> Iterator[Problem]:
    """YAML lets the last one win; a person who wrote both should be told."""
    for node in _mappings(root):
        seen: dict[str, int] = {}
        for key, _ in yamlfile.entries(node):
            if key.value in seen:
                place = yamlfile.place_of(key, path)
                yield Problem(place, f"{key.value}: given in line {seen[key.value]} already; remove one of them")
            seen[key.value] = key.start_mark.line + 1


def _contradictions(defaults: Defaults, root: yaml.Node | None, path: Path) -> Iterator[Problem]:
    """Values that are right by themselves, and not together."""
    names = yamlfile.lookup(root, "names")
    common = yamlfile.lookup(root, "defaults")
    seen = set()
    for pattern, settings in (("", {}), *defaults.by_name):
        try:
            parse_policy({**defaults.common, **settings})
        except LabelError as error:
            node = yamlfile.lookup(names, pattern) if error.key in settings else common
            key = error.key[len(PREFIX) :]
            places = [yamlfile.place_of(found, path) for found, _ in yamlfile.entries(node) if found.value == key]
            problem = Problem(max(places), f"{key}: {error.value}: {error.why}; {error.allowed}")
            if problem not in seen:
                seen.add(problem)
                yield problem


def _mappings(root: yaml.Node | None) -> Iterator[yaml.Node | None]:
    yield root
    yield yamlfile.lookup(root, "defaults")
    names = yamlfile.lookup(root, "names")
    yield names
    for _, settings in yamlfile.entries(names):
        yield settings


def _problem(found: dict[str, Any], root: yaml.Node | None, path: Path) -> Problem:
    """One of pydantic's errors in our words, with its line."""
    where: tuple[object, ...] = found["loc"]
    place, node = (Place(str(path), 1), root)
    for step in where:
        for key, value in yamlfile.entries(node):
            if key.value == step:
                place, node = yamlfile.place_of(key, path), value
    called = ".".join(str(step) for step in where)
    kind = found["type"]
    if kind == "extra_forbidden":
        why = _unknown(where)
    elif kind == "value_error":
        shown = found["input"] if len(found["input"]) <= 60 else found["input"][:57] + "..."
        return Problem(place, f"{called}: {shown or 'an empty value'}: {found['ctx']['error']}")
    elif kind == "string_type":
        why = "not a single value"
    else:
        why = "not a mapping"
    return Problem(place, f"{called}: {why}" if called else f"the file: {why}")


def _unknown(where: tuple[object, ...]) -> str:
    key = str(where[-1])
    if len(where) == 1:
        return "unknown key; known are defaults and names"
    if key == "enable":
        return "can not be a default: a container is protected when its own label says avckpt.enable=true"
    if key.startswith(PREFIX):
        return f"here the keys have no prefix; write {key[len(PREFIX) :]}"
    known = sorted(label[len(PREFIX) :] for label in LABELS if label != ENABLE)
    near = difflib.get_close_matches(key, known, n=1)
    return f"unknown key; did you mean {near[0]}?" if near else "unknown key; known are " + ", ".join(known)
