# SPDX-License-Identifier: Apache-2.0
"""What a Compose file says to avckpt, and what of it cannot be honoured.

Only the `avckpt.*` labels and annotations of services are looked at; whether
the rest of the file is good Compose is podman-compose's to say.  Followed are
anchors, merge keys, `extends` and `include`.  A value with ${VARIABLES} in it
is known only when the file is brought up: there the hooks check it.
"""

from __future__ import annotations

import enum
import os
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import podman_compose
import yaml
from avckpt_hooks.shared.labels import LABELS, PREFIX, LabelError, meant_by, merge, parse_policy

from avckpt import yamlfile
from avckpt.cli.compose import doubts
from avckpt.errors import ConfigError
from avckpt.yamlfile import Place, Unreadable

ENABLE = doubts.ENABLE
USUAL_NAME = "vehicle.yaml"
"""Is meant, and nothing else, when no file is named."""
COMPOSE_NAMES = (
    "compose.yaml",
    "compose.yml",
    "compose.override.yaml",
    "compose.override.yml",
    "podman-compose.yaml",
    "podman-compose.yml",
    "docker-compose.yml",
    "docker-compose.yaml",
    "docker-compose.override.yml",
    "docker-compose.override.yaml",
    "container-compose.yml",
    "container-compose.yaml",
    "container-compose.override.yml",
    "container-compose.override.yaml",
)
"""Without that, all of these that are there, later ones over earlier ones: so does podman-compose 1.6."""

SHOWN_MOST = 60
"""Characters of a value in a message."""
EXTENDS_MOST = 50
"""Services that one extends, one by way of the other."""


class Kind(enum.Enum):
    """Where a service says it."""

    LABEL = "label"
    ANNOTATION = "annotation"


class Severity(enum.Enum):
    """How bad it is."""

    ERROR = "error"
    """The container would not start, or not as it is meant."""
    WARNING = "warning"
    """It works, but is hardly meant."""


@dataclass(frozen=True)
class Problem:
    """Something to be mended in a file."""

    place: Place
    service: str
    """Empty: it is the file's, not a service's."""
    message: str
    severity: Severity = Severity.ERROR

    def __str__(self) -> str:
        service = f"service {self.service}: " if self.service else ""
        warning = "warning: " if self.severity is Severity.WARNING else ""
        return f"{self.place}: {service}{warning}{self.message}"

    def to_json(self) -> dict[str, object]:
        """For programs."""
        return {
            "file": self.place.file,
            "line": self.place.line,
            "service": self.service or None,
            "severity": self.severity.value,
            "message": self.message,
        }


@dataclass(frozen=True)
class Setting:
    """One label or annotation, as a service or what it extends gives it."""

    key: str
    value: str
    place: Place

    @property
    def is_open(self) -> bool:
        """Its value is not known before the environment is."""
        return _is_open(self.value)

    @property
    def final(self) -> str:
        """The value the container gets; only if it is not open."""
        return self.value.replace("$$", "$")


@dataclass
class Service:
    """A service and its `avckpt.*` settings, its own over those it extends."""

    name: str
    place: Place
    settings: dict[Kind, dict[str, Setting]] = field(default_factory=lambda: {kind: {} for kind in Kind})
    extends: tuple[Path, str] | None = None
    """The file and the service in it; the path is this service's own file's for one of the same project."""
    profiles: tuple[str, ...] = ()
    """It is started with one of these only; none: always.  Nobody inherits them by `extends`."""
    programs: dict[str, str] = field(default_factory=dict)
    """The first words of `entrypoint` and `command`, as far as they are given."""
    facts: doubts.Facts = field(default_factory=doubts.Facts)

    @property
    def enabled(self) -> bool | None:
        """Whether it asks to be protected; None: the environment will tell.  Wrong values ask for nothing."""
        for settings in self.settings.values():
            setting = settings.get(ENABLE)
            if setting is None:
                continue
            if setting.is_open:
                return None
            try:
                return parse_policy({ENABLE: setting.final}).enable
            except LabelError:
                return False
        return False

    def all_settings(self) -> Iterator[tuple[Kind, Setting]]:
        """Labels, then annotations."""
        for kind, settings in self.settings.items():
            for setting in settings.values():
                yield kind, setting


@dataclass
class Manifest:
    """What one or several Compose files come to together."""

    files: tuple[Path, ...]
    services: dict[str, Service] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    is_partial: bool = False
    """The environment names a file that it includes."""

    @property
    def errors(self) -> list[Problem]:
        return [problem for problem in self.problems if problem.severity is Severity.ERROR]

    @property
    def wants_protection(self) -> bool:
        """Some service asks for it, or may."""
        return any(service.enabled is not False for service in self.services.values())

    def to_json(self) -> dict[str, object]:
        """For programs."""
        return {
            "files": [str(path) for path in self.files],
            "services": [
                {
                    "name": service.name,
                    "file": service.place.file,
                    "line": service.place.line,
                    "protected": service.enabled,
                    "profiles": list(service.profiles),
                    "settings": {setting.key: setting.value for _, setting in service.all_settings()},
                }
                for service in self.services.values()
            ],
            "problems": [problem.to_json() for problem in self.problems],
        }


def files_meant(named: Sequence[Path], environ: Mapping[str, str]) -> tuple[Path, ...]:
    """The files that are meant when these are named, or none: what podman-compose takes, and vehicle.yaml.

    Raises ConfigError when there is none.
    """
    project = environ.get("COMPOSE_PROJECT_DIR", "")
    directory = Path(project).resolve() if os.path.isdir(project) else Path()
    if named:
        return tuple(directory / path for path in named)
    names: Sequence[str] = (USUAL_NAME,) if (directory / USUAL_NAME).exists() else COMPOSE_NAMES
    listed = environ.get("COMPOSE_FILE", "")
    if listed:
        names = listed.split(environ.get("COMPOSE_PATH_SEPARATOR", os.pathsep))
    found = tuple(directory / name for name in names if (directory / name).exists())
    if not found:
        looked_for = f"of COMPOSE_FILE={listed}" if listed else f"called {USUAL_NAME} or compose.yaml"
        raise ConfigError(f"no file is named, and none {looked_for} is here: name one with -f FILE")
    return found


def check(files: Sequence[Path]) -> Manifest:
    """Reads the files, later ones over earlier ones as podman-compose does, and finds every problem."""
    manifest = Manifest(tuple(files))
    reader = _Reader(manifest)
    # A file that includes others is overridden by them, and they by nobody: so does podman-compose.
    reader.queue = list(files)
    while reader.queue:
        reader.read(reader.queue.pop(0))
    for service in list(manifest.services.values()):
        reader.resolve(service)
    is_sidecars = any(reader.has(files[0], key) for key in ("defaults", "names", "sidecar"))
    hint = " The sidecar's own is checked by avckpt check --config FILE" if is_sidecars else ""
    judge(manifest, f"no services: is this a Compose file?{hint}")
    return manifest


def judge(manifest: Manifest, nothing: str) -> None:
    """Adds every problem of its services, or else says that it has none; sorts all."""
    services = manifest.services
    for service in services.values():
        found = list(_judge(service))
        # After a mistake (avckpt.enabled=true, say) nobody needs to be told what follows from it.
        doubts_of_it = () if found else doubts.of_service(service)
        found += [Problem(place, service.name, message, Severity.WARNING) for place, message in doubts_of_it]
        manifest.problems += found
    for service, place, message in doubts.of_groups(services.values()):
        manifest.problems.append(Problem(place, service.name, message, Severity.WARNING))
    for service, message in doubts.of_returns(services.values()):
        manifest.problems.append(Problem(service.place, service.name, message, Severity.WARNING))
    wrong = [*doubts.of_order(services), *(() if manifest.is_partial else doubts.of_absent(services))]
    for service, message in wrong:
        manifest.problems.append(Problem(service.place, service.name, message))
    if nothing and not services and not manifest.errors:
        manifest.problems.append(Problem(Place(str(manifest.files[0]), 1), "", nothing))
    # What several services share through an anchor is one mistake, not several.
    unique = {(problem.place, problem.message): problem for problem in reversed(manifest.problems)}
    manifest.problems = sorted(unique.values(), key=lambda problem: problem.place)


class _Reader:
    """Takes files apart into services."""

    def __init__(self, manifest: Manifest) -> None:
        self._manifest = manifest
        self.queue: list[Path] = []
        """Files to be read yet."""
        self._read: set[str] = set()
        self._roots: dict[Path, yaml.Node | None] = {}
        self._resolved: set[int] = set()
        self._others: dict[Path, dict[str, tuple[yaml.ScalarNode, yaml.Node]]] = {}
        """Services of files that are only extended, by name."""
        self._bases: dict[tuple[Path, str], Service] = {}
        """Those of them that are extended."""

    def read(self, path: Path) -> None:
        """Adds the services of a file, and the files it includes to the queue."""
        name = os.path.realpath(path)  # which leaves a loop of symbolic links to whoever opens it
        if name in self._read:
            return
        self._read.add(name)
        root = self._root(path)
        if root is not None and not isinstance(root, yaml.MappingNode):
            self._complain(yamlfile.place_of(root, path), "not a mapping: is this a Compose file?")
            return
        services = yamlfile.lookup(root, "services")
        for key, node in yamlfile.entries(services):
            if not isinstance(node, yaml.MappingNode) and node.tag != yamlfile.NULL:
                message = "a service is a mapping (image: ...): this is none"
                self._complain(yamlfile.place_of(key, path), message, key.value)
                continue
            service = self._service(key.value, yamlfile.place_of(key, path), node, path)
            self._add(service)
        include = yamlfile.lookup(root, "include")
        for item in include.value if isinstance(include, yaml.SequenceNode) else []:
            paths = yamlfile.lookup(item, "path") if isinstance(item, yaml.MappingNode) else item
            for one in paths.value if isinstance(paths, yaml.SequenceNode) else [paths]:
                if not isinstance(one, yaml.ScalarNode):
                    continue
                if _is_open(one.value):
                    self._manifest.is_partial = True
                else:
                    included = path.parent / one.value
                    self._root(included, yamlfile.place_of(one, path))
                    self.queue.append(included)

    def has(self, path: Path, key: str) -> bool:
        """Whether a file that was read says something of `key`."""
        return yamlfile.lookup(self._roots.get(path), key) is not None

    def resolve(self, service: Service) -> None:
        """Puts what `service` extends under its own settings."""
        self._resolve(service, ())

    def _resolve(self, service: Service, above: tuple[tuple[Path, str], ...]) -> None:
        if service.extends is None or id(service) in self._resolved:
            return
        path, name = service.extends
        if (path, name) in above:
            self._complain(service.place, f"extends itself, by way of {name}", service.name)
            return
        if len(above) >= EXTENDS_MOST:
            self._complain(
                service.place, f"extends more than {EXTENDS_MOST} services, one by way of the other", service.name
            )
            return
        base = self._base(service, path, name)
        if base is None:
            return
        self._resolve(base, (*above, (path, name)))
        self._resolved.add(id(service))
        for kind, settings in base.settings.items():
            service.settings[kind] = {**settings, **service.settings[kind]}
        service.programs = {**base.programs, **service.programs}
        service.facts = service.facts.over(base.facts)

    def _base(self, service: Service, path: Path, name: str) -> Service | None:
        if path == Path(service.place.file) and name in self._manifest.services:
            return self._manifest.services[name]
        if (path, name) in self._bases:
            return self._bases[path, name]
        root = self._root(path, service.place, service.name)
        if path not in self._others:
            there = yamlfile.entries(yamlfile.lookup(root, "services") or root)
            self._others[path] = {key.value: (key, node) for key, node in reversed(there)}
        if name in self._others[path]:
            key, node = self._others[path][name]
            base = self._bases[path, name] = self._service(name, yamlfile.place_of(key, path), node, path)
            return base
        if root is not None:
            where = "" if path == Path(service.place.file) else f" in {path}"
            self._complain(service.place, f"extends {name}, and there is no such service{where}", service.name)
        return None

    def _service(self, name: str, place: Place, node: yaml.Node, path: Path) -> Service:
        service = Service(name, place, extends=_extends(node, path), profiles=_profiles(node), programs=_programs(node))
        service.facts = doubts.facts_of(node)
        for kind, key in ((Kind.LABEL, "labels"), (Kind.ANNOTATION, "annotations")):
            for setting in self._settings(yamlfile.lookup(node, key), path, name):
                known = service.settings[kind].get(setting.key)
                if known is not None and known.value != setting.value:
                    self._complain(
                        setting.place, f"{kind.value} {setting.key}: line {known.place.line} says {known.value}", name
                    )
                service.settings[kind][setting.key] = setting
        deploy = yamlfile.lookup(yamlfile.lookup(node, "deploy"), "labels")
        # podman-compose passes over a key that it does not know.
        misspelt = ((key, yamlfile.lookup(node, key)) for key in ("label", "annotation"))
        for key, elsewhere in (("deploy", deploy), *misspelt):
            for setting in self._settings(elsewhere, path, name):
                why = f"{setting.key} under {key} is no label of the container; put it under labels"
                self._complain(setting.place, why, name)
        return service

    def _settings(self, node: yaml.Node | None, path: Path, name: str) -> Iterator[Setting]:
        """The `avckpt.*` entries of labels or annotations, whichever way they are written."""
        if isinstance(node, yaml.MappingNode):
            for key, value in yamlfile.entries(node):
                place = yamlfile.place_of(key, path)
                if self._is_ours(key.value, place, name):
                    try:
                        yield Setting(key.value, yamlfile.text_of(value), place)
                    except ValueError as error:
                        self._complain(place, f"{key.value}: {error}", name)
            return
        for item in node.value if isinstance(node, yaml.SequenceNode) else [node]:
            if isinstance(item, yaml.ScalarNode):
                text, _, value = item.value.partition("=")
                place = yamlfile.place_of(item, path)
                if self._is_ours(text, place, name):
                    yield Setting(text, value, place)
            for inner, _ in yamlfile.entries(item):  # "- avckpt.enable: true"
                place = yamlfile.place_of(inner, path)
                if self._is_ours(inner.value, place, name):
                    self._complain(place, f"{inner.value}: in a list, write it as {inner.value}=VALUE", name)

    def _is_ours(self, key: str, place: Place, service: str) -> bool:
        if key.startswith(PREFIX):
            return not _is_open(key)
        meant = meant_by(key)
        if meant:
            self._complain(place, f"{key} is no label of avckpt's; did you mean {meant}?", service)
        return False

    def _add(self, service: Service) -> None:
        earlier = self._manifest.services.get(service.name)
        if earlier is not None:
            for kind, settings in earlier.settings.items():
                service.settings[kind] = {**settings, **service.settings[kind]}
            service.extends = service.extends or earlier.extends
            service.profiles = (*earlier.profiles, *service.profiles)
            service.programs = {**earlier.programs, **service.programs}
            service.facts = service.facts.over(earlier.facts)
        self._manifest.services[service.name] = service

    def _root(self, path: Path, asked_at: Place | None = None, service: str = "") -> yaml.Node | None:
        if path not in self._roots:
            self._roots[path] = None
            try:
                self._roots[path] = yamlfile.read(path)
            except Unreadable as error:
                if asked_at is not None and isinstance(error.__cause__, OSError):
                    self._complain(asked_at, f"{path}: {error.why}", service)
                else:
                    self._complain(error.place, error.why)
            self._manifest.problems += repeated(self._roots[path], path)
            self._manifest.problems += _unfinished(self._roots[path], path)
        return self._roots[path]

    def _complain(self, place: Place, message: str, service: str = "") -> None:
        self._manifest.problems.append(Problem(place, service, message))


def repeated(document: yaml.Node | None, path: Path) -> Iterator[Problem]:
    """What is lost in a document because something is given again."""
    for key in yamlfile.repeated(document):
        message = f"{key.value} is given twice: what was given first is lost"
        yield Problem(yamlfile.place_of(key, path), "", message, Severity.WARNING)


class _AllSet(dict[str, str]):
    """An environment with every variable: without it some values would only lack one."""

    def get(self, name: str, default: object = None) -> str:
        return name


def _unfinished(document: yaml.Node | None, path: Path) -> Iterator[Problem]:
    """Values that podman-compose takes for ${VARIABLES}, and cannot read.  It names neither file nor line."""
    for node in yamlfile.scalars(document):
        if "$" not in node.value:  # which takes it a millisecond to find out
            continue
        try:
            podman_compose.var_interpolate(node.value, _AllSet())
        except ValueError as error:
            shown = textwrap.shorten(node.value, SHOWN_MOST, placeholder="...")
            message = f"{shown}: {str(error)[:1].lower()}{str(error)[1:]} (a $ is written $$)"
            yield Problem(yamlfile.place_of(node, path), "", message)


def _extends(node: yaml.Node, path: Path) -> tuple[Path, str] | None:
    extends = yamlfile.lookup(node, "extends")
    name = yamlfile.lookup(extends, "service") if isinstance(extends, yaml.MappingNode) else extends
    file = yamlfile.lookup(extends, "file")
    if not isinstance(name, yaml.ScalarNode) or _is_open(name.value):
        return None
    if not isinstance(file, yaml.ScalarNode):
        return path, name.value
    return None if _is_open(file.value) else (path.parent / file.value, name.value)


def _profiles(node: yaml.Node) -> tuple[str, ...]:
    profiles = yamlfile.lookup(node, "profiles")
    items = profiles.value if isinstance(profiles, yaml.SequenceNode) else []
    return tuple(item.value for item in items if isinstance(item, yaml.ScalarNode))


def _programs(node: yaml.Node) -> dict[str, str]:
    programs = {}
    for key in ("entrypoint", "command"):
        value = yamlfile.lookup(node, key)
        first = next(iter(value.value), None) if isinstance(value, yaml.SequenceNode) else value
        if isinstance(first, yaml.ScalarNode):
            programs[key] = "".join(first.value.split()[:1])
    return programs


def _judge(service: Service) -> Iterator[Problem]:
    """Everything that is wrong with the settings of a service."""
    alone = {"avckpt.group": "any"}  # which avckpt.notify asks for
    right: dict[str, Setting] = {}
    for kind, setting in service.all_settings():
        value = {setting.key: setting.final}
        try:
            if setting.is_open:
                _judge_key(setting.key)
                continue
            if kind is Kind.LABEL:
                merge(value, {})
            parse_policy(value if setting.key == ENABLE else {**alone, **value})
        except LabelError as error:
            yield Problem(setting.place, service.name, str(error).replace("label", kind.value, 1))
        else:
            right[setting.key] = setting
    yield from _judge_both(service)
    if not any(setting.is_open for _, setting in service.all_settings()):
        yield from _judge_together(service, right)


def _judge_together(service: Service, settings: Mapping[str, Setting]) -> Iterator[Problem]:
    """Of values that are right by themselves.  Where the environment has a say, nobody can know."""
    try:
        parse_policy({key: setting.final for key, setting in settings.items()})
    except LabelError as error:
        yield Problem(settings[error.key].place, service.name, str(error))


def _judge_key(key: str) -> None:
    """Raises LabelError for a name that no value could make right."""
    label = LABELS.get(key)
    # A good value of a label that there is; and any value of one that there is not.
    if label is None:
        parse_policy({key: ""})
        merge({key: ""}, {})


def _judge_both(service: Service) -> Iterator[Problem]:
    annotations: Mapping[str, Setting] = service.settings[Kind.ANNOTATION]
    for key, label in service.settings[Kind.LABEL].items():
        annotation = annotations.get(key)
        if annotation is None or label.is_open or annotation.is_open:
            continue
        try:
            merge({key: label.final}, {key: annotation.final})
        except LabelError as error:
            yield Problem(annotation.place, service.name, str(error))


def _keys(service: Service) -> Iterator[str]:
    for _, setting in service.all_settings():
        yield setting.key


def _is_open(text: str) -> bool:
    """Compose will put something of the environment into it."""
    return "$" in text.replace("$$", "")
