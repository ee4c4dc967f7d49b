# SPDX-License-Identifier: Apache-2.0
"""What an application died of, as reported by its sidecar: real deaths of real processes."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from avckpt.cli.client import Client
from avckpt.events.log import AT_ONCE, EACH_S
from avckpt.evidence.crash import FRAMES_MAX
from avckpt.evidence.deaths import PROCESSES_MAX, RING_PAGES_MAX, THREADS_ALL, Deaths

from testkit.harness import take_checkpoint, wait_until
from testkit.local_sidecar import ON_COMMAND, QUICK, Container, LocalSidecar, local_sidecar
from testkit.procfs import children_of, comm_of, peak_kb

pytestmark = pytest.mark.shared_machine("a sidecar, its guards and containers have to get CPU time within seconds")

# A thread with a name of its own dies of what it is told to.
VICTIM = """
import ctypes, os, signal, threading, time
wanted = []
def work():
    ctypes.CDLL(None).prctl(15, b"worker", 0, 0, 0)
    while not wanted:
        time.sleep(0.01)
    if wanted[0] == signal.SIGUSR1:
        ctypes.string_at(0x10)
    os.abort()
for each in (signal.SIGUSR1, signal.SIGUSR2):
    signal.signal(each, lambda signum, frame: wanted.append(signum))
signal.signal(signal.SIGHUP, lambda *_: os._exit(3))
threading.Thread(target=work, daemon=True).start()
while True:
    time.sleep(0.01)
"""


@pytest.fixture
def sidecar(tmp_path: Path) -> Iterator[LocalSidecar]:
    with local_sidecar(tmp_path) as sidecar:
        sidecar.start()
        yield sidecar


def crash_by(sidecar: LocalSidecar, victim: Container, signum: int) -> dict[str, Any]:
    """Takes a checkpoint, sends a signal, and waits for the crash event.

    No other checkpoint comes in between: one between the signal and the death would restore what dies again.
    """
    take_checkpoint(sidecar.client, victim.name)
    told = len(sidecar.events(victim.name, "crash"))
    os.kill(victim.app_pid, signum)
    crashes = wait_until(lambda: sidecar.events(victim.name, "crash")[told:], 10, "the crash is told of", every_s=0.05)
    assert sidecar.row(victim), f"it has ended; log:\n{sidecar.log}"
    return crashes[-1]


def test_what_it_died_of(sidecar: LocalSidecar) -> None:
    victim = sidecar.protected("victim", [sys.executable, "-c", VICTIM], ON_COMMAND)

    event = crash_by(sidecar, victim, signal.SIGUSR1)
    crash = event["crash"]
    assert (crash["signal"], crash["code"], crash["fault"]) == ("SIGSEGV", "SEGV_MAPERR", "0x10")
    assert (crash["thread"], crash["count"]) == ("worker", 1)
    assert crash["command"] == sys.executable
    # string_at() reads in the C library, whose build id Debian's own tools know, too.
    assert crash["module"].endswith("/libc.so.6")
    assert len(crash["build_id"]) == 40
    assert "_ctypes" in crash["backtrace"]
    assert (event["outcome"], event["left"]) == ("restored", 4)
    assert event["lost_s"] >= event["age_s"] > 0

    again = crash_by(sidecar, victim, signal.SIGUSR1)["crash"]
    assert (again["fingerprint"], again["count"]) == (crash["fingerprint"], 2)

    aborted = crash_by(sidecar, victim, signal.SIGUSR2)["crash"]
    assert (aborted["signal"], aborted["code"], aborted["thread"]) == ("SIGABRT", "SI_TKILL", "worker")
    assert "sender_pid" not in aborted
    assert aborted["fingerprint"] != crash["fingerprint"]

    killed = crash_by(sidecar, victim, signal.SIGKILL)["crash"]
    assert (killed["signal"], killed["code"], killed["sender_pid"]) == ("SIGKILL", "SI_USER", os.getpid())

    # The guard keeps nothing that nobody looks at any more.
    wait_until(lambda: len(_holders(victim)) <= 1, 5, "what the dead have left is gone", every_s=0.05)


# Crashes below forty calls, in a file and under a name that are as long as can be, and control a terminal.
DEEP = """
#include <signal.h>
#include <unistd.h>
volatile sig_atomic_t told;
void odd(int calls);
__attribute__((noinline)) void even(int calls)
{
    while (!calls) {
        usleep(10000);
        if (told)
            *(volatile int *)0 = 1;
    }
    odd(calls - 1);
    __asm__ volatile("");
}
__attribute__((noinline)) void odd(int calls) { even(calls); __asm__ volatile(""); }
void tell(int signum) { told = signum; }
int main(void) { signal(SIGUSR1, tell); even(40); }
"""


def test_long_names_fill_no_history(sidecar: LocalSidecar, tmp_path: Path) -> None:
    built = tmp_path / "deep"
    subprocess.run(
        ["gcc", "-O0", "-fno-omit-frame-pointer", "-x", "c", "-o", str(built), "-"], input=DEEP.encode(), check=True
    )
    program = built.rename(tmp_path / ("\x1b" * 255))
    run = f"import os; os.execv({os.fsencode(program)!r}, [bytes([0xff]) * 4090])"
    victim = sidecar.protected("victim", [sys.executable, "-c", run], ON_COMMAND)
    wait_until(lambda: Path(f"/proc/{victim.app_pid}/exe").readlink() == program, 10, "it is executed")
    crash = crash_by(sidecar, victim, signal.SIGUSR1)
    assert len(crash["crash"]["backtrace"].split()) == FRAMES_MAX
    assert len(json.dumps(crash)) < 10_000
    assert max(map(len, sidecar.log.splitlines())) < 1000


def test_deaths_fill_no_log(sidecar: LocalSidecar) -> None:
    """It may have 64 restores a second, and dies another death each time."""
    labels = {**ON_COMMAND, "avckpt.restore.max": "64/1s"}
    victim = sidecar.protected("victim", ["sleep", "1000"], labels)
    deaths = 0

    def is_cut_short() -> bool:
        nonlocal deaths
        if deaths % 20 == 0:
            time.sleep(1.1)  # it has lived long enough to go on with a new generation
            take_checkpoint(sidecar.client, victim.name)
        dead = victim.app_pid
        os.kill(dead, (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS)[deaths % 3])
        deaths += 1
        wait_until(lambda: victim.app_pid not in (0, dead), 10, "it is restored", every_s=0.001)
        return "left out here" in sidecar.log

    begun = time.monotonic()
    wait_until(is_cut_short, 90, "it has had enough lines", every_s=0.01)
    lines = sum("victim: " in line for line in sidecar.log.splitlines())
    assert lines <= AT_ONCE + (time.monotonic() - begun) / EACH_S * 1.5 + 1
    # None of them is missing in the history, of which half is its own.
    wait_until(lambda: sidecar.row(victim)["restores"] == deaths, 10, "all are told of")
    kept = [event["restores"] for event in sidecar.events("victim", "restored")]
    assert kept == list(range(deaths - len(kept) + 1, deaths + 1))
    assert len(kept) > 100


def test_an_exit_has_no_place(sidecar: LocalSidecar) -> None:
    victim = sidecar.protected("victim", [sys.executable, "-c", VICTIM], ON_COMMAND)
    event = crash_by(sidecar, victim, signal.SIGHUP)
    assert os.waitstatus_to_exitcode(event["wait_status"]) == 3
    assert not {"signal", "at"} & set(event["crash"])
    assert event["crash"]["command"] == sys.executable


def test_the_command_of_one_that_left_nothing(sidecar: LocalSidecar) -> None:
    """The sidecar looks when the memory of the dead is not there any more."""
    program = ["sh", "-c", f"sleep 0.2; exec {sys.executable} -c '{VICTIM}'"]
    victim = sidecar.protected("victim", program, {**QUICK, "avckpt.keep": "1"})
    so_far = sidecar.wait_for(victim, state="protected", threads=2)["checkpoints"]
    # It has heard of the first one of the new program before, and looked.
    wait_until(lambda: sidecar.row(victim)["checkpoints"] > so_far + 1, 10, "checkpoints", every_s=0.05)
    with asleep(sidecar):
        kill_unheard(victim, signal.SIGUSR1)
        left = set(children_of(victim.init_pid)) - {victim.app_pid}
        left = {pid for pid in left if comm_of(pid) != "avckpt-hold" or pid == min(_holders(victim))}
        wait_until(lambda: not left & set(children_of(victim.init_pid)), 20, "its memory is gone", every_s=0.05)
    event = wait_until(lambda: sidecar.events("victim", "crash"), 10, "the crash is told of", every_s=0.05)[0]
    assert event["crash"]["command"] == sys.executable
    assert "the command is that of an earlier look" in event["crash"]["unknown"]


def test_a_final_death_waits_for_nobody(sidecar: LocalSidecar) -> None:
    """The container ends as soon as the sidecar has seen where it died, and not after the 0.2 s of a lost sidecar."""

    def wait_s(run: int) -> float:
        victim = sidecar.protected(f"v{run}", ["sleep", "1000"], {**QUICK, "avckpt.restore.on": "exit"})
        sidecar.wait_for(victim, state="protected")
        begun = time.monotonic()
        os.kill(victim.app_pid, signal.SIGSEGV)
        assert victim.status() == 128 + signal.SIGSEGV
        return time.monotonic() - begun

    assert any(wait_s(run) < 0.2 for run in range(5))


def test_arguments_without_an_end(sidecar: LocalSidecar) -> None:
    """A process says itself where its arguments are: 300 MB, of which a page is read."""
    odd = sidecar.protected("odd", [sys.executable, "-m", "testkit.odd_environ", "300", "--arguments"])
    wait_until(lambda: "set" in odd.output.read_text(), 10, "it has such arguments")
    assert sidecar.process is not None
    before_kb = peak_kb(sidecar.process.pid)
    wait_until(lambda: sidecar.row(odd)["checkpoints"] > 2, 10, "it is protected", every_s=0.05)
    crash_by(sidecar, odd, signal.SIGKILL)
    assert peak_kb(sidecar.process.pid) < before_kb + 50_000


@contextlib.contextmanager
def asleep(sidecar: LocalSidecar) -> Iterator[None]:
    """The sidecar reads nothing meanwhile."""
    assert sidecar.process is not None
    sidecar.process.send_signal(signal.SIGSTOP)
    try:
        yield
    finally:
        sidecar.process.send_signal(signal.SIGCONT)


def kill_unheard(victim: Container, signum: int) -> None:
    """Has it die, and waits until its guard has restored it."""
    dead = victim.app_pid
    os.kill(dead, signum)
    wait_until(lambda: victim.app_pid not in (0, dead), 10, "it is restored", every_s=0.05)


def test_others_that_die_in_masses_take_nothing_away(sidecar: LocalSidecar) -> None:
    victim = sidecar.protected("victim", [sys.executable, "-c", VICTIM])
    sidecar.wait_for(victim, state="protected", generations=2)
    die = "import os\nfor _ in range(%d):\n    os.fork() or os.kill(os.getpid(), 9)\n    os.wait()"
    with asleep(sidecar):
        kill_unheard(victim, signal.SIGUSR1)
        subprocess.run([sys.executable, "-c", die % (PROCESSES_MAX + 50)], check=True, timeout=60)
    event = wait_until(lambda: sidecar.events("victim", "crash"), 10, "the crash is told of", every_s=0.05)[0]
    # Its memory is not kept for so long; this is what the kernel told at the death.
    assert (event["crash"]["signal"], event["crash"]["code"]) == ("SIGSEGV", "SEGV_MAPERR")
    assert event["crash"]["tid"] > 0
    assert event["detected_s"] > 0


def test_a_death_that_was_not_heard_of_has_a_core_all_the_same(sidecar: LocalSidecar) -> None:
    """More threads die at once than the kernel has room to report: the signal, the memory and the restore are left."""
    cpu = min(os.sched_getaffinity(0))
    victim = sidecar.protected(
        "victim", ["taskset", "--cpu-list", str(cpu), sys.executable, "-c", VICTIM], {**QUICK, "avckpt.core": "on"}
    )
    sidecar.wait_for(victim, state="protected", generations=2, threads=2)
    # A report has more than 256 bytes.
    crowd = RING_PAGES_MAX * 4096 // 256 // 1000 + 1
    many = "import threading\nthreading.stack_size(65536)\nlock = threading.Lock()\nlock.acquire()\n"
    many += "for _ in range(1000):\n    threading.Thread(target=lock.acquire).start()\nprint(flush=True)"
    command = ["taskset", "--cpu-list", str(cpu), sys.executable, "-c", many]
    with asleep(sidecar):
        for _ in range(crowd):
            with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
                assert process.stdout is not None
                assert process.stdout.readline() == b"\n"
                process.kill()
        kill_unheard(victim, signal.SIGUSR1)
    event = wait_until(lambda: sidecar.events("victim", "crash"), 10, "the crash is told of", every_s=0.05)[0]
    assert event["outcome"] == "restored"
    assert event["crash"]["signal"] == "SIGSEGV"
    assert event["crash"]["command"].endswith(sys.executable)
    assert "report of it was lost" in event["crash"]["unknown"]
    assert "detected_s" not in event
    (core,) = wait_until(lambda: sidecar.events("victim", "core"), 60, "the core is told of", every_s=0.1)
    assert "without registers" in core["detail"]
    assert Path(core["core"]).stat().st_size > 0

    def told() -> bool:
        """The kernel says how many were lost when it next has room for a death on that CPU."""
        subprocess.run(["taskset", "--cpu-list", str(cpu), "sh", "-c", "kill -9 $$"], check=False)
        return "had no room to report" in sidecar.log

    wait_until(told, 10, "what was lost is counted", every_s=0.1)

    # And the next one is known again.
    assert crash_by(sidecar, victim, signal.SIGUSR1)["crash"]["code"] == "SEGV_MAPERR"


@pytest.mark.timeout(180)
def test_threads_of_others_fill_no_memory(sidecar: LocalSidecar) -> None:
    """Nobody will ask for what is known of them."""
    many = "import os, threading\nthreading.stack_size(65536)\nlock = threading.Lock()\nlock.acquire()\n"
    many += "for _ in range(2000):\n    threading.Thread(target=lock.acquire).start()\nos.kill(os.getpid(), 9)"
    assert sidecar.process is not None
    before_kb = peak_kb(sidecar.process.pid)
    for _ in range(3 * THREADS_ALL // 2000):
        subprocess.run([sys.executable, "-c", many], check=False, timeout=60)
    victim = sidecar.protected("victim", [sys.executable, "-c", VICTIM], ON_COMMAND)
    assert crash_by(sidecar, victim, signal.SIGUSR1)["crash"]["signal"] == "SIGSEGV"
    assert peak_kb(sidecar.process.pid) < before_kb + 30_000


def test_a_stop_is_no_death() -> None:
    """Nor does one that a thread has survived stand for its death."""
    cpu = min(os.sched_getaffinity(0))
    deaths = Deaths(set, pages=16)
    try:
        with subprocess.Popen(["taskset", "--cpu-list", str(cpu), "sleep", "1000"]) as process:
            wait_until(lambda: comm_of(process.pid) == "sleep", 10, "it sleeps")
            process.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
            process.send_signal(signal.SIGCONT)
            killed_ns = time.monotonic_ns()
            process.kill()
        hit = deaths.of(process.pid).fatal(signal.SIGKILL)
    finally:
        deaths.close()
    assert hit is not None
    assert (hit.signal, hit.at_ns > killed_ns) == (signal.SIGKILL, True)


def test_signals_without_a_death_wake_nobody() -> None:
    """They cost their sender nothing; the newest are known all the same."""
    program = "import os, signal\nsignal.signal(signal.SIGTERM, lambda *_: None)\n"
    program += "for _ in range(20000):\n    os.kill(os.getpid(), signal.SIGTERM)\nprint(flush=True)\nsignal.pause()"
    deaths = Deaths(set, pages=16)  # room for the deaths of others meanwhile
    try:
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as sender:
            assert sender.stdout is not None
            assert sender.stdout.readline() == b"\n"
            sender.kill()
        death = deaths.of(sender.pid)
    finally:
        deaths.close()
    assert [(each.signal, each.sender_pid) for each in death.sent] == [(signal.SIGKILL, os.getpid())]
    assert death.fatal(signal.SIGKILL) is not None


def _holders(victim: Container) -> list[int]:
    return [pid for pid in children_of(victim.init_pid) if comm_of(pid) == "avckpt-hold"]


def test_back_to_an_older_generation(sidecar: LocalSidecar) -> None:
    program = "import time\ni = 0\nwhile True:\n    i += 1\n    print(i, flush=True)\n    time.sleep(0.01)"
    counter = sidecar.protected("counter", [sys.executable, "-c", program], {**ON_COMMAND, "avckpt.keep": "3"})

    def numbers() -> list[int]:
        return [int(line) for line in counter.output.read_text().splitlines()]

    held: list[int] = []
    at = []
    for _ in range(3):
        begun = len(numbers())
        wait_until(lambda: len(numbers()) > begun + 20, 10, "it counts on")  # noqa: B023
        held.append(take_checkpoint(sidecar.client, "counter"))
        at.append(numbers()[-1])
    known = json.loads(sidecar.avckpt("inspect", "counter", "--json").stdout)
    assert [each["generation"] for each in known["generations"]] == held
    ages = [each["age_s"] for each in known["generations"]]
    assert ages == sorted(ages, reverse=True)
    assert (known["settings"]["keep"], known["settings"]["interval"]) == ("3", "1h")
    assert f"  {held[1]}: " in sidecar.avckpt("inspect", "counter").stdout

    refused = sidecar.avckpt("restore", "counter", "--generation", "700", check=False)
    assert (refused.status, "that generation is not held" in refused.stderr) == (5, True)
    length = len(numbers())
    assert f"back at generation {held[1]}" in sidecar.avckpt("restore", "counter", "--generation", str(held[1])).stdout
    wait_until(lambda: len(numbers()) > length + 200, 10, "it counts on")
    lowest = min(numbers()[length:])
    assert at[0] < lowest <= at[1] + 1
    known = json.loads(sidecar.avckpt("inspect", "counter", "--json").stdout)
    assert [each["generation"] for each in known["generations"]] == held[:2]


# More of them than a restore can make within a millisecond.
THREADS = """
import threading, time
for _ in range(150):
    threading.Thread(target=time.sleep, args=(1e6,), daemon=True).start()
while True:
    time.sleep(0.01)
"""


def test_a_recovery_that_comes_late(sidecar: LocalSidecar) -> None:
    labels = {**QUICK, "avckpt.deadline": "1ms"}
    late = sidecar.protected("late", [sys.executable, "-c", THREADS], labels)
    cold = sidecar.protected("cold", [sys.executable, "-c", THREADS], {**labels, "avckpt.deadline.late": "cold"})
    for each in (late, cold):
        sidecar.wait_for(each, timeout_s=20, state="protected", threads=151)
        os.kill(each.app_pid, signal.SIGKILL)

    told = sidecar.events
    (event,) = wait_until(lambda: told("late", "late"), 10, "it is told of", every_s=0.1)
    (crash,) = told("late", "crash")
    assert event["recovered_s"] == crash["recovered_s"] == crash["detected_s"] + crash["restore_s"] > 0.001
    assert "later than avckpt.deadline=1ms" in event["message"]

    assert cold.status() == 128 + signal.SIGKILL
    (given_up,) = wait_until(lambda: told("cold", "gave_up"), 10, "it is told of", every_s=0.1)
    assert given_up["outcome"] == "late"
    assert not told("cold", "restored")

    metrics = Client(sidecar.run_dir).metrics()
    assert 'avckpt_late_total{container="late"} 1.0' in metrics
    assert f'avckpt_detect_max_seconds{{container="late"}} {crash["detected_s"]}' in metrics
