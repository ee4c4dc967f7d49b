# SPDX-License-Identifier: Apache-2.0
"""Warnings about a Compose file: what is valid, but probably unintended."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import yaml
from avckpt_hooks.shared.labels import PREFIX
from avckpt_hooks.shared.programs import must_be_pid_1

from avckpt import yamlfile

if TYPE_CHECKING:
    from avckpt.cli.compose.manifest import Service
    from avckpt.yamlfile import Place

ENABLE = f"{PREFIX}enable"
RECOVERY = f"{PREFIX}group.recovery"
_GPUS = ("/dev/nvidia", "/dev/dri", "/dev/kfd", "nvidia.com/", "amd.com/gpu", "gpu.intel.com/")


@dataclass(frozen=True)
class Facts:
    """What else matters of a service; None: it does not say, so that what it extends does."""

    health_checked: bool | None = None
    depends_on: frozenset[str] = frozenset()
    gpu: str = ""
    """The device it asks for."""
    containers: int = 1
    """How many are started of it."""

    def over(self, base: Facts) -> Facts:
        """These, and what only `base` says."""
        checked = base.health_checked if self.health_checked is None else self.health_checked
        return Facts(checked, self.depends_on | base.depends_on, self.gpu or base.gpu)


def facts_of(node: yaml.Node) -> Facts:
    """Those of a service's mapping."""
    health = yamlfile.lookup(node, "healthcheck")
    disabled = yamlfile.lookup(health, "disable")
    off = isinstance(disabled, yaml.ScalarNode) and disabled.value.lower() in ("true", "yes", "on")
    depends = yamlfile.lookup(node, "depends_on")
    names = [key.value for key, how in yamlfile.entries(depends) if not _is_optional(how)] or list(_words(depends))
    return Facts(None if health is None else not off, frozenset(names), _gpu(node))


def _is_optional(how: yaml.Node) -> bool:
    required = yamlfile.lookup(how, "required")
    return isinstance(required, yaml.ScalarNode) and required.value.lower() in ("false", "no", "off")


def facts_of_pod(containers: Iterable[yaml.Node]) -> Facts:
    """Those of a pod, or of some of its containers."""
    listed = list(containers)
    checked = bool(listed) and all(yamlfile.lookup(each, "livenessProbe") is not None for each in listed)
    gpus = (gpu for each in listed for gpu in _gpus_of_container(each))
    return Facts(checked or None, gpu=next(gpus, ""), containers=len(listed))


def of_service(service: Service) -> Iterator[tuple[Place, str]]:
    """Of one by itself."""
    keys = {setting.key for _, setting in service.all_settings()}
    if service.enabled is False and not {"avckpt.group", "avckpt.notify"} <= keys and ENABLE not in keys:
        for _, setting in service.all_settings():
            yield setting.place, f"{setting.key} has no effect: without {ENABLE}=true the container is not protected"
            break
    if not service.enabled:
        return
    program = service.programs.get("entrypoint") or service.programs.get("command", "")
    if must_be_pid_1(program):
        unless = "" if "entrypoint" in service.programs else ", unless its image has an entrypoint of its own"
        yield service.place, f"{program} must itself be PID 1: this service runs unprotected{unless}"
    if service.facts.gpu:
        yield service.place, f"{service.facts.gpu}: a process that uses a GPU is not protected"
    for _, setting in service.all_settings():
        asks = setting.key == "avckpt.restore.on" and "unhealthy" in setting.value.split(",")
        if asks and not service.facts.health_checked:
            unless = "" if service.facts.health_checked is False else ", unless its image has one"
            yield setting.place, f"unhealthy needs a healthcheck, and the service has none{unless}"


def of_groups(services: Iterable[Service]) -> Iterator[tuple[Service, Place, str]]:
    """Of those that are alone in their group: nobody hears of anybody."""
    members: dict[str, list[tuple[Service, Place]]] = {}
    for service in services:
        named = {setting.final: setting.place for _, setting in service.all_settings() if setting.key == "avckpt.group"}
        for group, place in named.items():
            members.setdefault(group, []).append((service, place))
    for group, found in members.items():
        if sum(service.facts.containers for service, _ in found) == 1 and group and "$" not in group:
            service, place = found[0]
            yield service, place, f"no other service here is in the group {group}: nobody hears of anybody"


def of_returns(services: Iterable[Service]) -> Iterator[tuple[Service, str]]:
    """Of groups that go back together: members that do not."""
    groups: dict[str, list[tuple[Service, str]]] = {}
    for service in services:
        says = {setting.key: setting.value for _, setting in service.all_settings()}
        groups.setdefault(says.get("avckpt.group", ""), []).append((service, says.get(RECOVERY, "")))
    for group, members in groups.items():
        if not group or "$" in group or all(recovery != "together" for _, recovery in members):
            continue
        for service, recovery in members:
            if recovery == "together" and service.enabled is False:
                yield service, f"{RECOVERY}=together has no effect: without {ENABLE}=true nothing of it goes back"
            elif recovery in ("", "apart") and service.enabled:
                yield service, f"it does not go back with the others of group {group}: {RECOVERY}=together is missing"


def of_absent(services: Mapping[str, Service]) -> Iterator[tuple[Service, str]]:
    """Of services that wait for one that is not there, on which podman-compose fails half way."""
    for service in services.values():
        for name in sorted(service.facts.depends_on):
            if name not in services and "$" not in name:
                yield service, f"depends_on {name}, and there is no such service"


def of_order(services: Mapping[str, Service]) -> Iterator[tuple[Service, str]]:
    """Of services that wait for each other, and so for ever."""
    left: set[str] = set()
    for start in services:
        if start in left:
            continue
        trail = [start]
        ahead = [_awaited(services, start)]
        while trail:
            name = next(ahead[-1], None)
            if name is None:
                left.add(trail.pop())
                ahead.pop()
            elif name in trail:
                round_ = [*trail[trail.index(name) :], name]
                yield services[name], f"waits for itself (depends_on): {' -> '.join(round_)}"
            elif name not in left:
                trail.append(name)
                ahead.append(_awaited(services, name))


def _awaited(services: Mapping[str, Service], name: str) -> Iterator[str]:
    return (each for each in sorted(services[name].facts.depends_on) if each in services)


def _gpu(node: yaml.Node) -> str:
    if yamlfile.lookup(node, "gpus") is not None:
        return "gpus"
    runtime = yamlfile.lookup(node, "runtime")
    if isinstance(runtime, yaml.ScalarNode) and runtime.value.startswith("nvidia"):
        return f"runtime {runtime.value}"
    for device in _words(yamlfile.lookup(node, "devices")):
        if device.startswith(_GPUS):
            return device
    reserved = node
    for key in ("deploy", "resources", "reservations", "devices"):
        reserved = yamlfile.lookup(reserved, key) or yaml.ScalarNode("", "")
    for each in reserved.value if isinstance(reserved, yaml.SequenceNode) else []:
        if "gpu" in _words(yamlfile.lookup(each, "capabilities")):
            return "deploy.resources.reservations.devices"
    return ""


def _gpus_of_container(node: yaml.Node) -> Iterator[str]:
    resources = yamlfile.lookup(node, "resources")
    for key in ("limits", "requests"):
        for name, _ in yamlfile.entries(yamlfile.lookup(resources, key)):
            if name.value.startswith(_GPUS):
                yield name.value


def _words(node: yaml.Node | None) -> Iterator[str]:
    for item in node.value if isinstance(node, yaml.SequenceNode) else []:
        if isinstance(item, yaml.ScalarNode):
            yield item.value
