# SPDX-License-Identifier: Apache-2.0
"""Errors keep every field on their way, and agree with the C headers."""

from __future__ import annotations

import errno

import pytest
from avckpt import errors
from avckpt._native import ffi
from avckpt.errors import (
    AvckptError,
    Busy,
    Code,
    Denied,
    ExitCode,
    KernelError,
    NoSuchContainer,
    NothingToRestore,
    SidecarUnreachable,
    class_of_code,
    from_json,
)
from avckpt.events.vocabulary import Kind, Reason
from avckpt.guard import Command

from testkit.harness import ROOT


def test_the_line_a_person_sees() -> None:
    error = KernelError(
        "a thread would not stop",
        operation="freeze",
        syscall="ptrace(PTRACE_SEIZE)",
        errno=errno.EPERM,
        pid=42,
        undo_failures=1,
    )
    assert str(error) == (
        "freeze: a thread would not stop "
        "(ptrace(PTRACE_SEIZE): Operation not permitted, pid 42, 1 step(s) could not be undone)"
    )
    assert str(NoSuchContainer("nobody")) == "nobody"
    assert str(NothingToRestore("that generation is not held", operation="command", pid=42, container="web")) == (
        "web: that generation is not held"
    )
    traced = Busy("it is traced by strace", operation="stop", syscall="ptrace(SEIZE)", errno=errno.EPERM, pid=42)
    assert str(traced) == "it is traced by strace"
    assert str(Denied("not allowed", operation="freeze", container="web")) == "web: freeze: not allowed"


@pytest.mark.parametrize("cls", errors._CLASSES)
def test_all_fields_cross_the_api(cls: type[AvckptError]) -> None:
    error = cls("why", operation="restore", syscall="clone", errno=11, pid=7, undo_failures=2, container="web")
    back = from_json(error.to_json())
    assert type(back) is cls
    assert back.to_json() == error.to_json()


@pytest.mark.parametrize("cls", [cls for cls in errors._CLASSES if cls is not SidecarUnreachable])
def test_every_kind_is_in_the_apis_description(cls: type[AvckptError]) -> None:
    """But that of the one error for which there is no sidecar to say it."""
    assert f"`{cls.kind}`" in (ROOT / "docs/api.md").read_text()


def test_what_a_newer_sidecar_says_is_still_an_error() -> None:
    back = from_json({"kind": "from_the_future", "message": "so it is", "errno": "?"})
    assert type(back) is AvckptError
    assert str(back) == "so it is"
    assert back.exit_code is ExitCode.FAILED


def test_every_code_has_a_class_of_its_own() -> None:
    classes = {class_of_code(code) for code in Code if code is not Code.OK}
    assert len(classes) == len(Code) - 1
    assert class_of_code(Code.DENIED) is Denied
    assert class_of_code(12345) is AvckptError


@pytest.mark.parametrize(
    ("ours", "theirs", "prefix"),
    [
        (Code, "enum avc_code", "AVC_"),
        (Kind, "enum avc_event_kind", "AVC_EVENT_"),
        (Reason, "enum avc_reason", "AVC_REASON_"),
        (Command, "enum avc_command", "AVC_COMMAND_"),
    ],
)
def test_enums_are_those_of_the_headers(ours: type[Code], theirs: str, prefix: str) -> None:
    declared = {name[len(prefix) :]: value for name, value in ffi.typeof(theirs).relements.items()}
    numbers = {member.name: getattr(member, "number", member.value) for member in ours}
    # What has no number is the daemon's own, and RETRY does not leave the engine.
    assert {name: number for name, number in numbers.items() if number or name == "OK"} == {
        name: number for name, number in declared.items() if name not in ("NONE", "RETRY")
    }
