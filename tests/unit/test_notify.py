# SPDX-License-Identifier: Apache-2.0
"""Failures of one notification do not affect others.  With a real process as the notified container."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from avckpt.containers.protected import Protected
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind
from avckpt.policy import settings_of
from avckpt.supervision.notify import Notifier
from avckpt_hooks.shared.labels import Notify

RESTORED = EventRecord(Kind.RESTORED, container="web")


@dataclass
class Listening:
    """A container that is told, without avckpt-init."""

    container: Protected
    pidfd: int
    notify: Notify | None
    notify_self: Notify | None = None


@pytest.fixture
def friend() -> Iterator[Protected]:
    """A container in group `chain`; its main process ends with the test."""
    with subprocess.Popen(["sleep", "60"]) as process:
        made = Protected("ab" * 32, "friend", 1, process.pid, settings_of({}).config, 0.0, group="chain")
        made.listen()
        yield made
        process.kill()


def told(watch: Listening, *hows: Notify) -> list[tuple[Kind, str]]:
    """What is told of these deliveries, one after the other."""
    web = Protected("cd" * 32, "web", 2, 0, watch.container.config, 0.0, group="chain")
    found: list[tuple[Kind, str]] = []

    async def main() -> None:
        notifier = Notifier(lambda container, kind, detail: found.append((kind, detail)))
        for how in hows:
            watch.notify = how
            notifier.take(RESTORED, web, [watch])
        while len(found) < len(hows):
            await asyncio.sleep(0.01)
        await notifier.close()

    asyncio.run(asyncio.wait_for(main(), 10))
    return found


def test_one_that_can_not_be_delivered_takes_no_other_with_it(friend: Protected) -> None:
    pidfd = os.pidfd_open(friend.init_pid)
    try:
        watch = Listening(friend, pidfd, None)
        failed, delivered = told(watch, Notify(command=("no\0program",)), Notify(signal=signal.SIGCHLD))
    finally:
        os.close(pidfd)
    assert failed == (Kind.NOTIFY_FAILED, "web restored: ValueError: embedded null byte")
    assert delivered == (Kind.NOTIFIED, "notified of web by SIGCHLD")


def test_one_that_finds_no_descriptor_is_told_of(friend: Protected) -> None:
    watch = Listening(friend, -1, None)  # it cannot be duplicated
    assert told(watch, Notify(signal=signal.SIGCHLD)) == [
        (Kind.NOTIFY_FAILED, "web restored: the kernel said no (Bad file descriptor)")
    ]
