# SPDX-License-Identifier: Apache-2.0
"""Changes a thread's floating-point registers behind its back.

By ptrace(2) itself: gdb 13 can not write them on a CPU whose XSAVE area is larger than it knows (AMX).
"""

from __future__ import annotations

import ctypes
import os
import struct

PTRACE_GETFPREGS, PTRACE_SETFPREGS, PTRACE_ATTACH, PTRACE_DETACH = 14, 15, 16, 17
WALL = 0x40000000
# Where they are in struct user_fpregs_struct (the FXSAVE area).
FPREGS_BYTES = 512
FPREGS = {"mxcsr": (24, "<I"), "st3": (32 + 3 * 16, "<Q"), "xmm5": (160 + 5 * 16, "<Q")}


def set_fpu_register(tid: int, name: str, value: int) -> None:
    """Sets a register of a thread that nobody traces; of the wide ones, the low 64 bits."""
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


def _ptrace(request: int, tid: int, data: ctypes.Array[ctypes.c_char] | None = None) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = (ctypes.c_long, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    libc.ptrace.restype = ctypes.c_long
    if libc.ptrace(request, tid, None, data) != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"ptrace request {request}: {os.strerror(number)}")
