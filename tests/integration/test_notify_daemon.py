# SPDX-License-Identifier: Apache-2.0
"""Containers that are notified of recoveries: by signals, by commands, and failures of both."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from avckpt.cli.client import Client

from testkit.guarded import BUILD
from testkit.harness import wait_until
from testkit.local_sidecar import QUICK, Container, LocalSidecar, ended
from testkit.procfs import children_of, peak_kb
from testkit.protected import build_victims

SLEEPER = ["sleep", "1000"]
# Says READY, then a line for every SIGUSR1.
LISTENER = [
    sys.executable,
    "-uc",
    "import signal, time\n"
    "signal.signal(signal.SIGUSR1, lambda *_: print('USR1', flush=True))\n"
    "print('READY', flush=True)\n"
    "while True: time.sleep(100)",
]
IN_GROUP = {**QUICK, "avckpt.group": "chain"}
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine(
        "init waits two seconds for its guard, which may get no CPU for as long; notifications have time limits"
    ),
]


def listener(local: LocalSidecar, name: str, labels: dict[str, str]) -> Container:
    """A program that is protected only once it listens, so that a restored one listens, too."""
    container = local.container(name, LISTENER)
    wait_until(lambda: "READY" in container.output.read_text(), 10, f"{name} listens")
    assert container.hook("prestart", labels) == ""
    local.wait_for(container, state="protected")
    return container


def protected(local: LocalSidecar, name: str, labels: dict[str, str], argv: list[str] | None = None) -> Container:
    container = local.protected(name, argv or SLEEPER, labels)
    local.wait_for(container, state="protected")
    return container


def crash(local: LocalSidecar, container: Container, restores: int = 1) -> None:
    os.kill(container.app_pid, signal.SIGKILL)
    local.wait_for(container, restores=restores, state="protected")


def heard(container: Container) -> int:
    return container.output.read_text().count("USR1")


def told(local: LocalSidecar, kind: str) -> list[dict[str, Any]]:
    return [event for event in Client(local.run_dir).history() if event["kind"] == kind]


def test_a_signal_reaches_the_group_and_nobody_else(local: LocalSidecar) -> None:
    notify = {"avckpt.notify": "signal:USR1"}
    friend = listener(local, "friend", {**IN_GROUP, **notify})
    other = listener(local, "other", {**QUICK, "avckpt.group": "another", **notify})
    deaf = listener(local, "deaf", IN_GROUP)
    web = protected(local, "web", IN_GROUP)
    crash(local, web)
    wait_until(lambda: heard(friend) == 1, 5, "the signal comes")
    # Its own recovery is no other's; nor is there anybody else in the group who asked.
    crash(local, friend)
    time.sleep(0.5)
    assert (heard(friend), heard(other), heard(deaf)) == (1, 0, 0)
    assert told(local, "notify_failed") == []


def test_a_failed_recovery_is_told_too_and_a_stop_is_not(local: LocalSidecar) -> None:
    friend = listener(local, "friend", {**IN_GROUP, "avckpt.notify": "signal:USR1"})
    stopped = protected(local, "stopped", IN_GROUP)
    signal.pidfd_send_signal(stopped.pidfd, signal.SIGTERM)
    stopped.status()
    lost = protected(local, "lost", {**IN_GROUP, "avckpt.restore.on": "77"})
    os.kill(lost.app_pid, signal.SIGKILL)
    lost.status()
    local.wait_for(lost, state="ended")
    wait_until(lambda: heard(friend) == 1, 5, "the signal comes")
    time.sleep(0.3)
    assert heard(friend) == 1


def test_the_restored_application_itself_hears_of_it(local: LocalSidecar) -> None:
    web = listener(local, "web", {**QUICK, "avckpt.notify.self": "signal:USR1"})
    for restores in (1, 2, 3):
        before = heard(web)
        crash(local, web, restores)
        # Maybe twice: a checkpoint in the middle of the handler has it run again.
        wait_until(lambda before=before: heard(web) > before, 5, "the restored application is told")  # type: ignore[misc]
    assert told(local, "notify_failed") == []
    assert not ended(web)


def test_a_signal_that_would_end_the_application_is_not_sent(local: LocalSidecar) -> None:
    sleeper = protected(local, "sleeper", {**QUICK, "avckpt.notify.self": "signal:USR1"})
    crash(local, sleeper)
    wait_until(lambda: told(local, "notify_failed"), 5, "it is said")
    (event,) = told(local, "notify_failed")
    assert event["container"] == "sleeper"
    assert "does not handle SIGUSR1, which would end it: it was not sent" in event["message"]
    assert local.row(sleeper)["restores"] == 1
    assert "sleeper: was not notified: sleeper restored: " in local.log


def test_a_blocked_signal_waits_for_who_takes_it(local: LocalSidecar) -> None:
    """sigwait(3), signalfd(2): the signal's action is the default, yet it does not end the program."""
    program = (
        "import signal\nsignal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})\n"
        "while True: signal.sigwait({signal.SIGUSR1}); print('USR1', flush=True)"
    )
    web = local.container("web", [sys.executable, "-uc", program])
    app = web.app_pid
    wait_until(lambda: Path(f"/proc/{app}/syscall").read_text().startswith("128 "), 10, "it waits (rt_sigtimedwait)")
    assert web.hook("prestart", {**QUICK, "avckpt.notify.self": "signal:USR1"}) == ""
    local.wait_for(web, state="protected")
    crash(local, web)
    wait_until(lambda: heard(web) == 1, 5, "it takes it")


def test_a_command_runs_inside_with_the_event(local: LocalSidecar, tmp_path: Path) -> None:
    out = tmp_path / "told"
    script = f"env > {out}.env; readlink /proc/self/ns/pid > {out}.ns; echo $PPID > {out}.ppid; cat > {out}.json"
    label = f"exec:sh -c '{script}'"
    web = protected(local, "web", {**IN_GROUP, "avckpt.notify.self": label})
    crash(local, web)
    path = Path(f"{out}.json")
    wait_until(lambda: path.exists() and path.read_text().endswith("\n"), 10, "the command runs")
    event = json.loads(path.read_text())
    assert event == told(local, "restored")[0]
    env = dict(line.split("=", 1) for line in Path(f"{out}.env").read_text().splitlines() if "=" in line)
    assert env["AVCKPT_EVENT"] == "restored"
    assert env["AVCKPT_CONTAINER"] == "web"
    assert env["AVCKPT_GROUP"] == "chain"
    assert env["AVCKPT_REASON"] == "signal"
    assert float(env["AVCKPT_LOST_S"]) == event["lost_s"]
    assert env["PATH"] == os.environ["PATH"]
    # In the container's PID namespace, where it is nobody's child.
    assert Path(f"{out}.ns").read_text().strip() == os.readlink(f"/proc/{web.app_pid}/ns/pid")
    assert Path(f"{out}.ppid").read_text().strip() == "0"
    assert told(local, "notify_failed") == []


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("sh -c 'echo one; echo two >&2; exit 3'", " sh: exited with status 3: two"),
        # What a program is given may be secret; whoever reads the log need not be allowed to know it.
        ("/no/such/program --password=x", "/no/such/program: exited with status 127"),
        ("sh -c 'kill -SEGV $$'", ": exited with status 139"),
    ],
)
def test_a_command_that_fails_is_told(local: LocalSidecar, command: str, why: str) -> None:
    web = protected(local, "web", {**QUICK, "avckpt.notify.self": f"exec:{command}"})
    crash(local, web)
    wait_until(lambda: told(local, "notify_failed"), 10, "the failure is told")
    (event,) = told(local, "notify_failed")
    assert why in event["message"]
    assert not ended(web)


def test_an_environment_without_an_end(local: LocalSidecar) -> None:
    """A process chooses where its environment lies; without avckpt-init the main process is the application itself."""
    odd = local.container("odd", [sys.executable, "-m", "testkit.odd_environ", "300"], init=False)
    wait_until(lambda: "set" in odd.output.read_text(), 10, "it has such an environment")
    assert odd.hook("prestart", {"avckpt.group": "chain", "avckpt.notify": "exec:true"}) == ""
    local.wait_for(odd, state="listening")
    assert local.process is not None
    web = protected(local, "web", IN_GROUP)
    before_kb = peak_kb(local.process.pid)
    crash(local, web)
    wait_until(lambda: told(local, "notify_failed"), 5, "the failure is told")
    assert "its environment is longer than" in told(local, "notify_failed")[0]["message"]
    assert peak_kb(local.process.pid) < before_kb + 50_000


def test_a_stuck_command_is_killed_and_hinders_nobody(local: LocalSidecar, tmp_path: Path) -> None:
    pids = tmp_path / "pids"
    stuck = protected(
        local,
        "stuck",
        {**IN_GROUP, "avckpt.notify": f"exec:sh -c 'trap \"\" TERM; echo x >> {pids}; sleep 4711; true'"},
    )
    friend = listener(local, "friend", {**IN_GROUP, "avckpt.notify": "signal:USR1"})
    web = protected(local, "web", IN_GROUP)
    before = len(children_of(stuck.init_pid))
    crash(local, web)
    wait_until(pids.exists, 5, "the command runs")
    # While it is stuck: others are told, its own container is checkpointed and restored, web again.
    wait_until(lambda: heard(friend) == 1, 2, "the other receiver is told")
    checkpoints = local.row(stuck)["checkpoints"]
    time.sleep(1)
    assert local.row(stuck)["checkpoints"] > checkpoints + 3
    crash(local, stuck)
    crash(local, web, 2)
    restored = told(local, "restored")
    assert all(event["restore_s"] < 1 for event in restored)
    # friend: web twice, stuck once.
    wait_until(lambda: heard(friend) == 3, 2, "the other receiver is told again")
    wait_until(lambda: told(local, "notify_failed"), 8, "time is up")
    assert "killed after 5 s" in told(local, "notify_failed")[0]["message"]
    wait_until(lambda: pids.read_text().count("x") == 2, 3, "the one that waited has its turn")
    assert local.stop() == 0
    wait_until(lambda: len(children_of(stuck.init_pid)) <= before, 5, "nothing of ours is left inside")
    assert not [p for p in Path("/proc").iterdir() if p.name.isdigit() and _is_left(p)]
    assert not ended(stuck)


def test_a_command_that_cannot_be_killed_hinders_nobody(local: LocalSidecar, tmp_path: Path) -> None:
    """It waits for a file server, which has its request and does not answer."""
    build_victims()
    with subprocess.Popen([BUILD / "server", tmp_path, "head"], stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        if server.stdout.readline() != b"ready\n":
            pytest.skip("/dev/fuse is not available here")
        try:
            web = protected(local, "web", {**QUICK, "avckpt.notify.self": f"exec:head {tmp_path}/mount/served"})
            crash(local, web)
            failed: list[dict[str, Any]] = []
            slowest_s = 0.0
            while not failed:
                begun = time.monotonic()
                failed = told(local, "notify_failed")
                slowest_s = max(slowest_s, time.monotonic() - begun)
            assert "killed after 5 s" in failed[0]["message"]
            assert slowest_s < 0.3
        finally:
            server.kill()
            subprocess.run(["umount", "-l", tmp_path / "mount"], check=True)


def _is_left(process: Path) -> bool:
    try:
        return (process / "cmdline").read_bytes() == b"sleep\x004711\x00"
    except OSError:
        return False


def test_a_queue_has_an_end(local: LocalSidecar) -> None:
    """Crashes come faster than commands time out; by the API, since the command line is too slow."""
    protected(local, "stuck", {**IN_GROUP, "avckpt.notify": "exec:sleep 1000"})
    web = protected(local, "web", {**IN_GROUP, "avckpt.restore.max": "60/1s"})
    client = Client(local.run_dir)

    def restores() -> int:
        return max(int(row["restores"]) for row in client.containers() if row["id"] == web.id)

    def dropped() -> bool:
        return any("are waiting for it already" in event["message"] for event in told(local, "notify_failed"))

    for crashes in range(1, 60):
        os.kill(wait_until(lambda: web.app_pid, 10, "it runs"), signal.SIGKILL)
        wait_until(lambda: restores() == crashes, 10, "it runs again")  # noqa: B023
        if dropped():
            break
    assert dropped()


def test_a_sidecar_that_is_killed_takes_its_commands_with_it(local: LocalSidecar, tmp_path: Path) -> None:
    web = protected(
        local, "web", {**QUICK, "avckpt.notify.self": f"exec:sh -c 'echo x > {tmp_path}/x; exec sleep 4711'"}
    )
    crash(local, web)
    wait_until((tmp_path / "x").exists, 5, "the command runs")
    local.stop(signal.SIGKILL)
    wait_until(lambda: not any(_is_left(p) for p in Path("/proc").iterdir()), 5, "the command is gone")
    assert not ended(web)
