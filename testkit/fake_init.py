# SPDX-License-Identifier: Apache-2.0
"""Something that says it is avckpt-init, and is not to be trusted.

fake_init.py KIND: one of FOLLY below.  It has a child, as its app; prints "ready"; a line on
standard input has it do the second half of its folly, and is answered by "done".  Runs on the
standard library alone.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

MAGIC = int.from_bytes(b"CKPTCTL1", "little")
SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
PAGE = struct.Struct("<QIiiiiIIxxxxQiiixxxx")

FAKE_INIT = Path(__file__)

FOLLY = {
    "honest": "all is as it should be",
    "unsealed": "the control page can be cut off",
    "named": "the control page is a file of somebody else's, opened to be read",
    "fifo": "the verdict pipe is a FIFO of somebody else's, opened to be read",
    "swapped": "the pipes are regular files",
}


def page(app: int, report: int, verdict: int) -> bytes:
    """struct avc_ctl."""
    return PAGE.pack(MAGIC, 1, os.getpid(), app, report, verdict, 2000, 0, 0, 0, 0, 0)


def main(kind: str) -> None:
    """Plays init."""
    libc = ctypes.CDLL(None)
    libc.prctl(4, 0, 0, 0, 0)  # PR_SET_DUMPABLE, as avckpt-init does
    app = subprocess.Popen(
        ["/bin/sleep", "1000"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        preexec_fn=lambda: libc.prctl(1, signal.SIGKILL, 0, 0, 0),  # PR_SET_PDEATHSIG
    )
    report, _report_write = os.pipe()
    verdict, verdict_write = os.pipe()
    os.close(verdict_write)
    folder = tempfile.mkdtemp(prefix="fake-init-")
    if kind == "fifo":
        os.mkfifo(f"{folder}/fifo", 0o644)
        verdict = os.open(f"{folder}/fifo", os.O_RDONLY | os.O_NONBLOCK)
    if kind == "swapped":
        report = verdict = os.open(sys.executable, os.O_RDONLY)
    content = page(app.pid, report, verdict)
    if kind == "named":
        path = "/memfd:avckpt-ctl"
        with open(path, "wb") as file:
            file.write(content)
        ctl = os.open(path, os.O_RDONLY)
        os.unlink(path)
    else:
        ctl = os.memfd_create("avckpt-ctl", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(ctl, len(content))
        if kind != "unsealed":
            fcntl.fcntl(ctl, fcntl.F_ADD_SEALS, SEALS)
        os.pwrite(ctl, content, 0)
    print("ready", flush=True)
    for _line in sys.stdin:
        if kind == "unsealed":
            os.ftruncate(ctl, 0)
        print("done", os.pread(ctl, PAGE.size, 0) == content, flush=True)
    app.kill()


if __name__ == "__main__":
    main(sys.argv[1])
