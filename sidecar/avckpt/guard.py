# SPDX-License-Identifier: Apache-2.0
"""What a guard is told: configuration and commands, the plain data of `avckpt/engine.h`.

What it tells is in `avckpt.events.vocabulary`.  Nothing here needs the native library.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Command(enum.IntEnum):
    """`enum avc_command`."""

    CHECKPOINT = 1
    RESTORE = 2
    DROP_OLDEST = 3
    REFILL = 4
    VOUCH = 5
    UNHEALTHY = 6
    UNVOUCH = 7


class Files(enum.IntEnum):
    """`enum avc_files`: regular files at a restore."""

    REWIND = 0
    KEEP = 1
    STRICT = 2


class Tcp(enum.IntEnum):
    """`enum avc_tcp`: established TCP connections at a restore."""

    KEEP = 0
    RESET = 1
    RESET_MOVED = 2
    MESSAGES = 3


@dataclass(frozen=True)
class GuardConfig:
    """`struct avc_config` without the pidfd.  Durations in seconds."""

    interval_s: float
    """Between checkpoints; 0: only on command."""
    keep: int
    """Generations kept."""
    restore_on_signal: bool
    restore_on_exit: bool
    restore_on_statuses: frozenset[int]
    restore_max: int
    """Restores within `restore_window_s`."""
    restore_window_s: float
    quiesce_s: float
    """How long to look for a quiescent moment."""
    shm_bytes: int = 4_000_000
    """Shared memory of the application's own that is rolled back with it, at most."""
    freeze_deadline_s: float = 0.0
    """The longest the app is held to get it stopped; 0: the engine's default."""
    files: Files = Files.REWIND
    tcp: Tcp = Tcp.KEEP
