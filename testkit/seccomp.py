# SPDX-License-Identifier: Apache-2.0
"""Seccomp filters for what a test starts (seccomp(2))."""

from __future__ import annotations

import ctypes
import errno
import platform
import struct
from collections.abc import Callable

PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 38, 22, 2
SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO = 0x7FFF0000, 0x00050000
LOAD, EQUAL, RETURN = 0x20, 0x15, 0x06  # linux/bpf_common.h

NUMBERS = {
    "x86_64": {"socketpair": 53, "userfaultfd": 323, "close_range": 436},
    "aarch64": {"socketpair": 199, "userfaultfd": 282, "close_range": 436},
}[platform.machine()]

_libc = ctypes.CDLL(None, use_errno=True)


def refusing(call: str) -> Callable[[], None]:
    """A `preexec` that has this system call, of NUMBERS, answer EPERM from then on, as containers' profiles do."""
    instructions = (
        (LOAD, 0, 0, 0),  # seccomp_data.nr
        (EQUAL, 0, 1, NUMBERS[call]),
        (RETURN, 0, 0, SECCOMP_RET_ERRNO | errno.EPERM),
        (RETURN, 0, 0, SECCOMP_RET_ALLOW),
    )
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *each) for each in instructions))
    header = struct.pack("HxxxxxxP", len(instructions), ctypes.addressof(code))

    def install() -> None:
        if _libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or _libc.prctl(
            PR_SET_SECCOMP, SECCOMP_MODE_FILTER, header, 0, 0
        ):
            raise OSError(ctypes.get_errno(), f"seccomp filter for {call}, of {len(code)} bytes")

    return install
