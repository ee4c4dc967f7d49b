# SPDX-License-Identifier: Apache-2.0
"""What an application has a say in (names of files, output of commands), fit for a log and a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""One line with the same visible characters: all others read as their escapes (`\n`, `\x1b`, `\u202e`).

    So nobody writes lines of their own into root's log, or does anything to root's terminal.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
