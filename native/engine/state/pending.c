/* SPDX-License-Identifier: Apache-2.0
 *
 * Signals that have been sent and not delivered: read from the queues while
 * everything is stopped (PTRACE_PEEKSIGINFO, ptrace(2)), queued again by the
 * restored threads themselves, which may give any siginfo to their own process.
 */
#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/utsname.h>

#include "state.h"

#define PENDING_MAX 1024
#define AT_ONCE 32

struct pending {
	uint32_t count;
	bool too_many;
	int deadly;  /* 0: none                                             */
	bool caught; /* and it has a handler */
	struct {
		int block; /* of the thread, -1: of the process */
		siginfo_t info;
	} signal[PENDING_MAX];
	siginfo_t buffer[AT_ONCE];
};

struct pending *pending_new(void)
{
	return calloc(1, sizeof(struct pending));
}

static int read_queue(struct pending *pending, pid_t tid, int block, struct avc_error *err)
{
	struct __ptrace_peeksiginfo_args args = {
		.flags = block < 0 ? PTRACE_PEEKSIGINFO_SHARED : 0,
		/* Nearly always there is none: asking for one is enough to find out. */
		.nr = 1,
	};

	for (;;) {
		const long n = ptrace(PTRACE_PEEKSIGINFO, tid, &args, pending->buffer);

		if (n < 0)
			return fail_errno(err, tid, "freeze", "ptrace(PEEKSIGINFO)",
					  "it has been killed");
		if (n == 0)
			return 0;
		for (long i = 0; i < n; i++) {
			if (pending->count == PENDING_MAX) {
				pending->too_many = true;
				return 0;
			}
			pending->signal[pending->count].block = block;
			pending->signal[pending->count++].info = pending->buffer[i];
		}
		/* Fewer than requested need not be all: a signal of our own, as of the deadline's
		 * timer, ends the call, too (kernel/ptrace.c). */
		args.off += (uint64_t)n;
		args.nr = AT_ONCE;
	}
}

static bool takes(const struct thread *t, int signal)
{
	return t->block >= 0 && !(t->sigmask >> (signal - 1) & 1);
}

/* A thread that was just about to run a handler: the signal interrupts its call, so this thread has
 * to get it, even if any thread could. (An ignored one is queued only because we trace.) */
static void assign(struct process *process, const struct proc_status *status)
{
	struct pending *pending = process->pending;
	const uint64_t handled = status->caught;

	for (uint32_t k = 0; k < pending->count; k++) {
		const int signal = pending->signal[k].info.si_signo;
		struct thread *found = NULL;

		if (!(handled >> (signal - 1) & 1))
			continue;
		for (uint32_t i = 0; i < process->thread_count; i++) {
			struct thread *t = &process->threads[i];

			/* The kernel, too, prefers the main thread for these. */
			if (takes(t, signal) &&
			    (pending->signal[k].block == t->block ||
			     (pending->signal[k].block < 0 && (!found || t->block == 0))))
				found = t;
		}
		if (found) {
			found->signalled = true;
			pending->signal[k].block = found->block;
		}
	}
}

bool signal_ends_by_default(int signal)
{
	return signal != SIGCHLD && signal != SIGURG && signal != SIGWINCH && signal != SIGCONT &&
	       signal != SIGSTOP && signal != SIGTSTP && signal != SIGTTIN && signal != SIGTTOU;
}

/* Since Linux 5.17 /proc/PID/stat has the signal of a stop until the parent has waited for it, then 0
 * (fs/proc/array.c, group_exit_code). */
static bool tells_stops(void)
{
	int major = 0, minor = 0;
	struct utsname name;

	return uname(&name) == 0 && sscanf(name.release, "%d.%d", &major, &minor) == 2 &&
	       (major > 5 || (major == 5 && minor >= 17));
}

/* Not of several threads: the kernel does not expect one to be made in a stop (do_jobctl_trap()). */
static bool is_stop_heard(const struct process *process)
{
	struct proc_stat stat;

	return process->thread_count == 1 && process->threads[0].stop_signal && tells_stops() &&
	       proc_stat(process->pid, &stat) == 0 && !stat.exit_status;
}

/* A process that has got a fatal signal and was stopped by us before it could die of it, or run its
 * crash handler: every restore of such an image would die at once. */
static int find_deadly(const struct process *process, const struct proc_status *status)
{
	const struct pending *pending = process->pending;
	const uint64_t spared = (status->caught & ~FATAL_SIGNALS) | status->ignored;

	for (uint32_t k = 0; k < pending->count; k++) {
		const int signal = pending->signal[k].info.si_signo;

		if (!signal_ends_by_default(signal) || spared >> (signal - 1) & 1)
			continue;
		for (uint32_t i = 0; i < process->thread_count; i++) {
			const struct thread *t = &process->threads[i];

			if (takes(t, signal) &&
			    (pending->signal[k].block < 0 || pending->signal[k].block == t->block))
				return signal;
		}
	}
	return 0;
}

int pending_read(struct process *process, struct avc_error *err)
{
	struct pending *pending = process->pending;
	struct proc_status status;

	pending->count = 0;
	pending->deadly = 0;
	pending->caught = false;
	pending->too_many = false;
	process->stop_heard = is_stop_heard(process);
	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread *t = &process->threads[i];

		t->signalled = false;
		if (t->block < 0)
			continue;
		if ((t->tid == process->pid && read_queue(pending, t->tid, -1, err)) ||
		    read_queue(pending, t->tid, t->block, err))
			return -1;
	}
	if (pending->count && !proc_status_of(process->status_fd, process->pid, &status)) {
		assign(process, &status);
		pending->deadly = find_deadly(process, &status);
		pending->caught = pending->deadly && status.caught & SIGNAL_BIT(pending->deadly);
	}
	return 0;
}

int pending_check(const struct process *process, struct avc_error *err)
{
	const struct pending *pending = process->pending;

	if (!pending->deadly)
		return 0;
	/* A program that handles it may continue afterwards. */
	return pending->caught ? fail(err, AVC_RETRY, 0, process->pid, "freeze", "",
				      "it is about to handle signal %d", pending->deadly)
			       : fail(err, AVC_GONE, 0, process->pid, "freeze", "",
				      "it is being killed by signal %d", pending->deadly);
}

bool pending_contains(const struct pending *pending, int signal, int timer)
{
	for (uint32_t i = 0; i < pending->count; i++) {
		const siginfo_t *info = &pending->signal[i].info;

		if (info->si_signo == signal &&
		    (timer < 0 || (info->si_code == SI_TIMER && info->si_timerid == timer)))
			return true;
	}
	return false;
}

/* A process that is stopped while it is being restored would never become ready. */
static bool can_be_queued(const siginfo_t *info)
{
	return info->si_signo != SIGSTOP && info->si_signo != SIGKILL;
}

void pending_setup_thread(const struct process *process, const struct thread *thread,
			  struct setup *setup)
{
	const struct pending *pending = process->pending;

	for (uint32_t i = 0; i < pending->count; i++) {
		const siginfo_t *info = &pending->signal[i].info;

		if (pending->signal[i].block == thread->block && can_be_queued(info))
			setup_add_thread(setup, "rt_tgsigqueueinfo", SYS_rt_tgsigqueueinfo,
					 (uint64_t)process->inside, (uint64_t)thread->inside,
					 (uint64_t)info->si_signo,
					 setup_data(setup, info, sizeof *info))
				->flags = INJ_MAY_FAIL;
	}
}

void pending_setup(const struct process *process, struct setup *setup)
{
	const struct pending *pending = process->pending;

	for (uint32_t i = 0; i < pending->count; i++) {
		const siginfo_t *info = &pending->signal[i].info;

		if (pending->signal[i].block < 0 && can_be_queued(info))
			setup_add(setup, INJ_AFTER, "rt_sigqueueinfo", SYS_rt_sigqueueinfo,
				  (uint64_t)process->inside, (uint64_t)info->si_signo,
				  setup_data(setup, info, sizeof *info))
				->flags = INJ_MAY_FAIL;
	}
	if (pending->too_many && !setup->notice.code)
		fail(&setup->notice, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
		     "more than %d signals are pending; the others are lost at a restore",
		     PENDING_MAX);
}
