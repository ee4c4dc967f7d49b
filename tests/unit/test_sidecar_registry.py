# SPDX-License-Identifier: Apache-2.0
"""Finding a container by what users call it, and overlapping runs."""

from __future__ import annotations

import pytest
from avckpt.containers.protected import Protected
from avckpt.containers.registry import ENDED_KEPT, Registry
from avckpt.errors import Ambiguous, NoSuchContainer
from avckpt.guard import GuardConfig

CONFIG = GuardConfig(3.0, 2, True, True, frozenset(), 5, 60.0, 0.02)


def container(container_id: str, name: str, cookie: int) -> Protected:
    return Protected(
        id=container_id.ljust(64, "0"),
        name=name,
        cookie=cookie,
        init_pid=100 + cookie,
        config=CONFIG,
        registered_at=0.0,
    )


@pytest.fixture
def registry() -> Registry:
    registry = Registry()
    for number, (container_id, name) in enumerate([("abc1", "web"), ("abd2", "db"), ("cafe", "abd2")], 1):
        registry.add(container(container_id, name, number))
    return registry


@pytest.mark.parametrize(
    ("called", "cookie"),
    [("web", 1), ("abc", 1), ("abc1".ljust(64, "0"), 1), ("db", 2), ("c", 3), ("abd2", 3), ("abd20", 2)],
)
def test_name_wins_then_a_unique_prefix(registry: Registry, called: str, cookie: int) -> None:
    assert registry.find(called).cookie == cookie


@pytest.mark.parametrize("called", ["ab", "a"])
def test_a_prefix_of_two_is_ambiguous(registry: Registry, called: str) -> None:
    with pytest.raises(Ambiguous, match=r"abc100000000, abd200000000"):
        registry.find(called)


@pytest.mark.parametrize("called", ["we", "webb", "Web", "web "])
def test_a_name_that_is_mistyped(registry: Registry, called: str) -> None:
    with pytest.raises(NoSuchContainer, match=r"did you mean web\? See avckpt ps"):
        registry.find(called)


def test_a_node_that_is_named_without_its_container(registry: Registry) -> None:
    registry.add(container("dada", "car/lidar", 9))
    with pytest.raises(NoSuchContainer, match=r"did you mean car/lidar\? See avckpt ps"):
        registry.find("lidar")
    with pytest.raises(NoSuchContainer, match=r"avckpt\.enable=true"):
        registry.find("")


@pytest.mark.parametrize("called", ["", "ABC", "f", "lidar"])
def test_nobody_is_called_so(registry: Registry, called: str) -> None:
    with pytest.raises(NoSuchContainer, match=r"avckpt\.enable=true"):
        registry.find(called)


def test_one_that_has_ended_is_told_of(registry: Registry) -> None:
    web = registry.find("web")
    web.reason = "killed by SIGSEGV"
    registry.remove(web)
    for called in ("web", "abc"):
        with pytest.raises(NoSuchContainer, match="^web has ended: killed by SIGSEGV; avckpt events web tells"):
            registry.find(called)


def test_a_restarted_container_is_not_removed_with_its_old_run(registry: Registry) -> None:
    old = registry.find("web")
    new = container("abc1", "web", 10)
    registry.add(new)
    registry.remove(old)
    assert registry.find("web") is new
    assert registry.ended() == [old]


def test_ended_ones_are_kept_for_a_while_and_once(registry: Registry) -> None:
    web = registry.find("web")
    registry.remove(web)
    registry.remove(web)
    assert registry.ended() == [web]
    for cookie in range(100, 100 + ENDED_KEPT):
        other = container(f"f{cookie}", f"n{cookie}", cookie)
        registry.add(other)
        registry.remove(other)
    assert web not in registry.ended()
    assert len(registry.ended()) == ENDED_KEPT
