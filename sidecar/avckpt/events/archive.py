# SPDX-License-Identifier: Apache-2.0
"""The events on a disk, where there is one for them: /run, where the history is, does not outlive a reboot.

Nobody waits for that disk: it is read and written by a thread of its own.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import os
import queue
import threading
from pathlib import Path

from avckpt_hooks.shared.files import make_private
from avckpt_hooks.shared.protocol import RUN_DIR, STATE_DIR

from avckpt.events.history import LIMIT, History
from avckpt.events.record import EventRecord

log = logging.getLogger("avckpt")

LOAD_S = 2.0
"""A disk that takes longer is used, but what it holds is not known to this sidecar."""
CLOSE_S = 2.0


def archive_of(run_dir: Path) -> Archive | None:
    """The one of that sidecar; None: it has none.  Another runtime directory needs another one."""
    named = os.environ.get("AVCKPT_STATE_DIR")
    return Archive(Path(named or STATE_DIR)) if named or run_dir == Path(RUN_DIR) else None


class Archive:
    """A copy of the history in a folder; without that folder nothing is read or written."""

    def __init__(self, folder: Path, limit: int = LIMIT) -> None:
        self._folder = folder
        self._limit = limit
        self._records: queue.Queue[EventRecord | None] = queue.Queue(limit)
        self._loaded: concurrent.futures.Future[list[EventRecord]] = concurrent.futures.Future()
        self._thread = threading.Thread(target=self._run, name="avckpt-archive", daemon=True)
        self._thread.start()

    def load(self) -> list[EventRecord]:
        """What is in it, oldest first."""
        try:
            return self._loaded.result(LOAD_S)
        except concurrent.futures.TimeoutError:
            log.error("%s does not answer: earlier events are not known", self._folder)
            return []

    def add(self, record: EventRecord) -> None:
        """Has an event written that has its number."""
        if self._thread.is_alive():
            with contextlib.suppress(queue.Full):  # the disk hangs
                self._records.put_nowait(record)

    def close(self) -> None:
        """Waits a moment for what is not written yet."""
        try:
            self._records.put_nowait(None)
        except queue.Full:
            return
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        if not self._folder.is_dir():
            self._loaded.set_result([])
            return
        try:
            make_private(str(self._folder))
        except OSError as error:
            log.error("%s cannot be made private: %s", self._folder, error.strerror)
        history = History(self._folder / "history.jsonl", self._limit, durable=True)
        self._loaded.set_result(history.after())
        while (record := self._records.get()) is not None:
            history.keep(record)
            if self._records.empty():
                history.sync()
        history.close()
