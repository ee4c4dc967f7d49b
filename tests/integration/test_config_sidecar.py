# SPDX-License-Identifier: Apache-2.0
"""A real sidecar daemon and its configuration file."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from harness import wait_until
from local_sidecar import LocalSidecar, local_sidecar

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="PID namespaces and ptrace need root")

NAP = [sys.executable, "-c", "import time\nwhile True: time.sleep(0.1)"]
ENABLE = {"avckpt.enable": "true"}


@pytest.fixture
def sidecar(tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as made:
        yield made


def test_it_holds_for_containers_that_start_and_labels_win(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults: {interval: 200ms, keep: 3}\nnames: {quick*: {interval: 100ms}}\n")
    sidecar.start()
    asked = [("plain", ENABLE), ("quick-1", ENABLE), ("own", {**ENABLE, "avckpt.interval": "150ms"})]
    rows = [
        sidecar.wait_for(sidecar.protected(name, NAP, labels), state="protected", generations=3)
        for name, labels in asked
    ]
    assert [(row["interval_s"], row["keep"]) for row in rows] == [(0.2, 3), (0.1, 3), (0.15, 3)]

    sidecar.config.write_text("defaults: {interval: 400ms, keep: 3}\nnames: {quick*: {interval: 100ms}}\n")
    said = sidecar.avckpt("reload").stdout
    assert "in force" in said
    # Who is affected goes on as before, and is named; who is not, is not.
    assert said.splitlines()[1].endswith("go on as before: plain")
    assert sidecar.row(sidecar.containers[0])["interval_s"] == 0.2
    again = sidecar.protected("plain-2", NAP, ENABLE)
    assert sidecar.wait_for(again, state="protected")["interval_s"] == 0.4
    # A sidecar that starts anew adopts by the new one.
    sidecar.stop()
    sidecar.start()
    assert sidecar.wait_for(sidecar.containers[0], state="protected")["interval_s"] == 0.4


def test_a_broken_one_is_refused_and_the_old_one_stays(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults: {interval: 200ms}\n")
    sidecar.start()
    sidecar.config.write_text("defaults:\n  interval: 200ms\n  kep: 3\n")
    refused = sidecar.avckpt("reload", check=False)
    assert refused.status == 1
    assert refused.stderr.startswith(f"avckpt: {sidecar.config}:3: defaults.kep: unknown key; did you mean keep?")
    first = sidecar.protected("first", NAP, ENABLE)
    assert sidecar.wait_for(first, state="protected")["interval_s"] == 0.2

    assert sidecar.process is not None
    sidecar.process.send_signal(signal.SIGHUP)
    wait_until(lambda: "the new configuration was refused" in sidecar.log, 5, "the signal is answered in the log")
    sidecar.config.write_text("defaults: {interval: 300ms}\n")
    sidecar.process.send_signal(signal.SIGHUP)
    wait_until(lambda: "config.yaml was read" in sidecar.log, 5, "the mended file is taken")
    second = sidecar.protected("second", NAP, ENABLE)
    assert sidecar.wait_for(second, state="protected")["interval_s"] == 0.3
    answer = json.loads(sidecar.avckpt("reload", "--json").stdout)
    assert answer["unchanged"] == ["first"]
    assert answer["config"]["problem"] == ""


def test_a_sidecar_that_starts_with_a_broken_one_protects_all_the_same(sidecar: LocalSidecar) -> None:
    sidecar.config.write_text("defaults:\n  interval: soon\n")
    sidecar.start()
    assert f"the built-in defaults hold: {sidecar.config}:2: defaults.interval: soon" in sidecar.log
    made = sidecar.protected("node", NAP, ENABLE)
    assert sidecar.wait_for(made, state="protected")["interval_s"] == 3.0
