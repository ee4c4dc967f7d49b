# SPDX-License-Identifier: Apache-2.0
"""The harness itself: the other tests rely on it."""

from __future__ import annotations

import subprocess
import time

import pytest

from testkit.harness import CommandFailed, Completed, ContainerFactory, Podman, run, wait_until


def test_run_gives_back_all_of_it() -> None:
    done = run(["sh", "-c", "cat; echo oops >&2; exit 3"], stdin="hello", check=False)
    assert (done.status, done.stdout, done.stderr) == (3, "hello", "oops\n")


def test_run_says_what_failed() -> None:
    with pytest.raises(CommandFailed, match="ended with 3 .*oops"):
        run(["sh", "-c", "echo oops >&2; exit 3"])


def test_run_does_not_wait_for_grandchildren() -> None:
    started = time.monotonic()
    run(["sh", "-c", "sleep 5 & echo started"])
    assert time.monotonic() - started < 3


def test_run_has_a_deadline() -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        run(["sleep", "30"], timeout_s=0.2)


def test_wait_until_says_what_it_waited_for() -> None:
    with pytest.raises(TimeoutError, match="a miracle"):
        wait_until(lambda: False, 0.1, "a miracle")


def test_containers_are_removed(podman: Podman, base_image: str) -> None:
    factory = ContainerFactory(podman, "avckpt-test-removed")
    made = factory("sleep", "60")
    assert made.status == "running"
    assert made.exec("echo", "inside").stdout == "inside\n"
    factory.close()
    assert not podman.exists(made.name)


def test_a_container_that_never_started_is_removed(podman: Podman, base_image: str) -> None:
    factory = ContainerFactory(podman, "avckpt-test-refused")
    with pytest.raises(CommandFailed) as failure:
        factory("/no/such/program")
    assert isinstance(failure.value.completed, Completed)
    assert podman.exists(factory.made[0].name)
    name = factory.made[0].name
    factory.close()
    assert not podman.exists(name)


def test_logs_and_status(container: ContainerFactory) -> None:
    made = container("sh", "-c", "echo out; echo err >&2; exit 7")
    assert made.wait() == 7
    assert sorted(made.logs().split()) == ["err", "out"]
    assert (made.status, made.exit_code) == ("exited", 7)
