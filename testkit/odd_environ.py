# SPDX-License-Identifier: Apache-2.0
"""Says that its environment is so many MB of untouched memory, then "set", and waits for ever.

python -m testkit.odd_environ MB [--arguments]     of its arguments instead
"""

from __future__ import annotations

import ctypes
import mmap
import signal
import struct
import sys
from pathlib import Path

PR_SET_MM, PR_SET_MM_MAP = 35, 14
NO_FILE = 2**32 - 1
MAP_NORESERVE = 0x4000

libc = ctypes.CDLL(None, use_errno=True)


def check(result: int, what: str) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), what)
    return result


def set_places(start: int, arguments: int, environment: int) -> None:
    """struct prctl_mm_map: all as it is, but for arguments and environment."""
    stat = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    # proc(5): field 26 is startcode; the two words that come after pid and name are missing here.
    start_code, end_code, stack = (int(stat[number - 3]) for number in (26, 27, 28))
    start_data, end_data, start_brk = (int(stat[number - 3]) for number in (45, 46, 47))
    libc.sbrk.restype = ctypes.c_ulong
    fields = (start_code, end_code, start_data, end_data, start_brk, libc.sbrk(0), stack)
    packed = struct.pack("12QII", *fields, start, start + arguments, start, start + environment, 0, 0, NO_FILE)
    check(libc.prctl(PR_SET_MM, PR_SET_MM_MAP, packed, len(packed), 0), "prctl(PR_SET_MM)")


def main() -> None:
    length = int(sys.argv[1]) << 20
    memory = mmap.mmap(-1, length, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_NORESERVE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    set_places(start, *((length, 8) if "--arguments" in sys.argv else (8, length)))
    print("set", flush=True)
    while True:
        signal.pause()


if __name__ == "__main__":
    main()
