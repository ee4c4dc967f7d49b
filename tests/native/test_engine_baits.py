# SPDX-License-Identifier: Apache-2.0
"""Files that look like others, or answer to being opened: a guard opens only what it means, and harmlessly."""

from __future__ import annotations

import signal
import statistics
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.guard import Files

from testkit.guarded import GuardProcess, Victim, config
from testkit.scenario import checkpoint, disturb, restored


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def test_a_mount_is_not_sought_outside_of_the_container(tmp_path: Path, memory: Path) -> None:
    """A link by the name of a mount point leads to the host: what is written there is none of its business."""
    with (
        Victim(f"baits covered {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        (tmp_path / "of the host").write_text("written")
        assert "error" not in restored(victim, guard, looks=False)
        (Path(f"/proc/{victim.app}/root{tmp_path}") / "of the container").write_text("written")
        victim.kill_app()
        assert "was written since the checkpoint" in str(guard.wait("gave_up")["error"])


def test_a_lease_on_shared_memory_is_not_broken(tmp_path: Path) -> None:
    """SIGIO would end most programs; so it is not protected, and learns of nothing."""
    with Victim(f"baits leased-memory {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(3):
            answer = guard.checkpoint()
            victim.wait_beats()
            assert answer["kind"] == "unprotected", answer
            assert "F_SETLEASE" in str(answer["error"])


def test_to_look_for_leases_stops_nobody(tmp_path: Path) -> None:
    """To list locks, the kernel waits for all CPUs to have been idle or in user mode, some 10 ms each time."""

    def list_locks() -> float:
        time.sleep(0.1)  # right after another one, it waits for nothing
        start = time.monotonic()
        Path("/proc/locks").read_bytes()
        return time.monotonic() - start

    if (listing_s := statistics.median(list_locks() for _ in range(5))) < 0.003:
        pytest.skip(f"listing locks takes {listing_s * 1e3:.1f} ms here")
    with Victim("turnover join", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        freezes = []
        for _ in range(10):
            time.sleep(0.05)
            freezes.append(guard.checkpoint()["freeze_s"])
        victim.check()
        assert statistics.median(freezes) < listing_s / 2, (listing_s, freezes)


def test_a_lease_on_a_mapped_file_is_not_broken(tmp_path: Path, memory: Path) -> None:
    """What such a file holds is not known, and so it counts as written."""
    with (
        Victim(f"baits leased-file {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        for _ in range(3):
            checkpoint(guard)
            victim.wait_beats()
        victim.kill_app()
        assert "is mapped for writing" in str(guard.wait("gave_up")["error"])


def test_a_mapped_device_is_not_opened(tmp_path: Path, memory: Path) -> None:
    """Opening a device may have effects, and while it is open it cannot be given up."""
    with (
        Victim(f"baits device {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        assert not [name for name in guard.fds() if "bait" in name]
        victim.wait_beats()


def test_a_file_with_the_name_of_memory_is_a_file(tmp_path: Path) -> None:
    """Files do not go back, whatever they are called."""
    with Victim(f"baits named {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        checkpoint(guard)
        checkpoint(guard)
        for _ in range(2):
            disturb(victim)
            assert "error" not in restored(victim, guard)


def test_and_it_can_be_written(tmp_path: Path, memory: Path) -> None:
    """Which avckpt.files=strict does not overlook."""
    with (
        Victim(f"baits named {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        checkpoint(guard)
        disturb(victim)
        victim.kill_app()
        assert "written since the checkpoint" in str(guard.wait("gave_up")["error"])


@pytest.mark.parametrize("what", ["server", "other-server"])
def test_a_file_server_is_not_protected(what: str, tmp_path: Path) -> None:
    """Whoever has its files open and exits waits for it: templates, and the guard, as long as they have its device."""
    with Victim(f"baits {what} {tmp_path}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        answer = guard.checkpoint()
        assert answer["kind"] == "unprotected", answer
        assert "it serves a file system" in str(answer["error"])
        victim.wait_beats()
        victim.kill_app()
        assert victim.end() == 128 + signal.SIGKILL


@pytest.fixture
def server(tmp_path: Path, victims_built: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A file system at tmp_path/mount; when its server ends, nobody waits for it any more."""
    with subprocess.Popen([victims_built / "server", tmp_path], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        if process.stdout.readline() != b"ready\n":
            pytest.skip("/dev/fuse is not available here")
        yield process
        process.kill()
    subprocess.run(["umount", "-l", tmp_path / "mount"], check=True)


@pytest.mark.parametrize("what", ["served", "served-map"])
def test_a_file_server_is_not_asked(what: str, tmp_path: Path, memory: Path, server: subprocess.Popen[bytes]) -> None:
    """It may not answer, and a freeze would last until its deadline; or be a part of what is stopped."""
    with (
        Victim(f"baits {what} {tmp_path}", memory) as victim,
        GuardProcess(config(files=Files.STRICT), [victim.pid]) as guard,
    ):
        try:
            for _ in range(20):
                checkpoint(guard)
                victim.wait_beats(1)
            assert not [event for event in guard.events if "came too late" in str(event.get("error"))]
        finally:
            server.kill()
