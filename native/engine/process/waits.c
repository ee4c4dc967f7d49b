/* SPDX-License-Identifier: Apache-2.0
 *
 * Ends calls whose time is up.  A call that a checkpoint has interrupted is repeated
 * unchanged (rewind.c), and would take its whole timeout once more.
 */
#include "process.h"

#define END_DEADLINE_NS (20 * NS_PER_MS)
#define LOOKS_MAX 64 /* some 50 us each, before a checkpoint */

/* How often a thread has gone to sleep; 0: unknown. */
static uint64_t sleeps_of(pid_t tid)
{
	struct proc_sched sched;

	return proc_sched(tid, &sched) == 0 ? sched.sleeps : 0;
}

/* The thread is asleep in its call again by now, or about to be. If it has gone to sleep more often
 * when the time is up, it was woken and is usually in another call, which must not be disturbed. If
 * it is still in the same one, the next checkpoint ends that. Preemptions do not count. */
static bool is_waiting(struct thread *thread)
{
	return sleeps_of(thread->tid) - thread->rewound.sleeps <= 1;
}

/* Stopping the thread is enough (rewind_call()). */
static void end(struct process *process, struct thread *thread, timer_t timer)
{
	struct avc_error gone = { 0 };

	seccomp_counts_forget(process);
	rt_priority_begin();
	tracee_deadline_set(timer, END_DEADLINE_NS);
	if (process_check_dying(process, &gone) == 0 && thread_stop(process, thread, &gone) == 0 &&
	    thread_await(process, thread, &gone) == 0)
		thread_release(process, thread); /* or threads_tend_stragglers() does it, later */
	tracee_deadline_clear(timer);
	rt_priority_end();
}

void waits_prepare(struct process *process)
{
	uint32_t looks = 0;

	for (uint32_t i = 0; i < process->thread_count && looks < LOOKS_MAX; i++) {
		rewind_prepare(&process->threads[i]);
		looks += process->threads[i].sleeper.known;
	}
}

void waits_end(struct process *process, timer_t timer)
{
	const uint64_t now = now_ns();
	uint64_t due = UINT64_MAX;

	if (process->due_ns == UINT64_MAX)
		return;
	for (uint32_t i = 0; i < process->thread_count; i++) { /* may grow */
		struct thread *t = &process->threads[i];
		struct rewound *r = &t->rewound;

		if (!r->mark || r->due_ns == UINT64_MAX || t->attached)
			continue;
		rewind_date(t);
		if (!r->sleeps_known) {
			r->sleeps = sleeps_of(t->tid);
			r->sleeps_known = true;
			r->waiting = true;
		}
		if (!r->waiting)
			continue;
		if (r->due_ns > now) {
			due = r->due_ns < due ? r->due_ns : due;
			continue;
		}
		r->waiting = false;
		if (is_waiting(t))
			end(process, t, timer);
	}
	process->due_ns = due;
}
