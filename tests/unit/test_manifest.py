# SPDX-License-Identifier: Apache-2.0
"""`avckpt check` on typical Compose files."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
from avckpt import yamlfile
from avckpt.cli import commands
from avckpt.cli.compose import podman_compose
from avckpt.cli.compose.manifest import Kind, Manifest, Severity, check, files_meant
from avckpt.errors import ConfigError
from avckpt_hooks.shared.labels import LABELS, parse_policy
from click.testing import CliRunner

SHARED = """\
x-protect: &protect
  avckpt.enable: true
  avckpt.interval: 500ms

services:
  camera:
    image: camera
  filter:
    image: filter
    labels:
      <<: *protect
      avckpt.interval: 200ms
      org.example.team: perception
  monitor:
    image: monitor
    labels:
      - avckpt.enable=yes
      - "avckpt.keep=3"
      - org.example.team=perception
  planner:
    image: planner
    annotations:
      avckpt.enable: "true"
"""


def checked(path: Path, text: str) -> Manifest:
    path.write_text(text)
    return check([path])


def lines(manifest: Manifest) -> list[str]:
    """The problems, without the folder's name."""
    return [str(problem).rpartition("/")[2] for problem in manifest.problems]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "v.yaml"


def test_maps_lists_annotations_anchors_and_merge_keys(path: Path) -> None:
    manifest = checked(path, SHARED)
    assert lines(manifest) == []
    assert {name: service.enabled for name, service in manifest.services.items()} == {
        "camera": False,
        "filter": True,
        "monitor": True,
        "planner": True,
    }
    interval = manifest.services["filter"].settings[Kind.LABEL]["avckpt.interval"]
    assert (interval.value, interval.place.line) == ("200ms", 12)
    # What comes by an anchor stands where the anchor is.
    assert manifest.services["filter"].settings[Kind.LABEL]["avckpt.enable"].place.line == 2


@pytest.mark.parametrize(
    ("labels", "problem"),
    [
        ("{avckpt.enable: true, avckpt.kep: 3}", "label avckpt.kep: unknown label; did you mean avckpt.keep?"),
        ("{avckpt.interval: 5}", "label avckpt.interval=5: a duration needs a unit"),
        ("{avckpt.interval: }", 'label avckpt.interval="": not a duration'),
        ("{avckpt.keep: [1, 2]}", "avckpt.keep: a list, not a single value"),
        ("[avckpt.enable]", 'label avckpt.enable="": neither true nor false'),
        ("[avckpt.enable: true]", "avckpt.enable: in a list, write it as avckpt.enable=VALUE"),
        ("avckpt.enable=maybe", "label avckpt.enable=maybe: neither true nor false"),
        ("[avckpt_enable=true]", "avckpt_enable is no label of avckpt's; did you mean avckpt.enable?"),
        ("[avckpt=true]", "avckpt is no label of avckpt's; did you mean avckpt.enable?"),
        ("{avckpt: {enable: true}}", "avckpt is no label of avckpt's; did you mean avckpt.enable?"),
        ("[avkpt.enable=true]", "avkpt.enable is no label of avckpt's; did you mean avckpt.enable?"),
        ("{Avckpt.Restore-On: exit}", "Avckpt.Restore-On is no label of avckpt's; did you mean avckpt.restore.on?"),
        ("[avckpt.version=1]", "label avckpt.version=1: avckpt sets this itself"),
        ("['avckpt.nonsense=${X}']", "label avckpt.nonsense: unknown label"),
        ("[avckpt.keep=2, avckpt.keep=3]", "label avckpt.keep: line 3 says 2"),
    ],
)
def test_a_problem_is_one_line_with_file_line_and_service(path: Path, labels: str, problem: str) -> None:
    manifest = checked(path, f"services:\n  web:\n    labels: {labels}\n")
    assert len(manifest.errors) == 1, lines(manifest)
    line = str(manifest.errors[0])
    assert line.startswith(f"{path}:3: service web: {problem}")
    assert "\n" not in line


def test_an_annotation_is_called_one(path: Path) -> None:
    manifest = checked(path, "services:\n  web:\n    annotations:\n      avckpt.keep: 0\n")
    assert lines(manifest)[0].startswith("v.yaml:4: service web: annotation avckpt.keep=0: not within 1 to 16")


def test_label_and_annotation_must_agree(path: Path) -> None:
    text = "services:\n  web:\n    labels: [avckpt.enable=true]\n    annotations:\n      avckpt.enable: '{}'\n"
    assert lines(checked(path, text.format("true"))) == []
    [line] = lines(checked(path, text.format("false")))
    assert line.startswith(
        "v.yaml:5: service web: label avckpt.enable=true: the annotation of the same name says false"
    )


def test_what_the_environment_decides_is_left_alone(path: Path) -> None:
    text = (
        "services:\n  web:\n    labels: ['avckpt.enable=${ON:-true}', 'avckpt.interval=$INTERVAL', 'avckpt.keep=0']\n"
    )
    manifest = checked(path, text)
    assert [line.split(":")[3] for line in lines(manifest)] == [" label avckpt.keep=0"]
    assert manifest.services["web"].enabled is None
    assert manifest.wants_protection
    # A doubled dollar is a dollar.
    manifest = checked(path, "services:\n  web:\n    labels: ['avckpt.interval=$$5']\n")
    assert "avckpt.interval=$5: not a duration" in lines(manifest)[0]


def test_settings_without_enable_are_worth_a_warning(path: Path) -> None:
    manifest = checked(path, "services:\n  a:\n    labels: [avckpt.keep=3]\n  b:\n    labels: [avckpt.enable=false]\n")
    assert [(problem.service, problem.severity) for problem in manifest.problems] == [("a", Severity.WARNING)]
    assert "without avckpt.enable=true the container is not protected" in lines(manifest)[0]


def test_extends_in_a_file_and_beyond(path: Path) -> None:
    base = path.with_name("base.yaml")
    base.write_text("services:\n  node:\n    labels:\n      avckpt.enable: true\n      avckpt.keep: none\n")
    manifest = checked(
        path,
        "services:\n"
        "  a: {extends: {file: base.yaml, service: node}}\n"
        "  b: {extends: {service: a}, labels: {avckpt.keep: 3}}\n"
        "  c: {extends: b}\n",
    )
    [line] = lines(manifest)
    assert line.startswith("base.yaml:5: service a: label avckpt.keep=none")
    keep = [manifest.services[name].settings[Kind.LABEL]["avckpt.keep"].value for name in "abc"]
    assert keep == ["none", "3", "3"]
    assert all(service.enabled for service in manifest.services.values())


@pytest.mark.parametrize(
    ("extends", "problem"),
    [
        ("nobody", "v.yaml:2: service a: extends nobody, and there is no such service"),
        ("{file: no.yaml, service: x}", "v.yaml:2: service a: "),
        ("{file: other.yaml, service: x}", "v.yaml:2: service a: extends x, and there is no such service in "),
        ("a", "v.yaml:2: service a: extends itself, by way of a"),
    ],
)
def test_extends_that_lead_nowhere(path: Path, extends: str, problem: str) -> None:
    path.with_name("other.yaml").write_text("services: {y: {}}\n")
    manifest = checked(path, f"services:\n  a: {{extends: {extends}}}\n")
    assert len(manifest.problems) == 1
    assert str(manifest.problems[0]).replace(f"{path.parent}/v.yaml", "v.yaml").startswith(problem)


def test_include_and_several_files(path: Path) -> None:
    path.with_name("more.yaml").write_text("services:\n  b:\n    labels: [avckpt.enabled=true]\n")
    over = path.with_name("over.yaml")
    over.write_text("services:\n  a:\n    labels: {avckpt.interval: 1s}\n")
    path.write_text(
        "include:\n  - more.yaml\n  - {path: gone.yaml}\nservices:\n  a:\n    labels: [avckpt.enable=true]\n"
    )
    manifest = check([path, over])
    found = lines(manifest)
    assert found[0].startswith("more.yaml:3: service b: label avckpt.enabled: unknown label")
    assert found[1].endswith("gone.yaml: No such file or directory")
    assert str(manifest.problems[1].place) == f"{path}:3"
    assert len(found) == 2
    assert set(manifest.services["a"].settings[Kind.LABEL]) == {"avckpt.enable", "avckpt.interval"}


def test_one_mistake_behind_an_anchor_is_said_once(path: Path) -> None:
    text = "x: &x {avckpt.enable: true, avckpt.keep: 99}\nservices:\n  a: {labels: *x}\n  b: {labels: {<<: *x}}\n"
    assert [line[:21] for line in lines(checked(path, text))] == ["v.yaml:1: service a: "]


@pytest.mark.parametrize("where", ["deploy: {labels: {avckpt.enable: true}}", "label: [avckpt.enable=true]"])
def test_labels_elsewhere_are_not_the_containers(path: Path, where: str) -> None:
    manifest = checked(path, f"services:\n  a:\n    {where}\n")
    assert "put it under labels" in lines(manifest)[0]
    assert manifest.services["a"].enabled is False


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("services:\n  a: [\n", "v.yaml:3: not YAML: while parsing a flow node"),
        ("- a\n", "v.yaml:1: not a mapping: is this a Compose file?"),
        ("defaults: {}\n", "v.yaml:1: no services: is this a Compose file?"),
        ("", "v.yaml:1: no services: is this a Compose file?"),
        ("names: {}\n", "v.yaml:1: no services: is this a Compose file? The sidecar's own is checked by avckpt check"),
        ('services: {a: {image: "x\\0"}}\n', r"v.yaml:1: no text has the character \x00"),
        ('include: ["x\\0"]\n', r"v.yaml:1: no text has the character \x00"),
        ('services:\n  "\\ud800": {image: x}\n', r"v.yaml:2: no text has the character \ud800"),
        ("services: &s\n  a: {<<: *s, labels: &l {<<: *l}}\n", "v.yaml:1: an anchor that holds itself"),
        ("services: {a: , d: {labels: }, 5: {labels: {1: 2}}}\n", ""),
        ("services:\n  a: 3\n", "v.yaml:2: service a: a service is a mapping (image: ...): this is none"),
        ("services: {a: [1]}\n", "v.yaml:1: service a: a service is a mapping (image: ...): this is none"),
    ],
)
def test_files_that_are_something_else(path: Path, text: str, problem: str) -> None:
    found = lines(checked(path, text))
    assert len(found) == (1 if problem else 0)
    assert "".join(found).startswith(problem)


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("sleep ${X", "sleep ${X: no closing brace found for variable interpolation (a $ is written $$)"),
        ("${1}", "${1}: invalid interpolation format: ${1}."),
        ("${A:?must be set} ${B:-${C}} $D $$ $1 cost: 5$", ""),
    ],
)
def test_values_that_podman_compose_cannot_read(path: Path, value: str, problem: str) -> None:
    """Anywhere in a file; podman-compose 1.6 names neither file nor line.  Those that only lack a value can be read."""
    for text in (
        f"x-more: &more\n  - '{value}'\nservices:\n  a: {{command: *more, entrypoint: *more}}\n",
        f"services:\n  a: {{image: '{value}'}}\n",
    ):
        found = lines(checked(path, text))
        assert len(found) == (1 if problem else 0), found
        assert "".join(found).startswith(f"v.yaml:2: {problem}" if problem else "")


def test_what_is_lost_in_a_file_of_something_else(path: Path) -> None:
    """A warning alone would be no reason for status 1."""
    found = checked(path, "a: 1\na: 2\n")
    assert [str(each).rpartition("/")[2] for each in found.errors] == ["v.yaml:1: no services: is this a Compose file?"]


@pytest.mark.parametrize(
    "how", ["{path}", "include: [{path}]", "services: {{a: {{extends: {{file: {path}, service: b}}}}}}"]
)
def test_a_loop_of_links_is_a_wrong_file(path: Path, how: str) -> None:
    loop = path.with_name("loop")
    loop.symlink_to(loop)
    file = loop if how == "{path}" else path
    if file == path:
        path.write_text(how.format(path=loop) + "\n")
    status, output = avckpt("check", file)
    assert status == 1
    assert f"{loop}: {os.strerror(errno.ELOOP)}\n" in output


def test_what_a_file_is_called_moves_no_cursor(tmp_path: Path) -> None:
    path = tmp_path / "a\n\x1b[2J.yaml"
    for args in (("check",), ("check", "--config")):
        path.write_text("3\n")
        status, output = avckpt(*args, path)
        assert (status, output.count("\n")) == (1, 2)
        assert r"a\n\x1b[2J.yaml:1: " in output


def test_on_and_off_as_yaml_and_compose_pass_them_on(path: Path) -> None:
    """Without quotes they are booleans: the containers' labels say True and False."""
    manifest = checked(path, "services: {a: {labels: {avckpt.io_uring: off, avckpt.mark: on, avckpt.core: on}}}\n")
    assert manifest.errors == []
    labels = {key: one.value for key, one in manifest.services["a"].settings[Kind.LABEL].items()}
    policy = parse_policy(labels)
    assert (policy.io_uring, policy.mark, policy.core) == (False, True, "on")
    assert sorted(labels.values()) == ["False", "True", "True"]


def avckpt(*args: object) -> tuple[int, str]:
    result = CliRunner().invoke(commands.main, [str(arg) for arg in args])
    return result.exit_code, result.output


def test_a_file_that_may_not_be_read_is_a_wrong_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not wrong usage: whoever reads it says why."""
    path.write_text(SHARED)

    def refuse(name: str, bound: int) -> bytes:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), name)

    monkeypatch.setattr(os, "access", lambda *args, **more: False)
    monkeypatch.setattr(yamlfile, "read_bounded", refuse)
    assert avckpt("check", path) == (
        1,
        f"{path}: Permission denied\n0 services, to be protected: none; 1 problem\n",
    )


@pytest.mark.parametrize("command", ["up", "down"])
def test_a_file_that_is_named_as_other_commands_take_it(
    path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(path.parent)
    path.with_name("other.yaml").write_text(SHARED)
    status, output = avckpt(command, "other.yaml")
    assert status == 1
    assert output.endswith("; a file is named with -f other.yaml\n")


@pytest.mark.parametrize("command", ["up", "down"])
def test_what_can_be_read_once_is_no_manifest(path: Path, command: str) -> None:
    """podman-compose reads it again.  Nobody waits for a writer."""
    os.mkfifo(path)
    for file in (path, Path("/dev/stdin")):
        status, output = avckpt(command, "-f", file)
        assert (status, output.startswith(f"avckpt: {file} can be read once only")) == (1, True)


def test_the_command(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.write_text(SHARED)
    status, output = avckpt("check", path)
    assert status == 0
    assert output == "4 services, to be protected: filter, monitor, planner; no problems\n"
    path.write_text(SHARED.replace("keep=3", "keep=x"))
    status, output = avckpt("check", path)
    assert status == 1
    assert output.splitlines()[0].startswith(f"{path}:18: service monitor: label avckpt.keep=x: not a whole number")
    status, output = avckpt("check", "--json", path)
    assert status == 1
    answer = json.loads(output)
    assert answer["problems"][0]["line"] == 18
    assert answer["problems"][0]["service"] == "monitor"
    assert [service["protected"] for service in answer["services"]] == [False, True, True, True]
    monkeypatch.chdir(path.parent)
    assert avckpt("check")[0] == 1
    path.rename(path.with_name("compose.yml"))
    assert avckpt("check")[1].startswith("compose.yml:18: ")
    assert avckpt("check", "-f", "compose.yml") == avckpt("check", "compose.yml")
    assert avckpt("check", "gone.yaml") == (
        1,
        "gone.yaml: No such file or directory\n0 services, to be protected: none; 1 problem\n",
    )


def test_down_of_what_is_not_there(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(podman_compose.Compose, "down", lambda *_: pytest.fail("podman-compose was started"))
    assert avckpt("down", "-f", path) == (1, f"avckpt: {path}: No such file or directory\n")
    path.write_text("services: {a: [}")
    assert avckpt("down", "-f", path)[1].startswith(f"avckpt: {path}:1: not YAML: ")
    for text in ("", "services: []", "just words"):
        path.write_text(text)
        assert avckpt("down", "-f", path)[1].endswith(": is this a Compose file?\n")
    path.write_text("services: {a: {labels: {avckpt.enable: nonsense}}}")
    assert avckpt("down", "-f", path, "b") == (1, "avckpt: no such service: b; there are a\n")
    assert avckpt("down", "-f", path, path)[1].endswith(f"there are a; a file is named with -f {path}\n")
    path.write_text("apiVersion: v1\nkind: Pod\n")
    for command in ("up", "down"):
        assert avckpt(command, "-f", path)[1].startswith(f"avckpt: {path} is for Kubernetes: use podman kube play")
    path.write_text("services: {a: {labels: {avckpt.enable: nonsense}}}")
    done: list[object] = []
    monkeypatch.setattr(podman_compose.Compose, "down", lambda *_: done.append("down"))
    assert avckpt("down", "-f", path) == (0, "")
    assert done == ["down"]


def test_files_of_both_kinds_are_not_one_manifest(tmp_path: Path) -> None:
    """The labels of the pods were passed over."""
    pod, compose = tmp_path / "pod.yaml", tmp_path / "vehicle.yaml"
    pod.write_text("apiVersion: v1\nkind: Pod\nmetadata: {annotations: {avckpt.enabel: 'true'}}\n")
    compose.write_text("services: {node: {image: node}}\n")
    for files in ((pod, compose), (compose, pod)):
        status, said = avckpt("check", *map(str, files))
        assert status == 1
        assert said == f"avckpt: {pod} is for Kubernetes, and {compose} is not: check them one after the other\n"


def test_what_must_be_process_1_is_worth_a_warning(path: Path) -> None:
    manifest = checked(
        path,
        "services:\n"
        "  a: {labels: [avckpt.enable=true], command: /sbin/init --quiet}\n"
        "  b: {labels: [avckpt.enable=true], entrypoint: [/init], command: [node]}\n"
        "  c: {extends: a, entrypoint: /bin/sh -c}\n"
        "  d: {command: /sbin/init}\n"
        "  e: {extends: a, command: [node, /sbin/init]}\n",
    )
    why = "must itself be PID 1: this service runs unprotected"
    assert [str(problem) for problem in manifest.problems] == [
        f"{path}:2: service a: warning: /sbin/init {why}, unless its image has an entrypoint of its own",
        f"{path}:3: service b: warning: /init {why}",
    ]
    assert manifest.errors == []


def test_services_of_a_profile_are_told_as_such(path: Path) -> None:
    over = path.with_name("over.yaml")
    over.write_text("services: {rec: {profiles: [bench]}}\n")
    path.write_text(
        "services:\n  a: {labels: [avckpt.enable=true]}\n"
        "  rec: {labels: [avckpt.enable=true], profiles: [debug]}\n  b: {extends: rec}\n"
    )
    status, output = avckpt("check", path, over)
    assert (status, output) == (0, "3 services, to be protected: a, rec (profile debug/bench), b; no problems\n")
    services = json.loads(avckpt("check", "--json", path)[1])["services"]
    assert [service["profiles"] for service in services] == [[], ["debug"], []]


def test_files_that_nobody_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="none called vehicle.yaml or compose.yaml is here"):
        files_meant((), {})
    for name in ("docker-compose.yml", "compose.override.yaml", "compose.yaml", "other.yaml"):
        Path(name).touch()
    usual = [Path("compose.yaml"), Path("compose.override.yaml"), Path("docker-compose.yml")]
    assert files_meant((), {}) == tuple(usual)
    Path("vehicle.yaml").touch()
    assert files_meant((), {}) == (Path("vehicle.yaml"),)
    listed = {"COMPOSE_FILE": "other.yaml:gone.yaml:compose.yaml"}
    assert files_meant((), listed) == (Path("other.yaml"), Path("compose.yaml"))
    listed = {"COMPOSE_FILE": "other.yaml,compose.yaml", "COMPOSE_PATH_SEPARATOR": ","}
    assert files_meant((), listed) == (Path("other.yaml"), Path("compose.yaml"))
    with pytest.raises(ConfigError, match="none of COMPOSE_FILE=gone.yaml is here"):
        files_meant((), {"COMPOSE_FILE": "gone.yaml"})
    named = (Path("other.yaml"), Path("/x.yaml"))
    assert files_meant(named, listed) == named
    elsewhere = {"COMPOSE_PROJECT_DIR": str(tmp_path)}
    monkeypatch.chdir("/")
    assert files_meant((), elsewhere) == (tmp_path / "vehicle.yaml",)
    assert files_meant(named, elsewhere) == (tmp_path / "other.yaml", Path("/x.yaml"))


def test_the_command_for_the_sidecars_own_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AVCKPT_CONFIG", str(path))
    assert avckpt("check", "--config") == (0, f"no {path}: the built-in defaults hold\n")
    path.touch()
    assert avckpt("check", "--config") == (0, "no problems\n")
    path.write_text("defaults:\n  keep: 0\n")
    status, output = avckpt("check", "--config")
    assert (status, output.splitlines()[0][: len(str(path)) + 19]) == (1, f"{path}:2: defaults.keep: ")
    assert json.loads(avckpt("check", "--config", "--json", path)[1])["problems"][0]["line"] == 2
    assert avckpt("check", "--config", "gone.yaml")[0] == 1


@pytest.mark.parametrize("label", sorted(LABELS))
def test_every_label_is_known(path: Path, label: str) -> None:
    manifest = checked(path, f"services:\n  a:\n    labels:\n      {label}: '?!'\n")
    assert all("unknown label" not in line for line in lines(manifest))
    assert len(manifest.errors) == 1


def test_one_that_hears_of_its_group_is_no_mistake(path: Path) -> None:
    receiver = "    labels: [avckpt.group=g, 'avckpt.notify=signal:USR1']\n"
    both = checked(path, f"services:\n  a:\n{receiver}  b:\n{receiver.replace('[', '[avckpt.enable=true, ')}")
    assert lines(both) == []
    assert [service.enabled for service in both.services.values()] == [False, True]
    alone = checked(path, "services:\n  a:\n    labels:\n    - avckpt.enable=true\n    - avckpt.notify=signal:USR1\n")
    assert lines(alone) == [
        "v.yaml:5: service a: label avckpt.notify=signal:USR1: without a group there are no recoveries to report; "
        "add avckpt.group=NAME, or use avckpt.notify.self for its own recoveries"
    ]


def test_groups_that_go_back_together(path: Path) -> None:
    labels = "avckpt.group={}, avckpt.group.recovery=together"
    service = "  {}:\n    labels: [{}]\n"
    whole = "".join(service.format(name, "avckpt.enable=true, " + labels.format("g")) for name in "ab")
    assert lines(checked(path, f"services:\n{whole}")) == []
    odd = service.format("c", "avckpt.enable=true, avckpt.group=g") + service.format("d", labels.format("g"))
    alone = service.format("e", "avckpt.enable=true, " + labels.format("h"))
    assert [line.split(": ", 2)[2] for line in lines(checked(path, f"services:\n{whole}{odd}{alone}"))] == [
        "warning: it does not go back with the others of group g: avckpt.group.recovery=together is missing",
        "warning: avckpt.group.recovery=together has no effect: without avckpt.enable=true nothing of it goes back",
        "warning: avckpt.group has no effect: without avckpt.enable=true the container is not protected",
        "warning: no other service here is in the group h: nobody hears of anybody",
    ]


def test_values_that_do_not_go_together(path: Path) -> None:
    labels = "      avckpt.enable: true\n      avckpt.restore.on: unhealthy\n      avckpt.keep: 1\n"
    text = f"services:\n  a:\n    labels:\n{labels}"
    assert lines(checked(path, text))[0].startswith(
        "v.yaml:6: service a: label avckpt.keep=1: too few for avckpt.restore.on=unhealthy"
    )


def test_what_is_given_twice_is_lost(path: Path) -> None:
    """Not what is merged, or reached by several aliases."""
    found = checked(
        path,
        """\
x-protect: &protect
  avckpt.enable: true
services:
  camera:
    labels: *protect
    image: camera
    labels:
      <<: *protect
      avckpt.enable: false
      avckpt.keep: 3
      avckpt.keep: 4
  filter:
    labels: *protect
""",
    )
    told = [str(problem) for problem in found.problems if "twice" in problem.message]
    assert told == [
        f"{path}:{line}: warning: {key} is given twice: what was given first is lost"
        for line, key in ((7, "labels"), (11, "avckpt.keep"))
    ]
