/* SPDX-License-Identifier: Apache-2.0
 *
 * Stops every thread of a process, until none is left that could create another one; and releases
 * them.
 */
#include <sched.h>
#include <string.h>

#include "process.h"

struct walk {
	struct process *process;
	uint32_t fresh;
	struct avc_error *err;
};

static int stop_task(pid_t tid, void *arg)
{
	struct walk *walk = arg;
	struct process *process = walk->process;
	struct thread *t = thread_find(process, tid);
	struct avc_error gone = { 0 };

	if (t && t->seen)
		return 0;
	if (!t)
		t = thread_add(process, tid, walk->err);
	if (!t)
		return -1;
	t->seen = true;
	walk->fresh++;
	if (t->attached)
		return 0; /* created by a traced thread: has its own stop pending */
	if (thread_stop(process, t, &gone)) {
		if (gone.code == AVC_GONE && tid != process->pid)
			return 0; /* it ended meanwhile */
		if (!walk->err->code)
			*walk->err = gone;
		return -1;
	}
	return 0;
}

/* As of the last checkpoint. */
static bool is_real_time(const struct thread *thread)
{
	uint32_t policy; /* struct sched_attr, sched_setattr(2): after its size */

	memcpy(&policy, thread->scheduling.attr + sizeof(uint32_t), sizeof policy);
	return policy == SCHED_FIFO || policy == SCHED_RR || policy == SCHED_DEADLINE;
}

bool process_interrupt(struct process *process, bool real_time)
{
	bool others = false;

	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread *t = &process->threads[i];
		struct avc_error ignored = { 0 };

		if (is_real_time(t) != real_time)
			others = true;
		else if (!t->attached) /* failures show when it is waited for */
			t->seen = thread_stop(process, t, &ignored) == 0;
	}
	return others;
}

int process_await(struct process *process, struct avc_error *err)
{
	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread *t = &process->threads[i];
		struct avc_error gone = { 0 };

		if (!t->attached || t->stopped || !thread_await(process, t, &gone))
			continue;
		if (gone.code == AVC_GONE && t->tid != process->pid)
			continue;
		if (!err->code)
			*err = gone;
		return -1;
	}
	return 0;
}

void process_stop_begin(struct process *process)
{
	for (uint32_t i = 0; i < process->thread_count; i++) {
		process->threads[i].seen = false;
		process->threads[i].block = -1;
	}
	process->stage = FREEZE_RUNS;
	seccomp_counts_forget(process);
}

/* Until all are stopped, because threads create threads meanwhile: a walk finds them. */
static int stop_rest(struct process *process, struct avc_error *err)
{
	for (;;) {
		struct walk walk = { .process = process, .err = err };

		if (process_await(process, err))
			return -1;
		if (threads_all_stopped(process))
			return 0;
		if (proc_numbers(process->task_dirfd, stop_task, &walk))
			return err->code ? -1
					 : fail_errno(err, process->pid, "freeze", "getdents64",
						      "it has ended");
		if (!walk.fresh)
			return 0;
	}
}

/* One that goes home by itself says that it is there one instruction before it is, and may get a
 * signal, or be stopped, at that one, which still needs to know where home is.  That shows only now,
 * and what it says is only a hint: the app can write it as well. */
static void await_home(struct process *process)
{
	struct parasite *parasite = &process->parasite;

	if (!parasite->left_ns || !parasite_says_home(parasite))
		return;
	parasite->late = !process_is_home(process);
	if (!parasite->late)
		parasite->left_ns = 0;
}

int process_stop_all(struct process *process, struct avc_error *err)
{
	if (stop_rest(process, err))
		return -1;
	await_home(process);
	return 0;
}

int process_check_dying(const struct process *process, struct avc_error *err)
{
	return proc_is_dying(process->stat_fd)
		       ? fail(err, AVC_GONE, 0, process->pid, "stop", "", "a signal is killing it")
		       : 0;
}

int process_stop(struct process *process, struct avc_error *err)
{
	process_stop_begin(process);
	if (process_check_dying(process, err))
		return -1;
	if (process_interrupt(process, false)) {
		if (process_await(process, err))
			return -1;
		process_interrupt(process, true);
	}
	return process_stop_all(process, err);
}

void process_let_go(struct process *process)
{
	seccomp_own_forget(process);
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (is_real_time(&process->threads[i]))
			thread_let_go(process, &process->threads[i]);
	for (uint32_t i = 0; i < process->thread_count; i++)
		thread_let_go(process, &process->threads[i]);
	seccomp_counts_forget(process); /* now it can change them */
}

void process_go_on(struct process *process, timer_t timer)
{
	process_let_go(process);
	tracee_deadline_clear(timer);
	rt_priority_end();
}
