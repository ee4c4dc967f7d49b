/* SPDX-License-Identifier: Apache-2.0
 *
 * One checkpoint.  Every thread of every process that is known is stopped; then, and only
 * then, the processes are cloned: the main one by its main thread, the others by their
 * holders, which share their memory (infect.c).  While the kernel does that, everything is
 * read that is of this instant.  Then everything goes on.  What can wait, waits until then
 * (generation.c).
 *
 * What is to be read in a process' own memory is read before its clone begins: the kernel
 * lets nobody in while it clones (mmap_lock).
 */
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

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

static int read_all(struct target *target, uint32_t slot, struct avc_error *err)
{
	uint32_t next = 1;

	for (uint32_t i = 0; i < target->thread_count; i++) {
		struct thread *t = &target->threads[i];

		if (t->attached && !t->seen)
			return fail(err, AVC_DEADLINE, EAGAIN, t->tid, "freeze", "",
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
	target->blocks = next;
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

/* The tables do not change while the kernel clones: nobody runs. */
static void capture_files(struct target *target, struct generation *generation)
{
	struct scratch scratch = { -1, -1, 0 };

	files_capture(target, generation, generation->branches > 0, NULL, 0, &scratch,
		      &generation->files_error);
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct branch *branch = &generation->branch[i];
		const struct branch *parent = branch->parent >= 0
						      ? &generation->branch[branch->parent]
						      : NULL;

		if (branch->target)
			files_capture(branch->target, branch->image, true,
				      parent ? parent->image->files : generation->files,
				      parent ? parent->target->pid : target->pid, &scratch,
				      &branch->image->files_error);
	}
	scratch_close(&scratch);
}

/* ECHILD, if it has none: the one question that needs no look at each thread. */
static const struct inj_syscall *ask_for_children(struct inj_call *call)
{
	return call_add(call, SYS_waitid, P_ALL, 0, 0, WEXITED | WNOHANG | WNOWAIT | __WALL, 0);
}

/* Nobody has looked below one that had none at the last checkpoint. */
static int hear_of_children(struct target *target, struct avc_error *err)
{
	const bool was_childless = target->childless;

	target->childless = target->children->result == -ECHILD;
	return was_childless && !target->childless
		       ? fail(err, AVC_DEADLINE, EAGAIN, target->pid, "freeze", "",
			      "it has just started another process")
		       : 0;
}

/* Pads of guards that died, and of the process that forked this one. */
static void drop_old_pads(struct target *target, long *vm_pages, struct inj_call *call)
{
	if (!target->checkpoints)
		return;
	for (; target->old_pads && call->count < INJ_CALLS_MAX - 2; target->old_pads--) {
		const avc_remote base = target->old_pad[target->old_pads - 1].base;
		const size_t bytes = target->old_pad[target->old_pads - 1].bytes;

		if (anybody_uses(target, base, bytes))
			return;
		call_add(call, SYS_munmap, base, bytes, 0, 0, 0);
		*vm_pages -= (long)(bytes / ARCH_PAGE_BYTES);
	}
}

static int start_app_clone(struct target *target, struct thread *main_thread, long *vm_pages,
			   struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->runner;

	*vm_pages = proc_vm_pages(target->statm_fd, NULL);
	call_begin(call, INJ_AFTER_HOME);
	timers_ask(target, call);
	memory_dofork(target->memory, call);
	drop_old_pads(target, vm_pages, call);
	target->children = ask_for_children(call);
	/* The descriptor table is shared, not copied: what the app closes is closed. */
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD, 0, 0, 0, 0);
	target->asked_ns = now_ns();
	if (borrow(target, main_thread, err) || pad_start(main_thread->tid, err))
		return -1;
	target->cloning = true;
	return 0;
}

static int await_app_clone(struct target *target, struct thread *main_thread,
			   struct generation *generation, struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->runner;

	target->cloning = false;
	if (pad_await_clone(main_thread->tid, call, &generation->template, err)) {
		target->lost = err->code != AVC_KERNEL;
		thread_runs_on(main_thread, err);
		return -1;
	}
	/* After the timers were asked: one that has expired just now is found here. */
	pending_read(target);
	timers_answer(target, call, now_ns() - target->asked_ns);
	return hear_of_children(target, err);
}

/* After its clone it has a few steps to go before it can be let go. */
static int rest_app(struct thread *main_thread, struct avc_error *err)
{
	if (tracee_settle(main_thread->tid, err) == 0 && give_back(main_thread, err) == 0)
		return 0;
	main_thread->stopped = false;
	return -1;
}

/* ---- the other processes ---------------------------------------------------------- */

/* The holder shares the process' memory and descriptors; its clone is the template. */
static int start_clone(struct target *target, struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->holder;

	/* Before the holder runs, which maps something for a moment. */
	target->clone_pages = proc_vm_pages(target->statm_fd, NULL);
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, INJ_FUTURE_LOCK, 0, 0, 0, 0, 0);
	memory_dofork(target->memory, call);
	drop_old_pads(target, &target->clone_pages, call);
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD, 0, 0, 0, 0);
	if (pad_send(&target->pad, target->holder, &target->holder_base, call, err) ||
	    pad_start(target->holder, err))
		return -1;
	target->cloning = true;
	target->lost = true; /* until we have heard of the clone */
	return 0;
}

static int await_clone(struct target *target, pid_t *template, struct avc_error *err)
{
	const struct inj_call *call = &target->pad.control->holder;
	struct thread *thread = thread_find(target, target->pid);

	target->cloning = false;
	if (pad_await_clone(target->holder, call, template, err))
		return -1;
	target->lost = false;
	if (thread && call->call[0].result > 0)
		thread->creds.future_lock = (int32_t)call->call[0].result;
	return 0;
}

/* Timers only the process itself can tell of.  And young processes change what they are
 * all the time: a name, a user.  All are asked at the same time. */
static int ask_begin(struct target *target, struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->runner;
	struct thread *thread = thread_find(target, target->pid);

	call_begin(call, INJ_AFTER_HOME);
	timers_ask(target, call);
	target->children = ask_for_children(call);
	ask_add(target, false, call, &target->questions);
	target->asked_ns = now_ns();
	if (borrow(target, thread, err) || pad_start(thread->tid, err))
		return -1;
	target->asked = true;
	return 0;
}

/* All are interrupted before the first is waited for: it takes each some time to get there. */
static int ask_halt(struct target *target, struct avc_error *err)
{
	struct thread *thread = thread_find(target, target->pid);

	if (pad_halt(thread->tid, &target->pad.control->runner, err) == 0)
		return 0;
	target->asked = false;
	thread_runs_on(thread, err);
	return -1;
}

static int ask_end(struct target *target, struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->runner;
	struct thread *thread = thread_find(target, target->pid);

	target->asked = false;
	if (tracee_await(thread->tid, NULL, err) != STOP_TRAP) {
		thread_runs_on(thread, err);
		return -1;
	}
	pending_read(target);
	timers_answer(target, call, now_ns() - target->asked_ns);
	return give_back(thread, err) || ask_answer(thread, call, &target->questions, err) ||
			       hear_of_children(target, err)
		       ? -1
		       : 0;
}

/* Also of those that were asked before one failed. */
static int hear_all(struct tree *tree, struct avc_error *err)
{
	int (*const step[])(struct target *, struct avc_error *) = { ask_halt, ask_end };
	int result = 0;

	for (size_t k = 0; k < sizeof step / sizeof *step; k++)
		for (uint32_t i = 0; i < tree->members; i++) {
			struct avc_error failed = { 0 };

			if (tree->member[i]->asked && step[k](tree->member[i], &failed) &&
			    !result) {
				*err = failed;
				result = -1;
			}
		}
	return result;
}

/* It stands still: its clone begins, if it has a holder for that, and it answers meanwhile what
 * it is asked, which changes nothing of its memory. */
static int begin(struct target *target, uint32_t slot, struct avc_error *err)
{
	struct thread *thread = thread_find(target, target->pid);

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "freeze", "",
			    "its main thread has ended");
	target->begun = true;
	return read_all(target, slot, err) || vet(target, thread, err) ||
			       (target->holder && start_clone(target, err)) ||
			       ask_begin(target, err)
		       ? -1
		       : 0;
}

static int begin_app(struct target *target, struct generation *generation, struct avc_error *err)
{
	struct thread *thread = thread_find(target, target->pid);

	if (!thread || !thread->stopped)
		return fail(err, AVC_DEADLINE, 0, target->pid, "freeze", "",
			    "its main thread has just ended");
	target->begun = true;
	if (read_all(target, generation->slot, err))
		return -1;
	generation->threads = target->blocks;
	return start_app_clone(target, thread, &generation->vm_pages, err);
}

/* What it has just brought forth was taken for a thread of its own; a look tells. */
static bool has_strangers(const struct target *target)
{
	for (uint32_t i = 0; i < target->thread_count; i++)
		if (target->threads[i].attached && !target->threads[i].seen)
			return true;
	return false;
}

/* As soon as everybody stands still who is known to be there: whoever is found after that is
 * stopped, too, and has had nothing to do with the memory of the others.  (One that shares it
 * is not protected: find_branches().)  One that has no holder yet waits for the others. */
static int begin_known(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	if (!has_strangers(tree->main) && begin_app(tree->main, generation, err))
		return -1;
	for (uint32_t i = 1; i < tree->count; i++) {
		struct target *target = tree->kin[i].target;

		if (target && target->frozen && target->holder && target->pid == target->leader &&
		    !has_strangers(target) && begin(target, generation->slot, err))
			return -1;
	}
	return 0;
}

static int begin_others(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	if (!tree->main->begun && begin_app(tree->main, generation, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct target *target = generation->branch[i].target;

		if (target && !target->begun && begin(target, generation->slot, err))
			return -1;
	}
	return 0;
}

/* Of a process that was killed meanwhile, and all of them when the checkpoint failed. */
static void drop_clones(struct tree *tree)
{
	for (uint32_t i = 0; i < tree->members; i++) {
		struct target *target = tree->member[i];
		struct avc_error ignored = { 0 };
		pid_t template;

		if (!target->cloning || await_clone(target, &template, &ignored))
			continue;
		tracee_kill(template);
		target->lost = tracee_settle(target->holder, &ignored) != 0;
	}
}

#define LOOKS 64
#define LOOK_US 100

/* Those that have something of ours; another child may have to execute a program before its
 * parent can be stopped (vfork(2)). */
static int stop_known(struct tree *tree, struct avc_error *err)
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

/* Until a look at the whole tree finds nobody who is not stopped: processes create
 * processes while we look. */
static int stop_others(struct tree *tree, struct avc_error *err)
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

/* One that was found while everything was stopped has nothing of ours yet. */
static int prepare_stopped(struct tree *tree, struct target *target, struct avc_error *err)
{
	if (target->pid != target->leader)
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "freeze", "",
			    "the main thread of process %d has ended", target->inside);
	if (!target->infected && infect_stopped(target, tree->slots, err))
		return -1;
	return target->files_image ? 0 : files_prepare(target, err);
}

/* Of the leader of a session or group, as the app knows it; 0: it is none of the app's,
 * or gone. */
static pid_t number_inside(const struct tree *tree, pid_t pid)
{
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->kin[i].pid == pid)
			return tree->kin[i].target ? tree->kin[i].target->inside : proc_inside(pid);
	return 0;
}

/* Of a group whose leader is outside of the app, too, if it is to be seen. */
static pid_t group_inside(const struct tree *tree, pid_t group)
{
	const pid_t inside = group > 0 ? number_inside(tree, group) : 0;

	return inside || group <= 0 ? inside : proc_inside(group);
}

/* Now, while all stand still: right after, it may be in another group, or who leads its
 * group may be gone, and nobody know what number that one had inside. */
static void keep_place(const struct tree *tree, const struct proc_stat *stat,
		       struct generation *image)
{
	image->stat = *stat;
	image->tty_group = stat->tty ? group_inside(tree, stat->tty_group) : 0;
}

static int keep_place_of_main(const struct tree *tree, struct generation *generation,
			      struct avc_error *err)
{
	struct proc_stat stat;

	if (proc_stat_of(tree->main->stat_fd, &stat))
		return fail_errno(err, tree->main->pid, "freeze", "read(stat)", "it has ended");
	keep_place(tree, &stat, generation);
	generation->group = group_inside(tree, stat.group);
	return 0;
}

/* The kin that were there are the branches, in the same order. */
static int make_branches(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	int index[PROCESSES_MAX];

	index[0] = PARENT_MAIN;
	generation->branch = calloc(tree->count, sizeof *generation->branch);
	if (!generation->branch)
		return fail_errno(err, 0, "freeze", "calloc", "out of memory");
	for (uint32_t i = 1; i < tree->count; i++) {
		const struct kin *kin = &tree->kin[i];
		struct branch *branch = &generation->branch[generation->branches];

		index[i] = (int)generation->branches;
		if (!kin->pid)
			continue;
		branch->parent = kin->parent == PARENT_INIT ? PARENT_INIT : index[kin->parent];
		branch->pid = kin->pid;
		branch->inside = kin->ended ? proc_inside(kin->pid) : kin->target->inside;
		branch->target = kin->target;
		branch->session = number_inside(tree, kin->stat.session);
		branch->group = number_inside(tree, kin->stat.group);
		if (kin->ended) {
			if (branch->parent == PARENT_INIT || branch->inside <= 0)
				continue; /* init is just about to wait for it */
			branch->status = kin->stat.exit_status;
			memcpy(branch->name, kin->stat.name, sizeof branch->name);
		} else {
			branch->image = calloc(1, sizeof *branch->image);
			if (!branch->image)
				return fail_errno(err, 0, "freeze", "calloc", "out of memory");
			branch->image->pidfd = -1;
			branch->image->slot = generation->slot;
			keep_place(tree, &kin->stat, branch->image);
			kin->target->images++;
		}
		generation->branches++;
	}
	return 0;
}

static int keep_branch(struct branch *branch, bool strict, struct mem_seen *seen,
		       struct avc_error *err)
{
	struct target *target = branch->target;

	if (strict)
		branch->image->mapped = files_mapped_prepare(target->pid, target->shm_bytes);
	if (memory_prepare(target->memory, &branch->image->image, seen, err))
		return -1;
	branch->image->threads = target->blocks;
	memory_copy(target, branch->image->image);
	files_mapped_copy(branch->image->mapped);
	return 0;
}

static int find_branches(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	if (tree->count <= 1)
		return 0;
	/* Whoever waits for a child to execute a program (vfork(2)) could not be stopped. */
	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->kin[i].target && !tree->kin[i].target->infected &&
		    tree_shares_memory(tree, i))
			return fail(err, AVC_UNSUPPORTED, 0, tree->kin[i].pid, "check", "",
				    "a child process has its parent's memory (CLONE_VM)");
	if (make_branches(tree, generation, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].target &&
		    prepare_stopped(tree, generation->branch[i].target, err))
			return -1;
	return 0;
}

static int keep_branches(struct generation *generation, struct mem_seen *seen,
			 struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].target &&
		    keep_branch(&generation->branch[i], generation->mapped != NULL, seen, err))
			return -1;
	return 0;
}

static bool has_all_holders(const struct tree *tree)
{
	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->kin[i].target && !tree->kin[i].target->holder)
			return false;
	return true;
}

/* What a process above it adopts would be a child that it never had; it itself sees to that
 * (hold_stopped()). */
static int make_holder_missing(struct tree *tree, uint32_t i, struct avc_error *err)
{
	for (int k = tree->kin[i].parent; k >= 0; k = tree->kin[k].parent) {
		struct target *above = tree->kin[k].target;
		struct thread *thread = above ? thread_find(above, above->pid) : NULL;

		if (!thread)
			continue;
		if (!above->paused && !above->descendant && ask(above, thread, err))
			return -1; /* the others were asked just now */
		if (thread->creds.subreaper && adopt_no_more(above, err))
			return -1;
	}
	return hold_stopped(tree->kin[i].target, tree->init, err);
}

/* Parents come before their children. */
static int make_holders_missing(struct tree *tree, struct avc_error *err)
{
	struct avc_error failed = { 0 };
	int result = 0;

	for (uint32_t i = 1; !result && i < tree->count; i++)
		if (tree->kin[i].target && !tree->kin[i].target->holder)
			result = make_holder_missing(tree, i, err);
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->kin[i].target && adopt_again(tree->kin[i].target, &failed) && !result) {
			*err = failed;
			result = -1;
		}
	return result;
}

/* Their main threads make the holders, and have to be at rest for that, as well as those of
 * the processes above them. */
static int clone_missing(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	struct thread *main_thread = thread_find(tree->main, tree->main->pid);

	if (await_app_clone(tree->main, main_thread, generation, err) ||
	    rest_app(main_thread, err) || hear_all(tree, err) || make_holders_missing(tree, err))
		return -1;
	for (uint32_t i = 1; i < tree->count; i++) {
		struct target *target = tree->kin[i].target;

		if (target && !target->cloning && start_clone(target, err))
			return -1;
	}
	return 0;
}

static int await_clones(struct generation *generation, struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct branch *branch = &generation->branch[i];

		if (!branch->target)
			continue;
		if (await_clone(branch->target, &branch->image->template, err))
			return -1;
		branch->image->vm_pages = branch->target->clone_pages;
		branch->image->taken_ns = generation->taken_ns;
	}
	return 0;
}

/* ---- all of it ----------------------------------------------------------------------- */

static void let_go(const struct target *target, struct thread *thread)
{
	if (thread->attached && thread->stopped)
		rewind_count_stop(target, thread);
	thread_release(thread);
}

void let_go_process(struct target *target, const struct thread *but)
{
	for (uint32_t i = 0; i < target->thread_count; i++)
		if (&target->threads[i] != but)
			let_go(target, &target->threads[i]);
}

/* Whoever is killed has no descriptors any more, which looks like a table with nothing in it.
 * Of those that are still at what they were asked it will be seen then. */
static int see_alive(const struct tree *tree, struct avc_error *err)
{
	for (uint32_t i = 0; i < tree->count; i++) {
		const struct target *target = tree->kin[i].target;
		struct arch_regs ignored;

		if (target && !target->asked && !(i == 0 && target->cloning) &&
		    arch_regs_get(target->pid, &ignored))
			return fail_errno(err, target->pid, "freeze", "ptrace(GETREGS)",
					  "it has ended");
	}
	return 0;
}

int freeze(struct tree *tree, timer_t timer, uint64_t deadline_ns, struct generation *generation,
	   struct mem_seen *seen, struct freeze_times *times, struct avc_error *err)
{
	struct target *target = tree->main;
	struct avc_error failed = { 0 };
	struct thread *main_thread;
	bool cloned;
	uint64_t start;
	int result;

	*times = (struct freeze_times){ 0 };
	generation->template = 0;
	generation->pidfd = -1;
	urgent_begin();
	tracee_deadline_set(timer, deadline_ns);
	start = now_ns();
	result = stop_known(tree, err);
	generation->taken_ns = now_ns();
	times->stop_ns = generation->taken_ns - start;
	if (!result)
		result = begin_known(tree, generation, err) || stop_others(tree, err) ? -1 : 0;
	/* The deadline is for getting things stopped; the clone of a big process takes its
	 * time. */
	tracee_deadline_set(timer, CLONE_NS);
	if (!result) {
		memory_copy(target, generation->image);
		files_mapped_copy(generation->mapped);
		result = keep_place_of_main(tree, generation, err) ||
					 find_branches(tree, generation, err) ||
					 begin_others(tree, generation, err) ||
					 keep_branches(generation, seen, err)
				 ? -1
				 : 0;
	}
	if (!result && !has_all_holders(tree))
		result = clone_missing(tree, generation, err);
	if (!result) {
		capture_files(target, generation);
		result = see_alive(tree, err);
	}
	/* Also what was begun before something failed. */
	main_thread = thread_find(target, target->pid);
	if (target->cloning &&
	    await_app_clone(target, main_thread, generation, result ? &failed : err))
		result = -1;
	cloned = generation->template != 0;
	if (hear_all(tree, result ? &failed : err))
		result = -1;
	if (!result)
		result = await_clones(generation, err);
	drop_clones(tree);
	times->clone_ns = now_ns() - generation->taken_ns;
	/* The image is whole.  The main thread first: it would have to share the CPUs with
	 * everybody else. */
	if (main_thread) {
		tracee_deadline_set(timer, NS_PER_S); /* a frozen cgroup, at this very moment */
		if (cloned && main_thread->borrowed)
			(void)rest_app(main_thread, err);
		let_go(target, main_thread);
	}
	let_go_process(target, main_thread);
	for (uint32_t i = 0; i < tree->members; i++)
		let_go_process(tree->member[i], NULL);
	times->freeze_ns = now_ns() - start;
	tracee_deadline_clear(timer);
	urgent_end();
	if (!cloned || result)
		return -1;
	target->checkpoints++;
	if (pending_deadly(target->pending))
		return fail(err, AVC_GONE, 0, target->pid, "freeze", "",
			    "it is just being ended by signal %d", pending_deadly(target->pending));
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].target)
			generation->branch[i].target->checkpoints++;
	return 0;
}
