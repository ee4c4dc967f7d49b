# SPDX-License-Identifier: Apache-2.0
"""/etc/avckpt/config.yaml: defaults for what the labels of a container leave out.

    defaults:
      interval: 500ms
      restore.max: 10/60s
    names:
      "*_lidar_*":
        interval: 100ms
    sidecar:
      budget.cpu: 25%

Keys are those of the labels, without their prefix; those of `sidecar` are its own. The labels' own parser checks
every value, so that file and labels always agree on what is allowed.
"""

from __future__ import annotations

import difflib
import fnmatch
import os
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from avckpt_hooks.shared.labels import LABELS, PREFIX, LabelError, parse_policy, shown

from avckpt import yamlfile
from avckpt.budget import TOTAL
from avckpt.errors import ConfigError
from avckpt.yamlfile import Place, Unreadable

PATH = Path("/etc/avckpt/config.yaml")
ENABLE = f"{PREFIX}enable"
GROUP = f"{PREFIX}group"
AT_START = (ENABLE, f"{PREFIX}io_uring", f"{PREFIX}scope")
"""Settings that take effect when a container starts: only its own labels set them."""
NOTIFY = f"{PREFIX}notify"
LEAST_PERCENT = 0.1
CPU_TOTAL_ALLOWED = "a percentage of one CPU from 0.1% to 9999%, as 25%"


def default_path() -> Path:
    """The file of this machine; AVCKPT_CONFIG in the environment names another one."""
    return Path(os.environ.get("AVCKPT_CONFIG") or PATH)


@dataclass(frozen=True)
class Defaults:
    """What a configuration file says.  Keys have their prefix; an empty file changes nothing."""

    common: Mapping[str, str] = field(default_factory=dict)
    by_name: tuple[tuple[str, Mapping[str, str]], ...] = ()
    """Patterns of container names, in the order of the file."""
    cpu_total: float = TOTAL
    """Of one CPU: what all guards with `avckpt.interval=auto` may use together."""

    def under(self, labels: Mapping[str, str], name: str) -> dict[str, str]:
        """The effective settings of a container.

        Its labels take precedence, then the patterns that match its name, later over earlier,
        then `common`.
        """
        merged = dict(self.common)
        for pattern, settings in self.by_name:
            if fnmatch.fnmatchcase(name, pattern):
                merged.update(settings)
        merged.update(labels)
        # Meaningless without a group; as a label it is refused.
        if GROUP not in merged and NOTIFY not in labels:
            merged.pop(NOTIFY, None)
        return merged


@dataclass(frozen=True)
class Problem:
    """Something in the file that cannot be honoured."""

    place: Place
    message: str

    def __str__(self) -> str:
        return f"{self.place}: {self.message}"


class Configuration:
    """The configuration file of a sidecar, and its contents as last read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.defaults = Defaults()
        self.problem = ""
        """Why the file as it is now was refused; empty: it is in force."""
        self.loaded_at: float | None = None
        """When the configuration in force was read; None: the built-in defaults are in force."""
        self.found = False
        """Whether there was a file then."""

    def load(self) -> None:
        """Loads the current file; a missing file is empty.

        Raises ConfigError, and changes nothing, when anything in it is wrong.
        """
        found = self.path.exists()
        try:
            # Whoever waits for what a pipe says waits for ever, and nothing else can be read twice.
            if found and not self.path.is_file():
                raise ConfigError(f"{self.path}: not a file")
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
    reader = _Reader(path)
    defaults = reader.whole(root)
    problems = reader.wrong or list(_contradictions(defaults, root, path))
    return Defaults() if reader.wrong else defaults, sorted(
        problems + reader.repeated, key=lambda problem: problem.place
    )


@dataclass
class _Reader:
    """Parses a file, and collects its errors."""

    path: Path
    wrong: list[Problem] = field(default_factory=list)
    repeated: list[Problem] = field(default_factory=list)
    """In YAML the last one wins; a duplicate is more likely an error."""

    def whole(self, root: yaml.Node | None) -> Defaults:
        common: dict[str, str] = {}
        by_name: list[tuple[str, Mapping[str, str]]] = []
        cpu_total = TOTAL
        for key, (place, node) in self._mapping("the file", Place(str(self.path), 1), root).items():
            if key == "defaults":
                common = self._settings(key, place, node)
            elif key == "names":
                patterns = self._mapping(key, place, node)
                by_name = [(name, self._settings(f"{key}.{name}", *found)) for name, found in patterns.items()]
            elif key == "sidecar":
                cpu_total = self._cpu_total(place, node)
            else:
                self._complain(place, f"{key}: unknown key; known are defaults, names and sidecar")
        return Defaults(common, tuple(by_name), cpu_total)

    def _cpu_total(self, place: Place, node: yaml.Node) -> float:
        total = TOTAL
        for key, (here, value) in self._mapping("sidecar", place, node).items():
            text = str(value.value).strip()
            found = re.fullmatch(r"(\d{1,4}(?:\.\d{1,3})?)\s*%", text, re.ASCII)
            if key != "budget.cpu":
                self._complain(here, f"sidecar.{key}: unknown key; known is budget.cpu")
            elif found is None or float(found[1]) < LEAST_PERCENT:
                said = "not a single value" if not isinstance(value, yaml.ScalarNode) else shown(text)
                self._complain(here, f"sidecar.budget.cpu: {said}: allowed: {CPU_TOTAL_ALLOWED}")
            else:
                total = float(found[1]) / 100
        return total

    def _mapping(self, called: str, place: Place, node: yaml.Node | None) -> dict[str, tuple[Place, yaml.Node]]:
        found: dict[str, tuple[Place, yaml.Node]] = {}
        if not isinstance(node, yaml.MappingNode) and not _is_null(node):
            self._complain(place, f"{called}: not a mapping")
        for key, value in yamlfile.entries(node):
            here = yamlfile.place_of(key, self.path)
            if key.value in found:
                first = found[key.value][0].line
                self.repeated.append(Problem(here, f"{key.value}: given in line {first} already; remove one of them"))
            found[key.value] = here, value
        return found

    def _settings(self, called: str, place: Place, node: yaml.Node) -> dict[str, str]:
        """Label by label, with its prefix."""
        settings = {}
        for key, (here, value) in self._mapping(called, place, node).items():
            label = PREFIX + key
            if label not in LABELS or label in AT_START:
                self._complain(here, f"{called}.{key}: {_unknown(key)}")
            elif _is_null(value):
                continue
            elif not isinstance(value, yaml.ScalarNode):
                self._complain(here, f"{called}.{key}: not a single value")
            else:
                text = settings[label] = str(value.value).strip()
                try:
                    parse_policy({label: text})
                except LabelError as error:
                    said = shown(text, label) if text else "an empty value"
                    self._complain(here, f"{called}.{key}: {said}: {error.why}; {error.allowed}")
        return settings

    def _complain(self, place: Place, message: str) -> None:
        self.wrong.append(Problem(place, message))


def _is_null(node: yaml.Node | None) -> bool:
    return node is None or node.tag.endswith(":null")


def _contradictions(defaults: Defaults, root: yaml.Node | None, path: Path) -> Iterator[Problem]:
    """Values that are valid separately, but not together."""
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
            problem = Problem(
                max(places), f"{key}: {shown(error.value or '', error.key)}: {error.why}; {error.allowed}"
            )
            if problem not in seen:
                seen.add(problem)
                yield problem


def _unknown(key: str) -> str:
    if key == "enable":
        return "cannot be a default: a container is protected when its own label says avckpt.enable=true"
    if key == "io_uring":
        return "cannot be a default: it is taken away when a container starts, by its own label"
    if key == "scope":
        return "cannot be a default: it decides how a container is started, so its own label says it"
    if key.startswith(PREFIX):
        return f"here the keys have no prefix; write {key[len(PREFIX) :]}"
    known = sorted(label[len(PREFIX) :] for label in LABELS if label not in AT_START)
    near = difflib.get_close_matches(key, known, n=1)
    return f"unknown key; did you mean {near[0]}?" if near else "unknown key; known are " + ", ".join(known)
