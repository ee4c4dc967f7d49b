/* SPDX-License-Identifier: Apache-2.0
 *
 * Stopping: every thread of every process, until there is nobody left who could create
 * another one; and letting go.
 */
#include <errno.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "freeze.h"

/* ---- a process ------------------------------------------------------------------------ */

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
static void interrupt_known(struct target *target)
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

static void stop_begin(struct target *target)
{
	for (uint32_t i = 0; i < target->thread_count; i++) {
		target->threads[i].seen = false;
		target->threads[i].block = -1;
	}
	target->frozen = false;
	target->begun = false;
}

/* Until all are stopped, for threads create threads meanwhile: then a walk finds them. */
static int stop_all(struct target *target, struct avc_error *err)
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

int stop_process(struct target *target, struct avc_error *err)
{
	stop_begin(target);
	interrupt_known(target);
	return stop_all(target, err);
}

void let_go_thread(const struct target *target, struct thread *thread)
{
	if (thread->attached && thread->stopped)
		rewind_count_stop(target, thread);
	thread_release(thread);
}

void let_go_process(struct target *target)
{
	for (uint32_t i = 0; i < target->thread_count; i++)
		let_go_thread(target, &target->threads[i]);
}

/* ---- all of them ------------------------------------------------------------------------ */

#define LOOKS 64
#define LOOK_US 100

int stop_known(struct tree *tree, struct avc_error *err)
{
	stop_begin(tree->main);
	for (uint32_t i = 0; i < tree->members; i++)
		stop_begin(tree->member[i]);
	/* So that they stop at the same time, and not one after the other. */
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->kin[i].target && tree->kin[i].target->infected)
			interrupt_known(tree->kin[i].target);
	if (stop_all(tree->main, err))
		return -1;
	for (uint32_t i = 1; i < tree->count; i++) {
		struct target *target = tree->kin[i].target;
		struct avc_error failed = { 0 };

		if (!target || !target->infected)
			continue;
		target->frozen = stop_all(target, &failed) == 0;
		if (!target->frozen && failed.code != AVC_GONE) {
			*err = failed;
			return -1;
		}
	}
	return 0;
}

int stop_others(struct tree *tree, struct avc_error *err)
{
	/* It had no other one at the last checkpoint; whether that is still so, the clone
	 * will tell. */
	if (tree->count <= 1 && tree->main->childless)
		return 0;
	for (int looks = 0; looks < LOOKS; looks++) {
		bool all = true;

		if (tree_look(tree, err))
			return -1;
		for (uint32_t i = 1; i < tree->count; i++) {
			struct target *t = tree->kin[i].target;
			struct avc_error failed = { 0 };

			if (tree->kin[i].ending) {
				all = false;
				usleep(LOOK_US);
			}
			if (!t || t->frozen)
				continue;
			all = false;
			if (stop_all(t, &failed) == 0) {
				t->frozen = true;
			} else if (failed.code != AVC_GONE) {
				*err = failed;
				return -1;
			} else {
				usleep(LOOK_US); /* until it is a zombie, or nothing */
			}
		}
		if (all)
			return 0;
	}
	return fail(err, AVC_DEADLINE, EAGAIN, tree->main->pid, "freeze", "",
		    "its processes come and go too fast");
}
