# SPDX-License-Identifier: Apache-2.0
"""The tab key, in the shells that `avckpt completion` knows."""

from __future__ import annotations

import os
import pty
import select
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

from testkit.harness import SLOWNESS, run

SETUP = {
    "bash": "source {script}",
    # As zsh is set up by its users: the script is in one of the folders of fpath.
    "zsh": "fpath=({folder} $fpath); autoload -Uz compinit; compinit -u -d {folder}/dump",
}
SHELLS = {"bash": ("bash", "--norc", "--noprofile", "-i"), "zsh": ("zsh", "-f", "-i")}
PATIENCE_S = 30 * SLOWNESS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With `avckpt` in it, to be put into PATH, as this environment has it."""
    program = tmp_path / "bin/avckpt"
    program.parent.mkdir()
    code = "import sys\nfrom avckpt.cli.commands import main\nsys.argv[0] = 'avckpt'\nmain()\n"
    program.write_text(f"#!{sys.executable}\n{code}")
    program.chmod(0o755)
    return tmp_path


def needs(shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} on this machine: apt install {shell}")


def script(folder: Path, shell: str) -> Path:
    name = {"zsh": "_avckpt"}.get(shell, f"avckpt.{shell}")
    (folder / name).write_text(run([str(folder / "bin/avckpt"), "completion", shell]).stdout)
    return folder / name


def wait_for(fd: int, text: str) -> str:
    """Reads what the shell shows until `text` is there.  Raises TimeoutError."""
    shown = ""
    deadline = time.monotonic() + PATIENCE_S
    while text not in shown:
        ready, _, _ = select.select([fd], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            raise TimeoutError(f"no {text!r} on the terminal: {shown!r}")
        shown += os.read(fd, 4096).decode(errors="replace")
    return shown


@pytest.mark.parametrize("shell", SETUP)
def test_the_tab_key_completes_a_command(shell: str, folder: Path) -> None:
    needs(shell)
    setup = SETUP[shell].format(script=script(folder, shell), folder=folder)
    pid, terminal = pty.fork()
    if pid == 0:
        path = f"{folder / 'bin'}:{os.environ['PATH']}"
        os.execvpe(shell, SHELLS[shell], {"PATH": path, "TERM": "dumb", "HOME": str(folder), "PS1": "$ "})
    try:
        # A word that is not in what is typed, so that its echo is not taken for it.
        os.write(terminal, f"{setup}; echo set-'up'\n".encode())
        wait_for(terminal, "set-up\r")
        os.write(terminal, b"echo ready; avckpt uninst\t")
        wait_for(terminal, "uninstall")
    finally:
        os.kill(pid, signal.SIGKILL)
        os.close(terminal)
        os.waitpid(pid, 0)


def test_fish_offers_commands(folder: Path) -> None:
    needs("fish")
    path = f"{folder / 'bin'}:{os.environ['PATH']}"
    command = f"source {script(folder, 'fish')}; complete --do-complete 'avckpt uninst'"
    offered = run(["fish", "--no-config", "-c", command], env={"PATH": path, "HOME": str(folder)}, timeout_s=PATIENCE_S)
    assert [line.split("\t")[0] for line in offered.stdout.splitlines()] == ["uninstall"]
