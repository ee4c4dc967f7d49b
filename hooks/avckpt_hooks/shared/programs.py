# SPDX-License-Identifier: Apache-2.0
"""Programs that want to be PID 1 themselves: init systems."""

from __future__ import annotations

import os

OTHER_INITS = ("/run/podman-init", "/dev/init", "/sbin/docker-init")
"""Where `podman run --init` and `docker run --init` put their init, which only reaps and forwards signals."""
_ONLY_AS_PID_1 = ("init", "systemd", "s6-svscan")
"""Programs, in any directory, that exit or do less when they are not PID 1: systemd, s6-overlay (/init),
s6."""


def must_be_pid_1(command: str) -> bool:
    """Whether a program should have no init in front of it."""
    return os.path.basename(command) in _ONLY_AS_PID_1 and command not in OTHER_INITS
