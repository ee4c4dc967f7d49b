# SPDX-License-Identifier: Apache-2.0
"""Makes the man page from what `avckpt --help` knows.

python -m scripts.man > docs/avckpt.1
"""

from __future__ import annotations

import re

import click
from avckpt.cli.commands import EPILOG, main

FILES = (
    ("/etc/avckpt/config.yaml", "Defaults for all containers."),
    ("/run/avckpt", "Sockets, records and history; AVCKPT_RUN_DIR names another place."),
    ("/usr/local/libexec/avckpt", "Hooks and avckpt-init, as installed."),
)


def page() -> str:
    """The whole page, in man(7)."""
    lines = [
        '.\\" Made by scripts/man.py from `avckpt --help`.',
        ".TH AVCKPT 1",
        ".SH NAME",
        "avckpt \\- keeps Podman containers alive through crashes",
        ".SH SYNOPSIS",
        ".B avckpt",
        "COMMAND [OPTIONS] [ARGUMENTS]",
        ".SH DESCRIPTION",
        *paragraphs(main.help or ""),
        ".SH COMMANDS",
    ]
    for name in sorted(main.commands):
        lines += command(name, main.commands[name])
    lines += [".SH EXIT STATUS", *paragraphs(EPILOG), ".SH FILES"]
    for path, what in FILES:
        lines += [".TP", f".I {path}", escaped(what)]
    lines += [".SH SEE ALSO", ".BR podman (1),", ".BR podman\\-run (1),", ".BR podman\\-compose (1)"]
    return "\n".join(lines) + "\n"


def command(name: str, what: click.Command) -> list[str]:
    """One command with its options."""
    context = click.Context(what, info_name=name)
    usage = " ".join(what.collect_usage_pieces(context))
    lines = [f".SS avckpt {name} {escaped(usage)}", *paragraphs(what.help or "")]
    for parameter in what.get_params(context):
        record = parameter.get_help_record(context) if isinstance(parameter, click.Option) else None
        if record is not None and "--help" not in record[0]:
            lines += [".TP", f".B {escaped(record[0])}", escaped(record[1])]
    return lines


def paragraphs(text: str) -> list[str]:
    """Text of a docstring; \\b, which keeps click from filling lines, does the same here."""
    lines: list[str] = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        words = [escaped(line.strip()) for line in paragraph.strip().split("\n")]
        if words[0] == "\b":
            lines += [".PP", ".nf", *words[1:], ".fi"]
        else:
            lines += [".PP", *words]
    return lines


def escaped(text: str) -> str:
    """As troff shows it unchanged."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{text}" if text[:1] in (".", "'") else text


if __name__ == "__main__":
    print(page(), end="")
