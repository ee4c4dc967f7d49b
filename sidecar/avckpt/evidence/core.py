# SPDX-License-Identifier: Apache-2.0
"""Writes a core file of a dead application, from the memory that it has left.

    python -m avckpt.evidence.core < REQUEST > ANSWER      (JSON)

A program of its own, at the lowest priority: a gigabyte of somebody's memory is not for the daemon.
It is an ELF core as the kernel writes it (core(5)), compressed by zstd, of the pages that there
are: those that were never touched, and files that can be read elsewhere, are left out.

What the kernel did not tell is not in it: FPU and vector registers.  The base of FS is where a thread's
own memory says so (`_thread_pointers`).
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import struct
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zstandard

from avckpt.evidence.remains import Mapping, Remains

PAGE = os.sysconf("SC_PAGE_SIZE")
CHUNK = 4 << 20
SPARSE_MAX = 64 << 30
"""Mappings beyond that are reserved addresses, not memory: to look through them takes seconds."""
SEGMENTS_MAX = 60_000
GAP_PAGES = 16
"""So few pages that are not there do not part a segment."""
MINI_DATA, MINI_DATA_ALL = 256 << 10, 16 << 20
"""A mini core has private mappings up to this size each, and all together: data of programs and libraries."""
MINI_STACK = 256 << 10
RED_ZONE = 128
STACK_ALL = 64 << 20
"""Of a thread's stack, above its end: the C library keeps the thread's own data there."""
BLOCK = 1 << 16
"""Of addresses that differ in their low two bytes only."""
TLS_MAX = 1 << 20
"""A mapping that ld.so makes for the data of the main thread is smaller."""

_EHDR = struct.Struct("=16sHHIQQQIHHHHHH")
_PHDR = struct.Struct("=IIQQQQQQ")
_PRSTATUS = struct.Struct("=iiihhQQiiii8Q27Qii")
_PRPSINFO = struct.Struct("=cccbxxxxQIIiiii16s80s")
_SIGINFO = struct.Struct("=iiiiQ104x")
_ET_CORE, _EM_X86_64 = 4, 62
_PT_LOAD, _PT_NOTE = 1, 4
_NT_PRSTATUS, _NT_PRPSINFO, _NT_AUXV, _NT_FILE, _NT_SIGINFO = 1, 3, 6, 0x46494C45, 0x53494749
# struct user_regs_struct; what is not sampled is 0.
_REGS = (
    *("r15", "r14", "r13", "r12", "rbp", "rbx", "r11", "r10", "r9", "r8", "rax", "rcx", "rdx", "rsi", "rdi"),
    *("orig_rax", "rip", "cs", "eflags", "rsp", "ss", "fs_base", "gs_base", "ds", "es", "fs", "gs"),
)
_PRESENT, _SWAPPED, _OF_FILE = 1 << 63, 1 << 62, 1 << 61


@dataclass(frozen=True)
class Thread:
    """One that died."""

    tid: int
    registers: dict[str, int]


@dataclass(frozen=True)
class Request:
    """A core that is wanted."""

    remains_pid: int
    path: str
    mini: bool
    bytes_max: int
    """Of the compressed file: what grows beyond is given up."""
    seconds_max: float
    app_pid: int
    signal: int
    code: int
    fault: int
    threads: list[Thread]
    """The one that was hit first."""
    command: str

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Request:
        """What the daemon wrote."""
        return cls(**{**data, "threads": [Thread(**each) for each in data["threads"]]})


@dataclass(frozen=True)
class Segment:
    """Addresses with their contents."""

    start: int
    end: int
    flags: str


class TooLong(Exception):
    """It took, or became, more than it was allowed."""


def write(request: Request) -> dict[str, object]:
    """Makes the file, whole or not at all.  Raises OSError, TooLong."""
    begun = time.monotonic()
    remains = Remains(request.remains_pid)
    aside = Path(f"{request.path}.new")
    try:
        segments = list(_segments(remains, request))
        notes = _notes(remains, request)
        fd = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(fd, "wb") as file, zstandard.ZstdCompressor(level=1).stream_writer(file) as out:
            total = 0
            for piece in _pieces(remains, segments, notes):
                out.write(piece)
                total += len(piece)
                if file.tell() > request.bytes_max:
                    raise TooLong(f"it would be larger than {request.bytes_max / 1e6:.0f} MB")
                if time.monotonic() - begun > request.seconds_max:
                    raise TooLong(f"it would take longer than {request.seconds_max:g} s")
        aside.replace(request.path)
    finally:
        remains.close()
        with contextlib.suppress(FileNotFoundError):
            aside.unlink()
    return {
        "bytes": os.stat(request.path).st_size,
        "memory_bytes": total,
        "seconds": time.monotonic() - begun,
        "threads": len(request.threads),
    }


# ---- which memory --------------------------------------------------------------


def _segments(remains: Remains, request: Request) -> Iterator[Segment]:
    pages = os.open(f"/proc/{remains.pid}/pagemap", os.O_RDONLY | os.O_CLOEXEC)
    try:
        count = 0
        for mapping, start, end in _mini(remains, request) if request.mini else _whole(remains):
            for begin, stop in _runs(pages, mapping, start, end):
                count += 1
                if count > SEGMENTS_MAX:
                    raise TooLong("its memory is in too many pieces")
                yield Segment(begin, stop, mapping.flags)
    finally:
        os.close(pages)


def _is_ours(mapping: Mapping) -> bool:
    return "avckpt" in mapping.path


def _whole(remains: Remains) -> Iterator[tuple[Mapping, int, int]]:
    for mapping in remains.maps:
        if "r" in mapping.flags and not _is_ours(mapping) and mapping.end - mapping.start <= SPARSE_MAX:
            yield mapping, mapping.start, mapping.end


def _mini(remains: Remains, request: Request) -> Iterator[tuple[Mapping, int, int]]:
    """Stacks, and what a debugger needs to find programs and libraries."""
    tops = sorted(each.registers["rsp"] - RED_ZONE for each in request.threads if each.registers)
    data = 0
    for mapping in remains.maps:
        size = mapping.end - mapping.start
        if "r" not in mapping.flags or _is_ours(mapping):
            continue
        # Written data of programs and libraries, and what ld.so keeps of them: a debugger looks there.
        if size <= MINI_DATA and "p" in mapping.flags and data + size <= MINI_DATA_ALL:
            data += 0 if "x" in mapping.flags else size
            yield mapping, mapping.start, mapping.end
        elif mapping.inode and mapping.offset == 0:
            yield mapping, mapping.start, mapping.start + PAGE
        elif "w" in mapping.flags:
            for start, end in _merged(mapping, tops):
                yield mapping, start, end


def _merged(mapping: Mapping, tops: list[int]) -> Iterator[tuple[int, int]]:
    """The parts of a mapping that are somebody's stack."""
    at = 0
    for top in tops:
        start = max(top // PAGE * PAGE, mapping.start, at)
        end = min((top + MINI_STACK) // PAGE * PAGE, mapping.end)
        if mapping.start <= top < mapping.end and start < end:
            yield start, end
            at = end


def _runs(pagemap: int, mapping: Mapping, start: int, end: int) -> Iterator[tuple[int, int]]:
    """The pages of it that are there, and that no file has."""
    begin = stop = 0
    for address in range(start, end, CHUNK // 8 * PAGE):
        size = min(CHUNK, (end - address) // PAGE * 8)
        entries = os.pread(pagemap, size, address // PAGE * 8)
        for i, (entry,) in enumerate(struct.iter_unpack("=Q", entries[: len(entries) // 8 * 8])):
            if not _is_wanted(mapping, entry, address + i * PAGE):
                continue
            page = address + i * PAGE
            if stop and page - stop > GAP_PAGES * PAGE:
                yield begin, stop
                begin = page
            begin, stop = begin or page, page + PAGE
    if stop:
        yield begin, stop


def _is_wanted(mapping: Mapping, entry: int, page: int) -> bool:
    if mapping.path == "[vdso]":
        return True
    if not entry & (_PRESENT | _SWAPPED):
        return False
    if mapping.inode == 0:
        return True
    if mapping.flags[3] == "s":
        return mapping.path.endswith("(deleted)")  # memory that has no other name
    # Of a file: what was written, and the headers by which a debugger knows it.
    return not entry & _OF_FILE or (mapping.offset == 0 and page == mapping.start)


# ---- the file ----------------------------------------------------------------------


def _pieces(remains: Remains, segments: list[Segment], notes: bytes) -> Iterator[bytes]:
    headers = _EHDR.size + (1 + len(segments)) * _PHDR.size
    at = (headers + len(notes) + PAGE - 1) // PAGE * PAGE
    ident = b"\x7fELF\x02\x01\x01" + bytes(9)
    count = 1 + len(segments)
    yield _EHDR.pack(ident, _ET_CORE, _EM_X86_64, 1, 0, _EHDR.size, 0, 0, _EHDR.size, _PHDR.size, count, 0, 0, 0)
    yield _PHDR.pack(_PT_NOTE, 0, headers, 0, 0, len(notes), 0, 4)
    padding = at - headers - len(notes)
    for each in segments:
        size = each.end - each.start
        flags = sum(bit for bit, letter in ((4, "r"), (2, "w"), (1, "x")) if letter in each.flags)
        yield _PHDR.pack(_PT_LOAD, flags, at, each.start, 0, size, size, PAGE)
        at += size
    yield notes + bytes(padding)
    for each in segments:
        for address in range(each.start, each.end, CHUNK):
            yield from _memory(remains, address, min(CHUNK, each.end - address))


def _memory(remains: Remains, address: int, size: int) -> Iterator[bytes]:
    """Exactly that many bytes: what cannot be read is zeros."""
    while size:
        data = remains.read(address, size)
        if not data:
            data = bytes(min(PAGE, size))
        yield data
        address += len(data)
        size -= len(data)


def _note(kind: int, body: bytes) -> bytes:
    return struct.pack("=III8s", 5, len(body), kind, b"CORE\0") + body + bytes(-len(body) % 4)


def _notes(remains: Remains, request: Request) -> bytes:
    threads = request.threads or [Thread(request.app_pid, {})]
    pointers = _thread_pointers(remains, threads)
    first, *others = (_note(_NT_PRSTATUS, _prstatus(request, each, pointers.get(each.tid, 0))) for each in threads)
    name = request.command.rpartition("/")[2].encode()[:15]
    info = _PRPSINFO.pack(
        *(b"\0", b"R", b"\0", 0, 0, 0, 0, request.app_pid, 0, 0, 0, name, request.command.encode()[:79])
    )
    siginfo = _SIGINFO.pack(request.signal, 0, request.code, 0, request.fault)
    auxv = Path(f"/proc/{remains.pid}/auxv").read_bytes()[: 4 << 10]
    notes = [first, _note(_NT_PRPSINFO, info), _note(_NT_SIGINFO, siginfo), _note(_NT_AUXV, auxv)]
    return b"".join([*notes, _note(_NT_FILE, _files(remains.maps)), *others])


def _thread_pointers(remains: Remains, threads: list[Thread]) -> dict[int, int]:
    """The base of FS by thread, of those that can be told.

    Where FS points to, programs of the C library have the address itself, twice (`tcb` and `self` of tcbhead_t).
    Of a thread that pthread_create(3) made this is above its stack; of the main thread it is in a small mapping.
    """
    found: dict[int, int] = {}
    stacks = [each.registers["rsp"] for each in threads if each.registers]
    for each in threads:
        stack = each.registers.get("rsp", 0)
        mapping = next((one for one in remains.maps if one.start <= stack < one.end), None)
        if mapping is None or mapping.path == "[stack]":
            continue
        # Usually at the end of a mapping that is this stack and nothing else.  What was never touched takes
        # page tables when it is read.
        alone = sum(mapping.start <= at < mapping.end for at in stacks) == 1
        above = _self_pointers(remains, max(stack, mapping.end - BLOCK), mapping.end) if alone else []
        above = above or _self_pointers(remains, stack, min(mapping.end, stack + STACK_ALL))
        if above:
            found[each.tid] = above[0]
    rest = [each.tid for each in threads if each.registers and each.tid not in found]
    small = [
        one
        for one in remains.maps
        if "rw" in one.flags and one.inode == 0 and one.end - one.start <= TLS_MAX and one.path in ("", "[heap]")
    ]
    others = {at for one in small for at in _self_pointers(remains, one.start, one.end)} - set(found.values())
    if len(rest) == len(others) == 1:
        found[rest[0]] = others.pop()
    return found


def _self_pointers(remains: Remains, start: int, end: int) -> list[int]:
    found = []
    for begin in range(start // BLOCK * BLOCK, end, BLOCK):
        base = max(begin, start // 8 * 8)
        # 16 bytes further than the block: the second address may be there.
        words = remains.read(base, min(begin + BLOCK, end) + 24 - base)
        high = re.escape(struct.pack("=Q", begin)[2:])
        for match in re.finditer(rb"(?=" + high + rb")", words):
            at = match.start() - 2
            if at % 8 == 0 and words[at : at + 8] == words[at + 16 : at + 24] == struct.pack("=Q", base + at):
                found.append(base + at)
    return found


def _prstatus(request: Request, thread: Thread, thread_pointer: int) -> bytes:
    known = {"orig_rax": 2**64 - 1, "fs_base": thread_pointer, **thread.registers}
    registers = [known.get(name, 0) for name in _REGS]
    signum = request.signal  # of all threads, as the kernel has it
    return _PRSTATUS.pack(signum, 0, 0, signum, 0, 0, 0, thread.tid, 0, 0, 0, *[0] * 8, *registers, 0, 0)


def _files(maps: Iterable[Mapping]) -> bytes:
    named = [each for each in maps if each.inode and not _is_ours(each)]
    table = b"".join(struct.pack("=QQQ", each.start, each.end, each.offset // PAGE) for each in named)
    names = b"".join(each.path.encode() + b"\0" for each in named)
    return struct.pack("=QQ", len(named), PAGE) + table + names


def main() -> None:
    """Reads a request, writes an answer."""
    os.nice(19)
    request = Request.from_json(json.load(sys.stdin))
    try:
        answer = write(request)
    except (OSError, TooLong) as error:
        answer = {"problem": str(error)}
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
