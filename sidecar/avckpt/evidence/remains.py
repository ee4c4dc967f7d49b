# SPDX-License-Identifier: Apache-2.0
"""The remains of a dead application: a stopped task of the guard that still has its memory.

None of it is trusted; what is read is bounded.  Reading may block while a mapped file system does
not answer: not for the daemon's own thread.
"""

from __future__ import annotations

import bisect
import os
import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from avckpt_hooks.shared.tell import printable

from avckpt.containers.process import command_line, stat_fields
from avckpt.evidence.crash import FRAMES_MAX, Frame

MAPS_MAX = 32 << 20
HEADERS_MAX = 64
NOTES_MAX = 4096
STACK_MAX = 32 << 10
PATH_MOST = 1000
COMMAND_MOST = 200
"""Characters, of which it may take six to show one: they are in each event."""

_LINE = re.compile(rb"([0-9a-f]+)-([0-9a-f]+) (\S{4}) ([0-9a-f]+) (\S+) (\d+) *(.*)")
_INTERPRETERS = re.compile(r"(python|ruby|perl|node|nodejs|bash|sh|java|lua|php)[\d.]*")
# x86: call rel32, and the forms of call r/m64.
_CALL = re.compile(
    rb"(\xe8.{4}|\xff[\xd0-\xd7]|\xff[\x50-\x57].|\xff\x15.{4}|\xff[\x90-\x97].{4}|\xff\x14.)$", re.DOTALL
)
_PT_LOAD, _PT_NOTE = 1, 4
_NT_GNU_BUILD_ID = 3
_EHDR = struct.Struct("=4sB11xHHIQQQIHHHHHH")
_PHDR = struct.Struct("=IIQQQQQQ")


@dataclass(frozen=True)
class Mapping:
    """A line of /proc/PID/maps."""

    start: int
    end: int
    flags: str
    offset: int
    device: str
    inode: int
    path: str

    @property
    def file(self) -> tuple[str, int]:
        """Which file it is of; inode 0: none."""
        return self.device, self.inode


@dataclass(frozen=True)
class _Image:
    """An ELF file as it is mapped."""

    loads: tuple[tuple[int, int, int], ...] = ()
    """Offset in the file, address, size in the file."""
    build_id: str = ""

    def address_of(self, offset: int) -> int:
        """The address in the file's own terms, as addr2line(1) takes it."""
        for begin, address, size in self.loads:
            if begin <= offset < begin + size:
                return offset - begin + address
        return offset


class Remains:
    """The memory of a process.  Raises OSError when it is gone."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.maps = read_maps(pid)
        self._memory = os.open(f"/proc/{pid}/mem", os.O_RDONLY | os.O_CLOEXEC)
        self._starts = [mapping.start for mapping in self.maps]
        self._images: dict[tuple[str, int], _Image] = {}

    def close(self) -> None:
        """Looks no more."""
        os.close(self._memory)

    def read(self, address: int, size: int) -> bytes:
        """What is there; shorter, or nothing, where there is no more."""
        try:
            return os.pread(self._memory, size, address)
        except (OSError, OverflowError):
            return b""

    def frame(self, address: int) -> Frame:
        """Where an address is: in which file, and where in that."""
        mapping = next((each for each in self.maps if each.start <= address < each.end), None)
        if mapping is None:
            return Frame(address=address)
        if mapping.inode == 0:
            return Frame(address=address, module=mapping.path)
        image = self._image(mapping)
        offset = image.address_of(address - mapping.start + mapping.offset)
        return Frame(address=address, module=mapping.path, offset=offset, build_id=image.build_id)

    def frames(self, addresses: Iterable[int]) -> list[Frame]:
        """Callers, without what a broken chain of frame pointers makes of them."""
        found: list[Frame] = []
        for address in addresses:
            # A return address is one behind the call.
            frame = self.frame(address - 1 if found else address)
            if not frame.module or (found and frame == found[-1]):
                break
            found.append(frame)
        return found

    def on_stack(self, stack: int) -> list[int]:
        """Return addresses that lie on a stack, from its top: what follows a call in a program's text.

        For code without frame pointers.  Some may be of calls that have returned.
        """
        words = self.read(stack, STACK_MAX)
        found: list[int] = []
        for (address,) in struct.iter_unpack("=Q", words[: len(words) // 8 * 8]):
            mapping = self._text_at(address)
            if mapping is not None and _CALL.search(self.read(address - 7, 7)):
                found.append(address)
                if len(found) == FRAMES_MAX:
                    break
        return found

    def _text_at(self, address: int) -> Mapping | None:
        at = bisect.bisect_right(self._starts, address) - 1
        mapping = self.maps[at] if at >= 0 else None
        return mapping if mapping and address < mapping.end and mapping.inode and "x" in mapping.flags else None

    def _image(self, mapping: Mapping) -> _Image:
        if mapping.file not in self._images:
            self._images[mapping.file] = self._read_image(mapping)
        return self._images[mapping.file]

    def _read_image(self, mapping: Mapping) -> _Image:
        """By its headers, as they stand in memory: the file itself may be another one by now."""
        first = next((each for each in self.maps if each.file == mapping.file and each.offset == 0), None)
        header = self.read(first.start, _EHDR.size) if first else b""
        if first is None or len(header) < _EHDR.size or header[:5] != b"\x7fELF\x02":
            return _Image()
        _, _, _, _, _, _, offset, _, _, _, size, count, *_ = _EHDR.unpack(header)
        loads, build_id = [], ""
        if size != _PHDR.size or offset > first.end - first.start:
            return _Image()
        table = self.read(first.start + offset, min(count, HEADERS_MAX) * size)
        for kind, _, begin, address, _, length, *_ in _PHDR.iter_unpack(table[: len(table) // size * size]):
            if kind == _PT_LOAD:
                loads.append((begin, address, length))
            elif kind == _PT_NOTE and not build_id and begin < first.end - first.start:
                build_id = build_id_of(self.read(first.start + begin, min(length, NOTES_MAX)))
        return _Image(tuple(loads), build_id)


def command_of(pid: int, init_pid: int) -> str:
    """The program of a child of `init_pid`, and of an interpreter its script; other arguments may be secrets.

    Raises OSError.
    """
    texts = [printable(word)[:COMMAND_MOST] for word in command_line(pid)[:2]]
    check_parent(pid, init_pid)
    if len(texts) == 2 and _INTERPRETERS.fullmatch(texts[0].rpartition("/")[2]) and not texts[1].startswith("-"):
        return " ".join(texts)
    return texts[0]


def check_parent(pid: int, init_pid: int) -> None:
    """Raises OSError when the number belongs to another process by now."""
    if int(stat_fields(pid)[1]) != init_pid:
        raise ProcessLookupError(f"process {pid} is another one")


def read_maps(pid: int) -> list[Mapping]:
    """The mappings of a process.  Raises OSError."""
    with Path(f"/proc/{pid}/maps").open("rb") as file:
        return parse_maps(file.read(MAPS_MAX))


def parse_maps(text: bytes) -> list[Mapping]:
    """The text of /proc/PID/maps, in which only the newlines of a path are escaped."""
    mappings = []
    for line in text.split(b"\n"):
        found = _LINE.fullmatch(line)
        if found is not None:
            path = printable(found[7].decode("utf-8", "replace"))[:PATH_MOST]
            mappings.append(
                Mapping(
                    int(found[1], 16),
                    int(found[2], 16),
                    found[3].decode(),
                    int(found[4], 16),
                    found[5].decode(),
                    int(found[6]),
                    path,
                )
            )
    return mappings


def build_id_of(notes: bytes) -> str:
    """The build id in a PT_NOTE segment; empty: there is none."""
    at = 0
    while at + 12 <= len(notes):
        name_size, size, kind = struct.unpack_from("=III", notes, at)
        name = at + 12
        begin = name + (name_size + 3) // 4 * 4
        if kind == _NT_GNU_BUILD_ID and notes[name : name + name_size] == b"GNU\0":
            return notes[begin : begin + min(size, 64)].hex()
        at = begin + (size + 3) // 4 * 4
    return ""
