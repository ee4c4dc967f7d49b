# SPDX-License-Identifier: Apache-2.0
"""What systemd's journal is told, and what a bundle takes from it: by a real systemd-journald."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.bundles import read_bundle
from testkit.harness import avckpt_command, run, wait_until
from testkit.local_sidecar import QUICK, LocalSidecar, local_sidecar

JOURNALD = Path("/lib/systemd/systemd-journald")
# Where it keeps and is told things, but for nobody else.
ALONE = f"""
for folder in /run/systemd /run/log; do mkdir -p $folder && mount -t tmpfs journal $folder || exit; done
mkdir /run/systemd/journal /run/log/journal && exec {JOURNALD}
"""
NAP = [sys.executable, "-c", "import time\nwhile True: time.sleep(0.1)"]
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.skipif(not JOURNALD.exists(), reason="this machine has no systemd"),
]


@pytest.fixture
def sidecar(tmp_path: Path) -> Iterator[LocalSidecar]:
    """One that finds a systemd-journald where every program of systemd's looks for it."""
    with subprocess.Popen(["unshare", "--mount", "sh", "-c", ALONE]) as journald:
        try:
            beside = ["nsenter", "--mount", f"--target={journald.pid}", f"--wd={Path.cwd()}"]
            socket = Path(f"/proc/{journald.pid}/root/run/systemd/journal/socket")
            wait_until(socket.is_socket, 20, "journald listens")
            with local_sidecar(tmp_path) as made:
                made.command = [*beside, *avckpt_command()]
                made.start()
                yield made
        finally:
            journald.kill()


def test_a_bundle_has_what_the_journal_says_of_it(sidecar: LocalSidecar, tmp_path: Path) -> None:
    crashing, other = (sidecar.protected(name, NAP, QUICK) for name in ("crashing", "other"))
    for each in (crashing, other):
        sidecar.wait_for(each, state="protected")
    os.kill(crashing.app_pid, signal.SIGKILL)
    sidecar.wait_for(crashing, restores=1)
    sidecar.wait_for(other, state="protected")

    def bundle(what: str) -> str:
        path = tmp_path / "bundle.tar.gz"
        path.unlink(missing_ok=True)
        run([*sidecar.command, "bundle", what, "-o", str(path)], env=sidecar.env)
        return read_bundle(path)["journal.txt"]

    wait_until(lambda: "restored in" in bundle("crashing"), 20, "the restore is told")
    journal = bundle("crashing")
    assert all(": crashing: " in line for line in journal.splitlines()), journal
    [crash] = sidecar.events("crashing", "restored")
    assert "restored in" in bundle(str(crash["seq"]))
    assert "other: " in bundle("other")
