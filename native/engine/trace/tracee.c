/* SPDX-License-Identifier: Apache-2.0
 *
 * ptrace(2), the parts that every other file needs.
 *
 * A guard waits only for tracees of its own thread (__WNOTHREAD).  The rest of its process must not
 * call waitpid(-1).
 */
#include <errno.h>
#include <sched.h>
#include <setjmp.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "trace.h"

#define TICK_NS (2 * (long)NS_PER_MS)
#define PTRACE_GET_SYSCALL_INFO_ 0x420e /* since Linux 5.3 */
#define SYSCALL_INFO_ENTRY 1

#ifndef sigev_notify_thread_id
#define sigev_notify_thread_id _sigev_un._tid
#endif

static void nothing(int signal)
{
	(void)signal;
}

int tracee_timer_signal(void)
{
	return SIGRTMAX - 2;
}

static __thread struct {
	volatile sig_atomic_t waits;
	sigjmp_buf end;
} seizing;

static void end_seizing(int signal)
{
	(void)signal;
	if (!seizing.waits)
		return;
	seizing.waits = 0;
	siglongjmp(seizing.end, 1);
}

static void install_handlers(void)
{
	struct sigaction action = { .sa_handler = nothing }; /* no SA_RESTART: wait(2) ends */

	sigaction(SIGCHLD, &action, NULL);
	action.sa_handler = end_seizing;
	action.sa_flags = SA_NODEFER; /* it may be left by a jump */
	sigaction(tracee_timer_signal(), &action, NULL);
}

int tracee_poll(struct pollfd *fds, nfds_t n, const struct timespec *timeout)
{
	sigset_t blocked;

	sigfillset(&blocked);
	sigdelset(&blocked, tracee_timer_signal());
	sigdelset(&blocked, SIGCHLD);
	return ppoll(fds, n, timeout, &blocked);
}

int tracee_timer_new(timer_t *timer, struct avc_error *err)
{
	static pthread_once_t once = PTHREAD_ONCE_INIT;
	struct sigevent event = { .sigev_notify = SIGEV_THREAD_ID,
				  .sigev_signo = tracee_timer_signal() };
	sigset_t set;

	pthread_once(&once, install_handlers);
	sigfillset(&set);
	sigdelset(&set, tracee_timer_signal());
	pthread_sigmask(SIG_SETMASK, &set, NULL);
	event.sigev_notify_thread_id = (pid_t)syscall(SYS_gettid);
	if (timer_create(CLOCK_MONOTONIC, &event, timer))
		return fail_errno(err, 0, "start guard", "timer_create",
				  "no timer for the deadline");
	return 0;
}

static __thread uint64_t deadline_ns; /* CLOCK_MONOTONIC */
static __thread const uint32_t *watched;

void tracee_watch(const uint32_t *word)
{
	watched = word;
}

/* Ticks before the deadline, to check whether the tracee is dying, and after it: a tick just before
 * the thread enters wait(2) is lost. */
void tracee_deadline_set(timer_t timer, uint64_t ns)
{
	struct itimerspec t = { .it_interval.tv_nsec = TICK_NS, .it_value.tv_nsec = TICK_NS };

	const bool ticking = deadline_ns != 0;

	deadline_ns = now_ns() + ns;
	if (!ticking)
		timer_settime(timer, 0, &t, NULL);
}

void tracee_deadline_clear(timer_t timer)
{
	struct itimerspec t = { 0 };

	timer_settime(timer, 0, &t, NULL);
	deadline_ns = 0;
}

bool tracee_deadline_passed(void)
{
	return deadline_ns && now_ns() >= deadline_ns;
}

uint64_t tracee_deadline(uint64_t ns)
{
	return now_ns() + restore_patience(ns);
}

bool tracee_has_time(uint64_t end_ns)
{
	return budget_wait() && now_ns() <= end_ns;
}

/* A killed leader is not reported until all its other threads have been reaped, which only we can
 * do, one after the other. */
static bool is_dying(pid_t tid)
{
	struct proc_stat stat;

	if (proc_stat(tid, &stat))
		return !is_shortage(errno);
	return stat.state == 'Z' || stat.state == 'X';
}

/* Like waitpid(2), but leaves a thread that is about to receive a signal as it is.  Waiting for
 * such a stop takes the signal out of it (kernel/exit.c, wait_task_stopped()); if we then died
 * before passing it on, the application would never get it.  With WNOWAIT it does. */
static pid_t wait_keeping_signal(pid_t tid, int *status, int options)
{
	siginfo_t info = { 0 };

	options |= __WALL | __WNOTHREAD;
	if (waitid(P_PID, (id_t)tid, &info, WEXITED | WSTOPPED | WNOWAIT | options))
		return -1;
	if (!info.si_pid)
		return 0;
	/* No event, no system call: si_status is the exit code of the stop, ptrace(2). */
	if (info.si_code == CLD_TRAPPED && info.si_status < 0x80) {
		*status = W_STOPCODE(info.si_status);
		return tid;
	}
	return waitpid(tid, status, options);
}

/* tick() is called at intervals while there is a deadline. */
static struct stop wait_ticking(pid_t tid, int options, void (*tick)(void))
{
	struct stop stop = { .kind = STOP_OTHER };
	unsigned long message = 0;
	pid_t r;

	do {
		r = wait_keeping_signal(tid, &stop.status, options);
		if (r < 0 && errno == EINTR) {
			stop.kind = is_dying(tid) ? STOP_DYING : STOP_DEADLINE;
			if (stop.kind == STOP_DYING || tracee_deadline_passed() ||
			    (watched && __atomic_load_n(watched, __ATOMIC_ACQUIRE)) ||
			    !budget_wait())
				return stop;
			if (tick)
				tick();
			r = -2;
		}
	} while (r == -2);
	if (r == 0) {
		stop.kind = STOP_NONE;
		return stop;
	}
	if (r < 0 || !WIFSTOPPED(stop.status)) {
		stop.kind = STOP_EXIT;
		return stop;
	}
	stop.signal = WSTOPSIG(stop.status);
	stop.event = stop.status >> 16;
	switch (stop.event) {
	case 0:
		stop.kind = stop.signal == (SIGTRAP | 0x80) ? STOP_SYSCALL : STOP_SIGNAL;
		break;
	case PTRACE_EVENT_STOP:
		stop.kind = stop.signal == SIGTRAP ? STOP_TRAP : STOP_GROUP;
		break;
	case PTRACE_EVENT_FORK:
	case PTRACE_EVENT_VFORK:
	case PTRACE_EVENT_CLONE:
		stop.kind = STOP_FORK;
		ptrace(PTRACE_GETEVENTMSG, tid, NULL, &message);
		stop.message = (pid_t)message;
	}
	return stop;
}

struct stop tracee_wait(pid_t tid, int options)
{
	return wait_ticking(tid, options, NULL);
}

static __thread int group_signal;

int tracee_group_signal(void)
{
	return group_signal;
}

enum stop_kind tracee_await(pid_t tid, pid_t *child, struct avc_error *err)
{
	return tracee_await_while(tid, NULL, child, err);
}

enum stop_kind tracee_await_while(pid_t tid, void (*tick)(void), pid_t *child,
				  struct avc_error *err)
{
	for (;;) {
		struct stop stop = wait_ticking(tid, 0, tick);

		switch (stop.kind) {
		case STOP_TRAP:
			group_signal = 0;
			return STOP_TRAP;
		case STOP_GROUP:
			/* Stopped by job control, and stays so when it is released: its parent does
			 * not notice what it does meanwhile. */
			group_signal = stop.signal;
			return STOP_TRAP;
		case STOP_FORK:
			if (child)
				*child = stop.message;
			break;
		case STOP_SIGNAL:
		case STOP_SYSCALL:
		case STOP_NONE:
		case STOP_OTHER:
			break;
		case STOP_EXIT:
		case STOP_DYING:
			fail(err, AVC_GONE, 0, tid, "stop", "", "it has ended");
			return stop.kind;
		case STOP_DEADLINE:
			fail(err, AVC_DEADLINE, 0, tid, "stop", "",
			     "a thread did not stop in time: it gets no CPU, is paused, or waits in the "
			     "kernel for a device");
			return stop.kind;
		}
		/* Any stop clears a pending interrupt (kernel/signal.c, ptrace_stop): without a new
		 * one it would just keep running. */
		if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL) || seccomp_go_on(tid, &stop)) {
			fail_errno(err, tid, "stop", "ptrace(CONT)", "it has gone");
			return STOP_OTHER;
		}
	}
}

int tracee_settle(pid_t tid, struct avc_error *err)
{
	if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL) || seccomp_go_on(tid, NULL))
		return fail_errno(err, tid, "stop", "ptrace(CONT)", "it has gone");
	return tracee_await(tid, NULL, err) == STOP_TRAP ? 0 : -1;
}

int tracee_halt(pid_t tid, struct avc_error *err)
{
	if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL))
		return fail_errno(err, tid, "stop", "ptrace(INTERRUPT)", "it has gone");
	(void)seccomp_go_on(tid, NULL); /* fails if it runs */
	return tracee_await(tid, NULL, err) == STOP_TRAP ? 0 : -1;
}

bool tracee_enters_call(pid_t tid)
{
	/* struct ptrace_syscall_info of <linux/ptrace.h>, which does not go with <sys/ptrace.h>. */
	uint8_t info[88] = { 0 };

	return ptrace(PTRACE_GET_SYSCALL_INFO_, tid, sizeof info, info) > 0 &&
	       info[0] == SYSCALL_INFO_ENTRY;
}

/* False: it is no tracee of this thread.  info->si_pid: 0 if there is nothing new. */
static bool look(pid_t tid, siginfo_t *info)
{
	*info = (siginfo_t){ 0 };
	return waitid(P_PID, (id_t)tid, info,
		      WEXITED | WSTOPPED | WNOHANG | WNOWAIT | __WALL | __WNOTHREAD) == 0;
}

bool tracee_is_ours(pid_t tid)
{
	siginfo_t info;

	return look(tid, &info);
}

bool tracee_has_stopped(pid_t tid)
{
	siginfo_t info;

	return !look(tid, &info) || info.si_pid;
}

/* A tracee that has ended and was not reaped, or there is none that could. */
static bool any_has_ended(void)
{
	siginfo_t info = { 0 };

	return waitid(P_ALL, 0, &info, WEXITED | WNOHANG | WNOWAIT | __WALL | __WNOTHREAD) == 0 &&
	       info.si_pid;
}

/* The kernel lets nobody be seized while a thread of its process is in execve(2) (kernel/ptrace.c,
 * cred_guard_mutex).  And that thread waits until all others of its process are gone, of which we may
 * trace some: they are gone when we have reaped them (fs/exec.c, de_thread()).  A signal ends
 * neither wait, as the kernel has ptrace(2) go on after it (ERESTARTNOINTR): its handler has to leave
 * the call. */
int tracee_seize(pid_t tid, long options)
{
	int result;

	for (;;) {
		if (sigsetjmp(seizing.end, 0) == 0) {
			seizing.waits = 1;
			result = ptrace(PTRACE_SEIZE, tid, NULL, options) == -1 ? -1 : 0;
			seizing.waits = 0;
			return result;
		}
		if (tracee_is_ours(tid)) /* the tick came right after it */
			return 0;
		if (tracee_deadline_passed() || any_has_ended()) {
			errno = EAGAIN;
			return -1;
		}
	}
}

#define PC_NS (20 * NS_PER_MS)
#define PC_STEP_US 50

avc_remote tracee_pc(pid_t tid)
{
	const uint64_t end = tracee_deadline(PC_NS);
	struct arch_regs regs;

	/* Fails until it is stopped. */
	while (arch_regs_get(tid, &regs)) {
		if (!tracee_has_time(end) || is_dying(tid))
			return 0;
		usleep(PC_STEP_US);
	}
	return arch_pc(&regs);
}

/* ---- unknown tracees ---------------------------------------------------------------- */

static struct {
	bool (*known)(pid_t tid, const void *arg);
	const void *arg;
	uint64_t until_ns;
} strangers;

void tracee_know(bool (*known)(pid_t tid, const void *arg), const void *arg)
{
	strangers.known = known;
	strangers.arg = arg;
}

void tracee_expect_strangers(void)
{
	strangers.until_ns = now_ns() + NS_PER_S;
}

bool tracee_expects_strangers(void)
{
	return now_ns() < strangers.until_ns;
}

void tracee_release_strangers(void)
{
	for (;;) {
		siginfo_t info = { 0 };
		struct stop stop;

		if (!strangers.known ||
		    waitid(P_ALL, 0, &info,
			   WSTOPPED | WEXITED | WNOHANG | WNOWAIT | __WALL | __WNOTHREAD) ||
		    !info.si_pid || strangers.known(info.si_pid, strangers.arg))
			return;
		stop = tracee_wait(info.si_pid, WNOHANG);
		if (stop.kind != STOP_EXIT)
			ptrace(PTRACE_DETACH, info.si_pid, NULL,
			       (long)(stop.kind == STOP_SIGNAL ? stop.signal : 0));
	}
}

bool tracee_reap_unknown(bool (*known)(pid_t tid, const void *arg), const void *arg)
{
	siginfo_t info = { 0 };

	if (waitid(P_ALL, 0, &info, WEXITED | WNOHANG | WNOWAIT | __WALL | __WNOTHREAD) ||
	    !info.si_pid || known(info.si_pid, arg))
		return false;
	return waitpid(info.si_pid, NULL, __WALL | __WNOTHREAD | WNOHANG) == info.si_pid;
}

void tracee_signal(pid_t pid, int signal)
{
	if (tracee_is_ours(pid))
		kill(pid, signal);
}

void tracee_kill(pid_t pid)
{
	/* In a restore init hears meanwhile that it goes on: its end may take a CPU that others have. */
	const uint64_t end = tracee_deadline(0);
	const struct timespec tick = { .tv_nsec = TICK_NS };

	tracee_signal(pid, SIGKILL);
	for (;;) {
		int status;
		pid_t r = waitpid(pid, &status,
				  __WALL | __WNOTHREAD | (tracee_has_time(end) ? WNOHANG : 0));

		if (r == pid && (WIFEXITED(status) || WIFSIGNALED(status)))
			return;
		if (r < 0 && errno != EINTR)
			return;
		if (r == 0)
			(void)tracee_poll(NULL, 0, &tick);
	}
}

/* ---- ending tracees ------------------------------------------------------------------ */

/* If there are more, we wait for their end. */
#define ENDING_MAX 64
/* The app has just been stopped, and goes first: freeing memory keeps a CPU from it for as long as
 * the kernel does not reschedule. */
#define END_AFTER_NS (10 * NS_PER_MS)
#define END_TOGETHER_NS NS_PER_MS /* ends those at once that are to end within it */

static __thread struct {
	struct {
		pid_t pid;
		int pidfd;
		uint64_t kill_ns; /* 0: it was killed                                */
	} task[ENDING_MAX];
	uint32_t count;
} ending;

void tracee_end(pid_t pid, int pidfd)
{
	(void)tracee_reap_ending();
	if (pidfd < 0 || ending.count == ENDING_MAX) {
		tracee_kill(pid);
		close_fd(&pidfd);
		return;
	}
	ending.task[ending.count].pid = pid;
	ending.task[ending.count].kill_ns = now_ns() + END_AFTER_NS;
	ending.task[ending.count++].pidfd = pidfd;
}

static void end_until(uint64_t now)
{
	for (uint32_t i = 0; i < ending.count; i++)
		if (ending.task[i].kill_ns && ending.task[i].kill_ns <= now) {
			syscall(SYS_pidfd_send_signal, ending.task[i].pidfd, SIGKILL, NULL, 0);
			ending.task[i].kill_ns = 0;
		}
}

void tracee_end_now(void)
{
	end_until(UINT64_MAX);
}

uint32_t tracee_reap_ending(void)
{
	uint32_t left = 0;

	end_until(now_ns() + END_TOGETHER_NS);
	for (uint32_t i = 0; i < ending.count; i++) {
		int status;
		const pid_t r = waitpid(ending.task[i].pid, &status,
					__WALL | __WNOTHREAD | WNOHANG);
		/* It may stop before it ends. */
		if (r == 0 || (r > 0 && WIFSTOPPED(status)))
			ending.task[left++] = ending.task[i];
		else
			close_fd(&ending.task[i].pidfd);
	}
	ending.count = left;
	return left;
}

uint64_t tracee_ending_due(void)
{
	uint64_t due = UINT64_MAX;

	for (uint32_t i = 0; i < ending.count; i++)
		if (ending.task[i].kill_ns && ending.task[i].kill_ns < due)
			due = ending.task[i].kill_ns;
	return due;
}

bool tracee_is_ending(pid_t pid)
{
	for (uint32_t i = 0; i < ending.count; i++)
		if (ending.task[i].pid == pid)
			return true;
	return false;
}

int tracee_ending_pidfd(uint32_t i)
{
	return i < ending.count ? ending.task[i].pidfd : -1;
}
