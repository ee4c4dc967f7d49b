#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Functions of more than six arguments, in C and in Python: who reads a call of one loses count.

What is not counted: in C, a message (a format and what belongs to it); in Python, `self` and
arguments that every call must name.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

MOST = 6
# The system call itself: its number and the kernel's six.
BY_THE_KERNEL = {"raw_syscall", "inlined"}
NO_CODE = re.compile(r'/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|^#(?:\\\n|[^\n])*', re.DOTALL | re.MULTILINE)
# Statements are indented; what begins a line is a declaration or a definition.
FUNCTION = re.compile(r"^[a-z_][\w \t*]*?\b(\w+)\(([^;{]*?)\)\s*(?:__attribute__|warn_unused|[;{])", re.MULTILINE)
MESSAGE = re.compile(r",\s*const char \*\w+,\s*(?:\.\.\.|va_list \w+)$")
NESTED = re.compile(r"\([^()]*\)")


def in_c(text: str) -> Iterator[tuple[int, str, int]]:
    """Line, name and number of arguments of each function."""
    text = NO_CODE.sub(lambda found: "\n" * found[0].count("\n"), text)
    for found in FUNCTION.finditer(text):
        arguments = MESSAGE.sub("", found[2])
        while NESTED.search(arguments):
            arguments = NESTED.sub("", arguments)
        if found[1] not in BY_THE_KERNEL:
            yield text.count("\n", 0, found.start()) + 1, found[1], arguments.count(",") + 1


def in_python(text: str) -> Iterator[tuple[int, str, int]]:
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            names = [argument.arg for argument in (*node.args.posonlyargs, *node.args.args)]
            yield node.lineno, node.name, len([name for name in names if name not in ("self", "cls")])


def main() -> None:
    wrong = 0
    for path in map(Path, sys.argv[1:]):
        look = in_python if path.suffix == ".py" else in_c
        for line, name, count in look(path.read_text()):
            if count > MOST:
                print(f"error: {path}:{line}: {name}() takes {count} arguments, more than {MOST}", file=sys.stderr)
                wrong += 1
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
