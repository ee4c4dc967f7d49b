# SPDX-License-Identifier: Apache-2.0
"""Everything that can go wrong, as exceptions.

One tree for the engine's errors (made from `struct avc_error`, every field
kept) and for those between command line and sidecar. `str(error)` is the one
line for users; `kind` and the fields are for programs, and cross the API
unaltered (`to_json()`, `from_json()`).
"""

from __future__ import annotations

import enum
import os
from collections.abc import Mapping
from typing import ClassVar


class Code(enum.IntEnum):
    """`enum avc_code`."""

    OK = 0
    GONE = 1
    DENIED = 2
    UNSUPPORTED = 3
    BUSY = 4
    DEADLINE = 5
    PROTOCOL = 6
    CONFIG = 7
    KERNEL = 8
    EMPTY = 9
    LIMIT = 10


class ExitCode(enum.IntEnum):
    """What `avckpt` ends with (`avckpt run` ends with its program's status instead)."""

    OK = 0
    FAILED = 1
    USAGE = 2
    UNREACHABLE = 3
    NO_SUCH_CONTAINER = 4
    UNPROTECTED = 5


class AvckptError(Exception):
    """Something failed. `detail` is one clause for users.

    `operation` is what was being done, `syscall` and `errno` the call that
    failed ("" and 0: none), `pid` the process concerned (0: none),
    `undo_failures` how many steps could not be undone afterwards, and
    `container` the container's name ("": none, or `detail` names it).
    """

    kind: ClassVar[str] = "failed"
    code: ClassVar[Code | None] = None
    exit_code: ClassVar[ExitCode] = ExitCode.FAILED
    explained: ClassVar[bool] = False
    """`detail` says all that a user can use: the line leaves out operation, call and process."""

    def __init__(
        self,
        detail: str,
        *,
        operation: str = "",
        syscall: str = "",
        errno: int = 0,
        pid: int = 0,
        undo_failures: int = 0,
        container: str = "",
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.operation = operation
        self.syscall = syscall
        self.errno = errno
        self.pid = pid
        self.undo_failures = undo_failures
        self.container = container

    def __str__(self) -> str:
        text = self.detail or "no detail given"
        if self.operation and not self.explained:
            text = f"{self.operation}: {text}"
        if self.container:
            text = f"{self.container}: {text}"
        facts = []
        if self.explained:
            pass
        elif self.syscall and self.errno:
            facts.append(f"{self.syscall}: {os.strerror(self.errno)}")
        elif self.syscall or self.errno:
            facts.append(self.syscall or os.strerror(self.errno))
        if self.pid and not self.explained:
            facts.append(f"pid {self.pid}")
        if self.undo_failures:
            facts.append(f"{self.undo_failures} step(s) could not be undone")
        return f"{text} ({', '.join(facts)})" if facts else text

    def to_json(self) -> dict[str, object]:
        """All fields, for the API."""
        return {
            "kind": self.kind,
            "message": str(self),
            "detail": self.detail,
            "operation": self.operation,
            "syscall": self.syscall,
            "errno": self.errno,
            "pid": self.pid,
            "undo_failures": self.undo_failures,
            "container": self.container,
        }


class TargetGone(AvckptError):
    """The process, or its container, has ended."""

    kind = "gone"
    code = Code.GONE
    explained = True


class Denied(AvckptError):
    """A privilege is missing."""

    kind = "denied"
    code = Code.DENIED


class Unsupported(AvckptError):
    """This process, or this machine, cannot be protected."""

    kind = "unsupported"
    code = Code.UNSUPPORTED
    exit_code = ExitCode.UNPROTECTED


class Busy(AvckptError):
    """Another process traces or protects it."""

    kind = "busy"
    code = Code.BUSY
    explained = True
    exit_code = ExitCode.UNPROTECTED


class DeadlineMissed(AvckptError):
    """The app was not stopped within the freeze deadline, or an answer did not come in time."""

    kind = "deadline"
    code = Code.DEADLINE
    explained = True


class Paused(AvckptError):
    """The container is paused (podman pause): nothing in it runs."""

    kind = "paused"


class ProtocolError(AvckptError):
    """The peer is not a matching avckpt-init, hook or sidecar."""

    kind = "protocol"
    code = Code.PROTOCOL


class ConfigError(AvckptError):
    """An invalid value."""

    kind = "config"
    code = Code.CONFIG


class LabelsWrong(AvckptError):
    """A label of the container that cannot be honoured."""

    kind = "labels"
    exit_code = ExitCode.USAGE


class KernelError(AvckptError):
    """The kernel refused what it should have allowed."""

    kind = "kernel"
    code = Code.KERNEL


class NoRoom(AvckptError):
    """A limit on processes or memory leaves no room for another process."""

    kind = "limit"
    code = Code.LIMIT


class NothingToRestore(AvckptError):
    """There is no generation to restore from."""

    kind = "empty"
    code = Code.EMPTY
    explained = True
    exit_code = ExitCode.UNPROTECTED


class Unprotected(AvckptError):
    """The container runs without protection; `detail` says why."""

    kind = "unprotected"
    exit_code = ExitCode.UNPROTECTED


class NoSuchContainer(AvckptError):
    """No protected container answers to that name or id."""

    kind = "no_such_container"
    exit_code = ExitCode.NO_SUCH_CONTAINER


class Ambiguous(AvckptError):
    """An id prefix that several containers share."""

    kind = "ambiguous"
    exit_code = ExitCode.NO_SUCH_CONTAINER


class SidecarUnreachable(AvckptError):
    """No sidecar answers on the API socket."""

    kind = "unreachable"
    exit_code = ExitCode.UNREACHABLE


_CLASSES: tuple[type[AvckptError], ...] = (
    AvckptError,
    TargetGone,
    Denied,
    Unsupported,
    Busy,
    DeadlineMissed,
    Paused,
    ProtocolError,
    ConfigError,
    LabelsWrong,
    KernelError,
    NoRoom,
    NothingToRestore,
    Unprotected,
    NoSuchContainer,
    Ambiguous,
    SidecarUnreachable,
)
_BY_CODE = {cls.code: cls for cls in _CLASSES if cls.code is not None}
_BY_KIND = {cls.kind: cls for cls in _CLASSES}


def class_of_code(code: int) -> type[AvckptError]:
    """The exception class of an `enum avc_code` value; AvckptError itself for one we do not know."""
    try:
        return _BY_CODE.get(Code(code), AvckptError)
    except ValueError:
        return AvckptError


def of_any(error: Exception) -> AvckptError:
    """Converts any exception to one of ours."""
    if isinstance(error, AvckptError):
        return error
    if isinstance(error, OSError) and error.errno:
        return KernelError("the kernel said no", errno=error.errno)
    return AvckptError(f"{type(error).__name__}: {error}")


def from_json(data: Mapping[str, object]) -> AvckptError:
    """The exception that `to_json()` described; what is missing reads as empty."""

    def text(key: str) -> str:
        value = data.get(key)
        return value if isinstance(value, str) else ""

    def number(key: str) -> int:
        value = data.get(key)
        return value if isinstance(value, int) else 0

    return _BY_KIND.get(text("kind"), AvckptError)(
        text("detail") or text("message"),
        operation=text("operation"),
        syscall=text("syscall"),
        errno=number("errno"),
        pid=number("pid"),
        undo_failures=number("undo_failures"),
        container=text("container"),
    )
