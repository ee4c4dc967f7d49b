# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C on Podman's terminal: a program that handles it and exits has ended; one that continues stays protected."""

from __future__ import annotations

import os
import subprocess
import termios
from collections.abc import Callable

import pytest

from testkit.harness import SLOWNESS, Container, ContainerFactory, Sidecar, wait_until

pytestmark = pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long")
QUICK = {"interval": "100ms"}
PATIENCE_S = 20.0 * SLOWNESS
ENDS = (
    "import signal, sys, time\n"
    "signal.signal(signal.SIGINT, lambda *_: (time.sleep(0.5), sys.exit(1)))\n"
    "print('ready', flush=True)\n"
    "while True:\n"
    "    time.sleep(0.01)\n"
)
GOES_ON = ENDS.replace("(time.sleep(0.5), sys.exit(1))", "print('not now', flush=True)")


def press(made: Container) -> None:
    """Presses a key in `podman attach` on a terminal of its own."""
    master, slave = os.openpty()
    attached = subprocess.Popen(
        ["podman", "attach", made.name], stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    )
    os.close(slave)
    try:
        # Until then the terminal would take the key for one of its own.
        wait_until(lambda: not termios.tcgetattr(master)[3] & termios.ISIG, PATIENCE_S, "podman attach is there")
        before = made.logs()
        os.write(master, b"\x03")
        wait_until(lambda: made.logs() != before or made.status == "exited", PATIENCE_S, "the key")
    finally:
        attached.kill()
        attached.wait()
        os.close(master)


def kill(made: Container) -> None:
    made.podman.run("kill", "-s", "INT", made.name)


@pytest.mark.parametrize("interrupt", [press, kill])
def test_who_ends_in_its_own_way_ends(
    sidecar: Sidecar, container: ContainerFactory, interrupt: Callable[[Container], None]
) -> None:
    made = container.protected("python3", "-c", ENDS, labels=QUICK, options=["-it"])
    sidecar.wait_generation(made, 2)
    interrupt(made)
    wait_until(lambda: made.status == "exited", PATIENCE_S, "the end")
    assert made.exit_code == 1
    assert made.logs().split() == (["ready", "^C"] if interrupt is press else ["ready"])


def test_who_goes_on_is_protected(sidecar: Sidecar, container: ContainerFactory) -> None:
    made = container.protected("python3", "-c", GOES_ON, labels=QUICK, options=["-it"])
    sidecar.wait_generation(made, 2)
    press(made)
    wait_until(lambda: "not now" in made.logs(), PATIENCE_S, "it has heard the key")
    sidecar.wait_generation(made, 2)
    assert made.status == "running"
