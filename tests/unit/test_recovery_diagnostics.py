# SPDX-License-Identifier: Apache-2.0
"""The ROS example, without ROS: how events are mapped, and that it reconnects to a restarted sidecar."""

from __future__ import annotations

import contextlib
import importlib.util
import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from avckpt.events.record import EventRecord, of_guard
from avckpt.events.vocabulary import EXPECTED, Kind, Reason
from avckpt.guard import Event

from testkit.harness import wait_until

SOURCE = Path(__file__).parents[2] / "examples" / "ros" / "recovery_diagnostics.py"


@pytest.fixture(scope="module")
def node() -> ModuleType:
    spec = importlib.util.spec_from_file_location("recovery_diagnostics", SOURCE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look
    spec.loader.exec_module(module)
    assert "rospy" not in sys.modules
    return module


def event(kind: Kind, at: float = 1000.0, **more: Any) -> dict[str, Any]:
    record = EventRecord(kind, container="lidar", id="ab" * 32, at=at, seq=1, **more)
    told: dict[str, Any] = json.loads(json.dumps(record.to_json()))
    return told


def restored(at: float = 1000.0) -> dict[str, Any]:
    guard = Event(Kind.RESTORED, 1, reason=Reason.SIGNAL, wait_status=11, restore_s=0.006, age_s=1.5, generation=4)
    record = of_guard(guard, container="lidar", id="ab" * 32, group="chain", at=at)
    told: dict[str, Any] = json.loads(json.dumps(record.to_json()))
    return told


def test_a_recovery_is_a_warning_with_its_figures(node: ModuleType) -> None:
    status = node.status_of(restored(), hold_s=10.0)
    assert (status.name, status.level, status.hardware_id) == ("avckpt: lidar", node.WARN, "ab" * 6)
    assert status.message.startswith("killed by SIGSEGV, restored in 6.0 ms from generation 4 (1.5 s old)")
    assert status.values["lost_s"] == "1.506"
    assert (status.values["event"], status.values["reason"], status.values["group"]) == ("restored", "signal", "chain")
    assert all(isinstance(value, str) for value in status.values.values())
    assert status.until == 1010.0


def test_every_kind_has_a_level(node: ModuleType) -> None:
    assert {kind.value for kind in Kind} - set(node.LEVELS) == set(node.NO_NEWS)


def test_an_end_that_was_meant_is_no_error(node: ModuleType) -> None:
    assert set(node.MEANT) == {outcome.value for outcome in EXPECTED}
    assert node.status_of(event(Kind.GAVE_UP, outcome=Reason.STOPPED)).level == node.STALE
    assert node.status_of(event(Kind.GAVE_UP, outcome=Reason.LIMIT)).level == node.ERROR


def test_the_board_over_time(node: ModuleType) -> None:
    board = node.Board(hold_s=10.0)

    def levels(now: float) -> list[tuple[str, int]]:
        return [(status.name, status.level) for status in board.statuses(now)]

    assert levels(0.0) == [("avckpt: sidecar", node.ERROR)]
    board.lose("")
    board.take(event(Kind.DIED))
    assert levels(1000.0) == [("avckpt: sidecar", node.OK), ("avckpt: lidar", node.ERROR)]
    board.take(restored())
    assert board.take(event(Kind.NOTIFIED)) is None
    assert levels(1005.0)[1] == ("avckpt: lidar", node.WARN)
    assert levels(1011.0)[1] == ("avckpt: lidar", node.OK)
    board.lose("it went away")
    assert levels(1012.0) == [("avckpt: sidecar", node.ERROR), ("avckpt: lidar", node.STALE)]
    board.lose("")
    board.take(event(Kind.ENDED, at=1020.0))
    assert levels(1021.0)[1] == ("avckpt: lidar", node.STALE)
    assert levels(1031.0) == [("avckpt: sidecar", node.OK)]


@pytest.mark.parametrize("kind", [Kind.DROPPED, Kind.MISSED])
def test_nothing_held_is_an_error_until_there_is_something_again(node: ModuleType, kind: Kind) -> None:
    board = node.Board(hold_s=10.0)
    board.lose("")
    board.take(event(Kind.CHECKPOINT, generations=1))
    board.take(event(kind, generations=1))
    assert [status.level for status in board.statuses(1011.0)] == [node.OK, node.OK]
    board.take(event(kind, generations=0))
    assert [status.level for status in board.statuses(2000.0)] == [node.OK, node.ERROR]
    board.take(event(Kind.CHECKPOINT, generations=1))
    assert [status.level for status in board.statuses(2000.0)] == [node.OK, node.OK]


def test_news_of_something_else_hides_no_lack_of_protection(node: ModuleType) -> None:
    board = node.Board(hold_s=10.0)
    board.lose("")
    board.take(event(Kind.UNPROTECTED))
    for at, kind in ((1000.0, Kind.HEALTH), (1005.0, Kind.NOTIFY_FAILED)):
        board.take(event(kind, at=at))
    assert [status.level for status in board.statuses(1006.0)] == [node.OK, node.ERROR]
    assert [status.level for status in board.statuses(1016.0)] == [node.OK, node.ERROR]
    board.take(event(Kind.CHECKPOINT, generations=1))
    board.take(event(Kind.HEALTH))
    assert [status.level for status in board.statuses(1016.0)] == [node.OK, node.OK]


@contextlib.contextmanager
def following(
    node: ModuleType, path: Path, answers: Sequence[str], board: Any, changed: Callable[[Any], object]
) -> Iterator[tuple[list[str], threading.Thread]]:
    """It follows a sidecar that gives these answers, one connection each; what that was asked, and what ends
    after the last.
    """
    requests: list[str] = []
    stopped = threading.Event()

    def serve() -> None:
        for text in answers:
            connection, _ = server.accept()
            with connection:
                requests.append(connection.recv(4096).decode())
                connection.sendall(f"HTTP/1.1 200 OK\r\nContent-Length: {len(text)}\r\n\r\n{text}".encode())

    serving = threading.Thread(target=serve, daemon=True)
    follower = threading.Thread(target=node.follow, args=(str(path), board, changed, stopped), daemon=True)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        serving.start()
        follower.start()
        yield requests, serving
        stopped.set()
    follower.join(20)


@pytest.mark.parametrize(("state", "known"), [("nodes", False), ("listening", False), ("starting", True)])
def test_a_launcher_is_no_lasting_warning(node: ModuleType, tmp_path: Path, state: str, known: bool) -> None:
    """No checkpoint of it ever follows."""
    path, board = tmp_path / "api.sock", node.Board()
    answers = [
        f"id: 41\ndata: {json.dumps(event(Kind.REGISTERED))}\n\n",
        json.dumps({"container": {"state": state}}),
    ]
    with following(node, path, answers, board, print) as (asked, serving):
        serving.join(10)
    assert [request.split()[1] for request in asked] == ["/v1/events", f"/v1/containers/{'ab' * 32}"]
    assert [status.name for status in board.statuses(1000.0)[1:]] == (["avckpt: lidar"] if known else [])


def test_it_resumes_where_it_was_when_the_sidecar_comes_back(node: ModuleType, tmp_path: Path) -> None:
    path, board = tmp_path / "api.sock", node.Board()
    now = time.time()
    answers = [
        f"retry: 1000\n\nid: 41\ndata: {json.dumps(restored(now - 60))}\n\n: nothing new\n\n",
        f"id: 42\ndata: {json.dumps(restored(now + 60))}\n\n",
    ]
    changed: list[Any] = []
    with following(node, path, answers, board, changed.append) as (requests, _):
        wait_until(lambda: changed, 10, "the second event")
    # What was before it started is on the board, but is no news.
    assert len(changed) == 1
    assert "Last-Event-ID" not in requests[0]
    assert "Last-Event-ID: 41\r\n" in requests[1]
