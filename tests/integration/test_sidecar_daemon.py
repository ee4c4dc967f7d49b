# SPDX-License-Identifier: Apache-2.0
"""The daemon with real avckpt-init processes, registered by the real hooks."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import re
import resource
import shutil
import signal
import socket
import stat
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.cli.client import COMMAND_S, Client
from avckpt.errors import SidecarUnreachable
from avckpt_hooks import precreate
from avckpt_hooks.shared import protocol

from testkit.cgroups import Cgroup, freezer
from testkit.family import look
from testkit.harness import ROOT, avckpt_command, run, take_checkpoint, wait_until
from testkit.local_sidecar import ON_COMMAND, QUICK, Container, LocalSidecar, ended, local_sidecar
from testkit.pipes import emptied, full_pipe
from testkit.procfs import children_of

SLEEPER = ["sleep", "1000"]
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root")
SHARED = pytest.mark.shared_machine("the daemon's patience with hooks, guards and clients has limits")


@pytest.fixture
def idle_sidecar(tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as sidecar:
        yield sidecar


@pytest.fixture
def local(idle_sidecar: LocalSidecar) -> LocalSidecar:
    idle_sidecar.start()
    return idle_sidecar


@SHARED
def test_a_registered_container_is_protected(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    row = local.wait_for(web, state="protected")
    assert row["name"] == "web"
    assert row["app_pid"] == web.app_pid
    assert row["app_pid_inside"] == 2
    assert row["init_pid"] == web.init_pid
    assert row["interval_s"] == 0.1
    assert 0 < row["last_freeze_s"] < 5
    assert not row["adopted"]
    local.wait_for(web, generations=2)
    assert row["reason"] == ""


@SHARED
def test_a_killed_application_comes_back_under_its_pid(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    for restores in (1, 2):
        os.kill(web.app_pid, signal.SIGKILL)
        row = local.wait_for(web, restores=restores, state="protected")
        assert row["app_pid_inside"] == 2
        assert row["last_death"] == "killed by SIGKILL"
        assert 0 < row["last_restore_s"] < 5
        assert children_of(web.init_pid)
    assert not ended(web)
    assert "web: died: killed by SIGKILL" in local.log
    assert local.log.count("web: killed by SIGKILL, restored in") == 2


def checkpoint(local: LocalSidecar, *args: str) -> str:
    """Takes a checkpoint; on a busy machine a freeze may be missed, and is tried again."""
    deadline = time.monotonic() + 20
    while True:
        done = local.avckpt("checkpoint", *args, check=False)
        if done.status == 0:
            return done.stdout
        assert done.status == 1
        assert done.stderr.startswith("avckpt: web: ")
        assert "in time" in done.stderr
        assert time.monotonic() < deadline, done


@SHARED
def test_commands_on_a_container(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER, ON_COMMAND)
    local.wait_for(web, app_pid_inside=2)
    early = local.avckpt("restore", "web", check=False)
    assert early.status == 5
    assert early.stderr == "avckpt: web has nothing to go back to: no checkpoint yet\n"
    taken = json.loads(checkpoint(local, web.id[:8], "--json"))
    assert taken["event"]["kind"] == "checkpoint"
    assert taken["container"]["checkpoints"] == 1
    assert re.match(r"web: generation \d+, 1 thread\(s\), frozen \d", checkpoint(local, "web"))
    back = json.loads(local.avckpt("restore", "web", "--json").stdout)
    assert back["event"]["kind"] == "restored"
    assert back["event"]["reason"] == "manual"
    assert back["container"]["restores"] == 1
    assert not ended(web)


@SHARED
def test_a_container_that_is_stopped_is_forgotten(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    signal.pidfd_send_signal(web.pidfd, signal.SIGTERM)
    assert web.status() == 128 + signal.SIGTERM
    web.hook("poststop")
    row = local.wait_for(web, state="ended")
    assert row["ended_at"] is not None
    assert row["restores"] == 0
    assert local.ps() == []
    assert list((local.run_dir / "containers").iterdir()) == []
    gone = local.avckpt("checkpoint", "web", check=False)
    assert gone.status == 4


@SHARED
def test_a_container_that_is_killed_whole_is_forgotten(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    signal.pidfd_send_signal(web.pidfd, signal.SIGKILL)
    web.status()
    local.wait_for(web, state="ended")
    # Nothing of ours keeps what it held: no guard, no pidfd.
    assert local.process is not None
    descriptors = Path(f"/proc/{local.process.pid}/fd")

    def has_pidfd() -> bool:
        for descriptor in descriptors.iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed since
                if "pidfd" in str(descriptor.readlink()):
                    return True
        return False

    wait_until(lambda: not has_pidfd(), 10, "it has no pidfd")


@SHARED
def test_a_restarted_container_is_protected_again(local: LocalSidecar) -> None:
    first = local.protected("web", SLEEPER)
    local.wait_for(first, state="protected")
    first.close()
    local.containers.remove(first)
    second = local.container("web", SLEEPER, container_id=first.id)
    assert second.hook("prestart", QUICK) == ""
    local.wait_for(second, state="protected")
    assert [row["init_pid"] for row in local.ps()] == [second.init_pid]
    assert len(local.ps(ended=True)) == 2


@SHARED
def test_registering_twice_is_registering_once(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    assert web.hook("prestart", QUICK) == ""
    assert len(local.ps()) == 1
    assert local.row(web)["state"] == "protected"


def test_labels_that_a_sidecar_can_not_honour_are_refused(local: LocalSidecar) -> None:
    web = local.container("web", SLEEPER)
    said = web.hook("prestart", {"avckpt.enable": "true", "avckpt.keep": "many"})
    assert "web runs unprotected" in said
    assert "avckpt.keep=many" in said
    assert local.ps() == []


@SHARED
def test_what_is_no_avckpt_init_is_waited_for_and_left_alone(local: LocalSidecar) -> None:
    """A container that was created but not started looks the same."""
    web = local.container("web", SLEEPER)
    web.init_pid = web.app_pid  # the hook is told of a plain program
    assert web.hook("prestart", QUICK) == ""
    time.sleep(0.5)
    assert local.wait_for(web, state="starting")["reason"] == "avckpt-init has not started yet"
    for command in ("restore", "checkpoint"):
        refused = local.avckpt(command, "web", check=False)
        assert refused.status == 5
        assert "avckpt-init has not started yet" in refused.stderr
    assert not ended(web)


@SHARED
def test_what_can_not_be_protected_runs_unprotected_and_says_so(local: LocalSidecar) -> None:
    run(["make", "-s", "-C", str(ROOT / "tests/victims")])
    web = local.protected("web", [str(ROOT / "tests/victims/build/unsupported"), "aio"])
    row = local.wait_for(web, state="unprotected")
    assert "AIO" in row["reason"]
    refused = local.avckpt("checkpoint", "web", check=False)
    assert refused.status == 5
    assert refused.stderr.startswith("avckpt: web runs unprotected: ")
    assert local.log.count("web: runs unprotected") == 1
    assert not ended(web)


@SHARED
def test_a_program_that_executes_another_is_unprotected_until_the_next_checkpoint(
    local: LocalSidecar, tmp_path: Path
) -> None:
    """For example an entry point that takes some time before it executes the program."""
    go = tmp_path / "go"
    os.mkfifo(go)
    web = local.protected("web", ["sh", "-c", f"read line < {go}; exec sleep 1000"], ON_COMMAND)
    local.wait_for(web, app_pid_inside=2)
    lost = take_checkpoint(local.client, "web")
    go.write_text("now\n")
    row = local.wait_for(web, state="unprotected", generations=0)
    assert row["reason"].startswith(f"generation {lost}: the application has executed another program")
    assert local.avckpt("restore", "web", check=False).status == 5
    take_checkpoint(local.client, "web")
    local.wait_for(web, state="protected", generations=1)
    os.kill(web.app_pid, signal.SIGKILL)
    local.wait_for(web, restores=1, state="protected")
    lines = [line.partition("web: ")[2] for line in local.log.splitlines() if "web: " in line]
    assert f"generation {lost} is given up: the application has executed another program" in lines
    assert len([line for line in lines if line.startswith("protected: first checkpoint")]) == 2
    assert not [line for line in local.log.splitlines() if "WARNING" in line and "executed" in line]


MANY = """
import signal, sys, threading, time
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
open(sys.argv[1], "w").close()
signal.sigwait({signal.SIGUSR1})
for _ in range(40):
    threading.Thread(target=time.sleep, args=(1000,)).start()
open(sys.argv[1], "w").close()
"""
"""Starts more threads than a process of one thread is given room for, when it is told to."""


@SHARED
@pytest.mark.parametrize("version", [1, 2])
def test_a_missed_checkpoint_that_cost_what_was_held_is_told(version: int, local: LocalSidecar, tmp_path: Path) -> None:
    """There are more threads than there was room for, and the application cannot be stopped (`podman pause`)."""
    there = tmp_path / "there"
    web = local.protected("web", [sys.executable, "-c", MANY, str(there)], ON_COMMAND)
    wait_until(there.exists, 10, "it is ready")
    take_checkpoint(local.client, "web")
    there.unlink()
    with freezer(version) as pause, contextlib.ExitStack() as undo:
        undo.callback(signal.pidfd_send_signal, web.pidfd, signal.SIGKILL)
        os.kill(web.app_pid, signal.SIGUSR1)
        wait_until(there.exists, 10, "it has its threads")
        pause.take(web.app_pid)
        pause.wait()
        assert local.avckpt("checkpoint", "web", check=False).status == 1
        row = local.row(web)
        assert (row["state"], row["generations"]) == ("unprotected", 0)
        assert row["reason"].startswith("checkpoint missed: ")
        assert "nothing is held to go back to" in local.log
        pause.go()
        local.wait_for(web, state="protected")


@SHARED
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("command", ["checkpoint", "restore"])
def test_a_paused_container_says_so_at_once(command: str, version: int, local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER, ON_COMMAND)
    take_checkpoint(local.client, "web")
    app = web.app_pid
    with freezer(version) as pause, contextlib.ExitStack() as undo:
        undo.callback(signal.pidfd_send_signal, web.pidfd, signal.SIGKILL)
        for pid in (web.init_pid, *children_of(web.init_pid)):
            pause.take(pid)
        pause.wait()
        begun = time.monotonic()
        said = local.avckpt(command, "web", check=False)
        assert said.status == 1
        assert "web is paused: `podman unpause web` first" in said.stderr
        assert time.monotonic() - begun < 10
        pause.go()
        take_checkpoint(local.client, "web")
        row = local.row(web)
        assert (row["state"], row["restores"], row["generations"], web.app_pid) == ("protected", 0, 2, app)


@SHARED
def test_a_sidecar_that_starts_later_adopts(idle_sidecar: LocalSidecar) -> None:
    web = idle_sidecar.container("web", SLEEPER)
    said = web.hook("prestart", QUICK)
    assert "runs unprotected: no sidecar listens" in said
    (idle_sidecar.run_dir / "containers" / ("d" * 64 + ".json")).write_text(
        json.dumps(
            {"version": 1, "id": "d" * 64, "name": "old", "pid": 1, "starttime": 1, "bundle": "", "annotations": {}}
        )
    )
    idle_sidecar.start()
    row = idle_sidecar.wait_for(web, state="protected")
    assert row["adopted"]
    assert [path.stem for path in (idle_sidecar.run_dir / "containers").iterdir()] == [web.id]


def missed(local: LocalSidecar, name: str, labels: dict[str, str]) -> Container:
    """A container whose hook did not reach the sidecar (too many at a time, say) but left its record."""
    made = local.container(name, SLEEPER)
    socket = local.run_dir / "hooks.sock"
    socket.rename(f"{socket}.away")
    try:
        assert "runs unprotected" in made.hook("prestart", labels)
    finally:
        Path(f"{socket}.away").rename(socket)
    return made


@SHARED
def test_a_container_whose_hook_got_no_answer_is_adopted(local: LocalSidecar) -> None:
    web = missed(local, "web", QUICK)
    row = local.wait_for(web, state="protected", timeout_s=15)
    assert row["adopted"]
    assert local.log.count("web: ") == 2  # adopted, first checkpoint


@contextlib.contextmanager
def descriptors_left(local: LocalSidecar, count: int) -> Iterator[None]:
    """Leaves the sidecar `count` free descriptors for the length of the block."""
    assert local.process is not None
    pid = local.process.pid
    limits = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    time.sleep(0.5)  # it closes the connections of those who have just asked
    used = {int(fd) for fd in os.listdir(f"/proc/{pid}/fd")}
    free = [fd for fd in range(len(used) + count + 1) if fd not in used]
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (free[count], limits[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)


@SHARED
def test_descriptors_that_run_out_keep_nobody_from_being_adopted_later(local: LocalSidecar) -> None:
    web = missed(local, "web", QUICK)
    with descriptors_left(local, 0):
        time.sleep(6)  # it looks every 5 s
    assert "cannot be read, containers may run unprotected: Too many open files" in local.log
    assert local.wait_for(web, state="protected", timeout_s=15)["adopted"]


@SHARED
def test_one_who_asks_while_there_are_no_descriptors_waits(local: LocalSidecar) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        with descriptors_left(local, 0):
            client.connect(str(local.run_dir / "api.sock"))
            client.sendall(b"GET /v1/info HTTP/1.1\r\nHost: sidecar\r\n\r\n")
            wait_until(lambda: "out of system resource" in local.log, 10, "it is told")
            time.sleep(3)
            assert local.log.count("out of system resource") < 10
        client.settimeout(10)
        assert client.recv(4096).startswith(b"HTTP/1.1 200 ")


@SHARED
def test_a_container_that_ends_while_no_thread_can_be_created_has_ended(local: LocalSidecar) -> None:
    assert local.process is not None
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    with Cgroup(["pids", ""], "pids.max", go="max", wait="1") as tasks:
        tasks.take(local.process.pid)
        tasks.wait()
        os.kill(web.init_pid, signal.SIGKILL)
        local.wait_for(web, state="ended")
        tasks.go()
        local.stop()


@SHARED
def test_a_guard_for_which_there_are_no_descriptors_is_started_later(local: LocalSidecar) -> None:
    web = local.container("web", SLEEPER)
    # The hook's connection, the container's pidfd, and one to look at that.
    with descriptors_left(local, 3):
        assert web.hook("prestart", QUICK) == ""
    row = local.wait_for(web, state="unprotected")
    assert "Too many open files" in row["reason"]
    local.wait_for(web, state="protected", timeout_s=15)
    os.kill(web.app_pid, signal.SIGKILL)
    local.wait_for(web, restores=1, state="protected")
    assert local.log.count("web: runs unprotected: ") == 1


@SHARED
def test_a_guard_that_could_not_begin_is_started_anew(local: LocalSidecar) -> None:
    """Its timer takes a place in the queue of pending signals, of which none is left."""
    assert local.process is not None
    limits = resource.prlimit(local.process.pid, resource.RLIMIT_SIGPENDING)
    resource.prlimit(local.process.pid, resource.RLIMIT_SIGPENDING, (0, limits[1]))
    try:
        web = local.protected("web", SLEEPER)
        assert "timer" in local.wait_for(web, state="unprotected")["reason"]
    finally:
        resource.prlimit(local.process.pid, resource.RLIMIT_SIGPENDING, limits)
    local.avckpt("reload")
    local.wait_for(web, state="protected")
    os.kill(web.app_pid, signal.SIGKILL)
    local.wait_for(web, restores=1, state="protected")


@SHARED
def test_a_reload_adopts_it_at_once(local: LocalSidecar) -> None:
    web = missed(local, "web", QUICK)
    local.avckpt("reload")
    assert local.row(web)["adopted"]


def test_one_that_can_not_be_adopted_is_told_once(local: LocalSidecar) -> None:
    web = missed(local, "web", {**QUICK, "avckpt.keep": "many"})
    for _ in range(3):
        local.avckpt("reload")
    assert local.log.count("web: runs unprotected: ") == 1
    assert local.row(web) == {}


@SHARED
def test_a_sidecar_that_does_not_see_the_hosts_processes_says_so(local: LocalSidecar) -> None:
    """Its container was started without --pid=host."""
    why = "the sidecar does not see the host's processes: start it with --pid=host"
    old, new = local.container("old", SLEEPER), local.container("new", SLEEPER)
    assert old.hook("prestart", QUICK) == ""
    record = local.run_dir / "containers" / f"{old.id}.json"
    record.write_text(
        json.dumps({**json.loads(record.read_text()), "pid_namespace": os.stat("/proc/self/ns/pid").st_ino})
    )
    local.stop()
    with local.run_dir.with_suffix(".log").open("ab") as log:
        blind = subprocess.Popen(
            ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc", *avckpt_command(), "sidecar"],
            env={**os.environ, **local.env},
            stderr=log,
        )
    try:
        wait_until((local.run_dir / "hooks.sock").exists, 20, "it listens")
        wait_until(lambda: "is ready" in local.log.rpartition("asked to stop")[2], 20, "it has looked at the records")
        said = new.hook("prestart", QUICK)
        assert f"new runs unprotected: the sidecar said: {why}" in said
        assert f"old: runs unprotected: {why}" in local.log
        assert record.exists()
        [told] = [each for each in Client(local.run_dir).history() if each["kind"] == "sidecar_started"]
        assert "old" not in told["message"]  # nobody knows that it has ended
        doctor = local.avckpt("doctor", check=False).stdout
        assert "fail  sidecar: it does not see the host's processes" in doctor
    finally:
        blind.kill()
        blind.wait()
    local.start()
    local.wait_for(old, state="protected")


def test_hooks_know_of_it_before_it_listens(idle_sidecar: LocalSidecar, monkeypatch: pytest.MonkeyPatch) -> None:
    """For a container that is started right after it."""
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(idle_sidecar.run_dir))
    idle_sidecar.run_dir.mkdir(exist_ok=True)  # as Podman does, for the volume
    start = threading.Thread(target=idle_sidecar.start)
    start.start()
    wait_until(precreate._is_starting, 60, "it says that it starts", every_s=0.005)
    listened = os.path.exists(protocol.hooks_socket())
    start.join()
    assert not listened
    assert not precreate._not_listening()
    idle_sidecar.stop()
    assert not precreate._is_starting()


def test_it_takes_all_the_descriptors_it_may(idle_sidecar: LocalSidecar) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        idle_sidecar.start(inherits=True)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert idle_sidecar.process is not None
    assert resource.prlimit(idle_sidecar.process.pid, resource.RLIMIT_NOFILE) == (hard, hard)


@SHARED
def test_sigterm_leaves_the_application_running_and_nothing_else(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    app = web.app_pid
    assert local.stop() == 0
    assert sorted(path.name for path in local.run_dir.iterdir()) == [
        *("containers", "health", "history.jsonl", "lock", "present.json", "units")
    ]
    assert not ended(web)
    # Templates are gone, the application is not traced any more and runs.
    wait_until(lambda: children_of(web.init_pid) == [app], 5, "only the application is left")
    status = Path(f"/proc/{app}/status").read_text()
    assert "TracerPid:\t0" in status
    assert "State:\tS" in status
    os.kill(app, signal.SIGKILL)
    assert web.status() == 128 + signal.SIGKILL


@SHARED
def test_sigkill_leaves_the_application_running_and_the_next_one_takes_over(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    app = web.app_pid
    assert local.stop(signal.SIGKILL) == -signal.SIGKILL
    assert (local.run_dir / "hooks.sock").exists()
    wait_until(lambda: children_of(web.init_pid) == [app], 5, "only the application is left")
    assert not ended(web)
    local.start()
    row = local.wait_for(web, state="protected")
    assert row["adopted"]
    os.kill(app, signal.SIGKILL)
    local.wait_for(web, restores=1, state="protected")


@SHARED
def test_the_next_guard_and_the_next_sidecar_do_not_wait_an_interval(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER, ON_COMMAND)
    local.wait_for(web, app_pid_inside=2)
    checkpoint(local, "web")
    first = local.row(web)["guard_pid"]
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: local.row(web)["guard_pid"] not in (0, first), 10, "there is another guard")
    assert local.wait_for(web, state="protected", generations=1)["interval_s"] == 3600
    local.stop(signal.SIGKILL)
    local.start()
    assert local.wait_for(web, state="protected", generations=1)["adopted"]


@SHARED
def test_a_stuck_sidecar_delays_a_hook_by_a_second_and_catches_up(local: LocalSidecar) -> None:
    web = local.container("web", SLEEPER)
    assert local.process is not None
    local.process.send_signal(signal.SIGSTOP)
    try:
        started = time.monotonic()
        said = web.hook("prestart", QUICK)
        took_s = time.monotonic() - started
    finally:
        local.process.send_signal(signal.SIGCONT)
    assert "did not answer within 1 s" in said
    assert took_s < 2.5
    # What the hook had sent was not lost.
    local.wait_for(web, state="protected")
    os.kill(web.app_pid, signal.SIGKILL)
    local.wait_for(web, restores=1)


@SHARED
def test_a_stuck_sidecar_keeps_nobody_waiting_for_a_table(local: LocalSidecar) -> None:
    assert local.process is not None
    local.process.send_signal(signal.SIGSTOP)
    try:
        started = time.monotonic()
        said = local.avckpt("ps", check=False)
        took_s = time.monotonic() - started
    finally:
        local.process.send_signal(signal.SIGCONT)
    assert said.status == 3  # no sidecar
    assert said.stderr.count("\n") == 1
    assert "the sidecar did not answer within 10 s: is it paused (podman unpause avckpt-sidecar)?" in said.stderr
    assert took_s < COMMAND_S


@SHARED
def test_crashes_are_restored_while_the_event_loop_hangs(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    assert local.process is not None

    def runs() -> int:
        """Its PID, once it is restored, and no longer while it is being so."""
        seen = look(web.app_pid)
        return seen.pid if seen and not seen.is_traced and seen.state == "S" else 0

    with stopped_thread(local.process.pid):
        for _ in range(3):
            app = wait_until(runs, 10, "it is there")
            os.kill(app, signal.SIGKILL)
            wait_until(lambda app=app: runs() not in (0, app), 10, "it is there again")  # type: ignore[misc]
        assert not ended(web)
    assert local.wait_for(web, restores=3, state="protected")["last_death"] == "killed by SIGKILL"


@contextlib.contextmanager
def stopped_thread(tid: int) -> Iterator[None]:
    """Stops one thread by ptrace(2) while the others of its process run."""
    libc = ctypes.CDLL(None, use_errno=True)
    seize, interrupt, detach = 0x4206, 0x4207, 17
    arguments = (ctypes.c_long(tid), ctypes.c_void_p(), ctypes.c_void_p())
    assert libc.ptrace(seize, *arguments) == 0, os.strerror(ctypes.get_errno())
    try:
        assert libc.ptrace(interrupt, *arguments) == 0
        os.waitpid(tid, 0)
        yield
    finally:
        assert libc.ptrace(detach, *arguments) == 0


@SHARED
def test_a_log_that_nobody_reads_holds_nothing_up(idle_sidecar: LocalSidecar) -> None:
    with full_pipe() as (reader, writer):
        idle_sidecar.start("--watchdog", stderr=writer)
        web = idle_sidecar.protected("web", SLEEPER)
        idle_sidecar.wait_for(web, state="protected")
        first = idle_sidecar.client.info()["pid"]
        os.kill(first, signal.SIGKILL)

        def another() -> bool:
            with contextlib.suppress(SidecarUnreachable):
                return bool(idle_sidecar.client.info()["pid"] != first)
            return False

        wait_until(another, 30, "the watchdog has started another daemon")
        idle_sidecar.wait_for(web, state="protected", restores=0)
        assert set(emptied(reader)) == {"."}
        os.kill(web.app_pid, signal.SIGKILL)
        idle_sidecar.wait_for(web, restores=1)
        log = wait_until(lambda: emptied(reader), 10, "it writes again")
        assert re.match(r"avckpt: \d+ message\(s\) left out here: nobody read them\n2\d\d\d-.* web: ", log)


@SHARED
def test_a_sidecar_starts_on_a_full_disk_and_protects(idle_sidecar: LocalSidecar) -> None:
    folder = idle_sidecar.run_dir
    folder.mkdir()
    run(["mount", "-t", "tmpfs", "-o", "size=64k", "avckpt-test", str(folder)])
    try:
        with (folder / "others").open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while file.write(bytes(4096)):
                pass
        idle_sidecar.start()
        web = idle_sidecar.container("web", SLEEPER)
        assert "is not known to a sidecar that starts later" in web.hook("prestart", QUICK)
        idle_sidecar.wait_for(web, state="protected")
        os.kill(web.app_pid, signal.SIGKILL)
        idle_sidecar.wait_for(web, restores=1)
        (folder / "others").unlink()
        wait_until((folder / f"containers/{web.id}.json").exists, 20, "it is recorded when there is room again")
    finally:
        run(["umount", "--lazy", str(folder)])


@SHARED
def test_fifos_in_place_of_its_small_files_hold_nobody_up(
    idle_sidecar: LocalSidecar, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = idle_sidecar.run_dir
    folder.joinpath("containers").mkdir(parents=True)
    for path in ("starting", "present.json", "history.jsonl", f"containers/{'d' * 64}.json"):
        os.mkfifo(folder / path)
    os.mkfifo(idle_sidecar.config)
    idle_sidecar.start()
    assert f"the built-in defaults hold: {idle_sidecar.config}: not a file" in idle_sidecar.log
    web = idle_sidecar.protected("web", SLEEPER)
    idle_sidecar.wait_for(web, state="protected")
    assert idle_sidecar.stop() == 0
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(folder))
    assert not precreate._is_starting()


def test_a_second_sidecar_refuses_and_the_first_goes_on(local: LocalSidecar) -> None:
    second = local.avckpt("sidecar", check=False)
    assert second.status == 1
    assert second.stderr.count("\n") == 1
    assert local.process is not None
    assert f"a sidecar is running already (pid {local.process.pid}" in second.stderr
    assert local.ps() == []


def test_one_that_is_still_ending_is_waited_for(idle_sidecar: LocalSidecar) -> None:
    """Killed, it has its descriptors as long as a thread of it waits for a disk."""
    idle_sidecar.run_dir.mkdir()
    with (idle_sidecar.run_dir / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        ends = threading.Timer(1.5, lock.close)
        ends.start()
        idle_sidecar.start()
        ends.join()


def test_without_privileges_it_says_so(tmp_path: Path) -> None:
    refused = run(
        ["setpriv", "--bounding-set=-sys_ptrace,-sys_admin", "--inh-caps=-all", *avckpt_command(), "sidecar"],
        env={"AVCKPT_RUN_DIR": str(tmp_path / "run")},
        check=False,
    )
    assert refused.status == 1
    assert refused.stderr.startswith("avckpt: ")
    assert refused.stderr.count("\n") == 1
    assert "CAP_SYS_" in refused.stderr
    assert not (tmp_path / "run").exists()


def test_sockets_are_for_root_only(local: LocalSidecar) -> None:
    for name in ("api.sock", "hooks.sock"):
        assert stat.S_IMODE((local.run_dir / name).stat().st_mode) == 0o600
    assert stat.S_IMODE(local.run_dir.stat().st_mode) == 0o755


@SHARED
def test_an_idle_sidecar_sleeps(local: LocalSidecar) -> None:
    """At most a handful of wake-ups: a periodic task would be visible, whatever other tests' dying processes wake."""
    assert local.process is not None
    path = Path(f"/proc/{local.process.pid}/status")

    def switches() -> int:
        return int(path.read_text().split("voluntary_ctxt_switches:")[1].split()[0])

    def switches_of_3_s() -> int:
        before = switches()
        time.sleep(3)
        return switches() - before

    time.sleep(0.5)
    assert any(switches_of_3_s() <= 2 for _ in range(5))


def test_info(local: LocalSidecar) -> None:
    info = Client(local.run_dir).info()
    assert local.process is not None
    assert info["pid"] == local.process.pid
    assert info["containers"] == 0
    assert info["version"] == run([*avckpt_command(), "--version"]).stdout.split()[1]


@SHARED
def test_who_does_not_ask_for_memory_does_not_have_it_looked_at(local: LocalSidecar) -> None:
    local.protected("web", SLEEPER)
    client = Client(local.run_dir)

    def seen() -> int:
        (row,) = client.containers(memory=False)
        return int(row["memory_bytes"])

    wait_until(lambda: client.containers(memory=False)[0]["generations"] == 2, 10, "it is protected")
    assert seen() == 0
    (row,) = client.containers()
    assert row["memory_bytes"] > 0
    assert seen() == row["memory_bytes"]


@SHARED
def test_the_table_on_a_narrow_terminal(local: LocalSidecar) -> None:
    """Nothing is cut off, and states have colours."""
    local.wait_for(local.protected("web", SLEEPER), state="protected", generations=2)
    ours, terminal = os.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 60, 0, 0))
    environment = {**os.environ, **local.env, "TERM": "xterm"}
    subprocess.run([*avckpt_command(), "ps"], stdout=terminal, stdin=terminal, env=environment, check=True, timeout=60)
    os.close(terminal)
    said = os.read(ours, 65536).decode()
    os.close(ours)
    assert "\x1b[32mprotected\x1b[0m" in said
    head, line = (re.sub(r"\x1b\[[0-9;]*m", "", each).split() for each in said.splitlines()[:2])
    assert " ".join(head) == "NAME STATE GENS MEMORY INTERVAL CHECKPOINT FREEZE RESTORES RESTORE NOTE"
    assert line[:3] == ["web", "protected", "2/2"]


def test_an_emptied_runtime_directory_is_made_again(local: LocalSidecar) -> None:
    """The containers stay protected, new ones are, and the next sidecar finds all of them."""
    web = local.protected("web", SLEEPER)
    shutil.rmtree(local.run_dir)
    local.run_dir.mkdir()
    os.mkfifo(local.run_dir / "hooks.sock")
    wait_until(lambda: local.log.count("is made again") >= 4, 20, "it is made again")
    local.wait_for(web, state="protected")
    second = local.avckpt("sidecar", check=False)
    assert "a sidecar is running already" in second.stderr
    other = local.protected("other", SLEEPER)
    os.kill(web.app_pid, signal.SIGKILL)
    local.wait_for(web, restores=1)
    wait_until(lambda: (local.run_dir / f"containers/{web.id}.json").exists(), 10, "it is recorded")
    local.stop(signal.SIGKILL)
    local.start()
    for container in (web, other):
        local.wait_for(container, state="protected", adopted=True)
    assert any(event["kind"] == "restored" for event in local.client.history())
