# SPDX-License-Identifier: Apache-2.0
"""The records of live protected containers that the prestart hook leaves for a sidecar that starts later."""

from __future__ import annotations

import contextlib
import json
import logging
import os
from collections.abc import Callable, Iterator
from copy import copy
from pathlib import Path

from avckpt_hooks.shared.files import make_private, read_own, write_private
from avckpt_hooks.shared.protocol import MAX_BYTES, Register

from avckpt.containers.process import open_pidfd
from avckpt.errors import Denied, TargetGone

log = logging.getLogger("avckpt")

RECORD_BYTES = 2 * MAX_BYTES
"""The hook sends what it has written in a packet."""
PID_MOST = 1 << 22
"""PID_MAX_LIMIT, include/linux/threads.h."""
OWN_NAMESPACE = os.stat("/proc/self/ns/pid").st_ino
NOT_SEEN = "the sidecar does not see the host's processes: start it with --pid=host"


def keep_private(directory: Path) -> None:
    """Creates the directory of the hooks' files, and removes the access of others to existing ones.

    Earlier versions left them readable by everybody.  Raises OSError.
    """
    make_private(str(directory))
    for path in directory.iterdir():
        with contextlib.suppress(FileNotFoundError):  # its container has just stopped
            path.chmod(0o600)


def keep_hooks_folders(run_dir: Path) -> None:
    """Those that hooks write to.  Raises OSError."""
    for name in ("containers", "health"):
        keep_private(run_dir / name)


class Records:
    """The records in a directory, for repeated scans. An error in one is logged once."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._complaints: dict[str, str] = {}
        """By file name, while the file exists."""

    def adoptable(self, is_known: Callable[[str], bool]) -> Iterator[tuple[Register, int]]:
        """Every recorded container whose init still lives, with a pidfd that the caller must
        close.

        Those whose id `is_known` are left out, at the cost of a listing. Records of
        containers that have ended are removed; those that cannot be read, or whose PID means
        nothing here, are left where they are and logged. Raises nothing: errors are retried
        at the next scan.
        """
        try:
            names = sorted(name for name in os.listdir(self._directory) if name.endswith(".json"))
        except FileNotFoundError:
            return  # no hook has left one yet
        except OSError as error:
            self.complain("", f"{self._directory} cannot be read, containers may run unprotected: {error.strerror}")
            return
        self._complaints = {name: line for name, line in self._complaints.items() if name in names}
        for path in map(self._directory.joinpath, names):
            if is_known(path.stem):
                continue
            try:
                found = _open(path)
            except FileNotFoundError:
                continue  # its container has just stopped
            except Denied as error:
                self.complain(path.stem, str(error))
            except OSError as error:
                self.complain(path.stem, f"the container of {path} runs unprotected: {error.strerror}")
            except ValueError as error:
                self.complain(path.stem, f"{path} is not a record of a container ({error}): left alone")
            else:
                if found is not None:
                    yield found

    def write(self, request: Register, init_pid: int) -> None:
        """Does what the hook could not do, or what somebody has removed, for a container that lives.  Raises
        OSError."""
        ours = copy(request)
        ours.pid = init_pid
        write_private(str(self._directory.joinpath(f"{request.id}.json")), ours.to_record())

    def has(self, container_id: str) -> bool:
        """Whether there is a record of that container."""
        return self._directory.joinpath(f"{container_id}.json").exists()

    def complain(self, container_id: str, line: str) -> None:
        """Logs what is wrong with a record ("": with all of them), unless it was logged at the last scan."""
        name = f"{container_id}.json"
        if self._complaints.get(name) != line:
            log.error("%s", line)
        self._complaints[name] = line


def _open(path: Path) -> tuple[Register, int] | None:
    """The container of a record, with a pidfd; None when it has ended: then the record is removed.

    Raises OSError, and what _parse() does.
    """
    text = read_own(str(path), RECORD_BYTES)
    record = _parse(text)
    try:
        return record, open_pidfd(record.pid, record.starttime)
    except TargetGone:
        remove_if(path, text)
        return None


def _parse(text: bytes) -> Register:
    """Raises ValueError when it is no record, Denied when its PID is one of a PID namespace that we do not see."""
    try:
        data = json.loads(text)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    record = Register.from_record(data)
    if not 0 < record.pid <= PID_MOST:
        raise ValueError(f"its pid is {record.pid}")
    if data.get("pid_namespace", OWN_NAMESPACE) != OWN_NAMESPACE:
        raise Denied(f"runs unprotected: {NOT_SEEN}", container=record.name or record.id[:12])
    return record


def remove_if(path: Path, text: bytes) -> None:
    """Removes a record if it still says `text`.

    A container that is being restarted replaces its record at any moment, so it is
    moved aside first, checked, and moved back if it is a new one. Raises OSError.
    """
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.rename(aside)
    except FileNotFoundError:
        return
    is_it = False
    try:
        is_it = aside.read_bytes() == text
    finally:
        if not is_it:
            # link(2) does not replace: a still newer record wins.
            with contextlib.suppress(FileExistsError):
                os.link(aside, path)
        aside.unlink()
