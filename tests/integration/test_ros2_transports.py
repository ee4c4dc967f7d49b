# SPDX-License-Identifier: Apache-2.0
"""Sequence numbers go back with the memory: how a DDS reader reacts, and what examples/ros2/kept.h does about it.

Without Podman, by `avckpt run`, in a network namespace of their own; bench/ros2.py does it in containers.
"""

from __future__ import annotations

import contextlib
import ctypes.util
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from testkit.harness import ROOT, avckpt_command, run, wait_until
from testkit.local_sidecar import app_of
from testkit.procfs import children_of

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="avckpt run needs root"),
    pytest.mark.shared_machine(
        "init waits two seconds for its guard, which may get no CPU for as long; a reader is given a time to hear again"
    ),
]
needs_dds = pytest.mark.skipif(
    shutil.which("idlc") is None or ctypes.util.find_library("ddsc") is None,
    reason="no CycloneDDS here (Debian: cyclonedds-dev, cyclonedds-tools)",
)

EXAMPLES = ROOT / "examples/ros2"
RECORD = struct.Struct("<4Q")
LOOPBACK = '<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces></General>'

Spawn = Callable[..., "Spawned"]


@dataclass
class Spawned:
    """A command in the network namespace, its standard error in a file."""

    process: subprocess.Popen[bytes]
    stderr: Path

    @property
    def said(self) -> str:
        return self.stderr.read_text()

    def app(self) -> int:
        """The PID of the program below `avckpt run`, once it is the only one."""

        def look() -> int:
            # The engine's probe has children, too, but in our own namespace; init's application is number 2 in its own.
            return next((app for init in children_of(self.process.pid) if (app := app_of(init))), 0)

        return wait_until(look, 20, f"the program runs: {self.said[-500:]!r}")


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Spawn]:
    """Starts commands in a network of their own."""
    net = subprocess.Popen(
        ["unshare", "-n", "sh", "-c", "ip link set lo up && ip link set lo multicast on && echo up && exec sleep 1000"],
        stdout=subprocess.PIPE,
    )
    assert net.stdout is not None
    assert net.stdout.readline() == b"up\n"
    started: list[Spawned] = []

    def start(*command: str) -> Spawned:
        path = tmp_path / f"stderr{len(started)}"
        with path.open("wb") as err:
            process = subprocess.Popen(
                ["nsenter", "--net", "--target", str(net.pid), *command],
                stdin=subprocess.DEVNULL,
                stderr=err,
                env={**os.environ, "CYCLONEDDS_URI": LOOPBACK},
            )
        started.append(Spawned(process, path))
        return started[-1]

    yield start
    for spawned in started:
        for pid in children_of(spawned.process.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        spawned.process.kill()
        spawned.process.wait()
    net.kill()
    net.wait()
    net.stdout.close()


class Heard:
    """What the peer has heard of the node."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def counts(self) -> list[int]:
        data = self._path.read_bytes() if self._path.exists() else b""
        return [record[1] for record in RECORD.iter_unpack(data[: len(data) // RECORD.size * RECORD.size])]

    def wait_more(self, n: int) -> list[int]:
        """Waits for n more messages and returns them."""
        before = len(self.counts())
        wait_until(lambda: len(self.counts()) >= before + n, 60, f"{n} more messages are heard")
        return self.counts()[before:]


def pair(spawn: Spawn, folder: Path, remedy: str) -> tuple[Spawned, Heard]:
    """A protected node and its peer, connected to each other, with a checkpoint taken since."""
    run(["make", "-s", "-C", str(EXAMPLES), f"BUILD={folder}"], timeout_s=100)
    program = str(folder / "dds_node")
    protect = (*avckpt_command(), "run", "-v", "--label", "avckpt.interval=2s", "--label", "avckpt.restore.max=60/60s")
    node = spawn(*protect, "--", program, "--after-restore", remedy)
    spawn(program, "--in", "from_node", "--out", "to_node", "--log", str(folder / "heard"))
    heard = Heard(folder / "heard")
    heard.wait_more(5)
    wait_checkpoint(node)
    return node, heard


def wait_checkpoint(node: Spawned) -> None:
    before = node.said.count("checkpoint: generation")
    wait_until(lambda: node.said.count("checkpoint: generation") > before, 30, "the next checkpoint")


def kill(node: Spawned, restores: int) -> None:
    os.kill(node.app(), signal.SIGKILL)
    wait_until(lambda: len(re.findall(r"restored in .* restore \d+", node.said)) >= restores, 20, f"restore {restores}")


def wait_skipped(node: Spawned, times: int) -> None:
    wait_until(lambda: node.said.count("dds_node: skipped") >= times, 20, f"numbers are skipped: {node.said!r}")


@needs_dds
def test_a_reader_ignores_numbers_it_has_had(spawn: Spawn, tmp_path: Path) -> None:
    node, heard = pair(spawn, tmp_path, "none")
    heard.wait_more(30)
    kill(node, 1)
    heard.wait_more(30)
    counts = heard.counts()
    # The node counts as its writer does: nothing of the lost time is heard a second time.
    assert counts == sorted(set(counts))


@needs_dds
def test_skipped_numbers_are_new_to_the_reader(spawn: Spawn, tmp_path: Path) -> None:
    node, heard = pair(spawn, tmp_path, "skip")
    # More than once, also from the same generation, and with kills soon after a restore.
    for restores in range(1, 4):
        heard.wait_more(30)
        before = len(heard.counts())
        kill(node, restores)
        wait_skipped(node, restores)
        heard.wait_more(5)
        counts = heard.counts()[before - 1 :]
        # What the node sends now has counts that were heard before: it was not ignored.
        assert any(later < earlier for earlier, later in zip(counts, counts[1:])), counts
    assert "not restored" not in node.said


COUNTING = """
import sys, time
sys.path.insert(0, sys.argv[1])
from kept import Kept
kept = Kept()
while True:
    if kept.forgotten():
        print("forgotten", kept.forgotten(), file=sys.stderr, flush=True)
        while kept.forgotten():
            kept.count()
    kept.count()
    time.sleep(0.01)
"""


def test_what_was_sent_and_forgotten_is_counted_in_python_too(spawn: Spawn) -> None:
    program = (sys.executable, "-c", COUNTING, str(EXAMPLES))
    node = spawn(*avckpt_command(), "run", "-v", "--label", "avckpt.interval=2s", "--", *program)
    wait_checkpoint(node)
    # Nothing is forgotten by one that dies right after a checkpoint.
    for restores in range(1, 6):
        time.sleep(0.2)
        kill(node, restores)
        with contextlib.suppress(TimeoutError):
            wait_until(lambda: re.search(r"forgotten [1-9]", node.said) is not None, 4, "it is told")
            return
    pytest.fail(f"restored, and knows nothing of what it forgot: {node.said!r}")
