# SPDX-License-Identifier: Apache-2.0
"""avckpt-init and its guard: deaths, verdicts, stops. See native/include/avckpt/ctl.h."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import shutil
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from testkit.harness import wait_until
from testkit.init_peer import CTL, PATIENCE_S, Guard, Init, Page, Phoenix, Verdict
from testkit.pipes import full_pipe
from testkit.procfs import children_of, comm_of, state_of

pytestmark = pytest.mark.usefixtures("init_built", "victims_built")
SHARED = pytest.mark.shared_machine("what init waits for, and how long, is compared with the clock")

both = pytest.mark.parametrize("pid1", [False, True], ids=["child", "pid1"])
STOP_ASKED = 1
LONG_WAIT = ("--wait-ms", "60000")


@pytest.fixture
def init() -> Iterator[Phoenix]:
    """An application under an init with a long timeout, so that a quick end is not the timeout's."""
    with Phoenix(options=LONG_WAIT) as started:
        started.app_pid()
        yield started


@pytest.fixture
def guard(init: Phoenix) -> Iterator[Guard]:
    with Guard(init) as attached:
        yield attached


def still_waits(init: Phoenix, for_s: float = 0.3) -> bool:
    time.sleep(for_s)
    return init.popen.poll() is None


# --- restores --------------------------------------------------------------


@both
@pytest.mark.parametrize("how", ["die 9", "die 11", "die 6", "exit 3"])
def test_restored_app_goes_on_under_the_same_init(pid1: bool, how: str) -> None:
    with Phoenix(pid1=pid1, options=LONG_WAIT) as init, Guard(init) as guard:
        pid = init.app_pid()
        assert guard.ctl().app_pid == pid
        assert guard.ctl().init_pid == (1 if pid1 else init.pid)
        for seq in range(1, 6):
            before = time.monotonic_ns()
            init.app.say(how)
            report = guard.report()
            assert before < report.reaped_ns < time.monotonic_ns()
            kind, number = how.split()
            status = int(number) if kind == "die" else int(number) << 8
            # The kernel may add the core dump flag.
            assert (report.kind, report.seq, report.pid, report.flags) == (1, seq, pid, 0)
            assert report.status & ~0x80 == status
            init.spawn(pid)
            guard.answer(seq, Verdict.RESTORED)
            init.go()
            assert init.app_pid() == pid
        init.app.say("exit 0")
        assert init.end() == 0


@SHARED
def test_death_to_report_takes_no_wait(init: Phoenix, guard: Guard) -> None:
    os.kill(init.app_pid(), signal.SIGKILL)
    killed_ns = time.monotonic_ns()
    assert guard.report().reaped_ns - killed_ns < 1e9


def test_failed_attempts_are_the_guards_business(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    init.app.say("die 11")
    assert guard.report().seq == 1
    for _ in range(3):
        init.spawn(pid)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: state_of(pid) == "X", PATIENCE_S, "the attempt's end")
    init.spawn(pid)
    guard.answer(1, Verdict.RESTORED)
    init.go()
    assert init.app_pid() == pid
    assert guard.hears_nothing(0.2)


def test_failed_attempt_does_not_become_the_exit_status(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    init.app.say("die 11")
    assert guard.report().seq == 1
    init.spawn(pid)
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: state_of(pid) == "X", PATIENCE_S, "the attempt's end")
    guard.answer(1, Verdict.GIVE_UP)
    assert init.end() == 128 + signal.SIGSEGV


def test_death_right_after_the_verdict_is_a_new_death(init: Phoenix, guard: Guard) -> None:
    """The verdict is in the pipe and the restored application dead before init looks at either."""
    pid = init.app_pid()
    for seq in range(1, 20):
        init.app.say("die 11")
        assert guard.report().seq == seq * 2 - 1
        init.spawn(pid)
        os.kill(init.pid, signal.SIGSTOP)
        wait_until(lambda: state_of(init.pid) == "T", PATIENCE_S, "init's stop")
        guard.answer(seq * 2 - 1, Verdict.RESTORED)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: state_of(pid) == "Z", PATIENCE_S, "the death")
        os.kill(init.pid, signal.SIGCONT)
        report = guard.report()
        assert (report.seq, report.status) == (seq * 2, signal.SIGKILL)
        init.spawn(pid)
        guard.answer(seq * 2, Verdict.RESTORED)
        init.go()
        assert init.app_pid() == pid


def test_killed_before_the_verdict_is_noticed(init: Phoenix, guard: Guard) -> None:
    """The restored process is killed before it runs, and the guard does not know yet."""
    pid = init.app_pid()
    init.app.say("die 11")
    assert guard.report().seq == 1
    init.spawn(pid)
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: state_of(pid) == "X", PATIENCE_S, "the process's end")
    guard.answer(1, Verdict.RESTORED)
    report = guard.report()
    assert (report.seq, report.status) == (2, signal.SIGKILL)
    init.spawn(pid)
    guard.answer(2, Verdict.RESTORED)
    init.go()
    assert init.app_pid() == pid


@both
def test_every_death_is_reported_once_whenever_it_comes(pid1: bool) -> None:
    """Failed attempts, and deaths just before, at and after the verdict, in any order and as fast as possible."""
    chance = random.Random(20)
    with Phoenix(pid1=pid1, options=LONG_WAIT) as init, Guard(init) as guard:
        pid = init.app_pid()

        def kill_app() -> None:
            """Kills it directly, by its PID outside: the newest child of init that is not the template."""
            host_pid = next(child for child in reversed(children_of(init.pid)) if child != template)
            os.kill(host_pid, signal.SIGKILL)

        wait_until(lambda: any("tmpl" in comm_of(child) for child in children_of(init.pid)), PATIENCE_S, "the template")
        template = next(child for child in children_of(init.pid) if "tmpl" in comm_of(child))
        alive = True
        for seq in range(1, 151):
            if alive:
                init.app.say("die 11")
            assert guard.report().seq == seq
            for _ in range(chance.randrange(3)):
                init.spawn(pid)
                kill_app()
            init.spawn(pid)
            moment = chance.choice(["before", "at", "after", "never", "never"])
            if moment == "before":
                kill_app()
            guard.answer(seq, Verdict.RESTORED)
            if moment == "at":
                kill_app()
            if moment in ("after", "never"):
                init.go()
            if moment == "after":
                kill_app()
            alive = moment == "never"
            if alive:
                assert init.app_pid() == pid
        init.kill(signal.SIGTERM)
        if not alive:
            # It may have died unseen before the stop was asked for, or of another signal.
            guard.die()
        assert init.end() in (128 + signal.SIGTERM, 128 + signal.SIGKILL)


@pytest.mark.skipif(not shutil.which("strace"), reason="strace holds init at the right instant; it is not installed")
def test_attempt_and_next_verdict_are_not_mixed_up() -> None:
    """After init has reaped a failed attempt, and before its next step, the guard makes another attempt that works
    and reports it.  Init must not take the dead one for the restored application.
    """
    # Init sleeps 100 ms after each wait4 that reaped, which is where the guard gets in.
    prefix = ["strace", "-qq", "-o", "/dev/null", "-e", "trace=wait4", "-e", "inject=wait4:delay_exit=100000"]
    with Phoenix(options=LONG_WAIT, prefix=prefix) as init, Guard(init) as guard:
        pid = init.app_pid()
        for seq in range(1, 4):
            init.app.say("die 11")
            assert guard.report().seq == seq
            init.spawn(pid)
            os.kill(pid, signal.SIGKILL)
            init.spawn(pid)  # works as soon as the first is reaped
            guard.answer(seq, Verdict.RESTORED)
            init.go()
            assert init.app_pid() == pid
            assert guard.hears_nothing(0.3)


def test_stale_verdicts_are_ignored(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    guard.answer(1, Verdict.GIVE_UP + 40)  # for a death that is still to come, and of no known kind
    guard.answer(0, Verdict.GIVE_UP)
    guard.answer(77, Verdict.RESTORED)
    init.app.say("die 11")
    assert guard.report().seq == 1
    guard.answer(0, Verdict.GIVE_UP)
    guard.answer(2, Verdict.GIVE_UP)
    guard.answer(2, Verdict.RESTORED)
    assert still_waits(init)
    init.spawn(pid)
    guard.answer(1, Verdict.RESTORED)
    init.go()
    assert init.app_pid() == pid
    guard.answer(1, Verdict.GIVE_UP)
    init.app.say("die 11")
    assert guard.report().seq == 2
    assert still_waits(init)


# --- no restore ------------------------------------------------------------


@both
def test_give_up(pid1: bool) -> None:
    with Phoenix(pid1=pid1, options=LONG_WAIT) as init, Guard(init) as guard:
        init.app.say("exit 9")
        assert guard.report().seq == 1
        guard.answer(1, Verdict.GIVE_UP)
        assert init.end() == 9
        assert "phoenix ended with status 9 and was not restored: the guard gave up\n" in init.error_text()


@both
def test_an_end_waits_for_no_reader_of_its_messages(pid1: bool) -> None:
    with full_pipe() as (_, writer), Phoenix(pid1=pid1, options=LONG_WAIT, stderr=writer) as init, Guard(init) as guard:
        init.app.say("die 11")
        guard.answer(guard.report().seq, Verdict.GIVE_UP)
        assert init.end() == 128 + signal.SIGSEGV


@both
def test_guard_that_dies_is_noticed_at_once(pid1: bool) -> None:
    with Phoenix(pid1=pid1, options=LONG_WAIT) as init, Guard(init) as guard:
        init.app.say("die 11")
        guard.report()
        assert still_waits(init)
        guard.die()
        assert init.end() == 128 + signal.SIGSEGV
        assert "died by signal 11 (Segmentation fault) and was not restored: the guard is gone" in init.error_text()


def test_guard_that_died_long_ago(init: Phoenix, guard: Guard) -> None:
    """It left armed = 1 behind."""
    guard.die()
    init.app.say("exit 4")
    assert init.end() == 4


@contextlib.contextmanager
def stopped(init: Phoenix) -> Iterator[None]:
    """Meanwhile it reads nothing."""
    os.kill(init.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(init.pid) == "T", PATIENCE_S, "init's stop")
    yield
    os.kill(init.pid, signal.SIGCONT)


def test_verdict_of_a_guard_that_died_counts(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    init.app.say("die 11")
    guard.report()
    init.spawn(pid)
    with stopped(init):
        guard.answer(1, Verdict.RESTORED)
        guard.die()
        init.go()
    assert init.app_pid() == pid
    init.app.say("exit 4")
    assert init.end() == 4


@SHARED
def test_silent_guard_is_waited_for_only_so_long() -> None:
    with Phoenix(options=["--wait-ms", "400"]) as init, Guard(init) as guard:
        assert guard.ctl().wait_ms == 400
        init.app.say("exit 3")
        report = guard.report()
        assert init.end() == 3
        assert 0.39 < (time.monotonic_ns() - report.reaped_ns) / 1e9 < 3
        assert "the guard did not answer in time" in init.error_text()


@SHARED
def test_guard_that_says_it_is_at_work_is_waited_for() -> None:
    with Phoenix(options=["--wait-ms", "400"]) as init, Guard(init) as guard:
        pid = init.app_pid()
        init.app.say("exit 3")
        guard.report()
        for _ in range(5):
            assert still_waits(init, 0.2)
            guard.answer(1, Verdict.WORKING)
        guard.answer(0, Verdict.WORKING)
        init.spawn(pid)
        guard.answer(1, Verdict.RESTORED)
        init.go()
        assert init.app_pid() == pid
        init.app.say("exit 4")
        report = guard.report()
        guard.answer(1, Verdict.WORKING)  # of the death before this one
        assert init.end() == 4
        assert (time.monotonic_ns() - report.reaped_ns) / 1e9 > 0.39


@SHARED
@pytest.mark.skipif(not shutil.which("strace"), reason="strace keeps the CPU from init; it is not installed")
def test_an_answer_that_init_is_late_to_read_was_in_time() -> None:
    """It gets no CPU after its last look at the pipe, until the time of the guard, which has answered, is over."""
    prefix = ["strace", "-qq", "-o", "/dev/null", "-e", "trace=wait4", "-e", "inject=wait4:delay_exit=600000"]
    with Phoenix(options=["--wait-ms", "400"], prefix=prefix) as init, Guard(init) as guard:
        pid = init.app_pid()
        for seq in range(1, 4):
            init.app.say("die 11")
            assert guard.report().seq == seq
            init.spawn(pid)
            guard.answer(seq, Verdict.RESTORED)
            init.go()
            assert init.app_pid() == pid
        init.app.say("exit 5")
        assert guard.report().seq == 4
        guard.answer(4, Verdict.GIVE_UP)
        assert init.end() == 5
        assert "the guard gave up" in init.error_text()


@SHARED
def test_a_guard_is_not_late_for_what_init_is_late_to_tell() -> None:
    """The restored application dies while init, which gets no CPU, has yet to read that it was restored."""
    with Phoenix(options=["--wait-ms", "400"]) as init, Guard(init) as guard:
        pid = init.app_pid()
        init.app.say("die 11")
        assert guard.report().seq == 1
        init.spawn(pid)
        guard.answer(1, Verdict.WORKING)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: state_of(pid) == "X", PATIENCE_S, "init has reaped it")
        with stopped(init):
            guard.answer(1, Verdict.RESTORED)
            time.sleep(0.6)
        assert guard.report().seq == 2
        init.spawn(pid)
        guard.answer(2, Verdict.RESTORED)
        init.go()
        assert init.app_pid() == pid


def test_default_wait() -> None:
    with Phoenix() as init, Guard(init) as guard:
        assert guard.ctl().wait_ms == 2000


def test_no_wait_when_told_so() -> None:
    with Phoenix(options=["--wait-ms", "0"]) as init, Guard(init):
        init.app.say("exit 3")
        assert init.end() == 3


def test_no_wait_without_a_generation(init: Phoenix, guard: Guard) -> None:
    guard.arm(False)
    init.app.say("die 11")
    assert init.end() == 128 + signal.SIGSEGV
    assert (guard.report().status & 0x7F, init.error_text()) == (signal.SIGSEGV, "")


def test_clean_exit_is_final(init: Phoenix, guard: Guard) -> None:
    init.app.say("exit 0")
    assert init.end() == 0
    assert guard.report().status == 0


def test_broken_protocol_ends_the_wait(init: Phoenix, guard: Guard) -> None:
    init.app.say("exit 6")
    guard.report()
    os.write(guard.verdict_fd, b"abc")
    assert init.end() == 6
    assert "does not speak our protocol" in init.error_text()


def test_unread_reports_do_not_block_init(init: Phoenix, guard: Guard) -> None:
    fd = os.open(f"/proc/{init.pid}/fd/{guard.ctl().report_fd}", os.O_WRONLY | os.O_NONBLOCK)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(fd, b"x" * 4096)
    os.close(fd)
    init.app.say("exit 6")
    assert init.end() == 6
    assert "the guard does not read" in init.error_text()


def test_only_armed_is_read_from_the_page(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    for byte in (0xFF, 0x01):
        guard.page[: CTL.size] = bytes([byte]) * CTL.size
        init.app.say("die 11")
        report = guard.report()
        assert report.pid == pid
        init.spawn(pid)
        guard.answer(report.seq, Verdict.RESTORED)
        init.go()
        assert init.app_pid() == pid
    with pytest.raises(PermissionError):
        os.truncate(f"/proc/self/fd/{guard.fd}", 0)
    guard.page[: CTL.size] = bytes(CTL.size)  # says "not armed"
    init.app.say("exit 5")
    assert init.end() == 5


@SHARED
@pytest.mark.skipif(not shutil.which("strace"), reason="strace makes exec slow; it is not installed")
@pytest.mark.parametrize("program", ["sleep", "no-such-program"])
def test_guard_does_not_see_the_app_before_its_exec(program: str) -> None:
    """Until its exec it is a copy of init.  A guard that connects early is told why there will be no application."""
    prefix = ["strace", "-f", "-qq", "-o", "/dev/null", "-e", "trace=execve", "-e", "inject=execve:delay_enter=300000"]
    with Init([program, "60"], prefix=prefix, env={"PATH": "/nowhere:/bin"}) as init, Page(init) as page:
        assert (page.ctl().app_pid, page.ctl().exec_errno) == (0, 0)
        wait_until(lambda: bool(children_of(init.pid)), PATIENCE_S, "the child")
        assert page.ctl().app_pid == 0
        if program == "sleep":
            wait_until(lambda: page.ctl().app_pid != 0, PATIENCE_S, "the start")
            assert children_of(init.pid) == [page.ctl().app_pid]
            assert "sleep" in Path(f"/proc/{page.ctl().app_pid}/cmdline").read_text()
        else:
            wait_until(lambda: page.ctl().exec_errno != 0, PATIENCE_S, "the failure")
            assert (page.ctl().app_pid, page.ctl().exec_errno) == (0, errno.ENOENT)
            assert init.end() == 127


# --- stops -----------------------------------------------------------------


@both
@pytest.mark.parametrize("sig", [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT])
def test_stop_is_final(pid1: bool, sig: signal.Signals) -> None:
    with Phoenix(pid1=pid1, options=LONG_WAIT) as init, Guard(init) as guard:
        assert guard.ctl().stop_asked_ns == 0
        before = time.monotonic_ns()
        init.kill(sig)
        assert init.end() == 128 + sig
        assert before < guard.ctl().stop_asked_ns < time.monotonic_ns()
        assert guard.report().flags == STOP_ASKED


@pytest.mark.parametrize(("how", "status"), [("exit 3", 3), ("die 11", 139), ("die 9", 137)])
def test_any_end_after_a_stop_is_final(init: Phoenix, guard: Guard, how: str, status: int) -> None:
    assert init.app.ask("catch") == "caught"
    init.kill(signal.SIGTERM)
    assert init.app.hear().startswith("signal 15")
    init.app.say(how)
    assert init.end() == status


def test_stop_signal_of_the_container() -> None:
    with Phoenix(options=[*LONG_WAIT, "--stop-signal", "40"]) as init, Guard(init) as guard:
        assert init.app.ask("catch") == "caught"
        init.kill(40)
        assert init.app.hear().startswith("signal 40")
        assert guard.ctl().stop_asked_ns > 0
        init.app.say("exit 3")
        assert init.end() == 3


@pytest.mark.parametrize("sig", [signal.SIGSEGV, signal.SIGUSR1, signal.SIGHUP, 40])
def test_death_by_the_very_signal_that_was_sent_is_final(init: Phoenix, guard: Guard, sig: int) -> None:
    init.kill(sig)
    assert init.end() == 128 + sig
    assert guard.ctl().stop_asked_ns == 0


@pytest.mark.parametrize("sig", [signal.SIGABRT, signal.SIGINT])
def test_tearing_down_for_a_signal_that_was_sent_is_final(init: Phoenix, guard: Guard, sig: int) -> None:
    """It shuts down in its own time, and ends with its own status."""
    assert init.app.ask("catch") == "caught"
    init.kill(sig)
    assert init.app.hear().startswith(f"signal {int(sig)}")
    init.app.say("exit 1")
    assert init.end() == 1
    assert guard.report().flags == STOP_ASKED


def test_other_death_after_another_signal_is_not_final(init: Phoenix, guard: Guard) -> None:
    assert init.app.ask("catch") == "caught"
    init.kill(signal.SIGHUP)
    assert init.app.hear().startswith("signal 1")
    init.app.say("die 11")
    assert guard.report().flags == 0
    assert still_waits(init)


def test_stop_during_a_restore_is_not_lost(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    init.app.say("die 11")
    guard.report()
    init.kill(signal.SIGTERM)
    wait_until(lambda: guard.ctl().stop_asked_ns > 0, PATIENCE_S, "the page")
    assert still_waits(init)
    init.spawn(pid)
    guard.answer(1, Verdict.RESTORED)
    assert init.end() == 128 + signal.SIGTERM
    assert guard.report().flags == STOP_ASKED


def test_other_signals_during_a_restore_are_not_lost(init: Phoenix, guard: Guard) -> None:
    pid = init.app_pid()
    init.app.say("die 11")
    guard.report()
    init.kill(signal.SIGUSR2)
    wait_until(
        lambda: "ShdPnd:\t0000000000000000" in Path(f"/proc/{init.pid}/status").read_text(), PATIENCE_S, "reading"
    )
    init.spawn(pid)
    guard.answer(1, Verdict.RESTORED)
    report = guard.report()
    assert report.status == signal.SIGUSR2
    assert init.end() == 128 + signal.SIGUSR2


def test_who_asks_twice_does_not_wait(init: Phoenix, guard: Guard) -> None:
    init.app.say("die 11")
    guard.report()
    init.kill(signal.SIGTERM)
    wait_until(lambda: guard.ctl().stop_asked_ns > 0, PATIENCE_S, "the page")
    init.kill(signal.SIGTERM)
    assert init.end() == 128 + signal.SIGSEGV


@SHARED
@both
@pytest.mark.parametrize("moment", ["running", "waiting"])
def test_stop_never_hangs_on_a_stopped_guard(pid1: bool, moment: str) -> None:
    """A guard in SIGSTOP keeps its descriptors open and does nothing; so does this process."""
    with Phoenix(pid1=pid1, options=["--wait-ms", "1000"]) as init, Guard(init) as guard:
        init.app_pid()
        holder = os.fork()
        if holder == 0:
            os.kill(os.getpid(), signal.SIGSTOP)
            os._exit(0)
        try:
            guard.die()  # the copies in the stopped process live on
            if moment == "waiting":
                init.app.say("die 11")
                guard.report()
            init.kill(signal.SIGTERM)
            started = time.monotonic()
            assert init.end() == (143 if moment == "running" else 139)
            assert time.monotonic() - started < 5
        finally:
            os.kill(holder, signal.SIGKILL)
            os.waitpid(holder, 0)


def test_templates_end_with_init_where_no_namespace_ends(init: Phoenix, guard: Guard) -> None:
    init.app_pid()
    template = next(pid for pid in children_of(init.pid) if pid != guard.ctl().app_pid)
    init.app.say("exit 0")
    assert init.end() == 0
    assert state_of(template) == "X"
