# SPDX-License-Identifier: Apache-2.0
"""Memory that a fork does not copy unchanged is restored."""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt.policy import settings_of

from testkit.guarded import WHERE, GuardProcess, Json, Victim, config, kill_at_random
from testkit.harness import wait_until

GUARDS_AT_ONCE = 60
"""Each is killed, and the next one comes at once."""


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def flagged(pid: int, flag: str) -> list[str]:
    """Mappings of a process with that flag in smaps' VmFlags."""
    found, header = [], ""
    for line in Path(f"/proc/{pid}/smaps").read_text().splitlines():
        if line.startswith("VmFlags:"):
            if flag in line.split():
                found.append(header)
        elif not line[0].isupper():
            header = line.split()[0]
    return found


def pages(mappings: list[str]) -> set[int]:
    """Addresses of the pages: mappings may have been merged, and the heap may have grown."""
    bounds = ([int(bound, 16) for bound in mapping.split("-")] for mapping in mappings)
    return {page for start, end in bounds for page in range(start, end, 4096)}


@pytest.mark.parametrize(
    "command",
    [
        *("mappings", "mappings 0", "mappings 3000", "mappings 64 --future"),
        *("mappings --unbound --in-child", "mappings 3000 --unbound --in-child"),
        "mappings 64 --future --unbound --in-child",
        *("mappings --segment", "mappings 3000 --segment --unbound --in-child"),
    ],
)
def test_every_kind_of_memory(command: str, tmp_path: Path) -> None:
    """The victim keeps one version number in all of it, and compares them all the time."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        wiped = flagged(victim.player, "wf")
        locked = pages(flagged(victim.player, "lo"))
        for _ in range(10):  # some of it comes and goes
            victim.wait_beats(2)
            locked &= pages(flagged(victim.player, "lo"))
        marks = {flag: flagged(victim.player, flag) for flag in ("hg", "nh", "dd", "mg")}
        assert wiped
        assert any(marks.values())
        kill_at_random(guard, victim, 30, (0.01, 0.15))
        # Its own forks are to find it wiped, now as before.
        assert flagged(victim.player, "wf") == wiped
        assert {flag: flagged(victim.player, flag) for flag in marks} == marks
        assert locked <= pages(flagged(victim.player, "lo"))


def test_a_live_process_keeps_its_wipe_on_fork(tmp_path: Path) -> None:
    """Random number generators rely on it at every moment."""
    with Victim("mappings", tmp_path) as victim, GuardProcess(config(0.01), [victim.pid]) as guard:
        wiped = flagged(victim.player, "wf")
        guard.wait("checkpoint", count=3)
        for _ in range(200):
            assert flagged(victim.player, "wf") == wiped


def uninherited(victim: Victim) -> set[int]:
    """Pages that a fork does not inherit (MADV_DONTFORK)."""
    return pages(flagged(victim.player, "dc"))


@pytest.mark.parametrize("command", ["mappings", "mappings --unbound --in-child"])
def test_what_no_fork_inherits_is_inherited_by_none_after_a_checkpoint(command: str, tmp_path: Path) -> None:
    """Neither without a death nor after one, although the template has inherited it."""
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        before = uninherited(victim)
        assert before
        for _ in range(5):
            assert guard.checkpoint()["kind"] == "checkpoint"
            assert uninherited(victim) == before
        for _ in range(3):
            since = guard.mark()
            victim.kill_app()
            guard.wait("restored", since=since)
            victim.wait_beats()
            assert uninherited(victim) == before
            assert guard.checkpoint()["kind"] == "checkpoint"
            assert uninherited(victim) == before


@pytest.mark.parametrize("where", WHERE)
def test_it_stays_so_if_the_guard_dies(where: str, tmp_path: Path) -> None:
    """Also between the madvise(2) that allows its inheritance and the one that takes this back."""
    rng = random.Random(7)
    with Victim(f"mappings 0 {where}", tmp_path) as victim:
        before = uninherited(victim)
        with GuardProcess(config(0.002), [victim.pid]) as guard:
            for _ in range(25):
                guard.wait("checkpoint", since=guard.mark(), count=2)
                time.sleep(rng.uniform(0.0, 0.01))
                guard.kill_guards()
                wait_until(lambda: uninherited(victim) == before, 5, "it is inherited no more")
                guard.start_another(victim.pid)
        victim.wait_beats()


def test_the_next_guard_cuts_no_nap_short(tmp_path: Path) -> None:
    """It interrupts a thread that waits for a guard that has died: what the thread slept in before is not forgotten."""
    rng = random.Random(3)
    with Victim("mappings 0 --in-child", tmp_path) as victim, GuardProcess(config(0.002), [victim.pid]) as guard:
        for _ in range(GUARDS_AT_ONCE):
            guard.wait("checkpoint", since=guard.mark())
            time.sleep(rng.uniform(0.0, 0.005))
            guard.start_another(victim.pid)
        guard.wait("checkpoint", since=guard.mark())
        victim.wait_beats()


@contextlib.contextmanager
def large(tmp_path: Path) -> Iterator[Victim]:
    """A victim that others could find 64 MB of: it has a name in /dev/shm."""
    with Victim("mappings 64 --large", tmp_path) as victim:
        path = re.search(r"/dev/shm/victim-large-\w+", Path(f"/proc/{victim.app}/maps").read_text())
        assert path
        try:
            yield victim
        finally:
            os.unlink(path[0])


def test_more_shared_memory_than_allowed_is_left_alone_and_told(tmp_path: Path) -> None:
    with (
        Victim("idle 0 1", tmp_path) as plain,
        large(tmp_path) as victim,
        GuardProcess(config(0.05), [plain.pid, victim.pid]) as guard,
    ):
        told = guard.wait("checkpoint", cookie=2)["error"]["message"]
        assert "avckpt.shm has no room for 65536 KiB of shared memory" in told
        assert not guard.wait("checkpoint", cookie=1).get("error")


@pytest.mark.parametrize("kind", ["--inherited", "--segment", "--memfd", "--memfd --twice", "--inherited --twice"])
def test_more_shared_memory_than_allowed_that_nobody_else_has(kind: str, tmp_path: Path) -> None:
    """Refused: it is the process's own state, as the heap of Java's ZGC, which crashed after each restore."""
    with Victim(f"mappings 8000 {kind}", tmp_path) as victim:
        with GuardProcess(config(), [victim.pid]) as guard:
            answer = guard.checkpoint()
            assert answer["kind"] == "unprotected", answer
            assert "no room for 8000 KiB of shared memory that nobody else has" in answer["error"]["message"]
        with GuardProcess(config(shm_bytes=0), [victim.pid]) as guard:  # its user takes it for no state
            assert "no room for 8000 KiB of shared memory" in guard.checkpoint()["error"]["message"]
        with GuardProcess(
            config(0.1, shm_bytes=settings_of({"avckpt.enable": "true", "avckpt.shm": "8000 KiB"}).config.shm_bytes),
            [victim.pid],
        ) as guard:
            kill_at_random(guard, victim, 5, (0.01, 0.3))


@pytest.mark.parametrize(("megabytes", "kind"), [(8, "unprotected"), (2, "checkpoint")])
def test_more_shared_memory_than_allowed_of_several_processes(megabytes: int, kind: str, tmp_path: Path) -> None:
    """Refused: a restored process would wait for what the others had stored in it."""
    with Victim(f"crowd common 2 {megabytes}", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        answer = guard.checkpoint()
        assert answer["kind"] == kind, answer
        if kind == "unprotected":
            assert "8192 KiB" in answer["error"]["message"]
            assert "several of its processes share" in answer["error"]["message"]
        victim.wait_beats()


def test_small_shared_memory_is_rolled_back_beside_a_large_one(tmp_path: Path) -> None:
    with large(tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        assert "65536 KiB of shared memory" in guard.wait("checkpoint")["error"]["message"]
        kill_at_random(guard, victim, 10, (0.01, 0.15))


def restored(victim: Victim, guard: GuardProcess) -> Json:
    """Disturbs and kills the victim; the restore's notes, once it has checked itself."""
    before, disturbed, since = victim.see().counter[1], victim.see().counter[2], guard.mark()
    os.kill(victim.player, signal.SIGUSR1)
    wait_until(lambda: victim.see().counter[2] > disturbed or victim.see().violations, 5, "it has", 0.001)
    victim.kill_app()
    event = guard.wait("restored", since=since)
    wait_until(lambda: victim.see().counter[1] > before or victim.see().violations, 5, "it has looked", 0.001)
    victim.check()
    return event


KINDS = [
    *("guard", "unguard", "sealed", "droppable", "growing", "attached", "readable", "readonly", "unmoved"),
    *("shielded", "described", "scattered", "wiped", "reserved"),
]


@pytest.mark.parametrize(
    ("scenario", "where"),
    [
        *itertools.product(KINDS, WHERE),
        ("divided", ""),  # a child could not attach it again
        ("late", ""),  # nor map it
    ],
)
def test_kinds_that_few_have(scenario: str, where: str, tmp_path: Path) -> None:
    """Repeatedly from each of two checkpoints, with no notes."""
    command = f"regions {scenario} {tmp_path} {where}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(2):
            taken = guard.checkpoint()
            assert (taken["kind"], taken.get("error")) == ("checkpoint", None)
            for _kill in range(3):
                event = restored(victim, guard)
                assert "error" not in event, event
            if scenario == "late":
                break  # sealed for good


def test_a_divided_segment_is_only_mapped_and_told(tmp_path: Path) -> None:
    command = f"regions divided {tmp_path} --in-child"
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        assert "cannot be detached" in restored(victim, guard)["error"]["message"]


@pytest.mark.parametrize("where", WHERE)
def test_what_was_sealed_since_can_not_go_back_and_is_told(where: str, tmp_path: Path) -> None:
    command = f"regions changed {tmp_path} {where}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        assert guard.checkpoint()["kind"] == "checkpoint"
        assert "sealed" in restored(victim, guard)["error"]["message"]


@pytest.fixture
def visible(tmp_path: Path) -> Iterator[Path]:
    """A folder in /dev/shm that the victim and all others can reach."""
    folder = Path("/dev/shm") / f"avckpt-test-{tmp_path.name}-{os.getpid()}"
    folder.mkdir()
    yield folder
    shutil.rmtree(folder)


@pytest.mark.parametrize("where", WHERE)
def test_what_it_can_not_write_is_not_rolled_back(where: str, visible: Path, tmp_path: Path) -> None:
    """A reader's restore takes back nothing that the writer has written since."""
    with (
        Victim(f"regions viewed {visible} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        assert "error" not in guard.checkpoint()
        (visible / "map").write_bytes(b"now\0")
        assert "error" not in restored(victim, guard)
        assert (visible / "map").read_bytes() == b"now\0"


@pytest.mark.parametrize("where", WHERE)
def test_what_others_wrote_since_is_not_taken_back(where: str, visible: Path, tmp_path: Path) -> None:
    """When the application dies, they neither map it nor have it open any more."""
    with (
        Victim(f"regions published {visible} {where}", tmp_path) as victim,
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        assert "error" not in guard.checkpoint()
        with (visible / "map").open("r+b") as file:
            file.write(b"now\0")
        assert "have been written as files since" in restored(victim, guard)["error"]["message"]
        assert (visible / "map").read_bytes()[:4] == b"now\0"


def test_what_others_have_open_for_writing_is_theirs_and_told(visible: Path, tmp_path: Path) -> None:
    with (
        Victim(f"regions published {visible}", tmp_path) as victim,
        (visible / "map").open("r+b"),
        GuardProcess(config(), [victim.pid]) as guard,
    ):
        assert "shared memory are also others'" in guard.checkpoint()["error"]["message"]


ATTACH = """
import ctypes, os, sys
libc = ctypes.CDLL(None, use_errno=True)
libc.shmget.argtypes = [ctypes.c_int, ctypes.c_size_t, ctypes.c_int]
libc.shmat.argtypes, libc.shmat.restype = [ctypes.c_int, ctypes.c_void_p, ctypes.c_int], ctypes.c_void_p
number = int(sys.argv[1])
if sys.argv[2:]:  # another segment, with the same number
    assert libc.unshare(0x08000000) == 0
    open("/proc/sys/kernel/shm_next_id", "w").write(str(number))
    assert libc.shmget(0, 4096, 0o600) == number
attached = libc.shmat(number, None, 0)
print("no" if attached == ctypes.c_void_p(-1).value else "yes", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_segment_that_others_have_attached_is_theirs_and_told(elsewhere: bool, tmp_path: Path) -> None:
    """Not so one of another container, which may have the same number."""
    with Victim("mappings --segment", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        maps = Path(f"/proc/{victim.app}/maps").read_text().splitlines()
        number = next(int(line.split()[4]) for line in maps if "/SYSV" in line)
        command = [sys.executable, "-c", ATTACH, str(number), *(["elsewhere"] if elsewhere else [])]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout
            assert other.stdout.readline() == "yes\n"
            told = guard.checkpoint().get("error", {}).get("message", "")
            assert ("shared memory are also others'" in told) != elsewhere
            if elsewhere:
                since = guard.mark()
                victim.kill_app()
                guard.wait("restored", since=since)
                victim.wait_beats()
            assert other.stdin
            other.stdin.close()


@pytest.mark.usefixtures("huge_pages")
def test_shared_huge_pages_are_rolled_back(tmp_path: Path) -> None:
    with Victim("mappings 2048 --huge", tmp_path) as victim, GuardProcess(config(0.05), [victim.pid]) as guard:
        kill_at_random(guard, victim, 15, (0.01, 0.15))


@pytest.mark.usefixtures("huge_pages")
@pytest.mark.parametrize("kind", ["huge", "hugefile"])
def test_private_huge_pages_are_refused_as_long_as_there_are_any(kind: str, tmp_path: Path) -> None:
    with (
        Victim(f"unsupported {kind} signal 1", tmp_path) as victim,
        GuardProcess(config(0.02), [victim.pid]) as guard,
    ):
        guard.wait("checkpoint")
        victim.kill_app(signal.SIGUSR1)
        assert "private huge pages" in guard.wait("unprotected")["error"]["message"]
        since = guard.mark()
        # Those of a file are seen only in a clone, which is there for a moment.
        wait_until(lambda: victim.others() == [], 5, "nothing is left in the container")
        victim.wait_beats(20)
        guard.wait("checkpoint", since=since)


NODE = """
const crypto = require('crypto'), fs = require('fs');
const board = fs.openSync(process.argv[process.argv.indexOf('--board') + 1], 'r+');
const sum = text => crypto.createHash('sha256').update(text).digest('hex');
const kept = new Map();
let laps = 0;
function write(word, value) {
    const bytes = Buffer.alloc(8);
    bytes.writeBigUInt64LE(BigInt(value));
    fs.writeSync(board, bytes, 0, 8, 8 * word);
}
function beat() {
    const bytes = Buffer.alloc(8);
    fs.readSync(board, bytes, 0, 8, 24);
    write(3, bytes.readBigUInt64LE() + 1n);
}
function lap() {
    const key = laps % 3000, old = kept.get(key);
    if (old && sum(old.text) !== old.sum) {
        console.log('VIOLATION: ' + key);
        process.exit(99);
    }
    const text = Array.from({length: 50}, (_, i) => 'x' + laps * i).join(',');
    kept.set(key, {text, sum: sum(text)});
    if (++laps % 50 === 0) beat();
    setImmediate(lap);
}
setInterval(beat, 5);
write(1, 1);
write(2, process.pid);
write(8, 1);
lap();
"""


@pytest.mark.skipif(not shutil.which("node"), reason="Node.js is not installed")
def test_node(tmp_path: Path) -> None:
    """V8 marks its heap MADV_DONTFORK; here the heap grows and shrinks all the time."""
    script = tmp_path / "app.js"
    script.write_text(NODE)
    command = f"{shutil.which('node')} {script}"
    with Victim(command, tmp_path) as victim, GuardProcess(config(0.1), [victim.pid]) as guard:
        assert flagged(victim.player, "dc")
        kill_at_random(guard, victim, 30, (0.05, 0.4))


def go_on(victim: Victim) -> None:
    """Waits until its child has looked at its memory again."""
    looks = victim.see().counter[0]
    wait_until(lambda: victim.see().counter[0] > looks + 5, 20, "the child goes on")


def test_a_child_has_memory_where_its_parent_has_its_vdso(tmp_path: Path) -> None:
    """It has executed another program; the kernel looks for room where the process that forked it does."""
    with Victim("shadow", tmp_path) as victim, GuardProcess(config(), [victim.pid]) as guard:
        for _ in range(3):
            assert guard.checkpoint()["kind"] == "checkpoint"
            since = guard.mark()
            victim.kill_app()
            event = guard.wait("restored", since=since)
            assert "error" not in event, event
            go_on(victim)
            assert not victim.see().violations, victim.said
