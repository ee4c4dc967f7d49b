# SPDX-License-Identifier: Apache-2.0
"""The records of live protected containers that the prestart hook leaves for a sidecar that starts later."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from avckpt_hooks.protocol import ProtocolError, Register

from avckpt.errors import TargetGone
from avckpt.process import open_pidfd

log = logging.getLogger("avckpt")


def adoptable(directory: Path) -> Iterator[tuple[Register, int]]:
    """Every recorded container whose init still lives, with a pidfd that becomes the caller's.

    Records of containers that have ended are removed; unreadable ones are left
    where they are and logged.
    """
    for path in sorted(directory.glob("*.json")):
        try:
            text = path.read_bytes()
        except FileNotFoundError:
            continue  # its container has just stopped
        try:
            record = Register.from_record(json.loads(text))
        except (ProtocolError, ValueError) as error:
            log.warning("%s is not a record of a container (%s): left alone", path, error)
            continue
        try:
            pidfd = open_pidfd(record.pid, record.starttime)
        except TargetGone:
            remove_if(path, text)
            continue
        yield record, pidfd


def remove_if(path: Path, text: bytes) -> None:
    """Removes a record if it still says `text`.

    A container that is being restarted replaces its record at any moment, so it
    is taken aside first, looked at, and put back if it is a new one.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.rename(aside)
    except FileNotFoundError:
        return
    if aside.read_bytes() != text:
        # link(2) does not replace: a still newer record wins.
        with contextlib.suppress(FileExistsError):
            os.link(aside, path)
    aside.unlink()
