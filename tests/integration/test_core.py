# SPDX-License-Identifier: Apache-2.0
"""Core files of restored applications, beside the kernel's own of the same death."""

from __future__ import annotations

import os
import signal
import struct
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zstandard

from testkit.harness import wait_until
from testkit.local_sidecar import QUICK, LocalSidecar, local_sidecar

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root"),
    pytest.mark.shared_machine("a sidecar, its guards and a container have to get CPU time within seconds"),
]

VICTIM = """
import ctypes, signal, threading, time
wanted = []
big = bytearray(b"x" * 20_000_000)
threading.Thread(target=lambda: time.sleep(1e6), daemon=True).start()
signal.signal(signal.SIGUSR1, lambda *_: wanted.append(1))
while not wanted:
    time.sleep(0.01)
big[12_345_678:12_345_701] = b"written before it died!"
ctypes.string_at(0x10)
"""
NT_PRSTATUS, NT_SIGINFO, NT_FILE, NT_AUXV = 1, 0x53494749, 0x46494C45, 6
COMPARED = [i for i in range(27) if i != 15]
"""Of the registers, all but orig_rax."""
FS_BASE = 21


@dataclass
class Core:
    """The parsed contents of a core file."""

    loads: list[tuple[int, bytes]] = field(default_factory=list)
    notes: list[tuple[int, bytes]] = field(default_factory=list)

    @classmethod
    def of(cls, data: bytes) -> Core:
        core = cls()
        (at,), (count,) = struct.unpack_from("=Q", data, 32), struct.unpack_from("=H", data, 56)
        for i in range(count):
            kind, _, offset, address, _, size, _, _ = struct.unpack_from("=IIQQQQQQ", data, at + 56 * i)
            if kind == 1:
                core.loads.append((address, data[offset : offset + size]))
            else:
                core._take_notes(data[offset : offset + size])
        return core

    def _take_notes(self, data: bytes) -> None:
        at = 0
        while at < len(data):
            name, size, kind = struct.unpack_from("=III", data, at)
            at += 12 + (name + 3) // 4 * 4
            self.notes.append((kind, data[at : at + size]))
            at += (size + 3) // 4 * 4

    def all(self, kind: int) -> list[bytes]:
        return [body for each, body in self.notes if each == kind]

    @property
    def threads(self) -> dict[int, list[int]]:
        """Registers by thread."""
        bodies = self.all(NT_PRSTATUS)
        return {struct.unpack_from("=i", body, 32)[0]: list(struct.unpack_from("=27Q", body, 112)) for body in bodies}

    def read(self, address: int, size: int) -> bytes | None:
        for start, content in self.loads:
            if start <= address and address + size <= start + len(content):
                return content[address - start : address - start + size]
        return None


def crash(sidecar: LocalSidecar, folder: Path, mode: str) -> dict[str, object]:
    """Has a victim die that also leaves a core of the kernel's in `folder`; the event that names ours."""
    command = f'ulimit -c unlimited; cd {folder}; exec "$0" -c "$1"'
    labels = {**QUICK, "avckpt.core": mode}
    victim = sidecar.protected(mode, ["sh", "-c", command, sys.executable, VICTIM], labels)
    sidecar.wait_for(victim, state="protected", generations=2, threads=2)
    os.kill(victim.app_pid, signal.SIGUSR1)

    event = wait_until(lambda: sidecar.events(mode, "core"), 60, "the core is told of", every_s=0.1)[0]
    assert "core" in event, event["detail"]
    return event


def differences(mine: bytes, kernels: bytes) -> set[tuple[int, int]]:
    """The 8-byte words in which two pages differ."""
    if mine == kernels:
        return set()
    pairs = zip(struct.unpack("=1024I", mine), struct.unpack("=1024I", kernels))
    return {pair for pair in pairs if pair[0] != pair[1]}


def unpacked(event: dict[str, object]) -> Core:
    path = Path(str(event["core"]))
    assert path.stat().st_mode & 0o777 == 0o600
    return Core.of(zstandard.ZstdDecompressor().stream_reader(path.read_bytes()).read())


def test_it_is_the_core_that_the_kernel_writes(tmp_path: Path) -> None:
    if Path("/proc/sys/kernel/core_pattern").read_text().strip() not in ("core", "core.%p"):
        pytest.skip("the kernel gives its cores to somebody else here (core_pattern)")
    folder = tmp_path / "kernel"
    folder.mkdir()
    with local_sidecar(tmp_path) as sidecar:
        sidecar.start()
        ours = unpacked(crash(sidecar, folder, "on"))
        (theirs_path,) = folder.iterdir()
        theirs = Core.of(theirs_path.read_bytes())
        mini = unpacked(crash(sidecar, folder, "mini"))

    # Its memory is that of the death, not of a checkpoint.
    assert any(b"written before it died!" in content for _, content in ours.loads)
    compared, different = 0, set[tuple[int, int]]()
    for address, content in ours.loads:
        for at in range(0, len(content), 4096):
            page = theirs.read(address + at, 4096)
            if page is not None:
                different |= differences(content[at : at + 4096], page)
                compared += 1
    assert compared > 5000
    # But for what the kernel does when a thread ends, after its core: it clears the thread's number
    # (set_tid_address(2)) in the container, where this one's are small.
    assert all(mine == 0 < kernels < 100 for mine, kernels in different), different
    assert len(different) <= 2
    assert [len(core.threads) for core in (ours, theirs)] == [2, 2]
    for mine, kernels in zip(sorted(ours.threads.items()), sorted(theirs.threads.items())):
        assert [mine[1][i] for i in COMPARED] == [kernels[1][i] for i in COMPARED]
        assert mine[1][FS_BASE]
    # Whom it hit comes first; the signal, and the address.
    assert struct.unpack_from("=i8xQ", ours.all(NT_SIGINFO)[0]) == struct.unpack_from(
        "=i8xQ", theirs.all(NT_SIGINFO)[0]
    )
    assert struct.unpack_from("=16xQ", ours.all(NT_SIGINFO)[0]) == (0x10,)
    assert ours.all(NT_AUXV) == theirs.all(NT_AUXV)

    assert len(mini.threads) == 2
    assert sum(len(content) for _, content in mini.loads) < 16_000_000
    for registers in mini.threads.values():
        assert mini.read(registers[19], 64) is not None  # its stack
