# SPDX-License-Identifier: Apache-2.0
"""Protected containers of every kind, whose application is killed in every way."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from testkit.harness import ContainerFactory, Sidecar, take_checkpoint, wait_until
from testkit.procfs import status_of
from testkit.protected import QUICK, ours, start_victim

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; the sidecar is given a time to protect"
)

OPTIONS = {
    "root": [],
    "user": ["--user", "1000:1000"],
    "read-only": ["--read-only"],
    "terminal": ["-t"],
    "host network": ["--network=host"],
    "nothing allowed": ["--cap-drop=all", "--security-opt=no-new-privileges", "--network=none"],
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_killed_in_every_way(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, options: list[str]) -> None:
    """SIGKILL, a real SIGSEGV, abort(), exit(3): neither Podman nor a process inside sees a difference."""
    # Only when asked for: one that is taken when the signal has just come is an application that crashes at once.
    labels = {**QUICK, "interval": "1h"}
    victim = start_victim(sidecar, container, tmp_path, "crash", labels=labels, options=options, generation=0)
    made = victim.container
    take_checkpoint(sidecar.client, made.name)
    before = made.inspect()["State"]
    inside = sidecar.wait_generation(made)["app_pid_inside"]
    deaths = {
        signal.SIGKILL: "killed by SIGKILL",
        signal.SIGUSR1: "killed by SIGSEGV",
        signal.SIGUSR2: "killed by SIGABRT",
        signal.SIGHUP: "exited with status 3",
    }
    for n, (signum, death) in enumerate(deaths.items(), 1):
        take_checkpoint(sidecar.client, made.name)
        entry = victim.kill(signum)
        assert (entry["state"], entry["last_death"]) == ("protected", death)
        assert (entry["restores"], entry["app_pid_inside"]) == (n, inside)
    after = made.inspect()["State"]
    assert (after["Status"], after["StartedAt"], after["Pid"]) == ("running", before["StartedAt"], before["Pid"])
    assert made.exec("pgrep", "-x", "crash").stdout.split() == [str(inside)]
    processes = made.podman.run("top", made.name, "pid", "comm").stdout
    assert [line.split() for line in processes.splitlines() if line.split()[1] == "crash"] == [[str(inside), "crash"]]
    assert victim.see().starts == 1
    assert made.logs().split() == ["ready"]


def test_threads_of_an_unprivileged_user(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """Twenty threads with every kind of lock, default seccomp profile, killed ten times."""
    victim = start_victim(sidecar, container, tmp_path, "threads 20 20", options=["--user", "1000:1000"])
    for n in range(10):
        time.sleep(0.03 * n)
        os.kill(victim.app, signal.SIGKILL)
        victim.wait_beats()
    assert sidecar.wait_restores(victim.container, 10)["state"] == "protected"
    assert victim.see().starts == 1


FILTERS = {
    "default profile": ("threads 4 1", [], "2"),
    "unconfined": ("threads 4 1", ["--security-opt", "seccomp=unconfined"], "2"),
    "privileged": ("threads 4 1", ["--privileged"], "2"),
    "a filter of its own": ("sandbox", [], "0"),
    "filters of children": ("cells", [], "0"),
}


@pytest.mark.parametrize(("command", "options", "mode"), FILTERS.values(), ids=FILTERS.keys())
def test_the_seccomp_filter_of_its_guard(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path, command: str, options: list[str], mode: str
) -> None:
    """A guard has one unless the application has one, beyond its container's, that it may have to suspend."""
    victim = start_victim(sidecar, container, tmp_path, command, options=options)
    entry = sidecar.wait_generation(victim.container, 1)
    assert status_of(entry["guard_pid"])["Seccomp"] == mode
    entry = victim.kill(signal.SIGKILL)
    assert (entry["state"], entry["restores"]) == ("protected", 1)
    assert status_of(entry["guard_pid"])["Seccomp"] == mode


def test_a_guard_that_watches_memory_has_a_filter_too(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """Podman's default profile refuses userfaultfd(2). What is restored is watched again."""
    labels = {**QUICK, "images": "dirty"}
    victim = start_victim(sidecar, container, tmp_path, "dirt 40 2 --rate 1000", labels=labels)
    made = victim.container

    def watched() -> bool:
        return " uw " in Path(f"/proc/{victim.app}/smaps").read_text()  # VmFlags

    for _ in range(3):
        wait_until(watched, 20, "its memory is watched", every_s=0.1)
        entry = sidecar.wait_for(made, lambda e: e["last_images"] == "dirty", "a copy")
        assert status_of(entry["guard_pid"])["Seccomp"] == "2"
        victim.kill(signal.SIGKILL)
    assert victim.see().violations == 0


def test_pause_and_unpause(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """A paused container is left alone, and protected again when it is unpaused."""
    victim = start_victim(sidecar, container, tmp_path, "threads 4 1")
    made = victim.container
    for _ in range(3):
        made.podman.run("pause", made.name)
        beats = victim.see().beats
        time.sleep(0.5)
        assert victim.see().beats <= beats + 1
        made.podman.run("unpause", made.name, timeout_s=10)
        victim.wait_beats()
    entry = sidecar.find(made)
    assert entry is not None
    sidecar.wait_generation(made, entry["generation"] + 2)
    assert victim.kill(signal.SIGKILL)["state"] == "protected"


def test_a_checkpoint_missed_for_a_pause_says_so(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """And not that some thread did not stop in time."""
    made = start_victim(sidecar, container, tmp_path, "threads 4 1").container
    made.podman.run("pause", made.name)
    try:
        told = "checkpoint missed: it is paused (podman unpause)"
        sidecar.wait_for(made, lambda entry: entry["reason"] == told, "it is told why")
    finally:
        made.podman.run("unpause", made.name)
    sidecar.wait_for(made, lambda entry: entry["reason"] == "", "the next checkpoint")


def test_killed_while_paused(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """It dies when it is unpaused, and is restored then."""
    victim = start_victim(sidecar, container, tmp_path, "threads 4 1")
    made = victim.container
    app = victim.app
    made.podman.run("pause", made.name)
    os.kill(app, signal.SIGKILL)
    time.sleep(0.3)
    made.podman.run("unpause", made.name)
    sidecar.wait_restores(made, 1)
    victim.wait_beats()
    assert made.status == "running"


def test_podman_restart_keeps_protection(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    victim = start_victim(sidecar, container, tmp_path, "threads 4 1")
    made = victim.container
    first_init = made.pid
    made.podman.run("restart", "--time", "5", made.name)
    wait_until(lambda: victim.see().starts == 2 and victim.see().ready == 1, 10, "it has started again")
    assert made.pid != first_init
    sidecar.wait_generation(made, 1)
    assert victim.kill(signal.SIGKILL)["restores"] == 1
    assert victim.see().starts == 2


def test_nothing_is_left_of_a_removed_container(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    victim = start_victim(sidecar, container, tmp_path, "threads 4 1")
    # At most intervals an old template is just ending, too.
    for name, at_least in (("avckpt-tmpl", 2), ("avckpt-hold", 1), ("avckpt-spare", 1)):
        wait_until(lambda: len(ours(victim.container, name)) >= at_least, 5, f"{at_least} of {name}")  # noqa: B023
    pids = ours(victim.container)
    started = time.monotonic()
    victim.container.remove()
    assert time.monotonic() - started < 5
    wait_until(lambda: not [pid for pid in pids if Path(f"/proc/{pid}").exists()], 5, "templates are gone")
    wait_until(lambda: sidecar.find(victim.container) is None, 5, "the sidecar has forgotten it")


def test_restart_policy_before_the_first_checkpoint(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """There is nothing to restore: Podman's restart policy applies as without avckpt."""
    victim = start_victim(
        sidecar, container, tmp_path, "crash", labels={"interval": "1m"}, options=["--restart=on-failure"], generation=0
    )
    sidecar.wait_for(victim.container, lambda entry: entry["app_pid"] > 0, "guard")
    os.kill(victim.app, signal.SIGUSR1)
    wait_until(lambda: victim.see().starts == 2, 15, "Podman has started it again")
    wait_until(lambda: victim.container.status == "running", 10, "it runs")
    sidecar.wait_for(victim.container, lambda entry: entry["state"] == "starting", "its new guard")


def test_restart_policy_when_restores_are_used_up(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    victim = start_victim(
        sidecar,
        container,
        tmp_path,
        "crash",
        labels={**QUICK, "keep": "1", "restore.max": "2/60s"},
        options=["--restart=on-failure"],
    )
    for _ in range(2):
        victim.kill(signal.SIGKILL)
    assert victim.see().starts == 1
    os.kill(victim.app, signal.SIGKILL)
    wait_until(lambda: victim.see().starts == 2, 15, "Podman has started it again")
    # And it is protected as at its first start.
    sidecar.wait_generation(victim.container, 2)
    assert victim.kill(signal.SIGKILL)["restores"] == 1


def test_a_clean_exit_ends_the_container(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("sh", "-c", "exec sleep 1", labels=QUICK)
    sidecar.wait_generation(made)
    assert made.wait() == 0


@pytest.mark.parametrize(("signum", "status"), [("TERM", 143), ("KILL", 137)])
def test_podman_kill_is_no_crash(sidecar: Sidecar, container: ContainerFactory, signum: str, status: int) -> None:
    made = container.protected("sleep", "1000", labels=QUICK)
    sidecar.wait_generation(made)
    made.signal(signum)
    assert made.wait() == status


def test_what_can_not_be_protected_runs_and_is_told(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    why = "AIO"
    victim = start_victim(sidecar, container, tmp_path, "unsupported aio", generation=0)
    entry = sidecar.wait_for(victim.container, lambda entry: entry["state"] == "unprotected", "unprotected")
    assert why in entry["reason"]
    shown = sidecar.avckpt("ps").stdout
    line = next(line for line in shown.splitlines() if line.startswith(victim.container.name))
    assert "unprotected" in line
    assert why in line
    refused = sidecar.avckpt("checkpoint", victim.container.name, check=False)
    assert refused.status == 5
    assert refused.stderr.count("\n") == 1
    assert victim.container.name in refused.stderr
    assert why in refused.stderr
    victim.wait_beats()
