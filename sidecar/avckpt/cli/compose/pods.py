# SPDX-License-Identifier: Apache-2.0
"""What YAML of Kubernetes says to avckpt: the annotations of pods, and of whatever has a template of pods.

Whether the rest is good Kubernetes is the API server's to say, or kubeconform's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml
from avckpt_hooks.shared.labels import PREFIX, meant_by

from avckpt import yamlfile
from avckpt.cli.compose import doubts, manifest
from avckpt.cli.compose.manifest import Kind, Manifest, Problem, Service, Setting, Severity
from avckpt.yamlfile import Unreadable

_STRING = "tag:yaml.org,2002:str"
_TEMPLATES = (("template",), ("jobTemplate", "spec", "template"))
"""Where controllers have that of their pods, below `spec`."""


def is_pods(path: Path) -> bool:
    """Whether it is a file of Kubernetes, and no Compose file."""
    try:
        documents = yamlfile.read_all(path)
    except Unreadable:
        return False
    return any(yamlfile.lookup(each, "apiVersion") and yamlfile.lookup(each, "kind") for each in documents)


def check(files: Sequence[Path]) -> Manifest:
    """Reads the files, each by itself, and finds every problem.  A pod is called KIND/NAME."""
    found = Manifest(tuple(files))
    for path in files:
        try:
            documents = yamlfile.read_all(path)
        except Unreadable as error:
            found.problems.append(Problem(error.place, "", error.why))
            continue
        for document in documents:
            found.problems += manifest.repeated(document, path)
            for each in _objects(document):
                _read(each, path, found)
    manifest.judge(found, "")
    return found


def _objects(document: yaml.Node) -> Iterator[yaml.Node]:
    items = yamlfile.lookup(document, "items")
    if isinstance(items, yaml.SequenceNode):
        yield from items.value
    else:
        yield document


def _read(node: yaml.Node, path: Path, found: Manifest) -> None:
    kind, metadata, spec = (yamlfile.lookup(node, key) for key in ("kind", "metadata", "spec"))
    if not isinstance(kind, yaml.ScalarNode):
        return
    name = yamlfile.lookup(metadata, "name")
    called = f"{kind.value}/{name.value if isinstance(name, yaml.ScalarNode) else '?'}"
    service = Service(called, yamlfile.place_of(node, path))
    if kind.value != "Pod":
        template = _template(spec)
        if template is None:
            return
        for setting in _settings(yamlfile.lookup(metadata, "annotations"), path, called, found):
            message = f"{setting.key} is no annotation of its pods; put it under the template's metadata"
            found.problems.append(Problem(setting.place, called, message))
        metadata, spec = (yamlfile.lookup(template, key) for key in ("metadata", "spec"))
    listed = dict(_containers(spec))
    containers = {
        name: Service(f"{called}/{name}", service.place, facts=doubts.facts_of_pod([each]))
        for name, each in listed.items()
    }
    settings = list(_settings(yamlfile.lookup(metadata, "annotations"), path, called, found))
    for setting in settings:
        if "/" not in setting.key:
            for each in (service, *containers.values()):
                each.settings[Kind.ANNOTATION][setting.key] = setting
    named = set()
    for setting in settings:
        key, slash, container = setting.key.partition("/")
        if not slash:
            continue
        if container in containers:
            named.add(container)
            own = Setting(key, setting.value, setting.place)
            containers[container].settings[Kind.ANNOTATION][key] = own
        else:
            message = f"{setting.key}: the pod has no container {container!r}"
            found.problems.append(Problem(setting.place, called, message))
    for setting in _settings(yamlfile.lookup(metadata, "labels"), path, called, found):
        message = f"{setting.key}: Kubernetes tells a runtime of annotations, and not of labels; make it one of those"
        found.problems.append(Problem(setting.place, called, message, Severity.WARNING))
    # The pod stands for those of its containers that no annotation names.
    services = [containers[name] for name in sorted(named)]
    if not listed or len(named) < len(listed):
        service.facts = doubts.facts_of_pod(each for name, each in listed.items() if name not in named)
        services.insert(0, service)
    if any(each.enabled for each in services) and yamlfile.lookup(spec, "runtimeClassName") is None:
        message = "without a runtimeClassName Kubernetes starts it unprotected (podman kube play needs none)"
        found.problems.append(Problem(service.place, called, message, Severity.WARNING))
    found.services.update((each.name, each) for each in services)


def _containers(spec: yaml.Node | None) -> Iterator[tuple[str, yaml.Node]]:
    """A pod's containers by name."""
    for key in ("initContainers", "containers"):
        listed = yamlfile.lookup(spec, key)
        for each in listed.value if isinstance(listed, yaml.SequenceNode) else ():
            name = yamlfile.lookup(each, "name")
            if isinstance(name, yaml.ScalarNode):
                yield name.value, each


def _template(spec: yaml.Node | None) -> yaml.Node | None:
    for keys in _TEMPLATES:
        node = spec
        for key in keys:
            node = yamlfile.lookup(node, key)
        if node is not None:
            return node
    return None


def _settings(node: yaml.Node | None, path: Path, called: str, found: Manifest) -> Iterator[Setting]:
    """The `avckpt.*` entries of annotations or labels, without those that are none."""
    if node is not None and not isinstance(node, yaml.MappingNode) and node.tag != yamlfile.NULL:
        message = 'annotations and labels are a mapping (avckpt.enable: "true"): these are none'
        found.problems.append(Problem(yamlfile.place_of(node, path), called, message))
    for key, value in yamlfile.entries(node):
        place = yamlfile.place_of(key, path)
        if not key.value.startswith(PREFIX):
            meant = meant_by(key.value)
            if meant:
                message = f"{key.value} is no annotation of avckpt's; did you mean {meant}?"
                found.problems.append(Problem(place, called, message))
        elif not isinstance(value, yaml.ScalarNode) or value.tag != _STRING:
            text = value.value if isinstance(value, yaml.ScalarNode) else "..."
            message = f'{key.value}: Kubernetes takes strings only, write "{text}"'
            found.problems.append(Problem(place, called, message))
        else:
            # Nothing is replaced in it, as Compose does.
            yield Setting(key.value, value.value.replace("$", "$$"), place)
