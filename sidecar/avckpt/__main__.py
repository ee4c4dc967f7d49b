# SPDX-License-Identifier: Apache-2.0
"""`python3 -m avckpt` is the same as `avckpt`."""

from __future__ import annotations

from avckpt.cli.commands import main

if __name__ == "__main__":
    main(prog_name="avckpt")
