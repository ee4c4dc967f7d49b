# SPDX-License-Identifier: Apache-2.0
"""Reading the memory of generations is slow when memory is short; hooks and commands do not wait for it."""

from __future__ import annotations

import asyncio
import os
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from avckpt.containers.protected import Protected
from avckpt.engine import Guard
from avckpt.policy import settings_of
from avckpt.supervision import caretaker, pressure
from avckpt.supervision.caretaker import Caretaker

SLOW_S = 0.5


class Short:
    """A host that is short of memory, and says so all the time."""

    def __init__(self) -> None:
        self.fd, self._end = os.pipe()
        os.write(self._end, b"!")

    def is_high(self) -> bool:
        return True

    def close(self) -> None:
        os.close(self.fd)
        os.close(self._end)


@dataclass
class Ward:
    container: Protected
    pidfd: int = -1
    guard: Guard | None = None


def test_the_event_loop_goes_on_and_one_is_read_at_a_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    reading, most = [0], [0]

    def slow(app_pid: int, templates: object) -> int:
        reading[0] += 1
        most[0] = max(most[0], reading[0])
        time.sleep(SLOW_S)
        reading[0] -= 1
        return 1 << 30

    monkeypatch.setattr(caretaker, "HostPressure", Short)
    monkeypatch.setattr(pressure, "held_bytes", slow)
    settings = settings_of({})
    wards = [Ward(Protected(f"{n}" * 64, f"c{n}", n, os.getpid(), settings.config, 0.0)) for n in (1, 2)]

    async def main() -> float:
        care: Caretaker[Ward] = Caretaker(tmp_path, lambda ward, record: record)
        for ward in wards:
            ward.container.generations = 1
            care.begin(ward, settings.policy)
        care.start()
        longest_s, until = 0.0, time.monotonic() + 3 * SLOW_S
        while time.monotonic() < until:
            before = time.monotonic()
            await asyncio.sleep(0.01)
            longest_s = max(longest_s, time.monotonic() - before)
        await care.close()
        return longest_s

    assert asyncio.run(main()) < SLOW_S / 2
    assert most == [1]
