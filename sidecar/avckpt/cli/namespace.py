# SPDX-License-Identifier: Apache-2.0
"""Starts a program as PID 1 of a PID namespace of its own.

Python has unshare(2) and setns(2) only from 3.12 on, and mount(2) not at all:
they are called through the C library.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import select
import signal
import struct
from collections.abc import Iterator
from typing import NoReturn

from avckpt.errors import AvckptError, Denied, KernelError, Unsupported

CLONE_NEWNS = 0x00020000
CLONE_NEWPID = 0x20000000
PR_SET_PDEATHSIG = 1
MS_NOSUID, MS_NODEV, MS_NOEXEC = 2, 4, 8
MS_REC, MS_PRIVATE = 0x4000, 0x40000

PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 22, 2
AUDIT_ARCH_X86_64 = 0xC000003E
SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO = 0x7FFF0000, 0x00050000

_STEPS = ("setpgid", "prctl", "unshare", "mount", "mount", "seccomp", "execve")
_FAILURE = struct.Struct("ii")
_libc = ctypes.CDLL(None, use_errno=True)


def spawn_pid1(path: str, argv: list[str], *, tty: int | None, io_uring: bool = True) -> int:
    """Starts `path` with a /proc of its own and its own process group; returns its PID in our namespace.

    With `tty` (a descriptor of our controlling terminal) the new group becomes
    the terminal's foreground group.  SIGPIPE and SIGXFSZ, which Python itself
    ignores, are not ignored in the new process.

    Without `io_uring` the kernel has neither that nor AIO for it.

    It is killed, with all that it has started, when this process ends, however that comes about.

    Raises Denied, Unsupported or KernelError when it cannot be started; then
    nothing is left behind.  Precondition: this process has one thread.
    """
    with contextlib.ExitStack() as undo:
        own = os.open("/proc/self/ns/pid", os.O_RDONLY | os.O_CLOEXEC)
        undo.callback(os.close, own)
        failed, tell = os.pipe()
        undo.callback(os.close, failed)
        try:
            with _children_in_new_namespace(own):
                pid = os.fork()
                if pid == 0:
                    os.close(failed)  # only the parent's: that it is closed says that the parent has ended
                    _become(path, argv, tty, io_uring, tell)
        finally:
            os.close(tell)
        # The child's end closes when its exec succeeds.
        message = os.read(failed, _FAILURE.size)
    if message:
        os.waitpid(pid, 0)
        step, number = _FAILURE.unpack(message)
        raise _problem(_STEPS[step], number)
    return pid


@contextlib.contextmanager
def _children_in_new_namespace(own: int) -> Iterator[None]:
    """Children forked in the body are in a new PID namespace.

    Undone at once: while it lasts this process cannot start a thread, clone(2).
    """
    if _libc.unshare(CLONE_NEWPID) != 0:
        raise _problem("unshare", ctypes.get_errno())
    try:
        yield
    finally:
        if _libc.setns(own, CLONE_NEWPID) != 0:
            raise _problem("setns", ctypes.get_errno())


def _become(path: str, argv: list[str], tty: int | None, io_uring: bool, tell: int) -> NoReturn:
    """The child's way to the program; never returns, and runs nothing of the parent's."""
    step = 0
    try:
        signal.set_wakeup_fd(-1)
        os.setpgid(0, 0)
        if tty is not None:
            # We are in the background already: without this tcsetpgrp(3) stops us.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
            os.tcsetpgrp(tty, os.getpgrp())
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTTOU})
        step = 1
        _check(_libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0))
        if _has_ended(tell):
            os._exit(125)  # before we asked to be told
        step = 2
        _check(_libc.unshare(CLONE_NEWNS))
        step = 3
        _check(_libc.mount(b"none", b"/", None, MS_REC | MS_PRIVATE, None))
        step = 4
        _check(_libc.mount(b"proc", b"/proc", b"proc", MS_NOSUID | MS_NODEV | MS_NOEXEC, None))
        step = 5
        if not io_uring:
            _take_io_uring_away()
        step = 6
        # Python ignores them; what it starts should not.
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        os.execv(path, argv)
    except OSError as error:
        os.write(tell, _FAILURE.pack(step, error.errno or 0))
    finally:
        os._exit(125)


def _take_io_uring_away() -> None:
    """For this process and what it starts: io_uring_setup(2) and its like, and io_setup(2), answer ENOSYS."""
    load, equal, above, at_least, answer = 0x20, 0x15, 0x25, 0x35, 0x06  # linux/bpf_common.h
    program = b"".join(
        struct.pack("HBBI", *instruction)
        for instruction in (
            (load, 0, 0, 4),  # seccomp_data.arch
            (equal, 0, 5, AUDIT_ARCH_X86_64),
            (load, 0, 0, 0),  # seccomp_data.nr
            (equal, 2, 0, 206),  # io_setup
            (at_least, 0, 2, 425),  # io_uring_setup
            (above, 1, 0, 427),  # io_uring_register
            (answer, 0, 0, SECCOMP_RET_ERRNO | errno.ENOSYS),
            (answer, 0, 0, SECCOMP_RET_ALLOW),
        )
    )
    code = ctypes.create_string_buffer(program, len(program))
    header = struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(code))
    _check(_libc.prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, header, 0, 0))


def _has_ended(tell: int) -> bool:
    """Whether nobody reads what is written to this pipe."""
    poll = select.poll()
    poll.register(tell, 0)
    return bool(poll.poll(0))


def _check(result: int) -> None:
    if result != 0:
        raise OSError(ctypes.get_errno(), "")


def _problem(syscall: str, number: int) -> AvckptError:
    kind: type[AvckptError] = KernelError
    if isinstance(OSError(number, ""), PermissionError):
        kind = Denied
    elif syscall == "unshare":
        kind = Unsupported
    detail = "a PID namespace for the program cannot be made"
    if kind is Denied:
        detail += ": it takes root (CAP_SYS_ADMIN)" + ("" if os.geteuid() == 0 else ", use sudo")
    return kind(detail, syscall=syscall, errno=number)
