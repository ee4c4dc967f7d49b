# SPDX-License-Identifier: Apache-2.0
"""Reading a process that does not answer waits a second; nothing else waits for that."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from avckpt.api.server import ApiServer, Backend
from avckpt.cli.client import Client
from avckpt.containers import looks
from avckpt.containers.looks import in_own_thread, look
from avckpt.containers.protected import Protected
from avckpt.containers.registry import Registry
from avckpt.errors import DeadlineMissed
from avckpt.events.metrics import Metrics
from avckpt.policy import settings_of
from avckpt.supervision import pressure
from avckpt.supervision.pressure import held_by


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """What is looked at comes when this is set."""
    monkeypatch.setattr(looks, "WAIT_S", 0.2)
    event = threading.Event()
    yield event
    event.set()


def test_one_that_hangs_costs_others_nothing(stuck: threading.Event) -> None:
    async def main() -> None:
        hanging = [look("memory", 1, stuck.wait) for _ in range(100)]
        outcomes = await asyncio.gather(*hanging, return_exceptions=True)
        assert all(isinstance(outcome, DeadlineMissed) for outcome in outcomes)
        started = time.monotonic()
        with pytest.raises(DeadlineMissed):
            await look("memory", 1, stuck.wait)
        assert await look("memory", 2, lambda: 7) == 7
        assert await look("environment", 1, lambda: 8) == 8
        assert await in_own_thread(lambda: 9) == 9
        assert time.monotonic() - started < 0.15
        while threading.active_count() > before + 1:  # the one that hangs
            await asyncio.sleep(0.01)
        stuck.set()
        while threading.active_count() > before:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.01)
        assert await look("memory", 1, lambda: 10) == 10

    before = threading.active_count()
    asyncio.run(main())


def test_what_is_raised_is_raised_to_who_asked() -> None:
    def fail() -> int:
        raise FileNotFoundError("gone")

    async def main() -> None:
        with pytest.raises(FileNotFoundError):
            await look("memory", 1, fail)
        with pytest.raises(FileNotFoundError):
            await in_own_thread(fail)

    asyncio.run(main())


def test_a_scrape_waits_once_for_all_that_hang(
    stuck: threading.Event, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """And has the rest of what it knows of them."""

    def slow(app_pid: int, templates: object) -> int:
        if app_pid < 10:
            stuck.wait()
        return 123

    monkeypatch.setattr(pressure, "held_bytes", slow)
    registry = Registry()
    for number in range(1, 13):
        container = Protected(f"{number:064}", f"web{number}", number, number, settings_of({}).config, 0.0)
        container.generations, container.app_pid = 2, number
        registry.add(container)
    backend = cast("Backend", SimpleNamespace(registry=registry, metrics=Metrics("1.0", "1.0")))

    async def main() -> None:
        server = ApiServer(backend, tmp_path / "api.sock")
        await server.start()
        client = Client(tmp_path)
        started = time.monotonic()
        text = await in_own_thread(client.metrics)
        rows = await in_own_thread(client.containers)
        took_s = time.monotonic() - started
        await server.close()
        measured = re.findall(r'^avckpt_generations_memory_bytes\{container="(\w+)"', text, re.M)
        assert measured == ["web10", "web11", "web12"]
        assert text.count("avckpt_generations{") == len(rows) == 12
        assert took_s < 6 * looks.WAIT_S

    asyncio.run(main())


def test_what_comes_late_counts_at_the_next_look(stuck: threading.Event, monkeypatch: pytest.MonkeyPatch) -> None:
    def slow(app_pid: int, templates: object) -> int:
        stuck.wait()
        return 123

    monkeypatch.setattr(pressure, "held_bytes", slow)
    container = Protected("1" * 64, "web", 1, 1, settings_of({}).config, 0.0)
    container.generations = 2
    container.memory_bytes = 5

    async def main() -> None:
        assert await held_by(container) == 5
        stuck.set()
        while container.memory_bytes != 123:
            await asyncio.sleep(0.01)

    asyncio.run(main())
