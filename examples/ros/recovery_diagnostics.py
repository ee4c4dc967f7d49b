#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Publishes avckpt's events as diagnostic_msgs/DiagnosticArray on /diagnostics (ROS 1).

    ROS_MASTER_URI=http://localhost:11311 ./recovery_diagnostics.py

Every protected container is one diagnostic status, "avckpt: NAME": OK while it
is protected, WARN for ~hold seconds after a recovery, ERROR while it runs
unprotected, as long as nothing is held to go back to or when it could not be
restored, STALE when it has just ended or the sidecar does not answer.  Changes are
published as they happen, everything once in ~period seconds.  Reads the sidecar's
event stream on its Unix socket, so it runs as root, on the host or in a container
with -v /run/avckpt:/run/avckpt.

Parameters: ~socket (/run/avckpt/api.sock), ~period (1.0 s), ~hold (10.0 s).
"""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

SOCKET = "/run/avckpt/api.sock"
RETRY_S = 1.0
SILENCE_S = 40.0
"""The sidecar says something every 15 s: after this long it is gone."""

# diagnostic_msgs/DiagnosticStatus
OK, WARN, ERROR, STALE = 0, 1, 2, 3

LEVELS = {
    "registered": WARN,
    "attached": WARN,
    "checkpoint": OK,
    "missed": WARN,
    "unprotected": ERROR,
    "guard_lost": ERROR,
    "died": ERROR,
    "restored": WARN,
    "gave_up": ERROR,
    "dropped": WARN,
    "notify_failed": WARN,
    "refused": WARN,
    "health": WARN,
    "ended": STALE,
}
"""How much each kind of event matters."""

NO_NEWS = ("notified", "configured", "crash", "core", "late", "held", "waits", "sidecar_started", "sidecar_stopped")
"""Kinds of events that say nothing of how a container stands."""

ASIDE = ("health", "refused", "notify_failed")
"""Kinds that are news for a while, and change nothing of how a container stands."""

SHOWN = ("reason", "outcome", "generation", "age_s", "lost_s", "freeze_s", "restore_s", "attempt", "restores")
"""Fields of an event that become values of a status."""

MEANT = ("clean_exit", "stopped")
"""Outcomes of an end that somebody wanted."""


@dataclass(frozen=True)
class Status:
    """What a DiagnosticStatus will say, without ROS."""

    name: str
    level: int
    message: str
    hardware_id: str
    values: dict[str, str] = field(default_factory=dict)
    until: float = 0.0
    """When it is no longer news, seconds since 1970; 0: it holds until something else happens."""
    then: int = OK
    """Its level when it is no longer news."""


def status_of(event: dict[str, Any], hold_s: float = 10.0) -> Status:
    """The status that an event of avckpt's is."""
    kind = event["kind"]
    level = LEVELS.get(kind, WARN)
    if kind == "gave_up" and event.get("outcome") in MEANT:
        level = STALE
    if kind in ("missed", "dropped") and event.get("generations") == 0:
        level = ERROR
    values = {name: str(event[name]) for name in SHOWN if event.get(name) is not None}
    values["event"] = kind
    if event.get("group"):
        values["group"] = event["group"]
    passing = kind == "ended" or (level == WARN and kind not in ("registered", "attached"))
    return Status(
        name=f"avckpt: {event['container']}",
        level=level,
        message=event["message"],
        hardware_id=event["id"][:12],
        values=values,
        until=event["at"] + hold_s if passing else 0.0,
    )


class Board:
    """The newest status of every container.  For several threads."""

    def __init__(self, hold_s: float = 10.0) -> None:
        self._hold_s = hold_s
        self._statuses: dict[str, Status] = {}
        self._lock = threading.Lock()
        self._problem = "not connected yet"

    def take(self, event: dict[str, Any]) -> Status | None:
        """Takes in an event; the container's new status, None if this one changes nothing."""
        if event["kind"] in NO_NEWS:
            return None
        status = status_of(event, self._hold_s)
        with self._lock:
            before = self._statuses.get(event["container"])
            if before is not None and event["kind"] in ASIDE:
                then = before.then if before.until else before.level
                status = replace(status, level=max(status.level, then), then=then)
            self._statuses[event["container"]] = status
        return status

    def lose(self, problem: str) -> None:
        """The sidecar does not answer, and why; "" when it does again."""
        with self._lock:
            self._problem = problem

    def statuses(self, now: float) -> list[Status]:
        """What to publish at a time of day: the sidecar's own status first."""
        with self._lock:
            for name, status in list(self._statuses.items()):
                if status.until and now > status.until:
                    if status.level == STALE:
                        del self._statuses[name]
                    else:
                        self._statuses[name] = replace(status, level=status.then, until=0.0)
            problem, known = self._problem, sorted(self._statuses.items())
        if problem:
            sidecar = Status("avckpt: sidecar", ERROR, f"no containers are protected: {problem}", "")
            return [sidecar] + [replace(status, level=STALE) for _, status in known]
        return [Status("avckpt: sidecar", OK, "answers", "")] + [status for _, status in known]


class UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix socket."""

    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=SILENCE_S)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(SILENCE_S)
        self.sock.connect(self._path)


def events(path: str, last_id: str, connected: Callable[[], None]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The sidecar's events, each with its id ("" for one that cannot be resumed after), until it closes.

    Calls connected() as soon as it answers.

    Raises OSError or http.client.HTTPException.
    """
    connection = UnixConnection(path)
    try:
        connection.request("GET", "/v1/events", headers={"Last-Event-ID": last_id} if last_id else {})
        answer = connection.getresponse()
        if answer.status != 200:
            raise http.client.HTTPException(f"HTTP status {answer.status}")
        connected()
        event_id = ""
        for line in answer:
            name, _, value = line.decode().rstrip("\n").partition(": ")
            if name == "id":
                event_id = value
            elif name == "data":
                yield event_id, json.loads(value)
                event_id = ""
    finally:
        connection.close()


def needs_no_guard(path: str, container: str) -> bool:
    """Whether it is a launcher of nodes, or only hears of others: neither has checkpoints, nor lacks them."""
    connection = UnixConnection(path)
    try:
        connection.request("GET", f"/v1/containers/{container}")
        answer = json.loads(connection.getresponse().read())
    except (OSError, http.client.HTTPException, ValueError):
        return False
    finally:
        connection.close()
    return answer.get("container", {}).get("state") in ("nodes", "listening")


def follow(path: str, board: Board, changed: Callable[[Status], None], stopped: threading.Event) -> None:
    """Keeps a board up to date and calls changed(status) at each change; comes back to a sidecar that restarts."""
    last_id = ""
    started = time.time()
    while not stopped.is_set():
        try:
            for event_id, event in events(path, last_id, lambda: board.lose("")):
                last_id = event_id or last_id
                if event["kind"] == "registered" and needs_no_guard(path, event["id"]):
                    continue
                status = board.take(event)
                if status is not None and event["at"] >= started:  # what was before is no news
                    changed(status)
                if stopped.is_set():
                    return
            problem = "the sidecar was stopped"
        except (OSError, http.client.HTTPException) as error:
            problem = f"{path}: {error}"
        board.lose(problem)
        stopped.wait(RETRY_S)


def main() -> None:
    """The node."""
    import rospy  # type: ignore[import-not-found] # comes with ROS
    from diagnostic_msgs.msg import (  # type: ignore[import-not-found]
        DiagnosticArray,
        DiagnosticStatus,
        KeyValue,
    )

    rospy.init_node("avckpt_diagnostics")
    publisher = rospy.Publisher("/diagnostics", DiagnosticArray, queue_size=100)
    board = Board(float(rospy.get_param("~hold", 10.0)))

    def publish(statuses: list[Status]) -> None:
        array = DiagnosticArray()
        array.header.stamp = rospy.Time.now()
        for status in statuses:
            array.status.append(
                DiagnosticStatus(
                    # A byte: some releases of rospy have it as bytes, and take the number all the same.
                    level=status.level,
                    name=status.name,
                    message=status.message,
                    hardware_id=status.hardware_id,
                    values=[KeyValue(key, value) for key, value in status.values.items()],
                )
            )
        publisher.publish(array)

    def changed(status: Status) -> None:
        if status.level == ERROR or (status.level == WARN and status.until):
            rospy.logwarn("%s: %s", status.name, status.message)
        publish([status])

    stopped = threading.Event()
    rospy.on_shutdown(stopped.set)
    path = rospy.get_param("~socket", SOCKET)
    threading.Thread(target=follow, args=(path, board, changed, stopped), daemon=True).start()
    # Wall time: /clock may stand still, recoveries do not wait for it.
    period_s = float(rospy.get_param("~period", 1.0))
    while not stopped.wait(period_s):
        publish(board.statuses(time.time()))


if __name__ == "__main__":
    main()
