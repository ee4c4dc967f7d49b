# SPDX-License-Identifier: Apache-2.0
"""What a health check is, and when an application is unhealthy."""

from __future__ import annotations

import asyncio
import os
import resource
import subprocess
import time
from types import SimpleNamespace

import pytest
from avckpt.containers.process import age_s
from avckpt.containers.protected import Protected
from avckpt.events.record import EventRecord
from avckpt.guard import GuardConfig
from avckpt.supervision.health import HealthCheck, Pulse, _Watcher, describe, health_check_of
from avckpt.supervision.inside import Done

S = 1_000_000_000


def test_as_podman_inspect_has_it() -> None:
    found = health_check_of(
        {"Test": ["CMD-SHELL", "test -e /x"], "StartPeriod": 3 * S, "Interval": 2 * S, "Timeout": S, "Retries": 2}
    )
    assert found == HealthCheck(("/bin/sh", "-c", "test -e /x"), 2.0, 1.0, 2, 3.0)


@pytest.mark.parametrize(
    ("test", "command"),
    [
        (["CMD", "curl", "-f", "localhost"], ("curl", "-f", "localhost")),
        (["curl", "-f"], ("curl", "-f")),
        (["CMD-SHELL", "a || b"], ("/bin/sh", "-c", "a || b")),
    ],
)
def test_commands(test: list[str], command: tuple[str, ...]) -> None:
    found = health_check_of({"Test": test, "Interval": 30 * S})
    assert found is not None
    assert found.command == command
    assert (found.interval_s, found.timeout_s, found.retries, found.start_period_s) == (30, 30, 3, 0)


def test_without_an_interval_it_is_switched_off() -> None:
    """As Podman shows `--health-interval=disable`."""
    found = health_check_of({"Test": ["CMD-SHELL", "true"], "Timeout": 30 * S, "Retries": 3})
    assert found is not None
    assert found.interval_s == 0


@pytest.mark.parametrize("nothing", [None, {}, {"Test": ["NONE"]}, {"Test": []}, {"Test": ["CMD"]}])
def test_none(nothing: object) -> None:
    assert health_check_of(nothing) is None


@pytest.mark.parametrize(
    "wrong",
    [
        "x",
        {"Test": "true"},
        {"Test": ["CMD", 1]},
        {"Test": ["a", "b"], "Interval": "1s"},
        {"Test": ["a", "b"], "Retries": -1},
    ],
)
def test_what_is_no_health_check(wrong: object) -> None:
    with pytest.raises(ValueError):
        health_check_of(wrong)


def pulse(**changes: float) -> Pulse:
    return Pulse(HealthCheck(("true",), 1.0, **{"retries": 3, **changes}))  # type: ignore[arg-type]


def test_so_many_failures_in_a_row() -> None:
    counting = pulse()
    said = [counting.take(healthy, 100.0) for healthy in (False, False, True, False, False, False, False)]
    assert said == [False, False, False, False, False, True, False]


def test_failures_within_the_start_period_do_not_count_until_one_has_passed() -> None:
    counting = pulse(retries=1, start_period_s=10.0)
    assert not counting.take(False, 9.9)
    assert counting.take(False, 10.1)
    counting = pulse(retries=1, start_period_s=10.0)
    assert not counting.take(True, 1.0)
    assert counting.take(False, 2.0)


def test_with_a_startup_check_nothing_counts_until_one_has_passed() -> None:
    counting = pulse(retries=1, has_startup_check=True)
    assert not counting.take(False, 1000.0)
    assert not counting.take(True, 1001.0)
    assert counting.take(False, 1002.0)


def test_the_age_of_a_process_does_not_depend_on_the_time_of_day(monkeypatch: pytest.MonkeyPatch) -> None:
    with subprocess.Popen(["sleep", "60"]) as process:
        time.sleep(0.2)
        monkeypatch.setattr(time, "time", lambda: 0.0)
        assert 0.1 < age_s(process.pid) < 10
        assert age_s(os.getpid()) > age_s(process.pid)
        process.kill()


def test_descriptors_that_run_out_do_not_end_the_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    told: list[EventRecord] = []

    async def run(watcher: _Watcher) -> Done:
        with open("/dev/null") as file:
            resource.setrlimit(resource.RLIMIT_NOFILE, (file.fileno(), limits[1]))
        return Done(1, False, "", 0.1)

    def tell(record: EventRecord) -> EventRecord:
        told.append(record)
        return record

    config = GuardConfig(3.0, 3, True, True, frozenset(), 5, 60.0, 0.02)
    me = os.getpid()
    container = Protected(id="ab" * 32, name="web", cookie=1, init_pid=me, app_pid=me, config=config, registered_at=0.0)
    monkeypatch.setattr(_Watcher, "_run", run)
    watcher = _Watcher(SimpleNamespace(container=container, pidfd=-1, guard=None), tell, pulse(retries=1))
    loop = asyncio.new_event_loop()
    try:
        loop.run_until_complete(watcher.look())
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        loop.close()
    (record,) = told
    assert "Too many open files" in record.message


def test_how_it_failed_in_words() -> None:
    check = HealthCheck(("true",), 1.0, timeout_s=1.5)
    assert describe(Done(137, True, "", 1.5), check) == "no answer within 1.5 s"
    assert describe(Done(7, False, "curl: (7)\n  refused" + "x" * 500, 0.1), check).startswith(
        "status 7: curl: (7) refused"
    )
    assert len(describe(Done(7, False, "x" * 500, 0.1), check)) < 140
    assert describe(Done(7, False, "all\nwell\x1b[2K\x7f\x9b2K", 0.1), check) == r"status 7: all well\x1b[2K\x7f\x9b2K"
