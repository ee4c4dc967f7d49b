# SPDX-License-Identifier: Apache-2.0
"""The sidecar as it is meant to run: in its container, with hooks and real containers."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from avckpt.cli import doctor, sidecar_container
from avckpt.cli.client import Client
from avckpt.errors import SidecarUnreachable

from testkit.harness import CONFIG, RUN_DIR, SIDECAR_IMAGE, SIDECAR_NAME, take_checkpoint, wait_until
from testkit.protected import told

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; the sidecar is given a time to protect"
)

if TYPE_CHECKING:
    from testkit.harness import Completed, Container, ContainerFactory, Podman, Sidecar

COUNTER = "import time\nfor i in range(10**9):\n    print('n', i, flush=True)\n    time.sleep(0.02)"
COUNT = ("python3", "-c", COUNTER)
QUICK = {"interval": "100ms"}


def numbers(container: Container) -> list[int]:
    return [int(line.split()[1]) for line in container.logs().splitlines() if line.startswith("n ")]


def check_evidence(sidecar: Sidecar, web: Container) -> None:
    """After a kill and a SIGSEGV: who sent it, where it happened, and what a debugger can see."""
    wait_until(lambda: len(told(sidecar, web, "core")) == 2, 20, "two core files are told of", every_s=0.2)
    crashes = [event["crash"] for event in told(sidecar, web, "crash")]
    assert [crash["signal"] for crash in crashes] == ["SIGKILL", "SIGSEGV"]
    for crash in crashes:
        assert (crash["code"], crash["sender_pid"]) == ("SI_USER", os.getpid())
        assert "python3" in crash["command"]
        assert "/lib" in crash["module"]
        assert crash["build_id"]
    for event in told(sidecar, web, "core"):
        core = Path(event["core"])  # on the host as in the sidecar
        assert core.stat().st_size == event["core_bytes"]
        core.unlink()


def test_a_container_lives_through_kill_and_ends_with_stop(container: ContainerFactory, sidecar: Sidecar) -> None:
    web = container.protected(*COUNT, labels={**QUICK, "core": "mini"})
    entry = sidecar.wait_generation(web, 2)
    assert entry["name"] == web.name
    assert entry["state"] == "protected"
    assert entry["init_pid"] == web.pid
    init = web.pid
    for restores, signum in enumerate((signal.SIGKILL, signal.SIGSEGV), 1):
        os.kill(sidecar.app_pid(web), signum)
        entry = sidecar.wait_restores(web, restores)
        assert entry["last_death"] == f"killed by {signum.name}"
    assert (web.status, web.pid) == ("running", init)
    check_evidence(sidecar, web)
    seen = numbers(web)
    time.sleep(0.5)
    assert max(numbers(web)) > max(seen)
    # It went back by moments, not to its start.
    assert numbers(web).count(0) == 1
    done = web.podman.run("stop", "--time", "9", web.name, timeout_s=20)
    assert done.took_s < 5
    assert web.exit_code == 128 + signal.SIGTERM
    [ended] = [entry for entry in sidecar.ps(ended=True) if entry["id"] == web.id]
    assert ended["state"] == "ended"
    assert sidecar.find(web) is None
    log = sidecar.logs()
    for words in ("registered", "protected: first checkpoint", "killed by SIGSEGV, restored in", "ended: "):
        assert f"{web.name}: {words}" in log


def test_a_sidecar_of_another_build_is_told(
    sidecar: Sidecar, podman: Podman, base_image: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    sidecar_container.ensure(RUN_DIR, said.append)
    assert (said, sidecar_container.is_outdated()) == ([], False)
    # The tag of its image is on another one now, as after `make setup`.
    newer = f"localhost/avckpt-test-{os.getpid()}:latest"
    podman.run("tag", base_image, newer)
    monkeypatch.setattr(sidecar_container, "IMAGE", newer)
    try:
        sidecar_container.ensure(RUN_DIR, said.append)
        [check] = [check for check in doctor.checks() if check.name == "sidecar"]
    finally:
        podman.run("untag", newer, newer)
    assert said == [f"warning: {sidecar_container.OUTDATED} (sudo podman rm -f avckpt-sidecar, then sudo avckpt up)"]
    assert (check.status, check.detail) == (doctor.Status.WARN, sidecar_container.OUTDATED)


def test_a_paused_container_is_missed_and_goes_on(
    container: ContainerFactory, sidecar: Sidecar, podman: Podman
) -> None:
    web = container.protected(*COUNT, labels=QUICK)
    sidecar.wait_generation(web)
    podman.run("pause", web.name)
    try:
        entry = sidecar.wait_for(web, lambda entry: entry["missed"] >= 1, "a missed checkpoint")
        assert entry["state"] == "protected"
        assert entry["reason"].startswith("checkpoint missed: ")
    finally:
        podman.run("unpause", web.name)
    sidecar.wait_generation(web, entry["generation"] + 2)
    seen = max(numbers(web))
    time.sleep(0.5)
    assert max(numbers(web)) > seen
    assert sidecar.logs().count(f"{web.name}: checkpoint missed") == 1


def test_a_killed_sidecar_is_replaced_by_one_that_adopts(container: ContainerFactory, sidecar: Sidecar) -> None:
    web = container.protected(*COUNT, labels=QUICK)
    sidecar.wait_generation(web)
    app = sidecar.app_pid(web)
    sidecar.kill()
    assert web.status == "running"
    assert sidecar.app_pid(web) == app
    sidecar.restart()
    assert sidecar.wait_generation(web)["adopted"]
    os.kill(app, signal.SIGKILL)
    sidecar.wait_restores(web)
    assert numbers(web).count(0) == 1


def test_a_crashed_sidecar_comes_back_and_a_stopped_one_does_not(
    container: ContainerFactory, sidecar: Sidecar, podman: Podman
) -> None:
    def daemon() -> int:
        pid: int = podman.inspect(SIDECAR_NAME)["State"]["Pid"]
        return pid

    web = container.protected(*COUNT, labels=QUICK)
    sidecar.stop()
    try:
        sidecar_container.ensure(RUN_DIR, print)
        sidecar.wait_generation(web)
        for _ in range(2):
            killed = daemon()
            os.kill(killed, signal.SIGKILL)
            wait_until(lambda: daemon() not in (0, killed) and sidecar.answers(), 20, "another sidecar answers")  # noqa: B023
            assert sidecar.wait_generation(web)["adopted"]
        podman.run("stop", SIDECAR_NAME)
        time.sleep(3)
        assert not sidecar.running
        sidecar_container.ensure(RUN_DIR, print)
        assert sidecar.wait_generation(web)["adopted"]
        assert numbers(web).count(0) == 1
    finally:
        sidecar.restart()


def test_a_renamed_container_is_known_by_its_new_name(
    container: ContainerFactory, sidecar: Sidecar, podman: Podman
) -> None:
    made = container.protected(*COUNT, labels=QUICK)
    sidecar.wait_generation(made)
    anew = f"{made.name}-anew"
    podman.run("rename", made.name, anew)
    try:
        wait_until(lambda: (sidecar.find(made) or {})["name"] == anew, 20, "the new name is known")
        take_checkpoint(sidecar.client, anew)
    finally:
        podman.run("rename", anew, made.name)


def test_the_remedy_for_a_stopped_sidecar_works_when_pasted(sidecar: Sidecar, podman: Podman) -> None:
    podman.run("stop", SIDECAR_NAME)
    try:
        said = sidecar.avckpt("ps", check=False)
        assert said.status == 3
        remedy = said.stderr.partition("start it with: ")[2].split()
        assert remedy[:2] == ["podman", "run"]
        podman.run(*remedy[1:])
        wait_until(sidecar.answers, 20, "the sidecar answers")
    finally:
        sidecar.restart()


def test_a_sidecar_that_can_not_be_started_is_said(sidecar: Sidecar, podman: Podman, base_image: str) -> None:
    sidecar.stop()
    try:
        podman.run("create", "--name", SIDECAR_NAME, "--network=none", base_image, "/no/such/program")
        with pytest.raises(SidecarUnreachable, match=f"the container {SIDECAR_NAME} cannot be started: podman start: "):
            sidecar_container.ensure(RUN_DIR, print)
    finally:
        sidecar.restart()


def test_the_command_line_in_its_container(container: ContainerFactory, sidecar: Sidecar, podman: Podman) -> None:
    def inside(*args: str, check: bool = True) -> Completed:
        return podman.run("exec", SIDECAR_NAME, "avckpt", *args, check=check)

    web = container.protected(*COUNT, labels={"interval": "1h"})
    wait_until(lambda: inside("checkpoint", web.name, check=False).status == 0, 20, "a checkpoint", every_s=0.2)
    [row] = [entry for entry in json.loads(inside("ps", "--json").stdout) if entry["id"] == web.id]
    here = sidecar.find(web)
    assert here is not None
    assert {key: row[key] for key in ("name", "state", "generation", "app_pid")} == {
        key: here[key] for key in ("name", "state", "generation", "app_pid")
    }
    assert web.name in inside("ps").stdout
    assert f"{web.name}: back at generation " in inside("restore", web.id[:12]).stdout
    assert sidecar.wait_restores(web)["state"] == "protected"
    events = [json.loads(line) for line in inside("events", "--json", "--since", "1h").stdout.splitlines()]
    assert "restored" in {event["kind"] for event in events if event["id"] == web.id}
    assert str(CONFIG) in inside("reload").stdout
    assert inside("check", "--config").stdout == f"no {CONFIG}: the built-in defaults hold\n"
    assert "_AVCKPT_COMPLETE" in inside("completion", "bash").stdout
    doctor = inside("doctor")
    assert "run avckpt doctor on the host too" in doctor.stdout
    assert "sidecar: answers" in doctor.stdout
    statuses = [inside(*words, check=False).status for words in (("restore", "nobody"), ("restore",), ("ps", "--jsn"))]
    assert statuses == [4, 2, 2]


def test_events_outlive_a_reboot_on_a_volume(podman: Podman, sidecar: Sidecar, tmp_path: Path) -> None:
    """Another sidecar, whose /run/avckpt is empty at each start: only the volume is the same."""
    name = f"avckpt-archive-{os.getpid()}"
    events: list[list[dict[str, object]]] = []
    try:
        for run_dir in (tmp_path / "first", tmp_path / "second"):
            run_dir.mkdir()
            podman.run(
                *("run", "--detach", "--pull=never", "--name", name, "--privileged", "--pid=host", "--network=none"),
                *("--volume", f"{run_dir}:/run/avckpt", "--volume", f"{name}:/var/lib/avckpt", SIDECAR_IMAGE),
            )
            client = Client(run_dir)
            wait_until(lambda: sidecar_container.answers(client), 20, "it answers")  # noqa: B023
            events.append(client.history())
            podman.run("rm", "--force", "--time", "5", name)
    finally:
        podman.run("rm", "--force", "--ignore", name)
        podman.run("volume", "rm", "--force", name)
    before, after = events
    assert before == []
    assert [event["kind"] for event in after] == ["sidecar_stopped"]
