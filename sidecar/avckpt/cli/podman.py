# SPDX-License-Identifier: Apache-2.0
"""Podman's command line."""

from __future__ import annotations

import subprocess

from avckpt.errors import AvckptError


class PodmanFailed(AvckptError):
    """A command of Podman that had to succeed has not, or there is no Podman."""


def podman(*args: str, check: bool = True, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """`podman ARGS` to its end.  Raises PodmanFailed; without `check` a status other than 0 is no failure."""
    try:
        done = subprocess.run(["podman", *args], capture_output=True, text=True, check=False, timeout=timeout_s)
    except FileNotFoundError:
        raise PodmanFailed(f"podman {args[0]}: there is no podman here (PATH)") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PodmanFailed(f"podman {args[0]}: {error}") from error
    if check and done.returncode != 0:
        raise PodmanFailed(f"podman {args[0]}: {_why(done)}")
    return done


def _why(done: subprocess.CompletedProcess[str]) -> str:
    """The end of what it has said, or its line `Error: ...` where more than that follows."""
    lines = (done.stderr or done.stdout).strip().splitlines() or [f"exit status {done.returncode}"]
    errors = [line for line in lines[:-3] if line.startswith("Error: ")]
    if errors and not any(line.startswith("Error: ") for line in lines[-3:]):
        return errors[-1].rstrip(":")
    return " / ".join(lines[-3:])
