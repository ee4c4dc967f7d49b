# SPDX-License-Identifier: Apache-2.0
"""Interpretation of the kernel's reports of a death, and of a dead process's memory."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import pytest
from avckpt.events.vocabulary import Kind
from avckpt.evidence.collector import Collector, _name_of
from avckpt.evidence.crash import Crash, Frame, code_name, crash_of, fingerprint, placed
from avckpt.evidence.deaths import Death, Delivery, Sent
from avckpt.evidence.kernel_log import Fault, fault_of
from avckpt.evidence.remains import Remains, build_id_of, command_of, parse_maps
from avckpt.guard import Event


@pytest.mark.parametrize(
    ("line", "found"),
    [
        (
            b"6,3153,13435390200,-;die[32429]: segfault at 10 ip 000055bab059519f sp 00007ffd94b45d58 error 4",
            (32429, Fault("die", 16)),
        ),
        (b"6,1,2,-;traps: a b[7] trap divide error ip:40 sp:7f error:0 in a[1000+1]", (7, Fault("a b", None))),
        (b"6,1,2,-;traps: PLC[x[9] general protection fault ip:1 sp:2 error:0", (9, Fault("PLC[x", None))),
        # Names that look like a number that is another thread's, and names of which the kernel escapes each byte.
        (b"6,1,2,-;traps: evil[7] b[2997] trap invalid opcode ip:1 sp:2 error:0", (2997, Fault("evil[7] b", None))),
        (b"6,1,2,-;traps: x[7] trap y[9] trap int3 ip:1 sp:2 error:0 in z[8] [1,2+3]", (9, Fault("x[7] trap y", None))),
        (b"6,1,2,-;" + b"\\x1b" * 15 + b"[9]: segfault at 0 ip 1", (9, Fault("\x1b" * 15, 0))),
        (b"6,1,2,-;\\xc3\\xa9\\x5c[9]: segfault at 0 ip 1", (9, Fault("é\\", 0))),
        # Anybody who may write to the log: not the kernel's facility.
        (b"12,1,2,-;die[1]: segfault at 0 ip 1", None),
        (b"6,1,2,-;name that is too long for a task[1]: segfault at 0 ip 1", None),
        (b"\xff\xfe;;", None),
        (b"", None),
    ],
)
def test_the_kernels_log(line: bytes, found: tuple[int, Fault] | None) -> None:
    assert fault_of(line) == found


def delivery(tid: int, signal: int, code: int = 0, at_ns: int = 100) -> Delivery:
    return Delivery(tid, at_ns, signal, code, (0x1000,), {"rip": 0x1000, "rsp": 0})


def test_the_thread_that_was_hit_is_not_one_that_followed() -> None:
    death = Death(5, {5: delivery(5, 9, at_ns=120), 6: delivery(6, 11, 1, at_ns=100)})
    hit = death.fatal(11)
    assert hit is not None
    assert hit.tid == 6
    crash = crash_of("SIGSEGV", hit, death, Fault("worker", 0x10))
    assert (crash.code, crash.fault, crash.thread, crash.tid) == ("SEGV_MAPERR", "0x10", "worker", 6)


def test_a_signal_without_a_core_is_delivered_as_a_kill() -> None:
    death = Death(5, {6: delivery(6, 9, at_ns=90), 5: delivery(5, 9, at_ns=100)})
    hit = death.fatal(15)
    assert hit is not None
    assert hit.tid == 5
    assert Death(5).fatal(15) is None


def test_a_report_that_was_lost_blames_no_other_thread() -> None:
    death = Death(5, {5: delivery(5, 9), 6: delivery(6, 9)})
    assert death.fatal(11) is None


def test_who_sent_it() -> None:
    death = Death(5, {5: delivery(5, 9)}, [Sent(90, 9, 0, 77, 5, "app"), Sent(200, 9, 0, 78, 5, "app")])
    assert crash_of("SIGKILL", death.fatal(9), death, None).sender_pid == 77
    by_itself = Death(5, {5: delivery(5, 6, -6)}, [Sent(90, 6, -6, 5, 5, "app")])
    assert crash_of("SIGABRT", by_itself.fatal(6), by_itself, None).sender_pid == 0
    by_kernel = Death(5, {5: delivery(5, 9)}, [Sent(90, 9, 128, 99, 5, "app")])
    crash = crash_of("SIGKILL", by_kernel.fatal(9), by_kernel, None)
    assert (crash.code, crash.sender, crash.sender_pid) == ("SI_KERNEL", "kernel", 0)
    assert str(Crash(signal="SIGSEGV", sender_pid=77)) == "SIGSEGV, sent by a process that has ended (77)"


def test_names_of_threads_and_senders_control_no_terminal() -> None:
    name = "\x1b[2J\nok"
    crash = crash_of("SIGABRT", delivery(5, 6), Death(5, {}, [Sent(90, 6, 0, os.getpid(), 5, name)]), None)
    assert crash.thread == "\\x1b[2J\\nok"
    assert crash_of("SIGABRT", delivery(5, 6), Death(5), Fault(name, None)).thread == crash.thread

    before = Path("/proc/self/comm").read_text()
    Path("/proc/self/comm").write_text(name)
    try:
        assert _name_of(os.getpid()) == crash.thread
    finally:
        Path("/proc/self/comm").write_text(before)


def test_a_kill_does_not_tell_the_code_of_the_signal_behind_it() -> None:
    """alarm(2) sends SI_KERNEL, and nobody saw it being sent."""
    death = Death(5, {5: delivery(5, 9)})
    assert crash_of("SIGALRM", death.fatal(14), death, None).code == ""
    terminated = Death(5, {5: delivery(5, 9)}, [Sent(90, 15, 0, 77, 5, "app")])
    crash = crash_of("SIGTERM", terminated.fatal(15), terminated, None)
    assert (crash.code, crash.sender_pid) == ("SI_USER", 77)


def test_names_of_codes() -> None:
    assert code_name("SIGFPE", 1) == "FPE_INTDIV"
    assert code_name("SIGSEGV", -6) == "SI_TKILL"
    assert code_name("SIGSEGV", 99) == "99"


def test_the_same_crash_has_the_same_fingerprint() -> None:
    def frames(base: int, *offsets: int) -> list[Frame]:
        return [Frame(base + at, "/app/lib.so", at, "ab" * 20) for at in offsets]

    libc = Frame(0x7F00, "/lib/libc.so.6", 0x8000, "cd" * 20)
    crash = Crash(signal="SIGABRT", code="SI_TKILL")
    one = fingerprint(crash, 6, [libc, *frames(0x5500_0000, 1, 2, 3)])
    assert one == fingerprint(crash, 6, [libc, *frames(0x6600_0000, 1, 2, 3, 4)])
    assert one != fingerprint(crash, 6, [libc, *frames(0x5500_0000, 7, 2, 3)])
    assert fingerprint(Crash(), 3 << 8, []) != fingerprint(Crash(), 4 << 8, [])


def test_a_crash_goes_through_json() -> None:
    crash = placed(Crash("SIGSEGV", fault="0x0", tid=7, count=2), [Frame(5, "/lib/a.so", 0x19F, "ab")])
    assert (crash.at, crash.build_id) == ("a.so+0x19f", "ab")
    assert Crash.from_json(json.loads(json.dumps(crash.to_json()))) == crash
    assert Crash.from_json({"of_a_later_release": 1}) == Crash()
    for wrong in ({"tid": "7"}, {"tid": -1}, {"tid": 1 << 40}, {"signal": None}, {"count": True}):
        with pytest.raises(ValueError, match="is"):
            Crash.from_json(wrong)


def test_our_own_memory() -> None:
    remains = Remains(os.getpid())
    try:
        first = next(each for each in remains.maps if "libc" in each.path and "x" in each.flags)
        frame = remains.frame(first.start + 0x100)
        assert frame.module == first.path
        assert len(frame.build_id) == 40
        assert frame.offset == first.offset + 0x100  # as long as nobody links otherwise
        assert remains.frame(0x10) == Frame(0x10)
        assert [remains.read(0x10, 8), remains.read(1 << 63, 8)] == [b"", b""]
    finally:
        remains.close()


def test_the_command_is_of_a_child() -> None:
    assert "python" in command_of(os.getpid(), os.getppid())
    with pytest.raises(ProcessLookupError, match="another one"):
        command_of(os.getpid(), os.getpid())


def test_maps_and_notes_may_be_anything() -> None:
    text = b"1000-2000 r-xp 00000000 08:01 12   /a\\012b c\nnonsense\n3000-4000 rw-p 00000000 00:00 0 \n"
    assert [(each.start, each.path) for each in parse_maps(text)] == [(0x1000, "/a\\012b c"), (0x3000, "")]
    note = struct.pack("=III4s", 4, 4, 1, b"GNU\0") + bytes(4) + struct.pack("=III4s", 4, 3, 3, b"GNU\0") + b"\1\2\3\0"
    assert build_id_of(note) == "010203"
    for wrong in (b"", b"\xff" * 64, note[:20], struct.pack("=III", 0xFFFFFFFF, 0xFFFFFFFF, 3)):
        assert build_id_of(wrong) == ""


def test_a_path_adds_no_mapping() -> None:
    text = b"1000-2000 r-xp 00000000 08:01 7 /a\r3000-4000 r-xp 00000000 08:01 8 /b\n5000-6000 rw-p 0 00:00 0\n"
    assert [(each.start, each.path) for each in parse_maps(text)] == [
        (0x1000, "/a\\r3000-4000 r-xp 00000000 08:01 8 /b"),
        (0x5000, ""),
    ]


def test_a_machine_that_tells_nothing_costs_the_place_only() -> None:
    case = Collector(set).open_case(Event(Kind.DIED, 1, app_pid=1, wait_status=11), 1)
    assert case.crash == Crash(signal="SIGSEGV", unknown="the sidecar does not listen")


def test_meaning_of_each_field_is_in_the_manual() -> None:
    manual = (Path(__file__).parents[2] / "docs" / "events.md").read_text()
    for name in Crash.__dataclass_fields__:
        assert f"| `crash.{name}` |" in manual
