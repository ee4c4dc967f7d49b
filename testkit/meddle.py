# SPDX-License-Identifier: Apache-2.0
"""Changes a thread's floating-point registers, has it make system calls, or takes its descriptors, behind its back.

Registers by ptrace(2) itself: gdb 13 cannot write them on a CPU whose XSAVE area is larger than it knows (AMX).
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import struct

import pytest

PTRACE_SINGLESTEP, PTRACE_GETREGS, PTRACE_SETREGS = 9, 12, 13
PTRACE_SEIZE, PTRACE_INTERRUPT, PTRACE_EVENT_STOP = 0x4206, 0x4207, 128
PTRACE_GETFPREGS, PTRACE_SETFPREGS, PTRACE_ATTACH, PTRACE_DETACH = 14, 15, 16, 17
WALL = 0x40000000
PIDFD_GETFD = 438  # Python has no name for it
# Where they are in struct user_fpregs_struct (the FXSAVE area).
FPREGS_BYTES = 512
FPREGS = {"mxcsr": (24, "<I"), "st3": (32 + 3 * 16, "<Q"), "xmm5": (160 + 5 * 16, "<Q")}


def knows_registers() -> None:
    """Skips on a CPU whose registers are not known here."""
    if platform.machine() != "x86_64":
        pytest.skip("the registers that it would change are x86-64's")


def set_fpu_register(tid: int, name: str, value: int) -> None:
    """Sets a register of a thread that nobody traces; of the wide ones, the low 64 bits."""
    knows_registers()
    at, kind = FPREGS[name]
    registers = ctypes.create_string_buffer(FPREGS_BYTES)
    _ptrace(PTRACE_ATTACH, tid)
    try:
        os.waitpid(tid, WALL)
        _ptrace(PTRACE_GETFPREGS, tid, registers)
        struct.pack_into(kind, registers, at, value)
        _ptrace(PTRACE_SETFPREGS, tid, registers)
    finally:
        _ptrace(PTRACE_DETACH, tid)


# Words of struct user_regs_struct.
REGS_WORDS = 27
RAX, RIP, ORIG_RAX = 10, 16, 15
ARGUMENTS = (14, 13, 12, 7, 9, 8)
"""rdi, rsi, rdx, r10, r8, r9."""
WORD = (1 << 64) - 1


def remote_syscall(tid: int, number: int, *args: int) -> int:
    """Has a thread that nobody traces, and that is blocked in a system call, make another one first; its result.

    Raises BlockingIOError when this is no moment for it: try again.
    """
    knows_registers()
    saved = ctypes.create_string_buffer(REGS_WORDS * 8)
    signal_to_take = 0
    _ptrace(PTRACE_SEIZE, tid)
    try:
        _ptrace(PTRACE_INTERRUPT, tid)
        _, status = os.waitpid(tid, WALL)
        if status >> 16 != PTRACE_EVENT_STOP:
            signal_to_take = os.WSTOPSIG(status)
            raise BlockingIOError(f"thread {tid} has a signal to take first")
        _ptrace(PTRACE_GETREGS, tid, saved)
        registers = list(struct.unpack(f"{REGS_WORDS}Q", saved.raw))
        if registers[ORIG_RAX] == WORD:
            raise BlockingIOError(f"thread {tid} is not in a system call")
        # rip is behind the `syscall` instruction, two bytes long, that it will make again.
        registers[RIP] -= 2
        registers[RAX], registers[ORIG_RAX] = number, WORD
        for register, value in zip(ARGUMENTS, args):
            registers[register] = value & WORD
        _ptrace(PTRACE_SETREGS, tid, ctypes.create_string_buffer(struct.pack(f"{REGS_WORDS}Q", *registers)))
        _ptrace(PTRACE_SINGLESTEP, tid)
        _, status = os.waitpid(tid, WALL)
        if os.WSTOPSIG(status) != signal.SIGTRAP:
            _ptrace(PTRACE_SETREGS, tid, saved)
            signal_to_take = os.WSTOPSIG(status)
            raise BlockingIOError(f"thread {tid} has a signal to take first")
        after = ctypes.create_string_buffer(REGS_WORDS * 8)
        _ptrace(PTRACE_GETREGS, tid, after)
        result: int = struct.unpack_from("q", after, RAX * 8)[0]
        _ptrace(PTRACE_SETREGS, tid, saved)
        return result
    finally:
        _ptrace(PTRACE_DETACH, tid, signal_to_take)


def get_fd(pid: int, fd: int) -> int:
    """A descriptor of another process, the same open file; see pidfd_getfd(2)."""
    pidfd = os.pidfd_open(pid)
    try:
        got = ctypes.CDLL(None, use_errno=True).syscall(PIDFD_GETFD, pidfd, fd, 0)
    finally:
        os.close(pidfd)
    if got < 0:
        raise OSError(ctypes.get_errno(), "pidfd_getfd")
    return int(got)


def _ptrace(request: int, tid: int, data: ctypes.Array[ctypes.c_char] | int | None = None) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = (ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    libc.ptrace.restype = ctypes.c_long
    if libc.ptrace(request, tid, None, data) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"ptrace request {request}: {os.strerror(number)}")
