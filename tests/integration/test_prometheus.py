# SPDX-License-Identifier: Apache-2.0
"""A real Prometheus server reads a real sidecar, with the files of examples/prometheus."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from testkit.harness import ROOT, avckpt_command, free_port, wait_until
from testkit.local_sidecar import local_sidecar

EXAMPLES = ROOT / "examples" / "prometheus"
TOKEN = "a-token-of-the-operators"
PATIENCE_S = 60
pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine("two servers on a busy machine may take longer to start than the test waits"),
]


@contextlib.contextmanager
def running(*command: str | Path, env: dict[str, str] | None = None) -> Iterator[None]:
    process = subprocess.Popen(command, env={**os.environ, **(env or {})}, stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE_S)


def configured(folder: Path, web_port: int) -> Path:
    """The shipped configuration, with this machine's port and token file, and a shorter scrape interval."""
    config = yaml.safe_load((EXAMPLES / "prometheus.yaml").read_text())
    (job,) = config["scrape_configs"]
    job["authorization"]["credentials_file"] = str(folder / "token")
    job["static_configs"][0]["targets"] = [f"127.0.0.1:{web_port}"]
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    (folder / "token").write_text(TOKEN)
    (folder / "token").chmod(0o600)
    shutil.copy(EXAMPLES / "alerts.yaml", folder)
    made = folder / "prometheus.yaml"
    made.write_text(yaml.safe_dump(config))
    return made


def ask(port: int, path: str, **query: str) -> Any:
    url = f"http://127.0.0.1:{port}/api/v1/{path}?{urllib.parse.urlencode(query)}"
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:
            return json.load(answer)["data"]
    except OSError:
        return None  # it is starting


def test_crashes_alert_and_the_dashboard_has_something_to_show(tmp_path: Path) -> None:
    assert shutil.which("prometheus"), "prometheus is missing: make setup"
    web_port, port = free_port(), free_port()
    labels = {"avckpt.enable": "true", "avckpt.interval": "200ms"}
    config = configured(tmp_path, web_port)
    with (
        local_sidecar(tmp_path) as sidecar,
        contextlib.ExitStack() as stack,
    ):
        sidecar.start()
        lidar = sidecar.protected("lidar", ["sleep", "1000"], labels)
        sidecar.protected("ear", ["sleep", "1000"], {"avckpt.group": "g", "avckpt.notify": "signal:USR1"})
        web = ("web", "--port", str(web_port), "--token-file", str(tmp_path / "token"))
        stack.enter_context(running(*avckpt_command(), *web, env=sidecar.env))
        stack.enter_context(
            running(
                "prometheus",
                f"--config.file={config}",
                f"--storage.tsdb.path={tmp_path / 'data'}",
                f"--web.listen-address=127.0.0.1:{port}",
                "--log.level=error",
            )
        )

        def value(query: str) -> float | None:
            result = (ask(port, "query", query=query) or {"result": []})["result"]
            return float(result[0]["value"][1]) if result else None

        def has_value(query: str) -> bool:
            return value(query) is not None

        restores = 'avckpt_restores_total{container="lidar", reason="signal", outcome="restored"}'
        wait_until(lambda: value(restores) == 0, PATIENCE_S, "a counter that exists at zero", every_s=0.5)
        assert value('avckpt_protected{container="lidar"}') == 1
        assert value('avckpt_protected{container="ear"}') is None
        os.kill(lidar.app_pid, signal.SIGSEGV)
        wait_until(lambda: value(restores) == 1, PATIENCE_S, "the restore is counted", every_s=0.5)

        def firing() -> set[str]:
            alerts = (ask(port, "alerts") or {"alerts": []})["alerts"]
            return {alert["labels"]["alertname"] for alert in alerts if alert["state"] == "firing"}

        wait_until(lambda: "AvckptCrash" in firing(), PATIENCE_S, "the crash alerts", every_s=0.5)
        assert firing() == {"AvckptCrash"}
        rules = [rule for group in ask(port, "rules")["groups"] for rule in group["rules"]]
        assert {rule["health"] for rule in rules} == {"ok"}
        for panel in json.loads((EXAMPLES / "grafana.json").read_text())["panels"]:
            # A second target may have nothing to tell: no checkpoint was missed.
            query = panel["targets"][0]["expr"].replace("$container", ".*")
            wait_until(partial(has_value, query), PATIENCE_S, query, every_s=0.5)
