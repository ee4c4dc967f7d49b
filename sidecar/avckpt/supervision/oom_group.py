# SPDX-License-Identifier: Apache-2.0
"""memory.oom.group=1 (cgroup v2): when the kernel kills one process of a container for its memory, all go.

All includes avckpt-init and the templates, and nothing would be left to restore.  So while the container is
guarded the file says 0, and the rule is kept from here: an application that lost a process to the OOM killer
is killed as a whole, and goes back as a whole.  What the file said is noted at the control group itself, for
the next sidecar.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import signal
from dataclasses import dataclass
from pathlib import Path

from avckpt.containers.cgroup import Groups, fields_of
from avckpt.containers.process import open_app
from avckpt.containers.protected import Protected
from avckpt.errors import TargetGone

log = logging.getLogger("avckpt")

NOTE = "trusted.avckpt.oom_group"


@dataclass
class OomGroup:
    """Of one container.  `look()` at it all the time, `give_back()` at the end."""

    folder: Path
    kills: int = 0
    explained: tuple[int, int] = (0, 0)
    """By what the guard had told when the count was still right."""
    doubtful: bool = False
    """Somebody was killed; the guard may be about to tell who."""

    def look(self, container: Protected, init_pidfd: int) -> None:
        """Kills an application of which the kernel has killed a part.

        A death of the main process or of a template explains what the kernel has counted; both are told within
        a second.
        """
        self._take_over()
        kills, told = self._count(), (container.last_death_ns, container.dropped)
        if kills == self.kills or told != self.explained:
            self.kills, self.explained, self.doubtful = kills, told, False
        elif not self.doubtful:
            self.doubtful = True
        else:
            self.kills, self.doubtful = kills, False
            log.warning("%s: the OOM killer took one of its processes: memory.oom.group takes all", container.label)
            with contextlib.suppress(TargetGone, ProcessLookupError):
                app = open_app(container.app_pid, container.init_pid, init_pidfd)
                try:
                    signal.pidfd_send_signal(app, signal.SIGKILL)
                finally:
                    os.close(app)

    def give_back(self) -> None:
        """The kernel does it again.  Nothing when the control group is gone."""
        with contextlib.suppress(OSError):
            self._file.write_text("1")
            os.removexattr(self.folder, NOTE)

    @property
    def _file(self) -> Path:
        return self.folder / "memory.oom.group"

    def _take_over(self) -> None:
        """Again when somebody has written 1."""
        with contextlib.suppress(OSError):
            if self._file.read_text().strip() == "1":
                os.setxattr(self.folder, NOTE, b"1")  # first: who dies in between leaves no 0 without a note
                self._file.write_text("0")

    def _count(self) -> int:
        return int(fields_of(self.folder / "memory.events").get("oom_kill", self.kills))


def oom_group_of(groups: Groups, container: Protected, init_pidfd: int) -> OomGroup | None:
    """Takes it over, or from a sidecar before this one; None: there is no such rule for this container."""
    if groups.memory is None or groups.memory_version != 2 or container.node_of:
        return None
    group = OomGroup(groups.memory)
    try:
        is_set = (groups.memory / "memory.oom.group").read_text().strip() == "1"
        if not is_set and not _is_noted(groups.memory):
            return None
    except OSError:  # it has just ended
        return None
    group.kills, group.explained = group._count(), (container.last_death_ns, container.dropped)
    group.look(container, init_pidfd)
    return group


def _is_noted(folder: Path) -> bool:
    try:
        return bool(os.getxattr(folder, NOTE))
    except OSError as error:
        if error.errno in (errno.ENODATA, errno.ENOTSUP):
            return False
        raise
