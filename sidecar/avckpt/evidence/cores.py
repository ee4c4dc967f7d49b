# SPDX-License-Identifier: Apache-2.0
"""The core files of applications that have died: `avckpt.core`."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import platform
import re
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from avckpt_hooks.shared.tell import printable

from avckpt.containers.cgroup import groups_of
from avckpt.containers.protected import Protected
from avckpt.containers.records import keep_private
from avckpt.evidence.collector import Case
from avckpt.evidence.core import Request, Thread
from avckpt.evidence.crash import Crash
from avckpt.policy import REMAINS_S

KEPT_OF_EACH = 5
"""Of one container; the oldest make way."""
KEPT_BYTES = 1_000_000_000
"""Of all together, if that is not more than half of what is free without them; of one container, half of it."""
KEPT_S = 7 * 86400.0
BYTES_MAX = 500_000_000
"""Of one, compressed; of those that are being written, not more than half of what is free."""
CRAMPED = 0.9
"""Of its limit a container may use at most so much, while the memory of the dead is kept, too."""
AT_ONCE = 2
"""Written at the same time."""
SUFFIX = ".core.zst"


class Cores:
    """The folder where they are.  For one event loop."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._turn = asyncio.Semaphore(AT_ONCE)
        self._written_s: dict[Path, float] = {}
        """When, by CLOCK_BOOTTIME: the time of day may be set by decades since."""

    async def make(self, container: Protected, case: Case, crash: Crash, mode: str) -> tuple[str, int, str]:
        """Writes one; its path and size, and in words what it is or why there is none."""
        if platform.machine() != "x86_64":
            return "", 0, f"no core: none is written on {platform.machine()}"
        if crash.unknown != case.crash.unknown:
            return "", 0, f"no core: {crash.unknown}"
        if _is_cramped(case.init_pid):
            return "", 0, "no core: its container has no memory left to keep what is dead"
        begun = time.monotonic()
        async with self._turn:
            left_s = REMAINS_S[mode] - (time.monotonic() - begun)
            if left_s <= 0:
                return "", 0, "no core: too many others were being written"
            try:
                keep_private(self._folder)
                path = self._folder / f"{_file_name(container.label)}.{int(time.time() * 1000)}{SUFFIX}"
                bytes_max = min(BYTES_MAX, _free_bytes(self._folder) // 2 // AT_ONCE)
                request = _request(case, path, mode, left_s, crash.command)
                answer = await _written(replace(request, bytes_max=bytes_max), left_s)
            except (OSError, ValueError, asyncio.TimeoutError) as error:
                return "", 0, f"no core: {printable(str(error)) or 'it took too long'}"
        if "problem" in answer:
            return "", 0, f"no core: {printable(str(answer['problem']))}"
        size = int(answer["bytes"])
        kind = "mini core" if mode == "mini" else "core"
        self.prune(_file_name(container.label), path)
        threads = f"without registers ({crash.unknown})" if crash.unknown else f"of {answer['threads']} thread(s)"
        what = f"{kind} {threads}, {answer['memory_bytes'] / 1e6:.1f} MB of memory in "
        return str(path), size, f"{what}{size / 1e6:.1f} MB, after {answer['seconds']:.2f} s: {path}"

    def prune(self, name: str, newest: Path) -> None:
        """Makes room, oldest first; the newest stays."""
        found = []
        now_s = time.clock_gettime(time.CLOCK_BOOTTIME)
        for path in self._folder.glob(f"*{SUFFIX}"):
            with contextlib.suppress(OSError):
                status = path.stat()
                at = self._written_s.get(path, now_s - max(time.time() - status.st_mtime, 0))
                found.append((at, status.st_size, path))
        self._written_s = {path: at for at, _, path in found}
        # Where they are, others may have files to write: usually it is /run.
        room = min(KEPT_BYTES, (sum(size for _, size, _ in found) + _free_bytes(self._folder)) // 2)
        total = count = its_bytes = 0
        for at, size, path in sorted(found, reverse=True):
            total += size
            is_its = path.name.rsplit(".", 3)[0] == name
            count += is_its
            its_bytes += is_its * size
            too_many = total > room or (is_its and (count > KEPT_OF_EACH or its_bytes > room // 2))
            if path != newest and (too_many or now_s - at > KEPT_S):
                with contextlib.suppress(OSError):
                    path.unlink()
                total -= size
                its_bytes -= is_its * size


def _request(case: Case, path: Path, mode: str, seconds_max: float, command: str) -> Request:
    threads = sorted(case.death.deliveries.values(), key=lambda each: (each is not case.hit, each.tid))
    signum = case.wait_status & 0x7F
    return Request(
        remains_pid=case.remains_pid,
        path=str(path),
        mini=mode == "mini",
        bytes_max=BYTES_MAX,
        seconds_max=seconds_max,
        app_pid=case.app_pid,
        signal=signum,
        code=case.hit.code if case.hit is not None else 0,
        fault=int(case.crash.fault or "0", 16),
        threads=[Thread(each.tid, each.registers) for each in threads],
        command=command,
    )


async def _written(request: Request, within_s: float) -> dict[str, Any]:
    """What the program says.  Raises OSError, ValueError, asyncio.TimeoutError."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "avckpt.evidence.core"),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        said, _ = await asyncio.wait_for(process.communicate(json.dumps(asdict(request)).encode()), within_s)
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            with contextlib.suppress(FileNotFoundError):
                Path(f"{request.path}.new").unlink()
    answer = json.loads(said)
    if not isinstance(answer, dict):
        raise ValueError("invalid answer from its writer")
    return answer


def _free_bytes(folder: Path) -> int:
    status = os.statvfs(folder)
    return status.f_bavail * status.f_frsize


def _is_cramped(pid: int) -> bool:
    try:
        groups = groups_of(pid)
    except OSError:
        return True  # it is just ending
    limit, used = groups.memory_limit_bytes(), groups.memory_used_bytes()
    return limit is not None and used is not None and used > CRAMPED * limit


def _file_name(label: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", label)[:100]
