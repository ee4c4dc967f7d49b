# SPDX-License-Identifier: Apache-2.0
"""The main process of the sidecar's container, without the container: it outlives a daemon that hangs."""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from avckpt.cli.client import Client

from testkit.harness import wait_until
from testkit.local_sidecar import LocalSidecar, local_sidecar
from testkit.procfs import children_of

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root"),
    pytest.mark.shared_machine("what gets no CPU for seconds has hung, to a watchdog"),
]


@pytest.fixture
def local(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[LocalSidecar]:
    """A sidecar as Podman starts it, and one container."""
    monkeypatch.setenv("container", "podman")
    with local_sidecar(tmp_path) as made:
        made.start(inherits=True)  # whether it has a watchdog is decided when it is imported
        yield made


def daemon_of(local: LocalSidecar) -> int:
    """PID of the watchdog's child; 0 if there is none at the moment."""
    assert local.process is not None
    children = children_of(local.process.pid)
    return children[0] if children else 0


def stop_itself(pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)


def die(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("end", [stop_itself, die])
def test_another_daemon_takes_over(end: Callable[[int], None], local: LocalSidecar) -> None:
    web = local.protected("web", ["sleep", "1000"])
    local.wait_for(web, state="protected")
    first = daemon_of(local)
    end(first)
    wait_until(lambda: daemon_of(local) not in (0, first), 60, "another daemon")
    wait_until(lambda: "is ready, 1 container(s) found" in local.log, 60, "it has found the container")
    local.wait_for(web, 60, state="protected")
    assert ("has given no sign of life for" in local.log) == (end is stop_itself)
    os.kill(web.app_pid, signal.SIGKILL)
    local.wait_for(web, restores=1)


def test_an_outage_is_told_with_what_ended_meanwhile(local: LocalSidecar) -> None:
    web, db = (local.protected(name, ["sleep", "1000"]) for name in ("web", "db"))
    for each in (web, db):
        local.wait_for(each, state="protected")
    app = web.app_pid
    assert local.stop(signal.SIGKILL) == -signal.SIGKILL
    wait_until(lambda: children_of(web.init_pid) == [app], 10, "its guard has ended, too")
    os.kill(app, signal.SIGSEGV)
    web.status()
    local.start()
    local.wait_for(db, state="protected")
    assert local.stop() == 0
    local.start()
    told = [event for event in Client(local.run_dir).history() if event["container"] == ""]
    assert [event["kind"] for event in told] == ["sidecar_started", "sidecar_stopped", "sidecar_started"]
    assert "the one before crashed or was killed, " in told[0]["message"]
    assert told[0]["message"].endswith(" s without protection; meanwhile ended: web")
    assert "the one before was stopped" in told[2]["message"]
    assert "meanwhile" not in told[2]["message"]


def test_a_killed_watchdog_leaves_no_daemon(local: LocalSidecar) -> None:
    daemon = os.pidfd_open(daemon_of(local))
    assert local.stop(signal.SIGKILL) == -signal.SIGKILL
    wait_until(lambda: bool(_ended(daemon)), 10, "the daemon has ended")
    os.close(daemon)


def test_it_stops_when_it_is_told_to(local: LocalSidecar) -> None:
    assert local.stop() == 0
    assert "asked to stop" in local.log


def _ended(pidfd: int) -> bool:
    return bool(select.select([pidfd], [], [], 0)[0])
