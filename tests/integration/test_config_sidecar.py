# SPDX-License-Identifier: Apache-2.0
"""A real sidecar daemon and its configuration file."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from testkit.harness import take_checkpoint, wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="PID namespaces and ptrace need root"),
    pytest.mark.shared_machine("a daemon is given a time to start, to protect and to read its configuration again"),
]

NAP = [sys.executable, "-c", "import time\nwhile True: time.sleep(0.1)"]
ENABLE = {"avckpt.enable": "true"}


@pytest.fixture
def sidecar(tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as made:
        yield made


def kinds(sidecar: LocalSidecar, name: str) -> list[str]:
    """The kinds of the container's events so far, from the history."""
    return [event["kind"] for event in sidecar.client.history() if event["container"] == name]


def kill_and_wait(sidecar: LocalSidecar, container: Container, restores: int) -> dict[str, object]:
    """Kills the application; its row of `avckpt ps` once it has been restored that many times."""
    os.kill(container.app_pid, signal.SIGKILL)
    return sidecar.wait_for(container, restores=restores, state="protected")


def test_it_holds_for_containers_that_start_and_labels_win(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults: {interval: 200ms, keep: 3}\nnames: {quick*: {interval: 100ms}}\n")
    sidecar.start()
    asked = [("plain", ENABLE), ("quick-1", ENABLE), ("own", {**ENABLE, "avckpt.interval": "150ms"})]
    rows = [
        sidecar.wait_for(sidecar.protected(name, NAP, labels), state="protected", generations=3)
        for name, labels in asked
    ]
    assert [(row["interval_s"], row["keep"]) for row in rows] == [(0.2, 3), (0.1, 3), (0.15, 3)]


def test_a_new_one_holds_for_running_containers_and_takes_nothing_from_them(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults: {interval: 1h, keep: 3}\n")
    sidecar.start()
    plain = sidecar.protected("plain", NAP, ENABLE)
    own = sidecar.protected("own", NAP, {**ENABLE, "avckpt.interval": "30m", "avckpt.keep": "3"})
    first, of_own = (take_checkpoint(sidecar.client, name) for name in ("plain", "own"))
    assert kill_and_wait(sidecar, plain, 1)["generation"] == first

    sidecar.config.write_text("defaults: {interval: 100ms, keep: 2, restore.on: 'signal,3'}\n")
    said = sidecar.avckpt("reload").stdout.splitlines()
    assert said == [
        f"{sidecar.config}: in force",
        "plain: interval 1h -> 100ms, keep 3 -> 2, restore.on signal,exit -> signal,3",
        "own: restore.on signal,exit -> signal,3",
    ]
    # What was held stays until checkpoints at the new interval take its place.
    row = sidecar.row(plain)
    assert (row["state"], row["restores"], row["interval_s"], row["keep"]) == ("protected", 1, 0.1, 2)
    assert row["generations"] >= 1
    wait_until(lambda: sidecar.row(plain)["generation"] >= first + 3, 10, "it is checkpointed at the new interval")
    assert sidecar.row(plain)["generations"] == 2
    assert sidecar.row(own)["generation"] == of_own  # its label has won
    assert "configured" in kinds(sidecar, "plain")
    assert not {"unprotected", "dropped"} & set(kinds(sidecar, "plain"))
    assert kill_and_wait(sidecar, plain, 2)["last_death"] == "killed by SIGKILL"
    assert sidecar.avckpt("reload").stdout.splitlines()[1:] == ["it changes nothing for the containers that run"]


def test_more_generations_for_a_running_container(sidecar: LocalSidecar) -> None:
    """They need more room than the guard has mapped in the application."""
    sidecar.config.write_text("defaults: {interval: 100ms, keep: 1}\n")
    sidecar.start()
    plain = sidecar.protected("plain", NAP, ENABLE)
    sidecar.wait_for(plain, state="protected", generations=1)
    sidecar.config.write_text("defaults: {interval: 100ms, keep: 9}\n")
    assert sidecar.avckpt("reload").stdout.splitlines()[1:] == ["plain: keep 1 -> 9"]
    sidecar.wait_for(plain, state="protected", generations=9)
    for restores in (1, 2, 3):
        kill_and_wait(sidecar, plain, restores)
    sidecar.wait_for(plain, generations=9)
    assert "unprotected" not in kinds(sidecar, "plain")


def test_ends_are_judged_by_the_new_one(sidecar: LocalSidecar, tmp_path: Path) -> None:
    end = tmp_path / "end"
    program = f"import os, sys, time\nwhile not os.path.exists({str(end)!r}): time.sleep(0.05)\nsys.exit(3)"
    sidecar.config.write_text("defaults: {interval: 100ms}\n")
    sidecar.start()
    made = sidecar.protected("exits", [sys.executable, "-c", program], ENABLE)
    sidecar.wait_for(made, state="protected")
    sidecar.config.write_text("defaults: {interval: 100ms, restore.on: signal}\n")
    assert "exits: restore.on signal,exit -> signal" in sidecar.avckpt("reload").stdout
    end.touch()
    assert made.status(60) == 3
    assert sidecar.row(made, ended=True)["restores"] == 0


def test_one_that_its_labels_contradict_is_named_and_goes_on(sidecar: LocalSidecar) -> None:
    sidecar.start()
    made = sidecar.protected("single", NAP, {**ENABLE, "avckpt.interval": "100ms", "avckpt.keep": "1"})
    sidecar.wait_for(made, state="protected")
    sidecar.config.write_text("defaults: {restore.on: 'signal,unhealthy'}\n")
    said = sidecar.avckpt("reload").stdout.splitlines()
    assert said[1].startswith("single: goes on as before: label avckpt.keep=1: too few for avckpt.restore.on=unhealthy")
    assert sidecar.row(made)["state"] == "protected"
    assert kill_and_wait(sidecar, made, 1)
    # One that starts is not left alone for that: its labels alone hold.
    again = sidecar.protected("single-2", NAP, {**ENABLE, "avckpt.interval": "100ms", "avckpt.keep": "1"})
    sidecar.wait_for(again, state="protected")
    assert f"single-2: {sidecar.config} does not hold for it: label avckpt.keep=1" in sidecar.log


def test_a_group_and_who_is_told(sidecar: LocalSidecar, tmp_path: Path) -> None:
    told = tmp_path / "told"
    sidecar.config.write_text("defaults: {interval: 100ms}\n")
    sidecar.start()
    one, other = (sidecar.protected(name, NAP, ENABLE) for name in ("one", "other"))
    for each in (one, other):
        sidecar.wait_for(each, state="protected")
    sidecar.config.write_text(
        "defaults: {interval: 100ms, group: cars}\n"
        f"names:\n  other: {{notify: \"exec:sh -c 'echo $AVCKPT_CONTAINER >>{told}'\"}}\n"
    )
    assert "one: group none -> cars" in sidecar.avckpt("reload").stdout
    kill_and_wait(sidecar, one, 1)
    wait_until(lambda: told.exists() and told.read_text() == "one\n", 10, "the other one was told")
    # Without a file everything is as the labels say.
    sidecar.config.unlink()
    said = sidecar.avckpt("reload").stdout
    assert f"{sidecar.config}: not there, the built-in defaults hold" in said
    assert sidecar.row(one)["group"] == ""


def test_a_broken_one_is_refused_and_the_old_one_stays(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults: {interval: 200ms}\n")
    sidecar.start()
    sidecar.config.write_text("defaults:\n  interval: 200ms\n  kep: 3\n")
    refused = sidecar.avckpt("reload", check=False)
    assert refused.status == 1
    assert refused.stderr.startswith(f"avckpt: {sidecar.config}:3: defaults.kep: unknown key; did you mean keep?")
    doctor = json.loads(sidecar.avckpt("doctor", "--json", check=False).stdout)
    found = next(check for check in doctor if check["name"] == "config")
    assert found["status"] == "warn"
    assert f"{sidecar.config}:3: defaults.kep" in found["detail"]
    assert found["remedy"] == "mend it, then run: sudo avckpt reload"
    first = sidecar.protected("first", NAP, ENABLE)
    assert sidecar.wait_for(first, state="protected")["interval_s"] == 0.2

    assert sidecar.process is not None
    sidecar.process.send_signal(signal.SIGHUP)
    wait_until(lambda: "the new configuration was refused" in sidecar.log, 5, "the signal is answered in the log")
    sidecar.config.write_text("defaults: {interval: 300ms}\n")
    sidecar.process.send_signal(signal.SIGHUP)
    wait_until(lambda: "first: new settings: interval 200ms -> 300ms" in sidecar.log, 5, "the mended file is taken")
    assert sidecar.row(first)["interval_s"] == 0.3
    answer = json.loads(sidecar.avckpt("reload", "--json").stdout)
    assert answer["containers"] == []
    assert answer["config"]["problem"] == ""
    doctor = json.loads(sidecar.avckpt("doctor", "--json", check=False).stdout)
    assert next(check for check in doctor if check["name"] == "config")["status"] == "ok"


def test_a_sidecar_that_starts_with_a_broken_one_protects_all_the_same(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults:\n  interval: soon\n")
    sidecar.start()
    assert f"the built-in defaults hold: {sidecar.config}:2: defaults.interval: soon" in sidecar.log
    made = sidecar.protected("node", NAP, ENABLE)
    assert sidecar.wait_for(made, state="protected")["automatic"]


SENDER = """
import socket, time
to = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
to.bind(("127.0.0.1", 0))
while True:
    to.sendto(b"x", to.getsockname())
    to.recv(64)
    time.sleep(0.02)
"""


def test_guards_that_choose_their_interval_share_what_all_may_use(sidecar: LocalSidecar) -> None:
    """A checkpoint uses at least half a millisecond: at 0.1 % of a CPU, for both, there is less than one a second."""
    sidecar.config.write_text("sidecar: {budget.cpu: 0.1%}\n")
    sidecar.start()
    auto = {**ENABLE, "avckpt.interval": "auto"}
    for name in ("one", "two"):
        sidecar.protected(name, [sys.executable, "-S", "-c", SENDER], auto)

    def spaced(bound: Callable[[float], bool]) -> bool:
        return all(row["checkpoints"] > 2 and bound(row["interval_s"]) for row in sidecar.ps())

    wait_until(lambda: spaced(lambda s: s > 0.9), 30, "the total holds both back", every_s=0.1)
    sidecar.config.write_text("sidecar: {budget.cpu: 100%}\n")
    sidecar.avckpt("reload")
    wait_until(lambda: spaced(lambda s: s < 0.9), 30, "each has its own", every_s=0.1)
