# SPDX-License-Identifier: Apache-2.0
"""What runs on the host: the command `avckpt` (commands.py).  Imports nothing: others need only a module of it."""
