/* SPDX-License-Identifier: Apache-2.0
 *
 * Interrupted system calls.
 *
 * A ptrace stop wakes a blocked call.  Most calls then return one of the kernel's
 * restart codes, and the kernel restarts them by itself when the thread continues.
 * Some (signal(7), "Interruption of system calls") return plain EINTR, which the app
 * would see although no signal came.  We change those to -ERESTARTNOHAND while the
 * thread is stopped: if a signal with a handler *is* pending, the kernel changes that
 * back to EINTR, as it should; if none is, it restarts the call.
 *
 * A restarted call begins its timeout again.  We shorten no argument for that: the app
 * may keep its arguments in registers from one call to the next, and would find the
 * shorter one there.  The call is repeated unchanged, and the guard ends it when its
 * time is up (waits.c): it stops the thread and sets the result that the kernel would
 * have returned (answer_late()).
 *
 * For that, a rewound call has to be told from a later one with the same arguments.  It
 * is marked where the app cannot see it: the kernel takes the number of a call from the
 * lower half of a register whose upper half it only preserves (arch_call_mark()), and
 * which the result of the call overwrites.
 *
 * If the guard dies:
 *   - before the result is changed, the call returns the EINTR that the kernel gave it.
 *     That cannot be avoided: the kernel wakes the call before it stops the thread, and
 *     lets the thread continue as soon as there is no tracer;
 *   - after that, the call begins its timeout once more, and ends late.
 * The app's state is unchanged in either case.
 */
#include <errno.h>
#include <linux/futex.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <unistd.h>

#include "trace.h"

#define DATE_LOOKS 5 /* attempts to read the clock of a busy CPU */
#define PATIENCE_NS (60 * NS_PER_S)
#define FDS_PER_WORD 64
#define FD_WORDS_MAX 16384 /* of an fd_set: a million descriptors */

/* Newer architectures lack these. */
#ifndef SYS_epoll_wait
#define SYS_epoll_wait (-2)
#define SYS_select (-2)
#define SYS_poll SYS_ppoll
#endif

enum timeout { NO_TIMEOUT, MILLISECONDS, TIMESPEC, TIMEVAL, RECEIVE, SEND, SLEEP, FUTEX, PATIENCE };

/* Calls that return EINTR after a stop, have had no effect when they do, and may be repeated.
 * Never close(2). */
static const struct rewindable {
	long nr;
	enum timeout timeout;
	unsigned int argument;
	int answer; /* its result when its time is up */
} rewindable[] = {
	{ SYS_epoll_wait, MILLISECONDS, 3, 0 },
	{ SYS_epoll_pwait, MILLISECONDS, 3, 0 },
	{ SYS_epoll_pwait2, TIMESPEC, 3, 0 },
	{ SYS_semop, NO_TIMEOUT, 0, 0 },
	/* On huge pages, where it goes on from where it was; before Linux 6.18 also on tmpfs, where it
	 * begins anew, and would not end if it takes longer than the time between two checkpoints. */
	{ SYS_fallocate, PATIENCE, 0, -EINTR },
	{ SYS_semtimedop, TIMESPEC, 3, -EAGAIN },
	{ SYS_rt_sigtimedwait, TIMESPEC, 2, -EAGAIN },
	{ SYS_io_getevents, TIMESPEC, 4, 0 },
	{ SYS_io_pgetevents, TIMESPEC, 4, 0 },
	/* Only when they cannot write the remaining timeout (fs/select.c, poll_select_finish()): it
	 * is in read-only memory, or the program has the personality STICKY_TIMEOUTS. */
	{ SYS_ppoll, TIMESPEC, 2, 0 },
	{ SYS_pselect6, TIMESPEC, 4, 0 },
	{ SYS_select, TIMEVAL, 4, 0 },
	/* Sockets with SO_RCVTIMEO or SO_SNDTIMEO (socket(7)). */
	{ SYS_read, RECEIVE, 0, -EAGAIN },
	{ SYS_readv, RECEIVE, 0, -EAGAIN },
	{ SYS_preadv2, RECEIVE, 0, -EAGAIN },
	{ SYS_recvfrom, RECEIVE, 0, -EAGAIN },
	{ SYS_recvmsg, RECEIVE, 0, -EAGAIN },
	{ SYS_recvmmsg, RECEIVE, 0, -EAGAIN },
	{ SYS_accept, RECEIVE, 0, -EAGAIN },
	{ SYS_accept4, RECEIVE, 0, -EAGAIN },
	{ SYS_connect, SEND, 0, -EINPROGRESS },
	{ SYS_write, SEND, 0, -EAGAIN },
	{ SYS_writev, SEND, 0, -EAGAIN },
	{ SYS_pwritev2, SEND, 0, -EAGAIN },
	{ SYS_sendfile, SEND, 0, -EAGAIN },
	{ SYS_sendto, SEND, 0, -EAGAIN },
	{ SYS_sendmsg, SEND, 0, -EAGAIN },
	{ SYS_sendmmsg, SEND, 0, -EAGAIN },
	/* From a socket, or into one. */
	{ SYS_splice, RECEIVE, 0, -EAGAIN },
	{ SYS_splice, SEND, 2, -EAGAIN },
};

/* Calls that the kernel does not repeat but continues, as restart_syscall(2).  That may be the end of
 * a thread whose filter does not know it (OpenSSH): there they are repeated, too. */
static const struct rewindable continued[] = {
	{ SYS_poll, MILLISECONDS, 2, 0 },
	{ SYS_nanosleep, SLEEP, 0, 0 },
	{ SYS_clock_nanosleep, SLEEP, 2, 0 },
	{ SYS_futex, FUTEX, 3, -ETIMEDOUT },
};

/* ---- how long a call may take --------------------------------------------------------- */

/* In ns; 0: forever. */
static uint64_t time_in_memory(const struct process *process, avc_remote pointer, uint64_t unit_ns)
{
	int64_t time[2];

	if (!pointer || pread(process->mem_fd, time, sizeof time, (off_t)pointer) != sizeof time ||
	    time[0] < 0 || time[1] < 0 || time[0] > INT32_MAX) /* as good as forever */
		return 0;
	return (uint64_t)time[0] * NS_PER_S + (uint64_t)time[1] * unit_ns;
}

static uint64_t socket_timeout(int fd, int option)
{
	struct timeval tv = { 0 };
	socklen_t bytes = sizeof tv;

	if (getsockopt(fd, SOL_SOCKET, option, &tv, &bytes))
		return 0;
	return (uint64_t)tv.tv_sec * NS_PER_S + (uint64_t)tv.tv_usec * 1000;
}

static bool is_unix_socket(int fd)
{
	return fd_option(fd, SOL_SOCKET, SO_DOMAIN) == AF_UNIX;
}

static uint64_t time_of_socket(const struct process *process, int app_fd, enum timeout kind,
			       int *answer)
{
	int fd = (int)syscall(SYS_pidfd_getfd, process->pidfd, app_fd, 0);
	uint64_t limit;

	if (fd < 0)
		return 0;
	limit = socket_timeout(fd, kind == RECEIVE ? SO_RCVTIMEO : SO_SNDTIMEO);
	if (*answer == -EINPROGRESS && is_unix_socket(fd))
		*answer = -EAGAIN;
	close(fd);
	return limit;
}

static uint64_t time_of_call(const struct process *process, const struct arch_regs *regs,
			     const struct rewindable *call, int *answer)
{
	const uint64_t argument = arch_syscall_arg(regs, call->argument);
	const int32_t ms = (int32_t)argument;

	*answer = call->answer;
	switch (call->timeout) {
	case MILLISECONDS:
		return ms > 0 ? (uint64_t)ms * NS_PER_MS : 0;
	case TIMESPEC:
		return time_in_memory(process, argument, 1);
	case TIMEVAL:
		return time_in_memory(process, argument, 1000);
	case RECEIVE:
	case SEND:
		return time_of_socket(process, (int)argument, call->timeout, answer);
	case SLEEP: /* where the time left is written to the argument, that is what is repeated */
		return argument == arch_syscall_arg(regs, call->argument + 1)
			       ? 0
			       : time_in_memory(process, argument, 1);
	case FUTEX: /* others name the time when it is up */
		return (arch_syscall_arg(regs, 1) & FUTEX_CMD_MASK) == FUTEX_WAIT
			       ? time_in_memory(process, argument, 1)
			       : 0;
	case PATIENCE:
		return PATIENCE_NS;
	case NO_TIMEOUT:
		break;
	}
	return 0;
}

static bool has_timeout(long nr)
{
	for (size_t i = 0; i < sizeof rewindable / sizeof *rewindable; i++)
		if (rewindable[i].nr == nr && rewindable[i].timeout != NO_TIMEOUT)
			return true;
	return false;
}

/* False: the call is none of those.  *limit_ns: 0 if it may take forever. */
static bool look_up(const struct process *process, const struct arch_regs *regs, uint64_t *limit_ns,
		    int *answer)
{
	const bool continues = arch_syscall_result(regs) == -ERESTART_RESTARTBLOCK;
	const struct rewindable *calls = continues ? continued : rewindable;
	const size_t count = continues ? sizeof continued / sizeof *continued
				       : sizeof rewindable / sizeof *rewindable;
	bool found = false;

	*limit_ns = 0;
	for (size_t i = 0; !*limit_ns && i < count; i++)
		if (calls[i].nr == arch_syscall_nr(regs)) {
			*limit_ns = time_of_call(process, regs, &calls[i], answer);
			found = true;
		}
	return found;
}

/* ---- the end of a call's time --------------------------------------------------------- */

/* select(2) clears its sets when its time is up. */
static void clear_sets(const struct thread *thread)
{
	static const uint64_t zero[FD_WORDS_MAX];
	const struct arch_regs *regs = &thread->regs;
	const int64_t n = (int32_t)arch_syscall_arg(regs, 0);
	const size_t words = n <= 0 ? 0 : (size_t)(n + FDS_PER_WORD - 1) / FDS_PER_WORD;
	const struct iovec from = { (void *)zero,
				    (words < FD_WORDS_MAX ? words : FD_WORDS_MAX) * sizeof *zero };

	for (unsigned int i = 1; i <= 3; i++) {
		const struct iovec to = { (void *)arch_syscall_arg(regs, i), from.iov_len };

		if (to.iov_base)
			(void)!process_vm_writev(thread->tid, &from, 1, &to, 1, 0);
	}
}

/* In this order: if the guard dies in between, the call is made again. */
static void answer_late(struct thread *thread)
{
	const long nr = arch_syscall_nr(&thread->regs);
	uint64_t mask;

	/* epoll_pwait(2) and others set a signal mask for the duration of the call, which must not
	 * apply to a signal that arrives now.  What we read here is the thread's own mask, and
	 * writing it back restores it (kernel/ptrace.c). */
	if (ptrace(PTRACE_GETSIGMASK, thread->tid, sizeof mask, &mask) ||
	    ptrace(PTRACE_SETSIGMASK, thread->tid, sizeof mask, &mask))
		return;
	if (nr == SYS_select || nr == SYS_pselect6)
		clear_sets(thread);
	if (arch_result_set(thread->tid, thread->rewound.answer))
		return;
	arch_result_note(&thread->regs, thread->rewound.answer);
	thread->rewound = (struct rewound){ 0 };
}

/* ---- which call it is ------------------------------------------------------------------ */

/* The kernel restarts nanosleep, clock_nanosleep, poll and futex as restart_syscall(2).  In another
 * process that means nothing, so there the original call has to be repeated, whose number is no
 * longer in the registers.  Normally we have seen it before.  If not (a guard started later), it is
 * guessed from the code before the system call, or from the arguments. */
static long guess_call(const struct process *process, const struct arch_regs *regs, avc_remote pc)
{
	const uint64_t a = arch_syscall_arg(regs, 0), b = arch_syscall_arg(regs, 1),
		       c = arch_syscall_arg(regs, 2), d = arch_syscall_arg(regs, 3);
	const uint64_t small = ARCH_PAGE_BYTES; /* no address */
	uint8_t code[ARCH_CODE_BYTES];
	long nr;

	if (pread(process->mem_fd, code, sizeof code, (off_t)(pc - sizeof code)) == sizeof code) {
		nr = arch_syscall_nr_before(code);
		if (nr >= 0)
			return nr;
	}
	if (a < small || (int32_t)a < 0)
		return SYS_clock_nanosleep; /* clock, flags, request, remain */
	if (b > small || (b == 0 && c > small && d < small))
		return SYS_nanosleep; /* request, remain */
	if (d > small && a % 4 == 0)
		return SYS_futex; /* word, operation, value, timeout */
	return SYS_poll;          /* descriptors, how many, timeout */
}

bool rewind_is_before(const struct process *process, const struct arch_regs *regs, long nr)
{
	uint8_t code[ARCH_SYSCALL_BYTES];

	return arch_syscall_result(regs) == nr &&
	       pread(process->mem_fd, code, sizeof code, (off_t)arch_pc(regs)) == sizeof code &&
	       arch_is_syscall(code);
}

static void note_call(const struct process *process, struct thread *t)
{
	struct call now = { .nr = arch_syscall_nr(&t->regs),
			    .pc = arch_pc(&t->regs),
			    .sp = arch_sp(&t->regs) };

	for (unsigned int n = 0; n < 3; n++)
		now.arg[n] = arch_syscall_arg(&t->regs, n);
	if (rewind_is_before(process, &t->regs, SYS_restart_syscall)) {
		now.nr = SYS_restart_syscall;
		now.pc += ARCH_SYSCALL_BYTES;
	}
	if (now.nr == SYS_restart_syscall) {
		now.nr = t->call.nr;
		if (now.nr < 0 || memcmp(&now, &t->call, sizeof now) != 0)
			now.nr = guess_call(process, &t->regs, now.pc);
	}
	t->call = now;
}

static bool is_rewound(const struct thread *thread)
{
	return thread->rewound.mark && thread->rewound.mark == arch_call_mark(&thread->regs);
}

/* Like rewind_is_before(), for a rewound call. */
static bool is_about_to_rewind(const struct thread *thread)
{
	return thread->rewound.mark && arch_result_mark(&thread->regs) == thread->rewound.mark;
}

/* The kernel does not show how much of its timeout an interrupted call had left. It shows when a
 * thread last ran: for a thread that slept in the call, that is when the call began. A thread takes
 * longer to exit once its /proc files were opened (proc_flush_pid()), so only those that may need
 * it are looked at. */
void rewind_prepare(struct thread *thread)
{
	struct sleeper *s = &thread->sleeper;
	struct proc_stat before, after = { 0 };

	s->known = (s->timed || has_timeout(thread->call.nr) ||
		    arch_may_continue(thread->call.nr) || !thread->stopped_ns) &&
		   proc_stat(thread->tid, &before) == 0 &&
		   proc_sched(thread->tid, &s->sched) == 0 && proc_stat(thread->tid, &after) == 0 &&
		   before.cpu == after.cpu && after.state == 'S';
	s->cpu = after.cpu;
}

/* Whether a thread that has just stopped slept in its call until then: if it has gone to sleep only
 * once since, which was to stop. It may have been preempted on the way. */
static bool has_slept(const struct thread *thread, struct proc_sched *now)
{
	return thread->sleeper.known && proc_sched(thread->tid, now) == 0 &&
	       now->sleeps == thread->sleeper.sched.sleeps + 1;
}

/* Subtracts the time that the call has taken so far. If the thread woke on another CPU than it
 * slept on, rewind_date() does that later, while nothing is stopped. */
static void count_sleep(struct thread *thread)
{
	const struct sleeper *s = &thread->sleeper;
	struct rewound *r = &thread->rewound;
	struct proc_sched now;

	if (!has_slept(thread, &now))
		return;
	if (now.migrations != s->sched.migrations) {
		r->cpu = s->cpu;
		r->ran_ns = s->sched.ran_ns;
	} else if (now.ran_ns > s->sched.ran_ns) {
		r->due_ns -= cpu_clock_least(now.ran_ns - s->sched.ran_ns);
	}
}

void rewind_date(struct thread *thread)
{
	struct rewound *r = &thread->rewound;
	uint64_t began_ns;

	if (!r->ran_ns)
		return;
	began_ns = cpu_clock_when(r->cpu, r->ran_ns);
	if (began_ns && began_ns < r->since_ns)
		r->due_ns -= r->since_ns - began_ns;
	if (began_ns || ++r->looks == DATE_LOOKS)
		r->ran_ns = 0;
}

/* If recvmmsg(2) is interrupted after some messages, it returns their number, and leaves the error
 * to the socket's next call (net/socket.c, do_recvmmsg()), which would fail with one of the
 * kernel's internal codes.  Reading SO_ERROR clears it. */
static void forget_error(const struct process *process, const struct arch_regs *regs)
{
	const long got = arch_syscall_result(regs);
	int fd, error;
	socklen_t bytes = sizeof error;

	if (got <= 0 || got >= (int32_t)arch_syscall_arg(regs, 2))
		return;
	fd = (int)syscall(SYS_pidfd_getfd, process->pidfd, (int)arch_syscall_arg(regs, 0), 0);
	if (fd < 0)
		return;
	(void)getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &bytes);
	close(fd);
}

/* Whether we have to repeat its call, or nobody does. */
static bool is_not_restarted(struct process *process, const struct thread *thread)
{
	const long result = arch_syscall_result(&thread->regs);

	return result == -EINTR ||
	       (result == -ERESTART_RESTARTBLOCK && seccomp_bars_restart(process, thread->tid));
}

/* Marks a call that returned EINTR after a stop, and computes when its time is up. */
static void begin_watch(const struct process *process, struct thread *thread, uint64_t now)
{
	uint64_t limit_ns;
	int answer;

	thread->rewound = (struct rewound){ 0 };
	if (!look_up(process, &thread->regs, &limit_ns, &answer))
		return;
	thread->rewound = (struct rewound){ .mark = (uint32_t)now | 1,
					    .answer = answer,
					    .due_ns = UINT64_MAX };
	if (!limit_ns)
		return;
	thread->sleeper.timed = true;
	thread->rewound.since_ns = now;
	thread->rewound.due_ns = now + limit_ns;
	count_sleep(thread);
}

/* The result first: if the guard dies before the mark is set, the wait is too long, but does not
 * fail. */
static bool send_back(struct thread *thread)
{
	if (arch_result_set(thread->tid, -ERESTARTNOHAND))
		return false;
	arch_result_note(&thread->regs, -ERESTARTNOHAND);
	thread->sent_back = true;
	return arch_call_mark_set(thread->tid, &thread->regs, thread->rewound.mark) == 0;
}

static void end_or_watch(struct process *process, struct thread *thread, uint64_t now)
{
	struct rewound *r = &thread->rewound;

	r->sleeps_known = false;
	if (now >= r->due_ns)
		answer_late(thread);
	else if (r->due_ns < process->due_ns)
		process->due_ns = r->due_ns;
}

void rewind_call(struct process *process, struct thread *thread)
{
	struct arch_regs *regs = &thread->regs;
	struct rewound *r = &thread->rewound;
	struct proc_sched sched;
	const uint64_t now = now_ns();

	thread->stopped_ns = now;
	if (arch_may_continue(arch_syscall_nr(regs)) && has_slept(thread, &sched))
		arch_note_slept(regs);
	note_call(process, thread);
	if (arch_syscall_nr(regs) < 0 || is_about_to_rewind(thread))
		return;
	if (arch_syscall_nr(regs) == SYS_recvmmsg)
		forget_error(process, regs);
	cut_go_on(process, thread);
	if (is_not_restarted(process, thread)) {
		if (!is_rewound(thread))
			begin_watch(process, thread, now);
		if (!r->mark || !send_back(thread))
			return; /* another call, or it was killed */
	} else if (arch_syscall_result(regs) != -ERESTARTNOHAND || !is_rewound(thread)) {
		return;
	} else { /* stopped again before it ran: nothing to change */
		thread->sent_back = true;
	}
	end_or_watch(process, thread, now);
}

/* Also now: another thread may have installed a filter for all while this one was stopped. */
void rewind_continued(struct process *process, struct thread *thread)
{
	if (arch_syscall_nr(&thread->regs) < 0 ||
	    arch_syscall_result(&thread->regs) != -ERESTART_RESTARTBLOCK ||
	    !seccomp_bars_restart(process, thread->tid))
		return;
	begin_watch(process, thread, thread->stopped_ns);
	if (thread->rewound.mark && send_back(thread))
		end_or_watch(process, thread, now_ns());
}

/* When ppoll, pselect and select are interrupted, they write the remaining timeout to the app's
 * memory, and are restarted with it: only the duration of the stop is missing. */
void rewind_count_stop(const struct process *process, const struct thread *thread)
{
	const struct arch_regs *regs = &thread->regs;
	const long nr = arch_syscall_nr(regs);
	const int64_t unit_ns = nr == SYS_select ? 1000 : 1; /* of struct timeval, timespec */
	uint64_t pointer;
	int64_t left[2], ns;

	if ((nr != SYS_ppoll && nr != SYS_pselect6 && nr != SYS_select) ||
	    arch_syscall_result(regs) != -ERESTARTNOHAND)
		return;
	if (is_rewound(thread))
		return; /* it could not write the timeout */
	pointer = arch_syscall_arg(regs, nr == SYS_ppoll ? 2 : 4);
	if (!pointer || pread(process->mem_fd, left, sizeof left, (off_t)pointer) != sizeof left ||
	    left[0] > INT32_MAX)
		return;
	ns = left[0] * (int64_t)NS_PER_S + left[1] * unit_ns -
	     (int64_t)(now_ns() - thread->stopped_ns);
	left[0] = ns > 0 ? ns / (int64_t)NS_PER_S : 0;
	left[1] = ns > 0 ? ns % (int64_t)NS_PER_S / unit_ns : 0;
	if (pwrite(process->mem_fd, left, sizeof left, (off_t)pointer) != sizeof left)
		return; /* then it ends a little late */
}

void rewind_original(const struct thread *thread, struct arch_regs *regs)
{
	if (is_about_to_rewind(thread))
		arch_result_note(regs, (int32_t)arch_syscall_result(regs));
	if (arch_syscall_nr(regs) == SYS_restart_syscall)
		arch_syscall_nr_set(regs, thread->call.nr);
	/* See rewind_is_before(). */
	if (arch_syscall_result(regs) == SYS_restart_syscall &&
	    thread->call.pc == arch_pc(regs) + ARCH_SYSCALL_BYTES)
		arch_result_note(regs, thread->call.nr);
	/* Its signal is sent again (pending.c), and interrupts the call as it would have done.
	 * (Whether -ERESTARTSYS becomes EINTR depends on sigaction's flags: those calls are
	 * restarted.) */
	if (thread->signalled && arch_syscall_nr(regs) >= 0 &&
	    (arch_syscall_result(regs) == -ERESTARTNOHAND ||
	     arch_syscall_result(regs) == -ERESTART_RESTARTBLOCK))
		arch_result_note(regs, -EINTR);
}

void rewind_home(const struct thread *thread, struct arch_regs *home)
{
	*home = thread->regs;
	if (!ARCH_HOME_FORGETS) {
		arch_resume(home);
		return;
	}
	if (arch_syscall_nr(home) == SYS_restart_syscall && thread->call.nr >= 0)
		arch_syscall_nr_set(home, thread->call.nr);
	arch_rewind(home);
}
