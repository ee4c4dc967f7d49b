# SPDX-License-Identifier: Apache-2.0
"""What runs on the host: the command `avckpt`."""

from __future__ import annotations

from avckpt.cli.commands import main

__all__ = ["main"]
