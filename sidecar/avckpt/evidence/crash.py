# SPDX-License-Identifier: Apache-2.0
"""A crash as everybody is told of it: by what, where, how often.  No I/O."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, cast

from avckpt_hooks.shared.tell import printable

from avckpt.events.vocabulary import signal_name
from avckpt.evidence.deaths import Death, Delivery
from avckpt.evidence.kernel_log import Fault

FRAMES_MAX = 32
FRAMES_OF_FINGERPRINT = 3
MODULE_SHOWN = 80
"""Characters of a file's name in a place."""

_CODES = {
    "SIGILL": ("ILL_ILLOPC", "ILL_ILLOPN", "ILL_ILLADR", "ILL_ILLTRP", "ILL_PRVOPC", "ILL_PRVREG", "ILL_COPROC"),
    "SIGFPE": ("FPE_INTDIV", "FPE_INTOVF", "FPE_FLTDIV", "FPE_FLTOVF", "FPE_FLTUND", "FPE_FLTRES", "FPE_FLTINV"),
    "SIGSEGV": ("SEGV_MAPERR", "SEGV_ACCERR", "SEGV_BNDERR", "SEGV_PKUERR"),
    "SIGBUS": ("BUS_ADRALN", "BUS_ADRERR", "BUS_OBJERR", "BUS_MCEERR_AR", "BUS_MCEERR_AO"),
    "SIGTRAP": ("TRAP_BRKPT", "TRAP_TRACE"),
    "SIGSYS": ("SYS_SECCOMP",),
}
_ANY_CODE = {0: "SI_USER", -1: "SI_QUEUE", -2: "SI_TIMER", -6: "SI_TKILL", 128: "SI_KERNEL"}
_LIBRARY = re.compile(r"(libc|libpthread|ld-linux[^.]*|ld-musl[^.]*|libstdc\+\+|libgcc_s|libm)[.-]")
_SENT_BY_USERS = (0, -1, -6)


def said(description: str, default: Any = "") -> Any:
    """A field of Crash with its meaning."""
    return field(default=default, metadata={"description": description})


@dataclass(frozen=True)
class Frame:
    """A place in a program."""

    address: int = 0
    module: str = ""
    """Path of the file as the application sees it; empty: none."""
    offset: int = 0
    """In the file's own terms: `addr2line -e MODULE OFFSET`."""
    build_id: str = ""

    def __str__(self) -> str:
        name = self.module.rpartition("/")[2][:MODULE_SHOWN]
        return f"{name}+{self.offset:#x}" if self.offset else name or f"{self.address:#x}"


@dataclass(frozen=True)
class Crash:
    """What is known of a death.  Empty or 0: it is not known, or there is no such thing."""

    signal: str = said("name of the signal that it died of; empty: it ended by itself")
    code: str = said("`si_code` of it: SEGV_MAPERR, SI_USER (kill), SI_TKILL (abort), ...; empty: not known")
    fault: str = said("address that could not be accessed, in hex digits; where the kernel's log has it")
    tid: int = said("thread that was hit, in the sidecar's PID namespace", 0)
    thread: str = said("name of the thread")
    at: str = said("instruction, as module+offset, or as an address outside of any file")
    module: str = said("path of that file, as the application sees it")
    build_id: str = said("of that file, in hex digits")
    backtrace: str = said(
        "places of its callers, innermost first, joined by blanks: by frame pointers, or as they lie on the stack"
    )
    command: str = said("program, and of an interpreter its script; as seen at an earlier look where `unknown` says so")
    sender_pid: int = said("process that sent the signal, in the sidecar's PID namespace", 0)
    sender: str = said("name of that process; `kernel`: nobody (the OOM killer, an end of a namespace)")
    fingerprint: str = said("the same for crashes by the same signal at the same place")
    count: int = said("crashes of this container with that fingerprint in the history, this one included", 0)
    unknown: str = said("why the rest is not known")

    def __str__(self) -> str:
        where = f" at {self.at}" if self.at else ""
        thread = f" in thread {self.thread}" if self.thread else ""
        fault = f" (access to {self.fault})" if self.fault else ""
        sender = f", sent by {self.sender or 'a process that has ended'} ({self.sender_pid})" if self.sender_pid else ""
        sender = ", sent by the kernel" if self.sender == "kernel" else sender
        code = f" {self.code}" if self.code else ""
        return f"{self.signal}{code}{fault}{thread}{where}{sender}" if self.signal else ""

    def to_json(self) -> dict[str, object]:
        """What is known."""
        return {each.name: value for each in fields(self) if (value := getattr(self, each.name))}

    @classmethod
    def from_json(cls, data: Mapping[str, object]) -> Crash:
        """What `to_json()` made; what this release does not know is left out.  Raises ValueError."""
        values = {}
        for each in fields(cls):
            value = data.get(each.name, each.default)
            if type(value) is not type(each.default) or (isinstance(value, int) and not 0 <= value < 1 << 32):
                raise ValueError(f"{each.name} is {value!r}")
            values[each.name] = value
        return cls(**cast("dict[str, Any]", values))


def code_name(signal: str, code: int) -> str:
    """SEGV_MAPERR for 1 of SIGSEGV; the number where it has no name."""
    names = _CODES.get(signal, ())
    if 0 < code <= len(names):
        return names[code - 1]
    return _ANY_CODE.get(code, str(code))


def crash_of(signal: str, hit: Delivery | None, death: Death, fault: Fault | None) -> Crash:
    """What the kernel told of a death by `signal` ("": it ended by itself), as far as memory is not needed."""
    if not signal or hit is None:
        return Crash(signal=signal)
    # The one that was answered by the death is the last before it.
    sent = [each for each in death.sent if signal_name(each.signal) == signal and each.at_ns <= hit.at_ns]
    last = max(sent, key=lambda each: each.at_ns, default=None)
    # One that leaves no core is delivered as a SIGKILL, which does not tell its code.
    delivered = hit.code if signal_name(hit.signal) == signal else None
    code = last.code if last is not None and not delivered else delivered
    outside = last is not None and last.sender_pid not in (0, death.pid) and code in _SENT_BY_USERS
    name = fault.thread if fault is not None else next((each.thread for each in sent if each.tid == hit.tid), "")
    return Crash(
        signal=signal,
        code="" if code is None else code_name(signal, code),
        fault=f"{fault.address:#x}" if fault is not None and fault.address is not None else "",
        tid=hit.tid,
        thread=printable(name),
        sender_pid=last.sender_pid if last is not None and outside else 0,
        sender="kernel" if code == 128 and signal == "SIGKILL" else "",
    )


def placed(crash: Crash, frames: list[Frame]) -> Crash:
    """With where it was; `frames` innermost first."""
    first = frames[0] if frames else Frame()
    return replace(
        crash,
        at=str(first) if frames else "",
        module=first.module,
        build_id=first.build_id,
        backtrace=" ".join(map(str, frames[:FRAMES_MAX])),
    )


def fingerprint(crash: Crash, wait_status: int, frames: Iterable[Frame]) -> str:
    """Twelve hex digits: how it ended, and the innermost places in files.  Addresses are other ones every time."""
    found = [frame for frame in frames if frame.offset]
    # Whatever is aborted, the innermost places are the C library's.
    own = [frame for frame in found if not _LIBRARY.match(frame.module.rpartition("/")[2])] or found
    places = [f"{frame.build_id or frame.module}+{frame.offset:x}" for frame in own]
    text = " ".join([crash.signal or f"{wait_status:x}", crash.code, *places[:FRAMES_OF_FINGERPRINT]])
    return hashlib.sha256(text.encode()).hexdigest()[:12]
