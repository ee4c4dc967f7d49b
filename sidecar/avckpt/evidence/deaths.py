# SPDX-License-Identifier: Apache-2.0
"""Receives fatal signals on this machine, with the registers of the threads that die.

Two of the kernel's tracepoints as perf events (perf_event_open(2)), on every CPU:

- `signal:signal_deliver` where there is no handler: a thread is about to die of a signal.  Sampled
  are its registers, and its callers as far as they keep frame pointers.  The other threads of the
  process follow, each with a SIGKILL.
- `signal:signal_generate` of signals that end a process: who sent it, and the thread's name.

The events belong to CPUs, not to processes: no context switch takes longer, and nothing happens
until a process dies.  The rings are read when a death is reported, or one is half full.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import mmap
import os
import platform
import signal
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
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
"""Dead processes that are remembered; the oldest make way."""
THREADS_MAX = 4096
"""Of each."""
RING_PAGES = 32

OURS = ("avckpt-tmpl", "avckpt-spare", "avckpt-hold", "avckpt-guard")
"""Names of tasks that are killed, and kill, at every checkpoint."""
_NOT_OURS = " && ".join(f'comm != "{name}"' for name in OURS)
_DELIVER = f"sa_handler == 0 && {_NOT_OURS}"
# Those that the CPU raises have no sender; SIGSEGV is left out, because runtimes live on it.
_SENT = " || ".join(f"sig == {number}" for number in (signal.SIGSEGV, signal.SIGTERM, signal.SIGINT, signal.SIGQUIT))
_ALWAYS = " || ".join(
    f"sig == {number}"
    for number in (signal.SIGABRT, signal.SIGKILL, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS)
)
_GENERATE = f"({_ALWAYS} || ((code == 0 || code == -1 || code == -6) && ({_SENT}))) && {_NOT_OURS}"

# linux/perf_event.h
_TYPE_TRACEPOINT = 2
_SAMPLE_TID, _SAMPLE_TIME, _SAMPLE_CALLCHAIN, _SAMPLE_RAW, _SAMPLE_REGS_USER = 1 << 1, 1 << 2, 1 << 5, 1 << 10, 1 << 12
_FLAG_DISABLED, _FLAG_WATERMARK, _FLAG_NO_KERNEL_CALLERS, _FLAG_CLOCKID = 1 << 0, 1 << 14, 1 << 21, 1 << 25
_ATTR = struct.Struct("=IIQQQQQIIQQQQIiQIHH")
_OPEN_CLOEXEC = 8
_ENABLE, _SET_OUTPUT, _SET_FILTER = 0x2400, 0x2405, 0x40082406
_RECORD_SAMPLE = 9
_HEAD, _TAIL = 1024, 1032
_CONTEXT_FROM = 2**64 - 4095
"""Callers from here on are no addresses, but say whose the following are."""

_NR_PERF_EVENT_OPEN = 298  # x86_64
_NR_FSOPEN, _NR_FSCONFIG, _NR_FSMOUNT = 430, 431, 432
_FSCONFIG_CREATE = 6

_libc = ctypes.CDLL(None, use_errno=True)


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
    """By thread; the first of each."""
    sent: list[Sent] = field(default_factory=list)

    def fatal(self, signum: int) -> Delivery | None:
        """The thread that the signal hit first: those that follow die of SIGKILL.

        Of a SIGKILL the main thread.  Of a signal without a core the kernel itself makes a SIGKILL for every
        thread (complete_signal(), kernel/signal.c).
        """
        hit = [each for each in self.deliveries.values() if each.signal == signum != signal.SIGKILL]
        first = min(hit, key=lambda each: each.at_ns, default=None)
        return first or self.deliveries.get(self.pid) or next(iter(self.deliveries.values()), None)


class Deaths:
    """What has died lately.  For one thread.  Raises AvckptError when this machine does not tell."""

    def __init__(self) -> None:
        if platform.machine() != "x86_64":
            raise Unsupported(f"registers of {platform.machine()} are not known", operation="hear of deaths")
        self._known: OrderedDict[int, Death] = OrderedDict()
        self._sent: OrderedDict[int, Sent] = OrderedDict()
        self._rings: list[_Ring] = []
        try:
            with _tracefs() as root:
                self._deliver = _tracepoint(root, "signal_deliver")
                generate = _tracepoint(root, "signal_generate")
            for cpu in _online():
                ring = _Ring(cpu, self._deliver, _DELIVER)
                self._rings.append(ring)
                ring.add(generate, _GENERATE)
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
        """Readable when a ring is half full: call `take()`."""
        return [ring.fd for ring in self._rings]

    def take(self) -> None:
        """Reads the rings."""
        for ring in self._rings:
            ring.read(self._sample)

    def of(self, pid: int) -> Death:
        """What was heard of a process that has ended, in our PID namespace."""
        self.take()
        death = self._known.pop(pid, Death(pid))
        tids = {pid, *death.deliveries}
        death.sent = [sent for sent in self._sent.values() if sent.tid in tids]
        return death

    def close(self) -> None:
        """Hears no more."""
        for ring in self._rings:
            ring.close()
        self._rings.clear()

    def _sample(self, body: bytes) -> None:
        pid, tid, at_ns, count = struct.unpack_from("=iiQQ", body)
        chain = struct.unpack_from(f"={count}Q", body, 24)
        at = 24 + 8 * count
        (size,) = struct.unpack_from("=I", body, at)
        raw = body[at + 4 : at + 4 + size]
        (number,) = struct.unpack_from("=H", raw)
        signum, _, code = struct.unpack_from("=iii", raw, 8)
        if number == self._deliver:
            callers = tuple(address for address in chain if address < _CONTEXT_FROM)[:CALLERS_MAX]
            registers = _registers(body, at + 4 + size)
            self._remember(pid, Delivery(tid, at_ns, signum, code, callers, registers))
        else:
            name, target = struct.unpack_from("=16si", raw, 20)
            thread = name.partition(b"\0")[0].decode("utf-8", "replace")
            self._sent[target] = Sent(at_ns, signum, code, pid, target, thread)
            self._sent.move_to_end(target)
            while len(self._sent) > PROCESSES_MAX:
                self._sent.popitem(last=False)

    def _remember(self, pid: int, delivery: Delivery) -> None:
        death = self._known.setdefault(pid, Death(pid))
        if len(death.deliveries) < THREADS_MAX:
            death.deliveries.setdefault(delivery.tid, delivery)
        while len(self._known) > PROCESSES_MAX:
            self._known.popitem(last=False)


class _Ring:
    """What one CPU has to tell.  Raises OSError."""

    def __init__(self, cpu: int, tracepoint: int, what: str) -> None:
        self._cpu = cpu
        self._map: mmap.mmap | None = None
        self.fd = _open_event(cpu, tracepoint)
        self._fds = [self.fd]
        try:
            _filter(self.fd, what)
            self._map = mmap.mmap(self.fd, (1 + RING_PAGES) * mmap.PAGESIZE)
            fcntl.ioctl(self.fd, _ENABLE, 0)
        except OSError:
            self.close()
            raise

    def add(self, tracepoint: int, what: str) -> None:
        """Another event, into the same ring."""
        fd = _open_event(self._cpu, tracepoint)
        self._fds.append(fd)
        _filter(fd, what)
        fcntl.ioctl(fd, _SET_OUTPUT, self.fd)
        fcntl.ioctl(fd, _ENABLE, 0)

    def read(self, take: Callable[[bytes], None]) -> None:
        """Gives each sample to `take`, and frees its room."""
        assert self._map is not None
        size = RING_PAGES * mmap.PAGESIZE
        (head,) = struct.unpack_from("=Q", self._map, _HEAD)
        (tail,) = struct.unpack_from("=Q", self._map, _TAIL)
        while tail < head:
            kind, _, length = struct.unpack("=IHH", self._bytes(tail % size, 8))
            if kind == _RECORD_SAMPLE:
                take(self._bytes((tail + 8) % size, length - 8))
            tail += length
        struct.pack_into("=Q", self._map, _TAIL, tail)

    def _bytes(self, at: int, length: int) -> bytes:
        assert self._map is not None
        size, begin = RING_PAGES * mmap.PAGESIZE, mmap.PAGESIZE
        part = self._map[begin + at : begin + min(at + length, size)]
        return part + self._map[begin : begin + length - len(part)]

    def close(self) -> None:
        if self._map is not None:
            self._map.close()
        for fd in self._fds:
            os.close(fd)
        self._fds.clear()


def _registers(body: bytes, at: int) -> dict[str, int]:
    # The raw data before it ends at a multiple of eight bytes.
    (abi,) = struct.unpack_from("=Q", body, at)
    if abi != _ABI_64:
        return {}
    return dict(zip(REGISTERS, struct.unpack_from(f"={len(REGISTERS)}Q", body, at + 8)))


def _open_event(cpu: int, tracepoint: int) -> int:
    sample = _SAMPLE_TID | _SAMPLE_TIME | _SAMPLE_CALLCHAIN | _SAMPLE_RAW | _SAMPLE_REGS_USER
    flags = _FLAG_DISABLED | _FLAG_WATERMARK | _FLAG_NO_KERNEL_CALLERS | _FLAG_CLOCKID
    attr = ctypes.create_string_buffer(
        _ATTR.pack(
            *(_TYPE_TRACEPOINT, _ATTR.size, tracepoint, 1, sample, 0, flags),
            *(RING_PAGES * mmap.PAGESIZE // 2, 0, 0, 0, 0),
            *(_REGISTERS_MASK, 0, 1, 0, 0, CALLERS_MAX, 0),  # 1: CLOCK_MONOTONIC
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
