# SPDX-License-Identifier: Apache-2.0
"""`avckpt events` and `avckpt completion` without a sidecar."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from avckpt.cli import commands
from avckpt.cli.client import Client
from click.testing import CliRunner, Result


@pytest.fixture(autouse=True)
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path))
    return tmp_path


def avckpt(*args: str, **options: Any) -> Result:
    return CliRunner().invoke(commands.main, args, **options)


def event(**fields: object) -> dict[str, object]:
    return {"kind": "restored", "container": "web", "at": 1700000000.25, "seq": 7, "message": "restored", **fields}


@pytest.mark.parametrize("args", [["events"], ["events", "--follow"], ["events", "--json"]])
def test_without_a_sidecar(args: list[str]) -> None:
    result = avckpt(*args)
    assert result.exit_code == 3
    assert result.stdout == ""
    assert result.stderr.startswith("avckpt: the sidecar is not running (no ")


@pytest.mark.parametrize(
    ("text", "ago_s"),
    [("30s", 30), ("10m", 600), ("2h", 7200), ("2h30m", 9000), ("1.5d", 129600), ("9" * 15 + "d", 1e20), (None, None)],
)
def test_since_so_long_ago(monkeypatch: pytest.MonkeyPatch, text: str | None, ago_s: float | None) -> None:
    asked: list[float | None] = []

    def history(self: Client, since: float | None) -> list[dict[str, object]]:
        asked.append(since)
        return []

    monkeypatch.setattr(Client, "history", history)
    assert avckpt("events", *(["--since", text] if text else [])).exit_code == 0
    if ago_s is None:
        assert asked == [None]
    else:
        assert asked == [pytest.approx(max(time.time() - ago_s, 0), abs=5)]


KEPT = [
    event(container="web", id="ab" * 32, kind="restored", message="web restored"),
    event(container="db", id="cd" * 32, kind="gave_up", message="db gave up"),
    event(container="web", id="ab" * 32, kind="gave_up", message="web gave up"),
]


@pytest.mark.parametrize(
    ("args", "said"),
    [
        ([], ["web restored", "db gave up", "web gave up"]),
        (["web"], ["web restored", "web gave up"]),
        (["cdcd"], ["db gave up"]),
        (["--kind", "gave_up"], ["db gave up", "web gave up"]),
        (["web", "-k", "restored", "-k", "missed"], ["web restored"]),
        (["idle"], []),
    ],
)
def test_only_some(args: list[str], said: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "history", lambda self, since: KEPT)
    monkeypatch.setattr(Client, "containers", lambda self, **options: [{"name": "idle", "id": "ef" * 32}])
    result = avckpt("events", *args)
    assert result.exit_code == 0
    assert [line.partition(": ")[2] for line in result.stdout.splitlines()] == said


def test_of_one_that_was_never_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "history", lambda self, since: KEPT)
    monkeypatch.setattr(Client, "containers", lambda self, **options: [])
    result = avckpt("events", "wbe")
    assert result.exit_code == 4
    assert result.stderr == "avckpt: no event is kept of a container 'wbe', and none is called so now\n"


def test_since_a_date(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float | None] = []

    def history(self: Client, since: float | None) -> list[dict[str, object]]:
        asked.append(since)
        return []

    monkeypatch.setattr(Client, "history", history)
    assert avckpt("events", "--since", "2026-05-17T08:30").exit_code == 0
    assert asked == [datetime(2026, 5, 17, 8, 30).timestamp()]


@pytest.mark.parametrize("text", ["yesterday", "10", "m", "-5m", "2026-13-01", ""])
def test_since_nonsense(text: str) -> None:
    result = avckpt("events", "--since", text)
    assert result.exit_code == 2
    assert "neither a time ago" in result.stderr


def test_lines_have_colours_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "history", lambda self, since: [event()])
    at = datetime.fromtimestamp(1700000000.25).isoformat(" ", "milliseconds")
    assert avckpt("events").stdout == f"{at}  web: restored\n"
    assert avckpt("events", color=True).stdout == f"{at}  web: \x1b[33mrestored\x1b[0m\n"


def complete(shell: str, line: str) -> str:
    """What our script has a real shell offer for the words of a line, the last of them unfinished."""
    words = line.split(" ")
    env = {
        **os.environ,
        "_AVCKPT_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": line,
        # fish gives the unfinished word, the others its number.
        "COMP_CWORD": words[-1] if shell == "fish" else str(len(words) - 1),
    }
    done = subprocess.run([sys.executable, "-m", "avckpt"], env=env, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return done.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion(shell: str) -> None:
    script = avckpt("completion", shell).stdout
    assert "_AVCKPT_COMPLETE" in script
    if shutil.which(shell):
        subprocess.run([shell, "-n"], input=script, text=True, check=True)
    offered = complete(shell, "avckpt check")
    assert "checkpoint" in offered
    assert "restore" not in offered
    assert "--follow" in complete(shell, "avckpt events --f")
    # No sidecar, no names; and no complaint in the middle of somebody's typing.
    assert complete(shell, "avckpt restore ").strip() == ""


def test_completion_by_bash_itself(tmp_path: Path) -> None:
    (tmp_path / "avckpt").write_text(f'#!/bin/sh\nexec {sys.executable} -m avckpt "$@"\n')
    (tmp_path / "avckpt").chmod(0o755)
    script = (
        'eval "$(avckpt completion bash)"; COMP_WORDS=(avckpt even); COMP_CWORD=1;'
        ' _avckpt_completion avckpt; echo "${COMPREPLY[@]}"'
    )
    env = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "events"


def test_a_shell_we_do_not_know() -> None:
    assert avckpt("completion", "tcsh").exit_code == 2
