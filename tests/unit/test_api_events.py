# SPDX-License-Identifier: Apache-2.0
"""The API's stream of events, without a daemon."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from avckpt.api import server
from avckpt.api.server import ApiServer, Backend
from avckpt.events.feed import Feed
from avckpt.events.history import History
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind


def test_a_stream_says_something_even_if_all_that_happens_is_routine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint each moment, which nobody has asked to hear of, must not look like a sidecar that hangs."""
    monkeypatch.setattr(server, "KEEP_ALIVE_S", 0.3)
    backend: Any = SimpleNamespace(feed=Feed(), history=History(tmp_path / "history.jsonl"))

    async def routine() -> None:
        while True:
            backend.feed.publish(EventRecord(Kind.CHECKPOINT))
            await asyncio.sleep(0.05)

    async def follow() -> list[bytes]:
        api = ApiServer(cast("Backend", backend), tmp_path / "api.sock")
        await api.start()
        checkpoints = asyncio.ensure_future(routine())
        reader, writer = await asyncio.open_unix_connection(str(tmp_path / "api.sock"))
        writer.write(b"GET /v1/events HTTP/1.0\r\n\r\n")
        said: list[bytes] = []
        with contextlib.suppress(asyncio.TimeoutError):
            while len([line for line in said if line.startswith(b":")]) < 2:
                said.append(await asyncio.wait_for(reader.readline(), 5))
        checkpoints.cancel()
        writer.close()
        await api.close()
        return said

    said = asyncio.run(follow())
    assert [line for line in said if line.startswith(b":")] == [b": nothing new\n"] * 2
    assert not any(b"checkpoint" in line for line in said)
