# SPDX-License-Identifier: Apache-2.0
"""Records of running containers: which are adopted, which removed.  With real processes."""

from __future__ import annotations

import json
import os
import resource
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.containers.process import has_ended, open_pidfd, pid_of, start_time
from avckpt.containers.records import NOT_SEEN, Records, keep_private, remove_if
from avckpt.errors import TargetGone
from avckpt_hooks.shared.protocol import Register


@pytest.fixture
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    """A process, killed and reaped in the end."""
    process = subprocess.Popen(["sleep", "60"])
    yield process
    process.kill()
    process.wait()


def record(directory: Path, digit: str, pid: int, started: int, **more: object) -> Path:
    register = Register(id=digit * 64, name=f"n{digit}", pid=pid, starttime=started, bundle="/b", annotations={})
    path = directory / f"{register.id}.json"
    path.write_text(json.dumps({**register.record(), **more}))
    return path


def adoptable(directory: Path, known: str = "") -> list[tuple[Register, int]]:
    """What a sidecar that has just started, and knows one container at most, would adopt."""
    return list(Records(directory).adoptable(lambda container_id: container_id == known))


def test_a_living_container_is_adopted(tmp_path: Path, sleeper: subprocess.Popen[bytes]) -> None:
    path = record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid))
    [(register, pidfd)] = adoptable(tmp_path)
    assert register.name == "na"
    assert pid_of(pidfd) == sleeper.pid
    assert path.exists()
    os.close(pidfd)


def test_a_reused_pid_is_not(tmp_path: Path, sleeper: subprocess.Popen[bytes]) -> None:
    path = record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid) - 1)
    before = len(os.listdir("/proc/self/fd"))
    assert adoptable(tmp_path) == []
    assert not path.exists()
    assert len(os.listdir("/proc/self/fd")) == before


def test_an_ended_one_is_not(tmp_path: Path, sleeper: subprocess.Popen[bytes]) -> None:
    started = start_time(sleeper.pid)
    pidfd = open_pidfd(sleeper.pid, started)
    assert not has_ended(pidfd)
    sleeper.kill()
    os.waitid(os.P_PIDFD, pidfd, os.WEXITED | os.WNOWAIT)  # it is a zombie now
    assert has_ended(pidfd)
    with pytest.raises(TargetGone):
        open_pidfd(sleeper.pid, started)
    path = record(tmp_path, "a", sleeper.pid, started)
    assert adoptable(tmp_path) == []
    assert not path.exists()
    sleeper.wait()
    with pytest.raises(TargetGone):
        open_pidfd(sleeper.pid, started)
    os.close(pidfd)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"version": 1, "id": "../../etc/passwd"}', '{"version": 99}', "[" * 99_999, " " * 999_999]
)
def test_what_is_no_record_is_left_alone(tmp_path: Path, text: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / ("b" * 64 + ".json")
    path.write_text(text)
    assert adoptable(tmp_path) == []
    assert path.exists()
    assert str(path) in caplog.text


def test_one_bad_record_does_not_hide_the_others(tmp_path: Path, sleeper: subprocess.Popen[bytes]) -> None:
    (tmp_path / ("0" * 64 + ".json")).write_text("{")
    record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid))
    [(_, pidfd)] = adoptable(tmp_path)
    os.close(pidfd)


@pytest.mark.parametrize("pid", [0, -1, 2**22 + 1, 2**40])
def test_what_can_be_no_pid_is_left_alone(tmp_path: Path, pid: int, caplog: pytest.LogCaptureFixture) -> None:
    path = record(tmp_path, "a", pid, 1)
    assert adoptable(tmp_path) == []
    assert path.exists()
    assert f"its pid is {pid}" in caplog.text


def test_what_can_not_be_opened_hides_no_other(
    tmp_path: Path, sleeper: subprocess.Popen[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / ("0" * 64 + ".json")).mkdir()
    record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid))
    [(_, pidfd)] = adoptable(tmp_path)
    os.close(pidfd)
    assert "Is a directory" in caplog.text


def test_without_descriptors_nobody_is_found_and_later_everybody(
    tmp_path: Path, sleeper: subprocess.Popen[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid))
    records = Records(tmp_path)
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    for free in (0, 1):  # one is enough for the directory, and for a record's text
        resource.setrlimit(resource.RLIMIT_NOFILE, (first_free() + free, limits[1]))
        try:
            assert [list(records.adoptable(lambda _: False)) for _ in range(2)] == [[], []]
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    said = [each.getMessage() for each in caplog.records]
    assert len(said) == 2
    assert said[0] == f"{tmp_path} cannot be read, containers may run unprotected: Too many open files"
    [(_, pidfd)] = records.adoptable(lambda _: False)
    os.close(pidfd)


def first_free() -> int:
    """The descriptor that the next open(2) will give."""
    with open("/dev/null") as file:
        return file.fileno()


def test_a_record_that_can_not_be_removed_hides_no_other(
    tmp_path: Path, sleeper: subprocess.Popen[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    ended = record(tmp_path, "0", sleeper.pid, start_time(sleeper.pid) - 1)
    (tmp_path / f".{ended.name}.{os.getpid()}").mkdir()
    record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid))
    [(_, pidfd)] = adoptable(tmp_path)
    os.close(pidfd)
    assert ended.exists()
    assert "Is a directory" in caplog.text


def test_a_record_that_can_not_be_looked_at_is_put_back(tmp_path: Path) -> None:
    path = tmp_path / ("c" * 64 + ".json")
    path.write_text("new")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (first_free(), limits[1]))
    try:
        with pytest.raises(OSError, match="Too many open files"):
            remove_if(path, b"new")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_who_is_known_is_not_looked_at(tmp_path: Path, sleeper: subprocess.Popen[bytes]) -> None:
    path = record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid) - 1)
    assert adoptable(tmp_path, known="a" * 64) == []
    assert path.exists()


def test_a_pid_of_another_namespace_means_nothing(
    tmp_path: Path, sleeper: subprocess.Popen[bytes], caplog: pytest.LogCaptureFixture
) -> None:
    own = os.stat("/proc/self/ns/pid").st_ino
    path = record(tmp_path, "a", sleeper.pid, 1, pid_namespace=own + 1)
    records = Records(tmp_path)
    for _ in range(2):
        assert list(records.adoptable(lambda _: False)) == []
    assert path.exists()
    assert [each.getMessage() for each in caplog.records] == [f"na: runs unprotected: {NOT_SEEN}"]
    record(tmp_path, "a", sleeper.pid, start_time(sleeper.pid), pid_namespace=own)
    [(_, pidfd)] = records.adoptable(lambda _: False)
    os.close(pidfd)


def test_a_record_replaced_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / ("c" * 64 + ".json")
    path.write_text("new")
    remove_if(path, b"old")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]
    remove_if(path, b"new")
    assert list(tmp_path.iterdir()) == []


def test_start_time_survives_a_wild_name(tmp_path: Path) -> None:
    program = tmp_path / "a) R 1 (b"
    program.symlink_to("/bin/sleep")
    with subprocess.Popen([str(program), "60"]) as process:
        try:
            assert start_time(process.pid) >= start_time(os.getpid())
        finally:
            process.kill()


def test_what_an_earlier_version_left_is_made_private(tmp_path: Path) -> None:
    folder = tmp_path / "containers"
    folder.mkdir(mode=0o755)
    path = record(folder, "a", 1, 1)
    path.chmod(0o644)
    keep_private(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    keep_private(tmp_path / "health")
    assert stat.S_IMODE((tmp_path / "health").stat().st_mode) == 0o700
