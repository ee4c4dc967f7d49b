/* SPDX-License-Identifier: Apache-2.0
 *
 * Interrupted system calls.
 *
 * A ptrace stop wakes a blocked call.  Most calls then return one of the kernel's
 * restart codes, and the kernel makes them again by itself when the thread goes
 * on.  Some (signal(7), "Interruption of system calls") return plain EINTR, which
 * the app would see although no signal came.  Those are turned into -ERESTARTNOHAND
 * while the thread is stopped: if a signal with a handler *is* pending, the kernel
 * makes EINTR of it again, as it should; if none is, the call is made again.
 *
 * A relative timeout would begin again with every checkpoint and never end.  So at
 * the second stop in the same call, what has passed since the first is taken off:
 *   - a timeout in a register is an int: its unused upper half is marked, so that a
 *     call we rewound is told from a new one with the same arguments;
 *   - a timeout in memory is passed in a cell of the parasite instead, which marks it too;
 *   - a timeout of a socket (SO_RCVTIMEO, SO_SNDTIMEO) can not be changed for one
 *     call: when it has passed, the call is answered as the kernel would have done
 *     it.  Here the upper half of the descriptor is the mark.
 */
#include <errno.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <unistd.h>

#include "trace.h"

#define ERESTARTNOHAND 514 /* include/linux/errno.h */
#define ERESTART_RESTARTBLOCK 516
#define MARK UINT64_C(0x6176636b) /* upper half of a rewound int timeout */

enum timeout { NO_TIMEOUT, MILLISECONDS, TIMESPEC, RECEIVE, SEND };

/* Calls that answer EINTR to a stop, have done nothing when they do, and may be
 * made again.  Never close(2). */
static const struct rewindable {
	long nr;
	enum timeout timeout;
	int argument;
} rewindable[] = {
	{ SYS_epoll_wait, MILLISECONDS, 3 },
	{ SYS_epoll_pwait, MILLISECONDS, 3 },
	{ SYS_epoll_pwait2, TIMESPEC, 3 },
	{ SYS_semop, NO_TIMEOUT, -1 },
	{ SYS_semtimedop, TIMESPEC, 3 },
	{ SYS_rt_sigtimedwait, TIMESPEC, 2 },
	{ SYS_io_getevents, TIMESPEC, 4 },
	{ SYS_io_pgetevents, TIMESPEC, 4 },
	/* Sockets with SO_RCVTIMEO or SO_SNDTIMEO (socket(7)). */
	{ SYS_read, RECEIVE, 0 },
	{ SYS_readv, RECEIVE, 0 },
	{ SYS_preadv2, RECEIVE, 0 },
	{ SYS_recvfrom, RECEIVE, 0 },
	{ SYS_recvmsg, RECEIVE, 0 },
	{ SYS_recvmmsg, RECEIVE, 0 },
	{ SYS_accept, RECEIVE, 0 },
	{ SYS_accept4, RECEIVE, 0 },
	{ SYS_connect, SEND, 0 },
	{ SYS_write, SEND, 0 },
	{ SYS_writev, SEND, 0 },
	{ SYS_pwritev2, SEND, 0 },
	{ SYS_sendfile, SEND, 0 },
	{ SYS_sendto, SEND, 0 },
	{ SYS_sendmsg, SEND, 0 },
	{ SYS_sendmmsg, SEND, 0 },
};

static const struct rewindable *lookup(long nr)
{
	for (size_t i = 0; i < sizeof rewindable / sizeof *rewindable; i++)
		if (rewindable[i].nr == nr)
			return &rewindable[i];
	return NULL;
}

static bool same_call(const struct thread *t, uint64_t value)
{
	const struct rewound *r = &t->rewound;

	return r->nr == arch_syscall_nr(&t->regs) && r->argument >= 0 &&
	       r->pc == arch_pc(&t->regs) && r->sp == arch_sp(&t->regs) && r->value == value;
}

/* Remembers what the argument was before it becomes `value`. */
static void replace(struct thread *t, int argument, uint64_t value, bool same, uint64_t at)
{
	const uint64_t before = arch_syscall_arg(&t->regs, (unsigned int)argument);

	t->rewound = (struct rewound){
		.nr = arch_syscall_nr(&t->regs),
		.pc = arch_pc(&t->regs),
		.sp = arch_sp(&t->regs),
		.argument = argument,
		.original = same ? t->rewound.original : before,
		.value = value,
		.at_ns = at,
	};
	arch_syscall_arg_set(&t->regs, (unsigned int)argument, value);
}

static void milliseconds(struct thread *t, int argument, uint64_t now)
{
	const uint64_t value = arch_syscall_arg(&t->regs, (unsigned int)argument);
	const bool same = same_call(t, value);
	int32_t left = (int32_t)value;
	uint64_t at = now;

	if (left <= 0)
		return; /* for ever, or not at all */
	if (same) {
		/* Whole milliseconds only; the rest counts next time. */
		const uint64_t passed = (now - t->rewound.at_ns) / NS_PER_MS;

		at = t->rewound.at_ns + passed * NS_PER_MS;
		left = passed < (uint64_t)left ? left - (int32_t)passed : 0;
	}
	replace(t, argument, MARK << 32 | (uint32_t)left, same, at);
}

static int take_cell(struct target *target, struct thread *t)
{
	if (t->timeout_cell < 0 && ~target->cells_used) {
		t->timeout_cell = __builtin_ctzll(~target->cells_used);
		target->cells_used |= UINT64_C(1) << t->timeout_cell;
	}
	return t->timeout_cell;
}

static void timespec(struct target *target, struct thread *t, int argument, uint64_t now)
{
	const uint64_t pointer = arch_syscall_arg(&t->regs, (unsigned int)argument);
	const bool same = same_call(t, pointer);
	struct avc_error gone = { 0 };
	int64_t left[2], *cell;
	int64_t ns;

	/* Without a parasite, or with all cells taken, it begins again in full. */
	if (!pointer || !target->infected || parasite_check(target, t->tid, &gone) ||
	    take_cell(target, t) < 0)
		return;
	cell = target->parasite.control->timeout[t->timeout_cell];
	if (same) {
		ns = cell[0] * (int64_t)NS_PER_S + cell[1] - (int64_t)(now - t->rewound.at_ns);
		left[0] = ns > 0 ? ns / (int64_t)NS_PER_S : 0;
		left[1] = ns > 0 ? ns % (int64_t)NS_PER_S : 0;
	} else if (pread(target->mem_fd, left, sizeof left, (off_t)pointer) != sizeof left) {
		return;
	}
	if (left[0] > INT32_MAX)
		return; /* for practical purposes for ever */
	memcpy(cell, left, sizeof left);
	replace(t, argument, parasite_remote(&target->parasite, cell), same, now);
}

/* What a socket of the app's allows a call to take; 0: for ever, or no socket. */
static uint64_t socket_timeout(const struct target *target, int app_fd, enum timeout kind)
{
	struct timeval tv = { 0 };
	socklen_t bytes = sizeof tv;
	int fd = (int)syscall(SYS_pidfd_getfd, target->pidfd, app_fd, 0);

	if (fd < 0)
		return 0;
	if (getsockopt(fd, SOL_SOCKET, kind == RECEIVE ? SO_RCVTIMEO : SO_SNDTIMEO, &tv, &bytes))
		tv = (struct timeval){ 0 };
	close(fd);
	return (uint64_t)tv.tv_sec * NS_PER_S + (uint64_t)tv.tv_usec * 1000;
}

/* False: its time is up, it is not to be made again. */
static bool socket_wait(const struct target *target, struct thread *t, enum timeout kind,
			uint64_t now)
{
	const uint64_t fd = arch_syscall_arg(&t->regs, 0);
	uint64_t limit;

	if (same_call(t, fd)) {
		if (now - t->rewound.at_ns < t->rewound.limit_ns)
			return true;
		arch_syscall_arg_set(&t->regs, 0, t->rewound.original);
		return false;
	}
	limit = socket_timeout(target, (int)fd, kind);
	if (limit) {
		replace(t, 0, MARK << 32 | (uint32_t)fd, false, now);
		t->rewound.limit_ns = limit;
	}
	return true;
}

/* restart_syscall(2) is what the kernel makes of nanosleep, clock_nanosleep, poll
 * and futex when it takes them up again.  In another process it means nothing, so
 * there the call itself has to be made again, and its number is no longer in the
 * registers.  Normally we have seen it before.  If not (a guard that came later),
 * the code in front of the system call or the arguments tell. */
static long guess_call(const struct target *target, const struct arch_regs *regs, avc_remote pc)
{
	const uint64_t a = arch_syscall_arg(regs, 0), b = arch_syscall_arg(regs, 1),
		       c = arch_syscall_arg(regs, 2), d = arch_syscall_arg(regs, 3);
	const uint64_t small = ARCH_PAGE_BYTES; /* no address */
	uint8_t code[ARCH_CODE_BYTES];
	long nr;

	if (pread(target->mem_fd, code, sizeof code, (off_t)(pc - sizeof code)) == sizeof code) {
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

/* Let go a moment ago, and stopped again before it was back in its call: the kernel
 * has sent it back to the instruction, with the number of restart_syscall(2). */
static bool is_about_to_restart(const struct target *target, const struct arch_regs *regs)
{
	uint8_t code[ARCH_SYSCALL_BYTES];

	return arch_syscall_result(regs) == SYS_restart_syscall &&
	       pread(target->mem_fd, code, sizeof code, (off_t)arch_pc(regs)) == sizeof code &&
	       arch_is_syscall(code);
}

static void note_call(const struct target *target, struct thread *t)
{
	struct call now = { .nr = arch_syscall_nr(&t->regs),
			    .pc = arch_pc(&t->regs),
			    .sp = arch_sp(&t->regs) };

	for (unsigned int n = 0; n < 3; n++)
		now.arg[n] = arch_syscall_arg(&t->regs, n);
	if (is_about_to_restart(target, &t->regs)) {
		now.nr = SYS_restart_syscall;
		now.pc += ARCH_SYSCALL_BYTES;
	}
	if (now.nr == SYS_restart_syscall) {
		now.nr = t->call.nr;
		if (now.nr < 0 || memcmp(&now, &t->call, sizeof now) != 0)
			now.nr = guess_call(target, &t->regs, now.pc);
	}
	t->call = now;
}

void rewind_call(struct target *target, struct thread *thread)
{
	const struct rewindable *call;
	const uint64_t now = now_ns();

	thread->stopped_ns = now;
	note_call(target, thread);
	if (arch_syscall_nr(&thread->regs) < 0 || arch_syscall_result(&thread->regs) != -EINTR)
		return;
	call = lookup(arch_syscall_nr(&thread->regs));
	if (!call)
		return;
	/* The result first: a tracer that dies before the timeout is mended leaves
	 * a wait that is too long, not one that fails. */
	if (arch_result_set(thread->tid, -ERESTARTNOHAND))
		return;
	arch_result_note(&thread->regs, -ERESTARTNOHAND);
	if (call->timeout == MILLISECONDS)
		milliseconds(thread, call->argument, now);
	else if (call->timeout == TIMESPEC)
		timespec(target, thread, call->argument, now);
	else if (call->timeout == NO_TIMEOUT)
		return;
	else if (!socket_wait(target, thread, call->timeout, now))
		arch_result_note(&thread->regs, call->nr == SYS_connect ? -EINPROGRESS : -EAGAIN);
	(void)arch_regs_set(thread->tid, &thread->regs); /* it was killed: no matter */
}

/* ppoll, pselect and select write what is left of their timeout to the app's memory
 * when they are interrupted, and are made again with that: what they do not count
 * is the time they were stopped. */
void rewind_count_stop(const struct target *target, const struct thread *thread)
{
	const struct arch_regs *regs = &thread->regs;
	const long nr = arch_syscall_nr(regs);
	const int64_t unit_ns = nr == SYS_select ? 1000 : 1; /* of struct timeval, timespec */
	uint64_t pointer;
	int64_t left[2], ns;

	if ((nr != SYS_ppoll && nr != SYS_pselect6 && nr != SYS_select) ||
	    arch_syscall_result(regs) != -ERESTARTNOHAND)
		return;
	pointer = arch_syscall_arg(regs, nr == SYS_ppoll ? 2 : 4);
	if (!pointer || pread(target->mem_fd, left, sizeof left, (off_t)pointer) != sizeof left ||
	    left[0] > INT32_MAX)
		return;
	ns = left[0] * (int64_t)NS_PER_S + left[1] * unit_ns -
	     (int64_t)(now_ns() - thread->stopped_ns);
	left[0] = ns > 0 ? ns / (int64_t)NS_PER_S : 0;
	left[1] = ns > 0 ? ns % (int64_t)NS_PER_S / unit_ns : 0;
	if (pwrite(target->mem_fd, left, sizeof left, (off_t)pointer) != sizeof left)
		return; /* a little late, then */
}

void rewind_original(const struct thread *thread, struct arch_regs *regs)
{
	const struct rewound *r = &thread->rewound;

	if (arch_syscall_nr(regs) == SYS_restart_syscall)
		arch_syscall_nr_set(regs, thread->call.nr);
	/* See is_about_to_restart(): otherwise it stands where note_call() found it. */
	if (arch_syscall_result(regs) == SYS_restart_syscall &&
	    thread->call.pc == arch_pc(regs) + ARCH_SYSCALL_BYTES)
		arch_result_note(regs, thread->call.nr);
	/* In the call, or just before it is made again. */
	if (r->argument >= 0 &&
	    (r->nr == arch_syscall_nr(regs) ||
	     (arch_syscall_nr(regs) < 0 && r->nr == arch_syscall_result(regs) &&
	      r->pc == arch_pc(regs) + ARCH_SYSCALL_BYTES && r->sp == arch_sp(regs))) &&
	    r->value == arch_syscall_arg(regs, (unsigned int)r->argument))
		arch_syscall_arg_set(regs, (unsigned int)r->argument, r->original);
	/* Its signal is sent again (pending.c), and cuts the call short as it would
	 * have done.  (Whether -ERESTARTSYS becomes EINTR is for sigaction's flags to
	 * say: those calls are made again.) */
	if (thread->signalled && arch_syscall_nr(regs) >= 0 &&
	    (arch_syscall_result(regs) == -ERESTARTNOHAND ||
	     arch_syscall_result(regs) == -ERESTART_RESTARTBLOCK))
		arch_result_note(regs, -EINTR);
}

void rewind_forget(struct target *target, struct thread *thread)
{
	if (thread->timeout_cell >= 0)
		target->cells_used &= ~(UINT64_C(1) << thread->timeout_cell);
	thread->timeout_cell = -1;
}
