/* SPDX-License-Identifier: Apache-2.0
 *
 * A process is stopped: every thread of it, until there is nobody left who could create another
 * one; and let go.
 */
#include "process.h"

struct walk {
	struct target *target;
	uint32_t fresh;
	struct avc_error *err;
};

static int stop_task(pid_t tid, void *arg)
{
	struct walk *walk = arg;
	struct target *target = walk->target;
	struct thread *t = thread_find(target, tid);
	struct avc_error gone = { 0 };

	if (t && t->seen)
		return 0;
	if (!t)
		t = thread_add(target, tid, walk->err);
	if (!t)
		return -1;
	t->seen = true;
	walk->fresh++;
	if (t->attached)
		return 0; /* born of a thread of ours: comes with its own stop */
	if (thread_stop(target, t, &gone)) {
		if (gone.code == AVC_GONE && tid != target->pid)
			return 0; /* it ended meanwhile */
		if (!walk->err->code)
			*walk->err = gone;
		return -1;
	}
	return 0;
}

/* Those that are known; what fails is seen when it is waited for. */
void process_interrupt(struct target *target)
{
	for (uint32_t i = 0; i < target->thread_count; i++) {
		struct thread *t = &target->threads[i];
		struct avc_error ignored = { 0 };

		if (!t->attached)
			t->seen = thread_stop(target, t, &ignored) == 0;
	}
}

/* Then nobody is left who could create another one. */
static bool everybody_stopped(const struct target *target)
{
	int stopped = 0;

	for (uint32_t i = 0; i < target->thread_count; i++)
		stopped += target->threads[i].seen && target->threads[i].stopped;
	return stopped && proc_thread_count(target->task_dirfd) == stopped;
}

void process_stop_begin(struct target *target)
{
	for (uint32_t i = 0; i < target->thread_count; i++) {
		target->threads[i].seen = false;
		target->threads[i].block = -1;
	}
	target->frozen = false;
	target->begun = false;
}

/* Until all are stopped, for threads create threads meanwhile: then a walk finds them. */
int process_stop_all(struct target *target, struct avc_error *err)
{
	for (;;) {
		struct walk walk = { .target = target, .err = err };

		for (uint32_t i = 0; i < target->thread_count; i++) {
			struct thread *t = &target->threads[i];
			struct avc_error gone = { 0 };

			if (!t->attached || t->stopped || !thread_await(target, t, &gone))
				continue;
			if (gone.code == AVC_GONE && t->tid != target->pid)
				continue;
			if (!err->code)
				*err = gone;
			return -1;
		}
		if (everybody_stopped(target))
			return 0;
		if (proc_tasks(target->task_dirfd, stop_task, &walk))
			return err->code ? -1
					 : fail_errno(err, target->pid, "freeze", "getdents64",
						      "it has ended");
		if (!walk.fresh)
			return 0;
	}
}

int process_stop(struct target *target, struct avc_error *err)
{
	process_stop_begin(target);
	process_interrupt(target);
	return process_stop_all(target, err);
}

void process_let_go(struct target *target)
{
	for (uint32_t i = 0; i < target->thread_count; i++)
		thread_let_go(target, &target->threads[i]);
}
