/* SPDX-License-Identifier: Apache-2.0
 *
 * One checkpoint.  Every thread is stopped; then, and only then, the main thread
 * clones the process; then everything goes on.  What can wait, waits until then
 * (generation.c).
 */
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>

#include "internal.h"

#define CLONE_NS (10 * NS_PER_S)

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

/* Until a walk finds nobody new, for threads create threads while we walk.  Once
 * all known ones are stopped and none is new, there is no one left to create. */
static int stop_all(struct target *target, struct avc_error *err)
{
	for (uint32_t i = 0; i < target->thread_count; i++) {
		target->threads[i].seen = false;
		target->threads[i].block = -1;
	}
	for (;;) {
		struct walk walk = { .target = target, .err = err };

		if (proc_tasks(target->task_dirfd, stop_task, &walk))
			return err->code ? -1
					 : fail_errno(err, target->pid, "freeze", "getdents64",
						      "it has ended");
		if (!walk.fresh)
			return 0;
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
	}
}

static int read_all(struct target *target, uint32_t slot, uint32_t *threads, struct avc_error *err)
{
	uint32_t next = 1;

	for (uint32_t i = 0; i < target->thread_count; i++) {
		struct thread *t = &target->threads[i];

		if (t->attached && !t->seen)
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "it is just starting a process");
		if (!t->stopped)
			continue;
		if (next >= target->pad.threads_max && t->tid != target->leader)
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "more threads than prepared for");
		if (!arch_is_native(&t->regs))
			return fail(err, AVC_UNSUPPORTED, 0, t->tid, "freeze", "",
				    "it is a 32-bit program");
		/* A thread that somebody who died sent into a pad finds its way out
		 * in microseconds: such an image would be of the pad. */
		if (pad_contains(&target->pad, arch_pc(&t->regs)))
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "a thread is in the pad");
		if (in_old_pad(target, arch_pc(&t->regs)))
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "a thread is in an old pad");
		t->block = t->tid == target->leader ? 0 : (int)next++;
		if (thread_read(t, err))
			return -1;
		if (arch_frame_read_xstate(t->tid,
					   pad_frame(&target->pad, slot, (uint32_t)t->block)))
			return fail_errno(err, t->tid, "freeze", "ptrace(GETREGSET)",
					  "its state can not be read");
		if ((!t->known || t->known_tls != arch_tls(&t->regs)) && ask(target, t, err))
			return -1;
	}
	*threads = next;
	return 0;
}

static bool anybody_uses(const struct target *target, avc_remote base, size_t bytes)
{
	for (uint32_t i = 0; i < target->thread_count; i++) {
		const struct thread *t = &target->threads[i];

		for (unsigned int n = 0; n < 6; n++)
			if (arch_syscall_arg(&t->regs, n) - base < bytes)
				return true;
		/* What we took for the app's own timeout (rewind.c). */
		if (t->rewound.argument >= 0 && t->rewound.original - base < bytes)
			return true;
	}
	return false;
}

struct capture {
	struct target *target;
	struct generation *generation;
};

/* The table does not change while the kernel clones: nobody runs. */
static void capture_files(void *arg)
{
	struct capture *capture = arg;

	files_capture(capture->target, capture->generation, &capture->generation->files_error);
}

static int clone_app(struct target *target, struct thread *main_thread,
		     struct generation *generation, struct freeze_times *times,
		     struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->runner;
	const struct inj_syscall *children;
	const uint64_t start = now_ns();
	struct capture capture = { target, generation };
	pid_t template = 0;

	call_begin(call, INJ_AFTER_HOME);
	timers_ask(target, call);
	memory_dofork(target->memory, call);
	if (target->checkpoints)
		for (; target->old_pads && call->count < INJ_CALLS_MAX - 2; target->old_pads--) {
			const avc_remote base = target->old_pad[target->old_pads - 1].base;
			const size_t bytes = target->old_pad[target->old_pads - 1].bytes;

			if (anybody_uses(target, base, bytes))
				break;
			call_add(call, SYS_munmap, base, bytes, 0, 0, 0);
			generation->vm_pages -= (long)(bytes / ARCH_PAGE_BYTES);
		}
	/* ECHILD, if it has none: the one question that needs no look at each thread. */
	children = call_add(call, SYS_waitid, P_ALL, 0, 0, WEXITED | WNOHANG | WNOWAIT | __WALL, 0);
	/* The descriptor table is shared, not copied: what the app closes is closed. */
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD, 0, 0, 0, 0);
	if (borrow(target, main_thread, err))
		return -1;
	if (pad_run_clone_while(main_thread->tid, call, capture_files, &capture, &template, err)) {
		target->lost = err->code != AVC_KERNEL;
		if (err->code == AVC_DEADLINE || err->code == AVC_GONE)
			main_thread->stopped = false;
		return -1;
	}
	times->clone_ns = now_ns() - start;
	generation->template = template;
	/* After the timers were asked: one that has expired just now is found here. */
	pending_read(target);
	timers_answer(target, call, now_ns() - start);
	target->childless = children->result == -ECHILD;
	return 0;
}

static void let_go(const struct target *target, struct thread *thread)
{
	if (thread->attached && thread->stopped)
		rewind_count_stop(target, thread);
	thread_release(thread);
}

int freeze(struct target *target, timer_t timer, uint64_t deadline_ns,
	   struct generation *generation, struct freeze_times *times, struct avc_error *err)
{
	const uint64_t start = now_ns();
	struct thread *main_thread;
	bool cloned = false;
	int result;

	*times = (struct freeze_times){ 0 };
	generation->template = 0;
	generation->pidfd = -1;
	urgent_begin();
	tracee_deadline_set(timer, deadline_ns);
	result = stop_all(target, err);
	times->stop_ns = now_ns() - start;
	main_thread = thread_find(target, target->pid);
	if (!result && (!main_thread || !main_thread->stopped))
		result = fail(err, AVC_DEADLINE, 0, target->pid, "freeze", "",
			      "its main thread has just ended");
	if (!result)
		result = read_all(target, generation->slot, &generation->threads, err);
	if (!result) {
		generation->vm_pages = proc_vm_pages(target->pid);
		memory_copy(target, generation->image);
		files_mapped_copy(generation->mapped);
		generation->taken_ns = now_ns();
		/* The deadline is for getting things stopped; the clone of a big
		 * process takes its time. */
		tracee_deadline_set(timer, CLONE_NS);
		result = clone_app(target, main_thread, generation, times, err);
		cloned = !result;
	}
	/* The image is whole.  The main thread first: it has a few steps to go before it
	 * can be let go, and would have to share the CPUs with everybody else. */
	if (main_thread) {
		tracee_deadline_set(timer, NS_PER_S); /* a frozen cgroup, at this very moment */
		if (cloned && (tracee_settle(main_thread->tid, err) || give_back(main_thread, err)))
			main_thread->stopped = false;
		let_go(target, main_thread);
	}
	for (uint32_t i = 0; i < target->thread_count; i++)
		if (&target->threads[i] != main_thread)
			let_go(target, &target->threads[i]);
	tracee_deadline_clear(timer);
	times->freeze_ns = now_ns() - start;
	urgent_end();
	if (!cloned)
		return -1;
	target->checkpoints++;
	if (pending_deadly(target->pending))
		return fail(err, AVC_GONE, 0, target->pid, "freeze", "",
			    "it is just being ended by signal %d", pending_deadly(target->pending));
	/* What that means, support_check() says at the next attempt. */
	if (!target->childless)
		return fail(err, AVC_DEADLINE, ECHILD, target->pid, "freeze", "",
			    "it has just started another process");
	return 0;
}
