# SPDX-License-Identifier: Apache-2.0
"""Receives fatal signals on this machine, with the registers of the threads that die.

Two of the kernel's tracepoints as perf events (perf_event_open(2)), on every CPU:

- `signal:signal_deliver` where there is no handler: a thread is about to die of a signal.  Sampled
  are its registers, and its callers as far as they keep frame pointers.  The other threads of the
  process follow, each with a SIGKILL.
- `signal:signal_generate` of signals that end a process: who sent it, and the thread's name.

The events belong to CPUs, not to processes: no context switch takes longer, and nothing happens
until a process dies.  They are of the whole machine, so that others must not take the room:

- A delivery is a real death.  Rings of these are read when a death is reported, or much has come; what
  was heard of applications that are protected makes way for nobody's.
- Signals cost their sender nothing, so that anybody can send millions.  They wake nobody: each ring keeps
  the newest, and is read only when a death is reported.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import logging
import math
import mmap
import os
import platform
import signal
import struct
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from avckpt.errors import AvckptError, KernelError, Unsupported

REGISTERS = (
    *("rax", "rbx", "rcx", "rdx", "rsi", "rdi", "rbp", "rsp", "rip", "eflags", "cs", "ss"),
    *("r8", "r9", "r10", "r11", "r12", "r13", "r14", "r15"),
)
"""In the order of a sample (asm/perf_regs.h), those of `_REGISTERS_MASK`."""
_REGISTERS_MASK = 0xFF0FFF
_ABI_64 = 2

CALLERS_MAX = 32
PROCESSES_MAX = 256
"""Dead processes of others that are remembered; the oldest make way."""
THREADS_MAX = 4096
"""Of each, ..."""
THREADS_ALL = 16384
"""... and of all others together: half a kilobyte for each."""
SELDOM_S = 60.0
"""What the kernel had no room for is logged at most this often."""
SENT_MAX = 2048
DELIVERED_PAGES = 2048
"""Rings of all CPUs together; each has a power of two, within these: """
RING_PAGES_MIN, RING_PAGES_MAX = 32, 256
SENT_PAGES = 32
WAKE_BYTES = 64 << 10

OURS = ("avckpt-tmpl", "avckpt-spare", "avckpt-hold", "avckpt-guard")
"""Names of tasks that are killed, and kill, at every checkpoint."""
_NOT_OURS = " && ".join(f'comm != "{name}"' for name in OURS)
# Their default action ends nobody; anybody can send them as often as he likes.
_DEADLY = " && ".join(
    f"sig != {number}"
    for number in (
        *(signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU),
        *(signal.SIGCONT, signal.SIGCHLD, signal.SIGURG, signal.SIGWINCH),
    )
)
_DELIVER = f"sa_handler == 0 && {_DEADLY} && {_NOT_OURS}"
# Those that the CPU raises have no sender; SIGSEGV is left out, because runtimes live on it.
_SENT = " || ".join(f"sig == {number}" for number in (signal.SIGSEGV, signal.SIGTERM, signal.SIGINT, signal.SIGQUIT))
_ALWAYS = " || ".join(
    f"sig == {number}"
    for number in (signal.SIGABRT, signal.SIGKILL, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS)
)
_GENERATE = f"({_ALWAYS} || ((code == 0 || code == -1 || code == -6) && ({_SENT}))) && result == 0 && {_NOT_OURS}"
"""Result 0: it was not dropped, or pending already."""

# What a signal that leaves a core is delivered as; of any other the kernel itself makes a SIGKILL for every
# thread (complete_signal(), kernel/signal.c).
_WITH_CORE = frozenset(
    (signal.SIGQUIT, signal.SIGILL, signal.SIGTRAP, signal.SIGABRT, signal.SIGFPE, signal.SIGSEGV, signal.SIGBUS)
) | {signal.SIGSYS, signal.SIGXCPU, signal.SIGXFSZ}

# linux/perf_event.h
_TYPE_TRACEPOINT = 2
_SAMPLE_TID, _SAMPLE_TIME, _SAMPLE_CALLCHAIN, _SAMPLE_RAW, _SAMPLE_REGS_USER = 1 << 1, 1 << 2, 1 << 5, 1 << 10, 1 << 12
_FLAG_DISABLED, _FLAG_WATERMARK, _FLAG_NO_KERNEL_CALLERS = 1 << 0, 1 << 14, 1 << 21
_FLAG_CLOCKID, _FLAG_BACKWARD = 1 << 25, 1 << 27
_ATTR = struct.Struct("=IIQQQQQIIQQQQIiQIHH")
_OPEN_CLOEXEC = 8
_ENABLE, _SET_FILTER, _PAUSE_OUTPUT = 0x2400, 0x40082406, 0x40042409
_RECORD_LOST, _RECORD_SAMPLE = 2, 9
_HEADER = struct.Struct("=IHH")
_HEAD, _TAIL = 1024, 1032
_CONTEXT_FROM = 2**64 - 4095
"""Callers from here on are no addresses, but say whose the following are."""

_NR_PERF_EVENT_OPEN = 298  # x86_64
_NR_FSOPEN, _NR_FSCONFIG, _NR_FSMOUNT = 430, 431, 432
_FSCONFIG_CREATE = 6

_libc = ctypes.CDLL(None, use_errno=True)

log = logging.getLogger("avckpt")


@dataclass(frozen=True)
class Delivery:
    """A thread that died: the signal, and where it was in user space."""

    tid: int
    at_ns: int
    """CLOCK_MONOTONIC."""
    signal: int
    code: int
    """`si_code` of sigaction(2)."""
    callers: tuple[int, ...]
    """Addresses, itself first, as far as there are frame pointers."""
    registers: dict[str, int]
    """Empty: the kernel had none."""


@dataclass(frozen=True)
class Sent:
    """A signal on its way to a process."""

    at_ns: int
    signal: int
    code: int
    sender_pid: int
    tid: int
    """Whom it was sent to: a thread, or for the whole process one of its threads."""
    thread: str
    """That one's name."""


@dataclass
class Death:
    """All that was heard of one process."""

    pid: int = 0
    deliveries: dict[int, Delivery] = field(default_factory=dict)
    """By thread."""
    sent: list[Sent] = field(default_factory=list)

    def fatal(self, signum: int) -> Delivery | None:
        """The thread that the signal hit first: those that follow die of SIGKILL.

        Of a SIGKILL the main thread.  None: the kernel's report of it was lost.
        """
        hit = [each for each in self.deliveries.values() if each.signal == signum != signal.SIGKILL]
        first = min(hit, key=lambda each: each.at_ns, default=None)
        if first is not None or signum in _WITH_CORE:
            return first
        return self.deliveries.get(self.pid) or next(iter(self.deliveries.values()), None)


class Deaths:
    """What has died lately.  For one thread.  Raises AvckptError when this machine does not tell.

    `protected` says which processes it is about.  `pages`: of the ring of each CPU; 0: by their number.
    """

    def __init__(self, protected: Callable[[], Collection[int]], pages: int = 0) -> None:
        if platform.machine() != "x86_64":
            raise Unsupported(f"registers of {platform.machine()} are not known", operation="hear of deaths")
        self._known: OrderedDict[int, dict[int, bytes]] = OrderedDict()
        """The newest report of each thread, by process: of most nobody ever wants to know."""
        self._sent: OrderedDict[int, Sent] = OrderedDict()
        self._protected = protected
        self.lost = 0
        """Deaths of threads that the kernel had no room to report."""
        self._lost_told = 0
        self._lost_told_s = -math.inf
        self._delivered: list[_Ring] = []
        self._generated: list[_Newest] = []
        try:
            with _tracefs() as root:
                deliver = _tracepoint(root, "signal_deliver")
                generate = _tracepoint(root, "signal_generate")
            cpus = _online()
            pages = pages or _pages_of_ring(len(cpus))
            for cpu in cpus:
                self._delivered.append(_Ring(cpu, deliver, pages))
                self._generated.append(_Newest(cpu, generate))
        except OSError as error:
            self.close()
            raise KernelError(
                "the kernel does not tell of deaths", errno=error.errno or 0, syscall="perf_event_open"
            ) from error
        except AvckptError:
            self.close()
            raise

    @property
    def fds(self) -> list[int]:
        """Readable when there is much to read: call `take()`."""
        return [ring.fd for ring in self._delivered]

    def take(self, most: int = RING_PAGES_MAX * mmap.PAGESIZE) -> bool:
        """Reads who has died, `most` bytes of each CPU's ring; whether there is more."""
        self.lost += sum(ring.read(self._take_delivery, most) for ring in self._delivered)
        if self.lost > self._lost_told and time.monotonic() - self._lost_told_s >= SELDOM_S:
            lost = self.lost - self._lost_told
            log.warning("too many deaths at once: the kernel had no room to report %d of a thread", lost)
            self._lost_told, self._lost_told_s = self.lost, time.monotonic()
        threads = sum(map(len, self._known.values()))
        if len(self._known) > PROCESSES_MAX or threads > THREADS_ALL:
            self._make_room()
        return any(ring.is_behind() for ring in self._delivered)

    def _make_room(self) -> None:
        protected = self._protected()
        others = deque(pid for pid in self._known if pid not in protected)
        threads = sum(len(self._known[pid]) for pid in others)
        while len(others) > PROCESSES_MAX or threads > THREADS_ALL:
            threads -= len(self._known.pop(others.popleft()))

    def of(self, pid: int) -> Death:
        """What was heard of a process that has ended, in our PID namespace."""
        self.take()
        for ring in self._generated:
            ring.read(self._take_sent)
        while len(self._sent) > SENT_MAX:
            self._sent.popitem(last=False)
        threads = self._known.pop(pid, {})
        death = Death(pid, {tid: _delivery_of(tid, body) for tid, body in threads.items()})
        tids = {pid, *death.deliveries}
        death.sent = [sent for sent in self._sent.values() if sent.tid in tids]
        return death

    def close(self) -> None:
        """Hears no more."""
        for ring in (*self._delivered, *self._generated):
            ring.close()
        self._delivered.clear()
        self._generated.clear()

    def _take_delivery(self, body: bytes) -> None:
        pid, tid, at_ns = struct.unpack_from("=iiQ", body)
        threads = self._known.setdefault(pid, {})
        self._known.move_to_end(pid)
        known = threads.get(tid)
        # Of an earlier process with that number, on whichever CPU.
        older = known is not None and struct.unpack_from("=Q", known, 8)[0] < at_ns
        if older or (known is None and len(threads) < THREADS_MAX):
            threads[tid] = body

    def _take_sent(self, body: bytes) -> None:
        pid, _, at_ns, _ = struct.unpack_from("=iiQI", body)
        signum, _, code, name, target = struct.unpack_from("=iii16si", body, 20 + 8)
        thread = name.partition(b"\0")[0].decode("utf-8", "replace")
        known = self._sent.get(target)
        if known is not None and known.at_ns > at_ns:
            return  # sent on another CPU, whose ring was read before
        self._sent[target] = Sent(at_ns, signum, code, pid, target, thread)
        self._sent.move_to_end(target)


class _Event:
    """A tracepoint on one CPU, with a ring for its samples.  Raises OSError."""

    def __init__(self, fd: int, what: str, pages: int, prot: int) -> None:
        self.fd = fd
        self._map: mmap.mmap | None = None
        self._size = pages * mmap.PAGESIZE
        try:
            _filter(fd, what)
            self._map = mmap.mmap(fd, mmap.PAGESIZE + self._size, prot=prot)
            fcntl.ioctl(fd, _ENABLE, 0)
        except OSError:
            self.close()
            raise

    def _head(self) -> int:
        assert self._map is not None
        head: int = struct.unpack_from("Q", self._map, _HEAD)[0]
        return head

    def _bytes(self, at: int, length: int) -> bytes:
        assert self._map is not None
        at, begin = at % self._size, mmap.PAGESIZE
        part = self._map[begin + at : begin + min(at + length, self._size)]
        return part + self._map[begin : begin + length - len(part)]

    def close(self) -> None:
        if self._map is not None:
            self._map.close()
        os.close(self.fd)


class _Ring(_Event):
    """Deliveries: what has been read makes room; what finds none is lost, and counted."""

    def __init__(self, cpu: int, tracepoint: int, pages: int) -> None:
        sample = _SAMPLE_TID | _SAMPLE_TIME | _SAMPLE_CALLCHAIN | _SAMPLE_RAW | _SAMPLE_REGS_USER
        wake = min(WAKE_BYTES, pages * mmap.PAGESIZE // 2)
        fd = _open_event(cpu, tracepoint, sample, _FLAG_NO_KERNEL_CALLERS, wake)
        super().__init__(fd, _DELIVER, pages, mmap.PROT_READ | mmap.PROT_WRITE)

    def read(self, take: Callable[[bytes], None], most: int) -> int:
        """Gives each sample in the next `most` bytes to `take`, and frees its room; how many were lost."""
        assert self._map is not None
        (tail,) = struct.unpack_from("Q", self._map, _TAIL)
        new = self._bytes(tail, min(self._head() - tail, most))
        lost = at = 0
        while at + _HEADER.size <= len(new):
            kind, _, length = _HEADER.unpack_from(new, at)
            if at + length > len(new):
                break  # the rest is for the next time
            if kind == _RECORD_SAMPLE:
                take(new[at + _HEADER.size : at + length])
            elif kind == _RECORD_LOST:
                lost += struct.unpack_from("=QQ", new, at + _HEADER.size)[1]
            at += length
        struct.pack_into("Q", self._map, _TAIL, tail + at)
        return lost

    def is_behind(self) -> bool:
        """Whether there is more to read."""
        assert self._map is not None
        (tail,) = struct.unpack_from("Q", self._map, _TAIL)
        return self._head() > int(tail)


class _Newest(_Event):
    """Signals: the kernel writes backwards, over the oldest."""

    def __init__(self, cpu: int, tracepoint: int) -> None:
        sample = _SAMPLE_TID | _SAMPLE_TIME | _SAMPLE_RAW
        fd = _open_event(cpu, tracepoint, sample, _FLAG_BACKWARD, SENT_PAGES * mmap.PAGESIZE)
        super().__init__(fd, _GENERATE, SENT_PAGES, mmap.PROT_READ)
        self._seen = 0

    def read(self, take: Callable[[bytes], None]) -> None:
        """Gives those that are new to `take`, the newest last."""
        fcntl.ioctl(self.fd, _PAUSE_OUTPUT, 1)
        head = self._head()
        new = self._bytes(head, min((self._seen - head) % 2**64, self._size))
        fcntl.ioctl(self.fd, _PAUSE_OUTPUT, 0)
        self._seen = head
        samples, at = [], 0
        while at + _HEADER.size <= len(new):
            kind, _, length = _HEADER.unpack_from(new, at)
            if length < _HEADER.size or at + length > len(new):
                break  # the oldest is half overwritten
            if kind == _RECORD_SAMPLE:
                samples.append(new[at + _HEADER.size : at + length])
            at += length
        for body in reversed(samples):
            take(body)


def _pages_of_ring(cpus: int) -> int:
    """A power of two."""
    wanted = max(RING_PAGES_MIN, min(RING_PAGES_MAX, DELIVERED_PAGES // cpus))
    return 1 << (wanted.bit_length() - 1)


def _delivery_of(tid: int, body: bytes) -> Delivery:
    _, _, at_ns, count = struct.unpack_from("=iiQQ", body)
    chain = struct.unpack_from(f"={count}Q", body, 24)
    at = 24 + 8 * count
    (size,) = struct.unpack_from("=I", body, at)
    signum, _, code = struct.unpack_from("=iii", body, at + 4 + 8)
    callers = tuple(address for address in chain if address < _CONTEXT_FROM)[:CALLERS_MAX]
    return Delivery(tid, at_ns, signum, code, callers, _registers(body, at + 4 + size))


def _registers(body: bytes, at: int) -> dict[str, int]:
    # The raw data before it ends at a multiple of eight bytes.
    (abi,) = struct.unpack_from("=Q", body, at)
    if abi != _ABI_64:
        return {}
    return dict(zip(REGISTERS, struct.unpack_from(f"={len(REGISTERS)}Q", body, at + 8)))


def _open_event(cpu: int, tracepoint: int, sample: int, flags: int, wake_bytes: int) -> int:
    flags |= _FLAG_DISABLED | _FLAG_WATERMARK | _FLAG_CLOCKID
    registers, callers = (_REGISTERS_MASK, CALLERS_MAX) if sample & _SAMPLE_REGS_USER else (0, 0)
    attr = ctypes.create_string_buffer(
        _ATTR.pack(
            *(_TYPE_TRACEPOINT, _ATTR.size, tracepoint, 1, sample, 0, flags),
            *(wake_bytes, 0, 0, 0, 0),
            *(registers, 0, 1, 0, 0, callers, 0),  # 1: CLOCK_MONOTONIC
        )
    )
    return _syscall(_NR_PERF_EVENT_OPEN, attr, -1, cpu, -1, _OPEN_CLOEXEC)


def _filter(fd: int, what: str) -> None:
    text = ctypes.create_string_buffer(what.encode())
    if _libc.ioctl(fd, ctypes.c_ulong(_SET_FILTER), text) != 0:
        errno = ctypes.get_errno()
        raise OSError(errno, os.strerror(errno))


def _online() -> list[int]:
    cpus: list[int] = []
    for part in Path("/sys/devices/system/cpu/online").read_text().strip().split(","):
        first, _, last = part.partition("-")
        cpus += range(int(first), int(last or first) + 1)
    return cpus


@contextlib.contextmanager
def _tracefs() -> Iterator[int]:
    """A descriptor of the file system with the tracepoints' numbers, which need not be mounted anywhere."""
    fs = _syscall(_NR_FSOPEN, b"tracefs", 1)
    try:
        _syscall(_NR_FSCONFIG, fs, _FSCONFIG_CREATE, None, None, 0)
        root = _syscall(_NR_FSMOUNT, fs, 1, 0)
    finally:
        os.close(fs)
    try:
        yield root
    finally:
        os.close(root)


def _tracepoint(root: int, name: str) -> int:
    fd = os.open(f"events/signal/{name}/id", os.O_RDONLY | os.O_CLOEXEC, dir_fd=root)
    with os.fdopen(fd) as file:
        return int(file.read(16))


def _syscall(number: int, *arguments: object) -> int:
    """Raises OSError."""
    result = int(_libc.syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        errno = ctypes.get_errno()
        raise OSError(errno, os.strerror(errno))
    return result
