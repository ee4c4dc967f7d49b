# SPDX-License-Identifier: Apache-2.0
"""The protected containers, in a file that outlives the sidecar: the next one reports what ended
meanwhile."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from avckpt_hooks.shared.files import read_own, write_at_once
from avckpt_hooks.shared.tell import printable

from avckpt.containers.protected import Protected

log = logging.getLogger("avckpt")

FILE_BYTES = 4 << 20
NAMED = 20
"""At most this many are named in one line."""


class Presence:
    """The file's time says when the sidecar was last alive. On a full disk only this report is lost."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._written = b""
        self._told = False

    def keep(self, live: Iterable[Protected], *, stopped: bool = False) -> None:
        """Writes the protected containers and a sign of life. Units are left out: they register again
        by themselves.

        Does nothing before `since_then()`.
        """
        if not self._told:
            return
        there = {each.id: [each.name, each.init_pid] for each in live if not each.node_of}
        content = json.dumps({"stopped": stopped, "containers": there}).encode()
        with contextlib.suppress(OSError):
            if content == self._written:
                with contextlib.suppress(FileNotFoundError):  # somebody has removed it
                    os.utime(self._path)
                    return
            write_at_once(str(self._path), content)
            self._written = content

    def stop(self, live: Iterable[Protected]) -> None:
        """Records that we exit on request."""
        self.keep(live, stopped=True)

    def since_then(self, live: Iterable[Protected], is_recorded: Callable[[str], bool]) -> str:
        """How long there was no sidecar, why, and which containers have ended meanwhile; "": this is the
        first one. Of one that `is_recorded` without being live nobody knows: it could not be adopted.

        Then writes the current containers.
        """
        live = list(live)
        detail = self._outage({each.id: each.init_pid for each in live}, is_recorded) if self._path.exists() else ""
        self._told = True
        self.keep(live)
        return detail

    def _outage(self, now: dict[str, int], is_recorded: Callable[[str], bool]) -> str:
        try:
            gone_s = max(time.time() - self._path.stat().st_mtime, 0)
            before = json.loads(read_own(str(self._path), FILE_BYTES))
            how = "was stopped" if before["stopped"] else "crashed or was killed"
            rows = {str(key): (str(name), int(pid)) for key, (name, pid) in before["containers"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            log.warning("%s cannot be read: what ended without protection is not known (%s)", self._path, error)
            return "what was before is not known"
        ended = [name or key[:12] for key, (name, pid) in rows.items() if key not in now and not is_recorded(key)]
        again = [name or key[:12] for key, (name, pid) in rows.items() if key in now and now[key] != pid]
        parts = [f"{what}: {_few(names)}" for what, names in (("ended", ended), ("started again", again)) if names]
        line = f"the one before {how}, {gone_s:.0f} s without protection"
        if parts:
            line += f"; meanwhile {', '.join(parts)}"
            log.warning("%s", line)
        return line


def _few(names: list[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(map(printable, names[:NAMED])) + more
