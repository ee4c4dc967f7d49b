# SPDX-License-Identifier: Apache-2.0
"""Waiting for podman-compose, with a program in its place that does as it does; and the verdicts on containers."""

from __future__ import annotations

import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from avckpt.cli.compose import podman_compose
from avckpt.cli.compose.podman_compose import Started
from avckpt.cli.compose.vehicle import judge, up
from avckpt.errors import AvckptError

from testkit.harness import wait_until


class Fake(podman_compose.Compose):
    """Runs a shell script instead of podman-compose."""

    def __init__(self, script: str) -> None:
        super().__init__([Path("v.yaml")])
        self._command = ["sh", "-c", script]


@pytest.fixture
def podman(tmp_path: Path) -> Path:
    """A command that, like `podman wait`, stays."""
    path = tmp_path / "podman"
    path.write_text("#!/bin/sh\nsleep 60\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(podman_compose, "STUCK_S", 0.5)
    monkeypatch.setattr(podman_compose, "UNHEALTHY_S", 2.0)
    monkeypatch.setattr(podman_compose, "LOOK_EVERY_S", 0.05)


def left_over(podman: Path) -> list[psutil.Process]:
    return [one for one in psutil.process_iter(["cmdline"]) if str(podman) in (one.info["cmdline"] or [])]


@pytest.mark.parametrize(
    ("waits", "words", "least_s"),
    [
        ("{0} wait --condition=running a b & {0} wait --condition=running b & wait", "a to become running, b to", 0.5),
        (
            "{0} wait --condition=running b & {0} wait --condition=healthy a & wait",
            "a to become healthy, b to become r",
            2.0,
        ),
    ],
)
def test_one_that_waits_in_vain_is_ended(podman: Path, waits: str, words: str, least_s: float) -> None:
    started = time.monotonic()
    with pytest.raises(AvckptError, match=f"it waited in vain for {words}"):
        Fake(waits.format(podman)).up([], lambda line: None)
    assert least_s <= time.monotonic() - started < 10
    # They were told to end, and podman-compose did: they may need a moment longer.
    wait_until(lambda: left_over(podman) == [], 5, "nobody waits any more")


def test_one_that_asks_in_vain_again_and_again_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it does for a container that does not exist: Podman says so at once, and is hardly ever seen."""
    monkeypatch.setattr(podman_compose, "STUCK_S", 2.0)
    ask = "subprocess.run(['true', 'wait', '--condition=running', 'a'])"
    asks = f"import subprocess, time\nwhile True: {ask}; time.sleep(1)"
    started = time.monotonic()
    with pytest.raises(AvckptError, match="it waited in vain for a "):
        Fake(f'exec {sys.executable} -c "{asks}"').up([], lambda line: None)
    assert 2 <= time.monotonic() - started < 10


@pytest.mark.parametrize("other", ["{0} pull image", "{0} wait --condition=stopped a", "{0} start a"])
def test_one_that_does_something_is_waited_for(podman: Path, other: str) -> None:
    script = f"{other} & O=$!; {{0}} wait --condition=running b & W=$!; sleep 1.2; kill $O $W; exit 0"
    Fake(script.format(podman)).up([], lambda line: None)


def test_what_it_says_is_passed_on_but_for_ids() -> None:
    said: list[str] = []
    Fake(f"echo {'ab' * 32}; echo it says >&2; sleep 0.3; echo and more; echo project_service_1").up([], said.append)
    assert said == ["it says", "and more"]
    with pytest.raises(AvckptError, match="^podman-compose up failed: and more$"):
        Fake("echo and more; echo project_service_1; exit 1").up([], said.append)


def test_a_warning_that_podman_repeats_is_said_once() -> None:
    said: list[str] = []
    lines = [f'time="2026-11-29T01:11:0{i}Z" level=warning msg="{what}"' for i, what in enumerate("aba")]
    Fake("; ".join(f"echo '{line}'" for line in lines)).up([], said.append)
    assert said == lines[:2]


def test_what_the_hooks_refuse_is_told_in_their_words(tmp_path: Path) -> None:
    said: list[str] = []
    why = "container c: label avckpt.interval=5: a duration needs a unit"
    failed = "executing [avckpt-hook precreate]: exit status 1"
    script = f"echo 'avckpt: {why}'; echo 'level=warning msg=\"precreate hook: {failed}\"'; echo 'Error: {failed}'"
    with pytest.raises(AvckptError) as failure:
        Fake(f"{script}; exit 125").up([], said.append)
    assert str(failure.value) == f"podman-compose up failed: {why}"
    assert said == [f"avckpt: {why}"]
    assert Fake(script).up([], said.append) == f"Error: {why}"


def test_a_question_that_fails_is_told_as_podman_composes() -> None:
    compose = podman_compose.Compose([Path("compose.yaml")])
    compose._command = [sys.executable, "-c", "raise SystemExit('ValueError: bad mount')", "podman_compose"]
    with pytest.raises(AvckptError, match="^compose.yaml: podman-compose ps failed: bad mount$"):
        compose.containers()


@pytest.mark.parametrize(
    ("last", "told"),
    [
        ("RuntimeError: missing networks: n", "v.yaml w.yaml: podman-compose up failed: missing networks: n"),
        ("TypeError: 'int' is no list", "v.yaml w.yaml: podman-compose up failed: TypeError: 'int' is no list"),
        ("Error: no such image", "podman-compose up failed: Error: no such image"),
    ],
)
def test_what_it_says_of_the_files_is_told_with_their_names(last: str, told: str) -> None:
    """An exception of its own is about them; what Podman says is not."""
    compose = podman_compose.Compose([Path("v.yaml"), Path("w.yaml")])
    compose._command = [sys.executable, "-c", f"raise SystemExit({last!r})"]
    with pytest.raises(AvckptError) as failure:
        compose.up([], lambda line: None)
    assert str(failure.value) == told


def test_a_job_that_is_done_is_no_reason_for_a_failure(tmp_path: Path) -> None:
    class Two(Fake):
        def containers(self) -> list[Started]:
            return [container(name="job", status="exited"), container(name="bad", status="exited", exit_code=3)]

        def services(self) -> list[str]:
            return ["s", "other"]

    with pytest.raises(AvckptError) as failure:
        up(Two("echo bad port; exit 1"), [], tmp_path, 0, lambda line: None)
    why = (
        "podman-compose up failed: bad port; bad has exited with status 3 (podman logs bad); without a container: other"
    )
    assert str(failure.value) == why


def test_a_traceback_is_its_last_line() -> None:
    said: list[str] = []
    program = "def f(): {}['a']\ntry:\n  f()\nexcept KeyError:\n  raise ValueError('no such thing')"
    with pytest.raises(AvckptError, match="^v.yaml: podman-compose up failed: no such thing$"):
        Fake(f'{sys.executable} -c "{program}"').up([], said.append)
    assert said == ["KeyError: 'a'", "ValueError: no such thing"]


def test_a_failure_is_told_by_its_last_words() -> None:
    with pytest.raises(AvckptError, match="^podman-compose down failed: no such file$"):
        Fake("echo no such file >&2; exit 4").down([], False, lambda line: None)
    with pytest.raises(AvckptError, match="exit status 4"):
        Fake("exit 4").down([], False, lambda line: None)


def test_a_service_without_a_container_is_a_failure_whatever_the_status(tmp_path: Path) -> None:
    class One(Fake):
        def containers(self) -> list[Started]:
            return [container(wanted=False)]

        def services(self) -> list[str]:
            return ["s", "idle"]

    refused = "Error: creating container storage: the container name c is already in use"
    with pytest.raises(AvckptError, match="^idle has no container: creating container storage: the container name c"):
        up(One(f"echo '{refused}'"), [], tmp_path, 0, lambda line: None)
    # Of no replicas nothing is said.
    assert [one.state for one in up(One("echo it goes well"), [], tmp_path, 0, lambda line: None)] == ["not asked for"]
    assert up(One(f"echo '{refused}'"), ["s"], tmp_path, 0, lambda line: None)


def test_podman_compose_is_there_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "podman_compose", "--version"], capture_output=True, text=True)
    assert "podman-compose version" in done.stdout


def container(**more: Any) -> Started:
    fields = {"id": "1", "name": "c", "service": "s", "status": "running", "exit_code": 0, "error": "", "wanted": True}
    fields["command"] = "/usr/libexec/avckpt-init"
    return Started(**{**fields, **more})


@pytest.mark.parametrize(
    ("started", "entry", "protected", "may_change", "why"),
    [
        (container(), {"state": "protected", "reason": ""}, True, False, ""),
        (container(), {"state": "starting", "reason": "no checkpoint yet"}, False, True, "no checkpoint yet"),
        (container(), {"state": "unprotected", "reason": "io_uring"}, False, True, "io_uring"),
        (container(), {"state": "restoring", "reason": ""}, False, True, "restoring"),
        (container(), None, False, True, "the sidecar does not know it"),
        (container(command="/init"), None, False, False, "its command is /init, which must itself be PID 1"),
        (container(wanted=False), None, False, False, ""),
        (container(status="exited", exit_code=7), None, False, False, "it has exited with status 7"),
        (
            container(status="created", error="no such image"),
            None,
            False,
            False,
            "it did not start and is created: no ",
        ),
    ],
)
def test_verdicts(started: Started, entry: Any, protected: bool, may_change: bool, why: str) -> None:
    verdict = judge(started, entry)
    assert (verdict.protected, verdict.may_change) == (protected, may_change)
    assert verdict.why.startswith(why)
    assert bool(verdict.why) == bool(why)


@pytest.mark.parametrize(
    ("labels", "annotations", "wanted"),
    [
        ({"avckpt.enable": "True"}, None, True),
        (None, {"avckpt.enable": "true", "avckpt.name": "c"}, True),
        ({"avckpt.enable": "false"}, {}, False),
        ({"avckpt.interval": "1s"}, {}, False),
        ({"avckpt.enable": "maybe"}, {}, True),
    ],
)
def test_who_wants_protection(labels: Any, annotations: Any, wanted: bool) -> None:
    state = {"Status": "running", "ExitCode": 0}
    config = {"Labels": labels, "Annotations": annotations}
    assert podman_compose._started({"Id": "1", "Name": "c", "Config": config, "State": state}).wanted is wanted
