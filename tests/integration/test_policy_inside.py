# SPDX-License-Identifier: Apache-2.0
"""A command that the sidecar runs in a container is like one run by `podman exec`."""

from __future__ import annotations

import asyncio
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from avckpt.containers.cgroup import groups_of
from avckpt.errors import AvckptError, TargetGone
from avckpt.supervision.inside import OUTPUT_BYTES, Done, _sealed_program, run_inside

from testkit.harness import ROOT, Container, ContainerFactory, Podman, wait_until

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="entering a container needs root")
SHARED = pytest.mark.shared_machine("commands that are run in containers have time limits")

WHO = (
    "id; pwd; hostname; echo $GREETING; ulimit -n; cat /proc/self/cgroup; "
    "grep -E '^(Cap|Seccomp|NoNewPrivs)' /proc/self/status"
)
OPTIONS = ["--env", "GREETING=hello there", "--hostname", "within"]
# Without its mount of /dev/shm: Podman 4.3.1 fails one in five times to remove that where users are mapped (EBUSY).
OTHER_USERS = ["--uidmap", "0:100000:2000", "--gidmap", "0:200000:2000", "--ipc", "none"]
Run = Callable[..., Done]


@pytest.fixture
def inside() -> Iterator[Callable[[Container], Run]]:
    """Runs commands in a container."""
    pidfds = []

    def of(container: Container) -> Run:
        pidfd = os.pidfd_open(container.pid)
        pidfds.append(pidfd)

        def run(*command: str, timeout_s: float = 10.0, stdin: bytes = b"") -> Done:
            return asyncio.run(run_inside(pidfd, command, timeout_s=timeout_s, stdin=stdin, env={"ADDED": "by us"}))

        return run

    yield of
    for pidfd in pidfds:
        os.close(pidfd)


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--user", "1000:1000", "--group-add", "33", "--workdir", "/tmp"],
        ["--cap-drop", "all", "--security-opt", "no-new-privileges", "--read-only"],
        ["--security-opt", "seccomp=unconfined", "--cap-add", "SYS_PTRACE", "--network", "host"],
        [*OTHER_USERS, "--network", "none"],
        [*OTHER_USERS, "--network", "host", "--user", "1000:1001", "--group-add", "33"],
    ],
    ids=["plain", "user", "confined", "unconfined", "userns", "userns, user"],
)
def test_it_is_as_podman_exec_has_it(
    container: ContainerFactory, inside: Callable[[Container], Run], options: list[str]
) -> None:
    made = container("sleep", "1000", options=[*OPTIONS, *options])
    done = inside(made)("sh", "-c", WHO)
    assert done.status == 0
    assert done.output.splitlines() == made.exec("sh", "-c", WHO).stdout.splitlines()


def test_input_output_and_status(container: ContainerFactory, inside: Callable[[Container], Run]) -> None:
    run = inside(container("sleep", "1000"))
    assert run("cat", stdin=b"an event").output == "an event"
    done = run("sh", "-c", "echo $ADDED; echo err >&2; exit 7")
    assert (done.status, done.output) == (7, "by us\nerr")
    assert run("sh", "-c", "kill -SEGV $$").status == 139
    assert run("no-such-program").status == 127
    assert run("/etc/passwd").status == 126


@SHARED
def test_output_without_an_end_does_not_keep_us_busy(
    container: ContainerFactory, inside: Callable[[Container], Run]
) -> None:
    run = inside(container("sleep", "1000"))
    before = time.process_time()
    done = run("yes", timeout_s=3)
    assert (done.timed_out, len(done.output)) == (True, OUTPUT_BYTES - 1)
    assert time.process_time() - before < 0.5
    assert run("head", "-c", "1000000", "/dev/zero").status == 0


def test_more_groups_than_anybody_needs_are_refused() -> None:
    """A process with CAP_SETGID can give itself 65536, and each would have to be converted."""
    with subprocess.Popen(["sleep", "1000"], preexec_fn=lambda: os.setgroups(range(1, 60001))) as main:
        pidfd = os.pidfd_open(main.pid)
        try:
            with pytest.raises(AvckptError, match="is in more than 1024 groups"):
                asyncio.run(run_inside(pidfd, ["true"], timeout_s=1))
        finally:
            os.close(pidfd)
            main.kill()


@SHARED
def test_it_is_killed_when_its_time_is_up(container: ContainerFactory, inside: Callable[[Container], Run]) -> None:
    made = container("sleep", "1000")
    before = time.monotonic()
    done = inside(made)("sh", "-c", "echo begun; sleep 555 & sleep 666; true", timeout_s=0.5)
    assert done.timed_out
    assert done.output == "begun"
    assert time.monotonic() - before < 3

    def left() -> str:
        return made.exec("ps", "-eo", "args").stdout

    assert "sleep 1000" in left()
    wait_until(lambda: "sleep 555" not in left() and "sleep 666" not in left(), 5, "nothing of it is left")


@SHARED
def test_an_endless_writer_fills_nothing(container: ContainerFactory, inside: Callable[[Container], Run]) -> None:
    done = inside(container("sleep", "1000"))("yes", timeout_s=0.3)
    assert done.timed_out
    assert len(done.output) <= OUTPUT_BYTES


@SHARED
def test_what_goes_on_in_the_background_is_not_waited_for(
    container: ContainerFactory, inside: Callable[[Container], Run]
) -> None:
    done = inside(container("sleep", "1000"))("sh", "-c", "sleep 20 & echo done")
    assert (done.status, done.output) == (0, "done")
    assert done.took_s < 5


def test_nothing_of_ours_can_be_written_to_in_there(container: ContainerFactory) -> None:
    """A process that enters a container is reachable there as /proc/PID/exe, which must not be the host's file."""
    made = container("sleep", "1000")
    pidfd = os.pidfd_open(made.pid)

    async def look() -> None:
        task = asyncio.create_task(run_inside(pidfd, ["sleep", "3"], timeout_s=10))
        await asyncio.sleep(1)
        (helper,) = [
            int(pid)
            for pid in Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
            if Path(f"/proc/{pid}/cmdline").read_bytes().startswith(b"avckpt-exec\0")
        ]
        assert Path(f"/proc/{helper}/exe").readlink() == Path("/memfd:avckpt-exec (deleted)")
        await task
        with (
            open(f"/proc/self/fd/{_sealed_program()}", "rb+", buffering=0) as program,
            pytest.raises(PermissionError),  # sealed: also for a second writer, once nobody runs it
        ):
            program.write(b"x")

    try:
        asyncio.run(look())
    finally:
        os.close(pidfd)


@SHARED
def test_a_container_can_hold_only_what_has_no_privileges(container: ContainerFactory, podman: Podman) -> None:
    """A container's CPU quota and freezer must not stop a process of the host's root in its PID namespace."""
    options = ["--user", "1000:1000", "--cap-drop", "all", "--security-opt", "seccomp=unconfined"]
    made = container("sleep", "1000", options=[*options, "--network", "none"])
    pidfd = os.pidfd_open(made.pid)

    def child_of(pid: int, name: bytes) -> int:
        (found,) = [
            int(child)
            for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            if Path(f"/proc/{child}/cmdline").read_bytes().startswith(name)
        ]
        return found

    async def look() -> None:
        task = asyncio.create_task(run_inside(pidfd, ["true"], timeout_s=30))
        await asyncio.sleep(1)
        try:
            held = Path("/proc", str(child_of(child_of(os.getpid(), b"avckpt-exec\0"), b"")))
            assert (held / "cgroup").read_text() == Path(f"/proc/{made.pid}/cgroup").read_text()
            status = dict(line.split(":\t", 1) for line in (held / "status").read_text().splitlines())
            assert {status["Uid"], status["Gid"]} == {"1000\t1000\t1000\t1000"}
            assert {int(status[name], 16) for name in ("CapPrm", "CapEff", "CapBnd", "CapInh", "CapAmb")} == {0}
        finally:
            podman.run("unpause", made.name)
            done = await task
        assert done.status == 0

    podman.run("pause", made.name)
    try:
        asyncio.run(look())
    finally:
        os.close(pidfd)


def test_nothing_of_the_sidecars_is_in_reach(container: ContainerFactory, tmp_path: Path) -> None:
    """A container with CAP_SYS_PTRACE attaches to every process that enters its PID namespace, at once."""
    options = ["--cap-drop", "all", "--cap-add", "SYS_PTRACE", "--security-opt", "seccomp=unconfined"]
    victims = ROOT / "tests/victims"
    subprocess.run(["make", "-s", "-C", str(victims), "STATIC=1", "build-static/intruder"], check=True)
    made = container("sleep", "1000", options=[*options, "--volume", f"{victims}/build-static:/victims:ro"])
    pidfd = os.pidfd_open(made.pid)

    async def run_many() -> None:
        while intruder.poll() is None:
            await run_inside(pidfd, ["true"], timeout_s=10)

    with (
        (tmp_path / "said").open("w") as out,
        subprocess.Popen(
            ["podman", "exec", made.name, "/victims/intruder", "60", "--count", "300", "--command"], stdout=out
        ) as intruder,
    ):
        try:
            asyncio.run(run_many())
        finally:
            intruder.kill()
            os.close(pidfd)
    said = (tmp_path / "said").read_text()
    assert said.count("looked at") == 300
    assert "GAIN" not in said, said


def test_a_directory_that_its_user_may_not_enter(
    container: ContainerFactory, inside: Callable[[Container], Run]
) -> None:
    """The runtime entered the working directory as root before it changed the user."""
    made = container("sleep", "1000", options=["--user", "1000:1000", "--workdir", "/root"])
    done = inside(made)("pwd")
    assert (done.status, done.output) == (0, "/")


def test_a_container_that_has_ended(container: ContainerFactory, inside: Callable[[Container], Run]) -> None:
    made = container("sleep", "1000")
    run = inside(made)
    made.remove()
    with pytest.raises(TargetGone):
        run("true")


def test_its_groups(container: ContainerFactory) -> None:
    made = container("sleep", "1000", options=["--memory", "64m", "--pids-limit", "65"])
    groups = groups_of(made.pid)
    assert groups.tasks_max() == 65
    assert groups.memory_limit_bytes() == 64 << 20
    used = groups.memory_used_bytes()
    assert used is not None
    assert 0 < used < 64 << 20
    assert not groups.is_frozen()
    made.podman.run("pause", made.name)
    try:
        assert groups.is_frozen()
    finally:
        made.podman.run("unpause", made.name)
    assert groups_of(container("sleep", "1000").pid).memory_limit_bytes() is None
