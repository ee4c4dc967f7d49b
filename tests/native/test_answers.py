# SPDX-License-Identifier: Apache-2.0
"""With default labels no client gets the answer to another request.

`python -m testkit.answers` asks 20,000 requests of each server (results in docs/fidelity.md).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from testkit.answers.servers import SERVERS, missing
from testkit.answers.trial import run

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; clients have time limits of their own"
)

REQUESTS = 1000
KILLS = 3


@pytest.fixture(autouse=True)
def built(init_built: None) -> None:
    """avckpt-init."""


@pytest.mark.timeout(300)
@pytest.mark.parametrize("server", SERVERS)
def test_every_answer_is_its_requests_own(server: str, tmp_path: Path) -> None:
    """Clients keep their connections while the server is killed at random moments."""
    if why := missing(server):
        pytest.skip(why)
    outcome = run(server, REQUESTS, tmp_path)
    assert outcome.wrong == []
    assert outcome.kills >= KILLS
    assert outcome.silent == 0  # nobody waits for what was forgotten


@pytest.mark.timeout(300)
def test_kept_connections_give_wrong_answers(tmp_path: Path) -> None:
    """Shows that the test above would fail if connections were simply kept."""
    assert run("prefork", 20 * REQUESTS, tmp_path, {"avckpt.tcp": "keep"}).wrong != []
