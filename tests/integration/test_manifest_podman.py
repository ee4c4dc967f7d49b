# SPDX-License-Identifier: Apache-2.0
"""`avckpt up` and `avckpt down` with podman-compose and real containers, and podman-compose alone."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from avckpt.cli.compose.manifest import COMPOSE_NAMES, Kind, check, files_meant
from avckpt.cli.compose.podman_compose import STUCK_S
from avckpt.cli.install import LIBEXEC

from testkit.harness import (
    BASE_IMAGE,
    CONFIG,
    OF_A_TEST,
    ROOT,
    SLOWNESS,
    Completed,
    Container,
    Podman,
    Sidecar,
    avckpt_command,
    run,
    wait_until,
)

COUNT = "import itertools, time\nfor i in itertools.count():\n  print('n', i, flush=True); time.sleep(0.02)\n"
PATIENCE_S = 300.0 * SLOWNESS
"""For a command that brings several containers up on a busy machine."""
pytestmark = [
    pytest.mark.timeout(900 * SLOWNESS),
    pytest.mark.shared_machine(
        "podman-compose is ended when it seems to hang, and containers are given a time to be protected"
    ),
]
SERVICES = f"""\
x-node: &node
  image: {BASE_IMAGE}
  network_mode: host
  stop_grace_period: 1s
  volumes: [./count.py:/count.py:ro]
  command: [python3, /count.py]
services:
  by-map:
    <<: *node
    labels: {{avckpt.enable: true, avckpt.interval: 100ms}}
  by-list:
    <<: *node
    labels: [avckpt.enable=true, "avckpt.interval=${{INTERVAL:-150ms}}"]
  by-annotation:
    <<: *node
    annotations: {{avckpt.enable: "true", avckpt.interval: 200ms}}
  plain:
    <<: *node
"""


@dataclass
class Project:
    """A folder with a vehicle.yaml."""

    name: str
    path: Path
    podman: Podman

    def write(self, services: str) -> None:
        self.path.write_text(f"name: {self.name}\n{services}")
        self.path.with_name("count.py").write_text(COUNT)

    def avckpt(self, command: str, *args: str, check: bool = True, env: dict[str, str] | None = None) -> Completed:
        words = [*avckpt_command(), command, "-f", str(self.path)]
        if command == "up":
            words += ["--wait", str(30 * SLOWNESS)]
        return run([*words, *args], check=check, env=env, timeout_s=PATIENCE_S)

    def compose(self, *args: str, check: bool = True) -> Completed:
        return run(
            [sys.executable, "-m", "podman_compose", "-f", str(self.path), *args], check=check, timeout_s=PATIENCE_S
        )

    def ids(self) -> list[str]:
        label = f"label=io.podman.compose.project={self.name}"
        return self.podman.run("ps", "-aq", "--no-trunc", "--filter", label).stdout.split()

    def container(self, service: str) -> Container:
        name = f"{self.name}_{service}_1"
        return Container(self.podman, name, self.podman.inspect(name)["Id"])

    def remove(self) -> None:
        # The pod takes its containers along, also those that others depend on.
        self.podman.run("pod", "rm", "--force", "--ignore", "--time", "0", f"pod_{self.name}", shielded=True)


@pytest.fixture
def project(podman: Podman, sidecar: Sidecar, tmp_path: Path) -> Iterator[Project]:
    made = Project(f"avckpt-test-{os.getpid()}", tmp_path / "vehicle.yaml", podman)
    yield made
    made.remove()


def states(done: Completed) -> dict[str, bool]:
    return {entry["service"]: entry["protected"] for entry in json.loads(done.stdout)}


def test_up_protects_what_podman_compose_alone_protects_too(project: Project, sidecar: Sidecar) -> None:
    project.write(SERVICES)
    expected = {"by-map": True, "by-list": True, "by-annotation": True, "plain": False}
    done = project.avckpt("up", "--json")
    assert states(done) == expected
    intervals = {
        entry["name"].split("_")[1]: entry["interval_s"] for entry in sidecar.ps() if project.name in entry["name"]
    }
    assert intervals == {"by-map": 0.1, "by-list": 0.15, "by-annotation": 0.2}
    by_list = project.container("by-list")
    os.kill(sidecar.app_pid(by_list), signal.SIGKILL)
    sidecar.wait_restores(by_list)
    assert by_list.logs().splitlines().count("n 0") == 1
    # A second time it finds everything as it should be.
    ids = project.ids()
    assert states(project.avckpt("up", "--json")) == expected
    assert project.ids() == ids
    gone = json.loads(project.avckpt("down", "--json").stdout)
    assert {one["service"] for one in gone} == set(expected)
    assert {one["id"] for one in gone} == set(ids)
    assert project.ids() == []
    assert sidecar.running

    project.compose("up", "-d")
    for service in ("by-map", "by-list", "by-annotation"):
        sidecar.wait_generation(project.container(service))
    assert sidecar.find(project.container("plain")) is None
    project.compose("down")


def test_a_change_makes_only_what_hangs_on_it_anew(project: Project, sidecar: Sidecar) -> None:
    """Also where something that depends on what has changed has done its work, and ended."""

    def services(step: int) -> str:
        asked = "labels: {avckpt.enable: true, avckpt.interval: 1h}"
        job = "command: [echo, done]\n    restart: 'no'\n    depends_on: [by-map]"
        return (
            f"{SERVICES.partition('services:')[0]}services:\n"
            f"  by-map:\n    <<: *node\n    {asked}\n    environment: {{STEP: {step}}}\n"
            f"  by-list:\n    <<: *node\n    {asked}\n    depends_on: [by-map]\n"
            f"  plain:\n    <<: *node\n    {asked}\n"
            f"  job:\n    <<: *node\n    {job}\n"
        )

    def up(step: int) -> dict[str, str]:
        project.write(services(step))
        done = project.avckpt("up", "--json")  # none waits an hour for its first checkpoint
        assert states(done) == {"by-map": True, "by-list": True, "plain": True, "job": False}
        return {entry["service"]: entry["id"] for entry in json.loads(done.stdout)}

    first = up(1)
    wait_until(lambda: project.container("job").status == "exited", 20 * SLOWNESS, "the job is done")
    assert up(1) == first
    second = up(2)
    assert {service for service in first if first[service] != second[service]} == {"by-map", "by-list", "job"}


def test_only_the_services_that_are_named(project: Project, sidecar: Sidecar) -> None:
    project.write(SERVICES)
    assert states(project.avckpt("up", "--json", "by-map")) == {"by-map": True}
    assert len(project.ids()) == 1
    done = project.avckpt("up", "by-mop", check=False)
    assert done.status == 1
    assert done.stderr.startswith("avckpt: no such service: by-mop; there are by-annotation, ")


def test_a_name_that_another_container_has_is_a_failure(project: Project, podman: Podman) -> None:
    project.write(SERVICES)
    name = f"{project.name}_by-map_1"
    podman.run("create", "--name", name, BASE_IMAGE, "true")
    try:
        done = project.avckpt("up", "by-map", check=False)
    finally:
        podman.run("rm", "--force", name, shielded=True)
    assert (done.status, done.stdout) == (1, "")
    assert "by-map has no container: " in done.stderr.splitlines()[-1]
    assert "already in use" in done.stderr.splitlines()[-1]


def test_what_another_manifest_of_the_project_started_stays(project: Project) -> None:
    """They share pod and networks; without a word it looked as if these had been forgotten."""
    plain = f"{{image: {BASE_IMAGE}, network_mode: host, stop_grace_period: 1s, command: sleep 100}}"
    project.write(f"services: {{first: {plain}}}")
    project.avckpt("up")
    project.write(f"services: {{second: {plain}}}")
    assert f"{project.name}_first_1: of another manifest" in project.avckpt("up").stderr
    assert f"{project.name}_first_1: of another manifest" in project.avckpt("down").stderr
    assert project.container("first").id in project.ids()
    project.write(f"services: {{first: {plain}}}")
    assert "manifest" not in project.avckpt("down").stderr
    assert not project.ids()


def test_what_podman_does_not_remove_is_a_failure(project: Project, podman: Podman) -> None:
    plain = f"image: {BASE_IMAGE}, network_mode: host, stop_grace_period: 0s, command: sleep 100"
    project.write(f"services: {{first: {{{plain}}}, second: {{{plain}}}}}")
    project.avckpt("up")
    first = project.container("first")
    podman.run("pause", first.name)
    done = project.avckpt("down", check=False)
    assert done.status == 1
    assert done.stderr.splitlines()[-1].startswith(f"avckpt: {first.name} not removed: ")
    assert project.ids() == [first.id]
    podman.run("unpause", first.name)
    project.avckpt("down")
    assert project.ids() == []


@pytest.mark.parametrize("policy", ["never", "missing"])
def test_an_image_that_is_missing_changes_nothing(podman: Podman, tmp_path: Path, policy: str) -> None:
    """podman-compose removes what runs before it finds out."""
    project = Project(f"avckpt-test-{os.getpid()}", tmp_path / "vehicle.yaml", podman)
    plain = "network_mode: host, stop_grace_period: 0s, command: sleep 100"
    there = f"{{image: {BASE_IMAGE}, {plain}}}"
    image = f"dir:{tmp_path}/no-such-image"  # asks no registry
    missing = f"{{image: '{image}', pull_policy: {policy}, depends_on: [there], {plain}}}"
    services = "services:\n  there: {there}\n  node: {node}\n  user: {{depends_on: [node], {user}\n"
    try:
        project.write(services.format(there=there, node=there, user=there[1:]))
        project.avckpt("up")
        ids = project.ids()
        project.write(services.format(there=there, node=missing, user=there[1:]))
        for named in ([], ["user"]):
            done = project.avckpt("up", *named, check=False)
            assert (done.status, done.stdout) == (1, "")
            last = done.stderr.splitlines()[-1]
            assert last.startswith(f"avckpt: service node: the image {image} is not here, and cannot be pulled (")
            assert last.endswith("): build it, or correct its name; nothing was started or stopped")
            assert project.ids() == ids
        project.avckpt("up", "there")
        assert project.ids() == ids
    finally:
        project.remove()


def test_files_that_nobody_names_are_those_of_podman_compose(
    project: Project, sidecar: Sidecar, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project.path.parent)
    project.write(SERVICES)
    project.path.rename("compose.yaml")
    Path("compose.override.yaml").write_text("services: {plain: {labels: {avckpt.enable: true}}}\n")
    up = [*avckpt_command(), "up", "--json"]
    assert states(run([*up, "plain"], timeout_s=PATIENCE_S)) == {"plain": True}
    run([*avckpt_command(), "down"], timeout_s=PATIENCE_S)
    done = run([*up, "plain"], env={"COMPOSE_FILE": "compose.yaml"}, timeout_s=PATIENCE_S)
    assert states(done) == {"plain": False}


def test_services_of_a_profile(project: Project, sidecar: Sidecar, tmp_path: Path) -> None:
    project.write(SERVICES.replace("    annotations: {", "    profiles: [debug]\n    annotations: {"))
    why = "service by-annotation is not started: that takes --profile debug"
    done = project.avckpt("up", "by-map", "by-annotation", check=False)
    assert (done.status, done.stderr) == (1, f"avckpt: {why}\n")
    assert project.ids() == []
    done = project.avckpt("up", "--json")
    assert why in done.stderr
    assert "by-annotation" not in states(done)
    # Named as on podman-compose's own command line, and by what that reads.
    assert states(project.avckpt("up", "--json", "--profile", "debug", "by-annotation"))["by-annotation"]
    project.avckpt("down", "--profile", "debug")
    assert project.ids() == []
    env = tmp_path / "debug.env"
    env.write_text("COMPOSE_PROFILES=debug\nINTERVAL=250ms\n")
    done = project.avckpt("up", "--json", "--env-file", str(env), "by-annotation", "by-list")
    assert states(done) == {"by-annotation": True, "by-list": True}
    assert sidecar.wait_generation(project.container("by-list"))["interval_s"] == 0.25


@pytest.mark.parametrize("listed", ["", "docker-compose.yml:gone.yaml:compose.yaml"])
def test_they_are_merged_in_the_same_order(
    podman: Podman, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COMPOSE_FILE", listed)
    for number, name in enumerate(COMPOSE_NAMES):
        # Each overrides all those before it.
        labels = {f"avckpt.{before}": name for before in COMPOSE_NAMES[: number + 1]}
        Path(name).write_text(yaml.safe_dump({"services": {"node": {"image": "node", "labels": labels}}}))
    merged = yaml.safe_load(run([sys.executable, "-m", "podman_compose", "config"]).stdout)
    settings = check(files_meant((), os.environ)).services["node"].settings[Kind.LABEL]
    assert {key: setting.value for key, setting in settings.items()} == merged["services"]["node"]["labels"]


def test_a_wrong_label_starts_nothing(project: Project) -> None:
    project.write(SERVICES.replace("avckpt.interval: 200ms", "avckpt.intervall: 200ms"))
    done = project.avckpt("up", check=False)
    assert done.status == 1
    assert done.stderr.startswith(
        f"{project.path}:17: service by-annotation: annotation avckpt.intervall: unknown label"
    )
    assert project.ids() == []


def test_who_is_not_protected_is_named_with_the_reason(project: Project) -> None:
    project.write(
        SERVICES.replace(
            "  plain:\n    <<: *node\n",
            '  plain:\n    <<: *node\n    command: ["sh", "-c", "exit 3"]\n    labels: [avckpt.enable=true]\n',
        )
    )
    # Nobody waits for what has ended: this would be more than PATIENCE_S.
    done = project.avckpt("up", "--wait", "9999", check=False)
    assert done.status == 5
    lines = dict(line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert lines.pop(f"{project.name}_plain_1").startswith("unprotected: it has exited with status 3 (podman logs ")
    assert set(lines.values()) == {"protected"}


def test_who_must_be_process_1_is_told_so_at_once(project: Project) -> None:
    init = project.path.with_name("init")
    init.write_text("#!/bin/sh\nexec sleep 60\n")
    init.chmod(0o755)
    service = f"image: {BASE_IMAGE}, network_mode: host, stop_grace_period: 0s, volumes: ['./init:/init:ro']"
    project.write(f"services:\n  s6: {{{service}, entrypoint: [/init], labels: {{avckpt.enable: 'true'}}}}\n")
    done = project.avckpt("up", "--wait", "9999", check=False)
    assert done.status == 5
    assert "its command is /init, which must itself be PID 1" in done.stdout + done.stderr


def test_a_dependency_that_does_not_start_hangs_nobody(project: Project) -> None:
    text = SERVICES + "    depends_on: [by-list]\n"
    project.write(text.replace("avckpt.interval=${INTERVAL:-150ms}", "avckpt.interval=${INTERVAL}"))
    done = project.avckpt("up", check=False, env={"INTERVAL": "soon"})
    assert done.status == 1
    assert "label avckpt.interval=soon: not a duration" in done.stderr  # the hook's own words
    last = done.stderr.splitlines()[-1]
    name = f"{project.name}_by-list_1"
    assert last.startswith(f"avckpt: podman-compose up was ended: it waited in vain for {name} to become running; ")
    assert f"{name} did not start and is created" in last
    assert project.container("by-map").status == "running"


def test_a_podman_that_is_slow_hangs_nobody(project: Project, tmp_path: Path) -> None:
    """What is waited for has been running for long, when a busy machine's Podman at last looks."""
    plain = f"image: {BASE_IMAGE}, network_mode: host, stop_grace_period: 0s, command: sleep 100"
    project.write(f"services: {{first: {{{plain}}}, second: {{depends_on: [first], {plain}}}}}")
    slow = tmp_path / "slow" / "podman"
    slow.parent.mkdir()
    waits = f'case "$*" in *--condition=running*) sleep {3 * STUCK_S};; esac'
    slow.write_text(f'#!/bin/sh\n{waits}\nexec {shutil.which("podman")} "$@"\n')
    slow.chmod(0o755)
    project.avckpt("up", env={"PATH": f"{slow.parent}:{os.environ['PATH']}"})
    assert project.container("second").status == "running"


def test_hooks_are_installed_only_when_asked_for(project: Project, sidecar: Sidecar) -> None:
    project.write(SERVICES)
    sidecar.avckpt("uninstall")
    try:
        done = project.avckpt("up", check=False)
        assert done.status == 1
        assert "hooks: not installed" in done.stderr
        assert "avckpt up --install" in done.stderr
        assert project.ids() == []
        assert states(project.avckpt("up", "--install", "--json", "by-map")) == {"by-map": True}
    finally:
        sidecar.avckpt("install")
        sidecar.restart()  # its mount of /etc/avckpt is that of the old folder


def test_hooks_of_another_build_are_said_and_brought_up_to_date(project: Project, sidecar: Sidecar) -> None:
    project.write(SERVICES)
    with (LIBEXEC / "avckpt_hooks" / "shared" / "tell.py").open("a") as installed:
        installed.write("# of another build\n")
    warning = f"warning: hooks: of another build than this avckpt: {installed.name} (run: sudo avckpt install)"
    assert warning in project.avckpt("up", "by-map").stderr
    assert "warning: " not in project.avckpt("up", "--install", "by-map").stderr
    assert "of another build" not in Path(installed.name).read_text()


def test_the_sidecar_is_started_and_reads_the_machines_configuration(project: Project, sidecar: Sidecar) -> None:
    if CONFIG.exists():
        pytest.skip(f"{CONFIG} is in use on this machine")
    project.write(SERVICES.replace(", avckpt.interval: 100ms", ""))
    sidecar.stop()
    try:
        CONFIG.write_text(f"{OF_A_TEST}names:\n  {project.name}*:\n    interval: 300ms\n    keep: 3\n")
        done = project.avckpt("up", "--json")
        assert "starting the container avckpt-sidecar" in done.stderr
        assert states(done)["by-map"]
        # There may be others on this machine.
        ours = [entry for entry in sidecar.ps() if entry["name"].startswith(project.name)]
        entries = {entry["name"].split("_")[1]: entry for entry in ours}
        assert entries["by-map"]["interval_s"] == 0.3
        assert entries["by-list"]["interval_s"] == 0.15  # its label wins
        assert entries["by-list"]["keep"] == 3
        # Stopped, not removed: it is started again, and adopts.
        project.podman.run("stop", "--time", "5", "avckpt-sidecar")
        CONFIG.write_text(f"{OF_A_TEST}defaults:\n  keep: few\n")
        said = project.avckpt("up").stderr
        assert "again" in said
        assert "warning: the sidecar goes by older or built-in defaults: /etc/avckpt/config.yaml:3: " in said
        [by_map] = [entry for entry in sidecar.ps() if entry["name"].startswith(f"{project.name}_by-map")]
        assert by_map["automatic"]
        CONFIG.write_text(f"{OF_A_TEST}defaults:\n  keep: 5\n")
        project.podman.run("kill", "--signal", "HUP", "avckpt-sidecar")
        wait_until(lambda: "config.yaml was read" in sidecar.logs(), 5 * SLOWNESS, "the sidecar has read it")
    finally:
        CONFIG.unlink(missing_ok=True)
        sidecar.restart()


def test_without_a_sidecar_to_start_it_says_so(
    project: Project, sidecar: Sidecar, monkeypatch: pytest.MonkeyPatch
) -> None:
    from avckpt.cli import sidecar_container
    from avckpt.errors import SidecarUnreachable

    sidecar.stop()
    try:
        monkeypatch.setattr(sidecar_container, "IMAGE", "localhost/avckpt-no-such-image")
        with pytest.raises(SidecarUnreachable, match="avckpt install --sidecar"):
            sidecar_container.ensure(Path("/run/avckpt"), lambda line: None)
    finally:
        sidecar.restart()


def test_the_example_goes_on_through_crashes(project: Project, sidecar: Sidecar, free_port: Callable[[], int]) -> None:
    text = (ROOT / "examples" / "vehicle.yaml").read_text()
    # A user may have it running.
    text = text.replace("name: avckpt-vehicle", f"name: {project.name}").replace("vehicle-", f"{project.name}-")
    project.path.write_text(text)
    project.path.with_name("pipeline.py").write_text((ROOT / "examples" / "pipeline.py").read_text())
    ports = {"FILTER_PORT": str(free_port()), "MONITOR_PORT": str(free_port()), "CRASH_EVERY_S": "2"}
    done = project.avckpt("up", "--json", env=ports)
    assert states(done) == {"monitor": True, "filter": True, "source": False}
    names = {entry["service"]: entry["name"] for entry in json.loads(done.stdout)}
    monitor, smooth = (Container(project.podman, names[name], "") for name in ("monitor", "filter"))
    log = monitor.wait_for_log("the filter CRASHED and went on", 60 * SLOWNESS, count=2)
    monitor.wait_for_log("readings", 20 * SLOWNESS, count=log.count("readings") + 1)
    assert smooth.logs().count("started as PID") == 1
    assert "hung up" not in monitor.logs()
    project.avckpt("down", env=ports)
    assert project.ids() == []


def test_the_example_of_a_group_agrees_after_crashes(
    project: Project, sidecar: Sidecar, free_port: Callable[[], int]
) -> None:
    text = (ROOT / "examples" / "group.yaml").read_text()
    # A user may have it running.
    text = text.replace("name: avckpt-group", f"name: {project.name}").replace("name: group-", f"name: {project.name}-")
    project.path.write_text(text.replace("avckpt.group: drive", f"avckpt.group: {project.name}"))
    project.path.with_name("group.py").write_text((ROOT / "examples" / "group.py").read_text())
    port = {"GROUP_PORT": str(free_port())}
    assert "warning" not in run([*avckpt_command(), "check", str(project.path)], env=port).stdout
    done = project.avckpt("up", "--json", env=port)
    assert states(done) == {"driver": True, "planner": True}
    names = {entry["service"]: entry["name"] for entry in json.loads(done.stdout)}
    members = [
        Container(project.podman, names[name], project.podman.inspect(names[name])["Id"])
        for name in ("driver", "planner")
    ]

    def rows() -> list[dict[str, Any]]:
        ids = {member.id for member in members}
        return [row for row in sidecar.ps() if row["id"] in ids]

    def line() -> int:
        lines = {row["line"] for row in rows()}
        return int(lines.pop()) if len(lines) == 1 else 0

    log = members[1].wait_for_log("and they agree", 60 * SLOWNESS)
    for restores, victim in enumerate(members, 1):
        before = line()
        wait_until(lambda: line() > before, 30 * SLOWNESS, "a line of both")  # noqa: B023
        os.kill(sidecar.app_pid(victim), signal.SIGKILL)
        for member in members:
            sidecar.wait_restores(member, restores)
        assert {row["group"] for row in rows()} == {project.name}
        log = members[1].wait_for_log("and they agree", 30 * SLOWNESS, count=log.count("and they agree") + 2)
    assert log.count("planner: connected") == 1
    assert "DISAGREE" not in log
    assert "hung up" not in log
    project.avckpt("down", env=port)
    assert project.ids() == []
