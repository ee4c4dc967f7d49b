# SPDX-License-Identifier: Apache-2.0
"""How many core files stay, how large and how old."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from avckpt.evidence import cores
from avckpt.evidence.cores import KEPT_BYTES, KEPT_OF_EACH, KEPT_S, SUFFIX, Cores


@pytest.fixture(autouse=True)
def free(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Says how much is free beside the files."""

    def say(size: int) -> None:
        monkeypatch.setattr(cores, "_free_bytes", lambda _: size, raising=False)

    say(10 * KEPT_BYTES)
    return say


def core(folder: Path, name: str, age_s: float, size: int = 1000) -> Path:
    """A file with a hole of that size."""
    path = folder / f"{name}.{int(age_s)}{SUFFIX}"
    path.touch()
    os.truncate(path, size)
    os.utime(path, (time.time() - age_s,) * 2)
    return path


def left(folder: Path, newest: Path) -> set[str]:
    """What is there when the newest, of `web`, has been written."""
    Cores(folder).prune("web", newest)
    return {path.name[: -len(SUFFIX)] for path in folder.iterdir()}


def test_the_oldest_of_a_container_make_way(tmp_path: Path) -> None:
    for age in range(1, KEPT_OF_EACH + 3):
        core(tmp_path, "web", age)
        core(tmp_path, "other", age)
    found = left(tmp_path, core(tmp_path, "web", 0))
    assert {name for name in found if name.startswith("web.")} == {f"web.{age}" for age in range(KEPT_OF_EACH)}
    assert len(found) == KEPT_OF_EACH + KEPT_OF_EACH + 2


def test_all_together_are_bounded(tmp_path: Path) -> None:
    for age in (1, 2, 3):
        core(tmp_path, f"c{age}", age, KEPT_BYTES // 3)
    assert left(tmp_path, core(tmp_path, "web", 0, KEPT_BYTES // 3)) == {"web.0", "c1.1", "c2.2"}


def test_half_of_what_is_free_is_left_to_others(tmp_path: Path, free: Callable[[int], None]) -> None:
    for age in (1, 2, 3):
        core(tmp_path, f"c{age}", age, 1000)
    free(2000)
    assert left(tmp_path, core(tmp_path, "web", 0, 1000)) == {"web.0", "c1.1", "c2.2"}
    free(0)
    assert left(tmp_path, core(tmp_path, "web", 0, 1000)) == {"web.0"}


def test_one_container_has_at_most_half_of_the_room(tmp_path: Path) -> None:
    core(tmp_path, "other", 5, KEPT_BYTES // 3)
    for age in (1, 2, 3):
        core(tmp_path, "web", age, KEPT_BYTES // 5)
    assert left(tmp_path, core(tmp_path, "web", 0, KEPT_BYTES // 5)) == {"web.0", "web.1", "other.5"}


def test_a_clock_that_is_set_makes_none_older(tmp_path: Path) -> None:
    """Of a vehicle that crashes before it knows the time of day; then the first core is from decades ago."""
    folder = Cores(tmp_path)
    first = core(tmp_path, "web", 0)
    folder.prune("web", first)
    os.utime(first, (time.time() - 20 * 365 * 86400,) * 2)
    folder.prune("web", core(tmp_path, "web", 1))
    assert first.exists()


def test_old_ones_go(tmp_path: Path) -> None:
    core(tmp_path, "other", KEPT_S - 100)
    core(tmp_path, "other", KEPT_S + 100)
    assert left(tmp_path, core(tmp_path, "web", 0)) == {"web.0", f"other.{int(KEPT_S) - 100}"}


def test_the_newest_stays(tmp_path: Path) -> None:
    assert left(tmp_path, core(tmp_path, "web", 0, KEPT_BYTES + 1)) == {"web.0"}
