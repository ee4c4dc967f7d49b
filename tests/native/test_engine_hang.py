# SPDX-License-Identifier: Apache-2.0
"""A process that holds a lock on an open file of the application does not block its guard."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from testkit.guarded import PATIENCE_S, GuardProcess, Victim, config, kill_at_random
from testkit.harness import wait_until

pytestmark = pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long")
HOLD = """
import os, socket, sys
ours, theirs = socket.socketpair()
pipe = os.open(sys.argv[1], os.O_WRONLY)
print("ready", flush=True)
os.splice(theirs.fileno(), pipe, 1)
"""
"""Waits in splice(2) for what is to go into a pipe, with the pipe's lock."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


@pytest.mark.parametrize("where", ["", " --in-child"])
def test_a_thread_waits_in_splice(tmp_path: Path, where: str) -> None:
    with Victim("splicer" + where, tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        guard.wait("checkpoint", count=20)
        kill_at_random(guard, victim, 5, (0.05, 0.2))
        moved = victim.see().counter[0]
        wait_until(lambda: victim.see().counter[0] > moved, PATIENCE_S, "another byte")
        victim.check()


def test_somebody_else_waits_in_splice(tmp_path: Path) -> None:
    """The pipe's contents are unknown then; the application runs on, and the guard does not wait."""
    with Victim("splicer --leave", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        end = f"/proc/{victim.app}/fd/{victim.see().counter[2]}"
        with subprocess.Popen([sys.executable, "-c", HOLD, end], stdout=subprocess.PIPE) as holder:
            try:
                assert holder.stdout is not None
                holder.stdout.readline()
                wchan = Path(f"/proc/{holder.pid}/stat")
                wait_until(lambda: wchan.read_text().rsplit(")", 1)[1].split()[0] == "S", PATIENCE_S, "it waits")
                for _ in range(8):  # more than may be left behind at a time
                    begun = time.monotonic()
                    taken = guard.command("checkpoint")
                    assert taken["kind"] == "checkpoint", str(taken)
                    assert time.monotonic() - begun < PATIENCE_S / 3
                    victim.wait_beats(3)
            finally:
                holder.kill()
        # Those that were left behind come back, and everything is as before.
        wait_until(lambda: len(os.listdir(f"/proc/{guard.pid}/task")) <= 2, PATIENCE_S, "they end")
        assert guard.command("checkpoint")["kind"] == "checkpoint"
        assert guard.command("restore")["kind"] == "restored"
        victim.wait_beats(3)
