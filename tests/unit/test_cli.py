# SPDX-License-Identifier: Apache-2.0
"""The command line without a sidecar: usage, messages, exit statuses, what is loaded."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import pytest
from avckpt.cli import client, commands, sidecar_container, sidecar_image
from avckpt.cli import install as installer
from avckpt.cli.bundle import find
from avckpt.cli.client import Client
from avckpt.cli.podman import PodmanFailed, podman
from avckpt.errors import NoSuchContainer, NothingToRestore, SidecarUnreachable
from avckpt.guard import Command
from avckpt.serve import is_cut_off
from click.testing import CliRunner, Result

from scripts.man import page
from testkit.harness import ROOT


@pytest.fixture(autouse=True)
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path))
    monkeypatch.setattr(client, "CONFIG_DIR", tmp_path)
    return tmp_path


def avckpt(*args: str) -> Result:
    return CliRunner().invoke(commands.main, args)


def row(**fields: object) -> dict[str, object]:
    return {
        "id": "ab" * 32,
        "name": "web",
        "state": "protected",
        "generations": 2,
        "keep": 2,
        "memory_bytes": 1_500_000,
        "interval_s": 0.062,
        "automatic": True,
        "last_checkpoint_at": 0.0,
        "last_freeze_s": 0.00251,
        "last_images": "dirty",
        "last_fork_reason": "",
        "restores": 1,
        "last_restore_s": 0.0063,
        "reason": "",
        "group": "drive",
        "line": 0,
        **fields,
    }


def test_how_to_start_it_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "UNITS", (tmp_path / "units",))
    assert f" -v {tmp_path}:/run/avckpt " in client.start_it(tmp_path)
    (tmp_path / "units").mkdir()
    (tmp_path / "units" / client.SERVICE).touch()
    monkeypatch.setattr(os.path, "isdir", lambda path: True)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert client.start_it(tmp_path) == "start it with: sudo systemctl start avckpt-sidecar.service"


@pytest.mark.parametrize("args", [["ps"], ["ps", "--json"], ["checkpoint", "web"], ["restore", "web"]])
def test_without_a_sidecar_one_line_says_how_to_start_it(args: list[str], run_dir: Path) -> None:
    result = avckpt(*args)
    assert result.exit_code == 3
    assert result.stdout == ""
    assert result.stderr.startswith(
        f"avckpt: the sidecar is not running (no {run_dir}/api.sock): start it with: podman run"
    )
    assert result.stderr.count("\n") == 1


def test_where_nothing_is_installed_the_command_installs_it_first(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "UNITS", ())
    monkeypatch.setattr(client, "CONFIG_DIR", tmp_path / "nothing")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert "install and start it with: sudo avckpt install && sudo podman run -d" in avckpt("ps").stderr


@pytest.mark.parametrize("command", ["checkpoint", "restore", "inspect"])
@pytest.mark.parametrize("name", ["", "x" * 9000])
def test_what_can_be_no_name(command: str, name: str) -> None:
    result = avckpt(command, name)
    assert result.exit_code == 4
    assert result.stderr.startswith("avckpt: no container")
    assert len(result.stderr) < 120


def test_no_name_is_no_beginning_of_an_id() -> None:
    with pytest.raises(NoSuchContainer, match="nothing is known of a container or an event ''"):
        find([row()], [], "")


@contextlib.contextmanager
def in_its_place(program: str, run_dir: Path) -> Iterator[IO[bytes]]:
    """A program where the sidecar should be, which has the socket `s`; what it says."""
    listen = "import socket,sys; s=socket.socket(socket.AF_UNIX); s.bind(sys.argv[1]); s.listen(); print(flush=True);"
    command = [sys.executable, "-c", listen + program, str(run_dir / "api.sock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as server:
        assert server.stdout is not None
        server.stdout.readline()
        yield server.stdout


def test_a_name_that_is_no_text(run_dir: Path) -> None:
    program = "c,_=s.accept(); print(c.recv(9999).split()[1].decode(), flush=True); c.close()"
    with in_its_place(program, run_dir) as said:
        result = avckpt("inspect", os.fsdecode(b"\xff/"))
        assert said.readline() == b"/v1/containers/%FF%2F\n"
    assert result.exit_code == 3
    assert "the sidecar went away (" in result.stderr


def test_a_sidecar_that_dies_meanwhile_is_told_in_words(run_dir: Path) -> None:
    program = "c,_=s.accept()"  # and ends with the request unread, as one that hangs and is killed
    with in_its_place(program, run_dir):
        result = avckpt("ps")
    assert result.exit_code == 3
    assert "Errno" not in result.stderr
    assert "the sidecar went away (" in result.stderr


def without_a_reader(command: str) -> tuple[int, str]:
    """The status, and what it says, of a command whose output nobody reads any more."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as pipe:
        argv = [sys.executable, "-m", "avckpt", *command.split()]
        done = subprocess.run(argv, stdout=pipe, stderr=subprocess.PIPE, text=True, timeout=60)
    return done.returncode, done.stderr


@pytest.mark.parametrize("command", ["completion bash", "--help", "--version", "ps --help"])
def test_a_reader_that_has_enough_ends_it_as_any_other_program(command: str) -> None:
    assert without_a_reader(command) == (-signal.SIGPIPE, "")


def test_a_reader_that_has_enough_ends_a_table_too(run_dir: Path) -> None:
    body = json.dumps({"containers": [row()]})
    answer = f"HTTP/1.0 200 OK\r\nContent-Length: {len(body)}\r\n\r\n{body}".encode()
    with in_its_place(f"c,_=s.accept(); c.recv(9999); c.sendall({answer!r}); c.close()", run_dir):
        assert without_a_reader("ps") == (-signal.SIGPIPE, "")


@pytest.mark.parametrize(
    ("command", "status"), [("ps", 3), ("nothing", 2), ("ps --nothing", 2), ("run -l a=b -- true", 2)]
)
def test_a_message_that_cannot_be_written_leaves_the_status_alone(command: str, status: int) -> None:
    for redirection in ("2>/dev/full", "2>&-"):
        assert os.waitstatus_to_exitcode(os.system(f"{sys.executable} -m avckpt {command} {redirection}")) == status


def test_ctrl_c_ends_it_as_any_other_program(run_dir: Path) -> None:
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(run_dir / "api.sock"))
        silent.listen()
        silent.settimeout(60)
        ps = [sys.executable, "-m", "avckpt", "ps"]
        with subprocess.Popen(ps, stderr=subprocess.PIPE, text=True) as process, silent.accept()[0]:
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (-signal.SIGINT, "avckpt: interrupted\n")


@pytest.mark.parametrize("redirection", [">/dev/full", ">&-"])
@pytest.mark.parametrize("command", ["check", "check --json", "completion bash", "--help"])
def test_an_output_that_cannot_be_written(command: str, redirection: str, tmp_path: Path) -> None:
    (tmp_path / "compose.yaml").write_text("services: {a: {image: x}}\n")
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m avckpt {command} {redirection}"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    if redirection == ">/dev/full":
        assert done.stderr == "avckpt: the output cannot be written: No space left on device\n"
        assert done.returncode == 1


def test_a_sidecar_that_was_killed_leaves_a_socket_that_is_no_sidecar(run_dir: Path) -> None:
    with socket.socket(socket.AF_UNIX) as left_behind:
        left_behind.bind(str(run_dir / "api.sock"))
    result = avckpt("ps")
    assert result.exit_code == 3
    assert "nobody listens on" in result.stderr


def test_an_answer_that_is_no_sidecars(run_dir: Path) -> None:
    program = "c,_=s.accept(); c.recv(9999); c.sendall(b'HTTP/1.0 200 OK\\r\\n\\r\\n[1]'); c.close()"
    with in_its_place(program, run_dir):
        result = avckpt("ps")
    assert result.exit_code == 1
    assert "is invalid" in result.stderr


@pytest.mark.parametrize(
    "args",
    [
        ["checkpoint"],
        ["restore", "a", "b"],
        ["ps", "--nonsense"],
        ["nonsense"],
        ["run"],
        ["run", "-l", "x", "true"],
        ["run", "--lable", "avckpt.interval=1s", "--", "true"],
        ["events", "--all"],
    ],
)
def test_wrong_usage(args: list[str]) -> None:
    assert avckpt(*args).exit_code == 2


def test_a_sidecar_that_is_a_service_is_not_asked_for_an_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The Debian package has no image: avckpt up says how its service is started."""
    absent = subprocess.CompletedProcess((), 1, "", "")
    monkeypatch.setattr(sidecar_container, "podman", lambda *args, **more: absent)
    for is_service, how in ((False, "sudo avckpt install --sidecar"), (True, "systemctl start avckpt-sidecar.service")):
        for module in (client, sidecar_container):
            monkeypatch.setattr(module, "is_service", lambda is_service=is_service: is_service)
        with pytest.raises(SidecarUnreachable, match=how):
            sidecar_container.ensure(tmp_path, print)


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("a\nb\nc\nError: no", "b / c / Error: no"),
        (
            "Getting\nError: payload matches no format:\n * oci: no\n * dir: no\n * tar: no",
            "Error: payload matches no format",
        ),
        ("", "exit status 125"),
    ],
)
def test_why_podman_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str, told: str) -> None:
    (tmp_path / "podman").write_text(f"#!/bin/sh\ncat >&2 <<'END'\n{said}\nEND\nexit 125\n")
    (tmp_path / "podman").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    with pytest.raises(PodmanFailed) as failure:
        podman("load")
    assert str(failure.value) == f"podman load: {told}"


def test_what_is_installed_is_told_also_if_the_image_cannot_be_had(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def load(archive: Path) -> str:
        raise PodmanFailed("it is none")

    monkeypatch.setattr(installer, "install", lambda root, quadlet: ["hooks: in place"])
    monkeypatch.setattr(sidecar_image, "load", load)
    (tmp_path / "x.tar").touch()
    result = avckpt("install", "--sidecar", "--archive", str(tmp_path / "x.tar"))
    assert (result.exit_code, result.stdout, result.stderr) == (1, "hooks: in place\n", "avckpt: it is none\n")


@pytest.mark.parametrize("answers", [False, True])
def test_a_sidecar_that_still_runs_is_told_when_the_hooks_go(monkeypatch: pytest.MonkeyPatch, answers: bool) -> None:
    monkeypatch.setattr(installer, "uninstall", lambda root: ["removed it"])
    monkeypatch.setattr(sidecar_container, "answers", lambda client: answers)
    monkeypatch.setattr(client, "is_service", lambda: False)
    said = avckpt("uninstall").stdout.splitlines()
    assert said == ["removed it", *(["left the sidecar, which runs: podman rm -f avckpt-sidecar"] if answers else [])]


def test_a_sidecar_whose_folder_is_not_the_hosts_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """podman run without -v: it would wait for containers for ever."""
    for container, mounts, cut_off in (
        ("podman", {Path("/")}, True),
        ("podman", {Path("/"), Path("/run/avckpt")}, False),
        ("podman", {Path("/"), Path("/run")}, False),
        (None, {Path("/")}, False),
    ):
        monkeypatch.delenv("container", raising=False)
        if container is not None:
            monkeypatch.setenv("container", container)
        monkeypatch.setattr(os.path, "ismount", mounts.__contains__)
        assert is_cut_off(Path("/run/avckpt")) is cut_off


def test_a_sidecar_that_is_paused_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Podman's own words for why it cannot be started are about states of containers."""

    def podman(*args: str, **_: object) -> subprocess.CompletedProcess[str]:
        assert args[0] == "inspect"
        return subprocess.CompletedProcess(args, 0, json.dumps([{"State": {"Status": "paused"}}]), "")

    monkeypatch.setattr(sidecar_container, "podman", podman)
    with pytest.raises(SidecarUnreachable, match="is paused, and nothing is protected: podman unpause avckpt-sidecar"):
        sidecar_container.ensure(tmp_path, print)


def test_without_podman_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SidecarUnreachable, match="there is no podman here"):
        sidecar_container.ensure(tmp_path, print)


def test_a_sidecar_is_started_here_only(tmp_path: Path) -> None:
    result = avckpt("install", "--sidecar", "--root", str(tmp_path))
    assert result.exit_code == 2
    assert "--sidecar is for this host" in result.stderr
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("label", ["avckpt.group=chain", "avckpt.notify.self=signal:USR1"])
def test_a_plain_program_has_nobody_who_notifies_it(label: str) -> None:
    result = avckpt("run", "-l", label, "--", "true")
    assert result.exit_code == 2
    assert f"label {label.partition('=')[0]}: it takes containers and the sidecar, leave it out" in result.stderr


@pytest.mark.parametrize("value", ["on", "mini"])
def test_a_plain_program_has_nobody_who_writes_its_core(value: str) -> None:
    result = avckpt("run", "-l", f"avckpt.core={value}", "--", "true")
    assert result.exit_code == 2
    assert "label avckpt.core: it takes the sidecar, which writes the files, leave it out" in result.stderr


def test_a_plain_program_has_no_health_check() -> None:
    result = avckpt("run", "-l", "avckpt.restore.on=signal,unhealthy", "--", "true")
    assert result.exit_code == 2
    assert "label avckpt.restore.on: unhealthy takes a container's health check, leave it out" in result.stderr


def test_help_documents_the_exit_statuses() -> None:
    text = avckpt("--help").stdout
    for words in ("3 the sidecar", "4 no such container", "5 the container"):
        assert words in text.replace("\n", " ").replace("  ", " ")


def test_the_sidecars_errors_decide_the_exit_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Client, name: str, command: Command, generation: int = 0) -> Any:
        raise NothingToRestore(f"{name} has nothing to go back to")

    monkeypatch.setattr(Client, "command", refuse)
    result = avckpt("restore", "web")
    assert result.exit_code == 5
    assert result.stderr == "avckpt: web has nothing to go back to\n"


def test_a_launcher_has_no_checkpoints_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {"container": row(state="nodes", reason="a launcher"), "settings": {"keep": "2"}, "crashes": []}
    monkeypatch.setattr(Client, "inspect", lambda self, name: known)
    assert avckpt("inspect", "web").stdout.splitlines() == [
        "web (abababababab): nodes: a launcher",
        "settings: keep=2",
        "crashes: 0 in the history",
    ]


def test_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        row(),
        row(name="", state="starting", last_freeze_s=None, last_checkpoint_at=None, reason="[red]no[/red] " * 20),
        row(last_images="fork", last_fork_reason="it writes too much"),
        row(line=12),
    ]
    monkeypatch.setattr(Client, "containers", lambda self, ended: rows)
    lines = avckpt("ps").stdout.splitlines()
    assert lines[0].split()[:3] == ["NAME", "STATE", "GENS"]
    assert lines[1].split()[:3] == ["web", "protected", "2/2"]
    assert "auto, 62 ms" in lines[1]
    assert "2.51 ms dirty" in lines[1]
    assert "2.51 ms fork" in lines[3]
    assert lines[3].endswith("forked: it writes too much")
    assert "2.51 ms" in lines[1]
    assert "6.30 ms" in lines[1]
    # The short id where there is no name; markup is text; one line, however long.
    assert lines[2].split()[:2] == ["abababababab", "starting"]
    assert lines[2].count("[red]no[/red]") == 20
    # A group that goes back together has a line.
    assert lines[4].endswith("line 12 of drive")
    assert "drive" not in lines[1]
    assert len(lines) == 5


@pytest.mark.parametrize(
    ("age_s", "said"),
    [
        (0, "0 s ago"),
        (100, "100 s ago"),
        (150, "2 min ago"),
        (7140, "119 min ago"),
        (10**5, "27 h ago"),
        (10**6, "11 d ago"),
    ],
)
def test_ages(monkeypatch: pytest.MonkeyPatch, age_s: float, said: str) -> None:
    rows = [row(last_checkpoint_at=time.time() - age_s)]
    monkeypatch.setattr(Client, "containers", lambda self, ended: rows)
    assert f" {said} " in avckpt("ps").stdout


def test_json_is_what_the_api_said(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def containers(self: Client, ended: bool) -> list[dict[str, object]]:
        asked.append(ended)
        return [row()]

    monkeypatch.setattr(Client, "containers", containers)
    assert json.loads(avckpt("ps", "-a", "--json").stdout) == [row()]
    assert asked == [True]


@pytest.mark.skipif(os.geteuid() != 0, reason="it takes root to become somebody else")
def test_who_may_not_ask_is_told(run_dir: Path) -> None:
    run_dir.chmod(0o700)
    pid = os.fork()
    if pid == 0:
        os.setuid(65534)
        result = avckpt("ps")
        os._exit(0 if result.exit_code == 1 and "is for root only" in result.stderr else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def test_nothing_heavy_is_loaded_before_it_is_needed() -> None:
    program = "import avckpt.cli.commands, sys; print(sorted({m.split('.')[0] for m in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    for heavy in ("rich", "aiohttp", "asyncio", "cffi", "podman", "_cffi_backend"):
        assert f"'{heavy}'" not in loaded


def test_the_man_page_is_that_of_this_command_line() -> None:
    assert (ROOT / "docs/avckpt.1").read_text() == page(), "run: python -m scripts.man > docs/avckpt.1"
