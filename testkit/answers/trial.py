# SPDX-License-Identifier: Apache-2.0
"""A server that is killed at random moments while clients ask it."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from avckpt.policy import settings_of

from testkit.answers.clients import Clients
from testkit.answers.servers import SERVERS, backend, wait_answers
from testkit.guarded import GuardProcess
from testkit.harness import app_pid, free_port, wait_until
from testkit.init_peer import Init

OFTEN = {"avckpt.interval": "100ms", "avckpt.restore.max": "64/1s"}
"""What the defaults are changed in: more of the same."""
KILL_AFTER_S = (0.0, 0.25)


@dataclass(frozen=True)
class Outcome:
    """What the clients of one server met."""

    server: str
    kills: int
    asked: int
    answered: int
    closed: int
    silent: int
    wrong: list[str]


def run(server: str, requests: int, folder: Path, labels: Mapping[str, str] | None = None, seed: int = 1) -> Outcome:
    """Kills the main process again and again until there are so many answers, or a wrong one."""
    rng = random.Random(seed)
    config = settings_of({**OFTEN, **(labels or {})}).config
    port, kills = free_port(), 0
    with (
        backend() as behind,
        (folder / "said").open("wb") as said,
        Init(SERVERS[server](folder, port, behind), pid1=True, stdout=said.fileno(), stderr=subprocess.STDOUT) as init,
        GuardProcess(config, [init.pid]) as guard,
    ):
        wait_answers(port)
        with Clients(port) as clients:
            clients.wait_answered(10)
            while clients.answered < requests and not clients.wrong:
                since = guard.mark()
                guard.wait("checkpoint", since=since)
                time.sleep(rng.uniform(*KILL_AFTER_S))
                since = guard.mark()
                pid = wait_until(lambda: _app(init), 10, "the server is there", every_s=0.002)
                os.kill(pid, signal.SIGKILL)
                guard.wait("restored", since=since)
                kills += 1
                # What came wrong after the restore has to be heard; and some are to be served by it.
                clients.wait_answered(min(requests, clients.answered + 10))
    return Outcome(server, kills, clients.asked, clients.answered, clients.closed, clients.silent, list(clients.wrong))


def _app(init: Init) -> int:
    try:
        return app_pid(init.pid)
    except LookupError:
        return 0
