/* SPDX-License-Identifier: Apache-2.0
 *
 * One checkpoint.  Every thread of every process that is known is stopped; then, and only
 * then, the processes are cloned: the main one by its main thread, the others by their
 * holders, which share their memory (infect.c).  While the kernel does that, everything is
 * read that is of this instant.  Then everything goes on.  What can wait, waits until then
 * (generation.c).
 */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "freeze.h"

#define CLONE_NS (10 * NS_PER_S)

/* ---- who there is ------------------------------------------------------------------------- */

/* One that was found while everything was stopped has nothing of ours yet. */
static int prepare_stopped(struct tree *tree, struct process *process, struct avc_error *err)
{
	if (process->pid != process->leader)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "freeze", "",
			    "the main thread of process %d has ended", process->inside);
	if (!process->infected && process_infect_stopped(process, tree->slots, err))
		return -1;
	return process->files_image ? 0 : files_prepare(process, err);
}

/* Of the leader of a session or group, as the app knows it; 0: it is none of the app's,
 * or gone. */
static pid_t number_inside(const struct tree *tree, pid_t pid)
{
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->entry[i].pid == pid)
			return tree->entry[i].process ? tree->entry[i].process->inside
						      : proc_inside(pid);
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

/* The entries that were there are the branches, in the same order. */
static int make_branches(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	int index[PROCESSES_MAX];

	index[0] = PARENT_MAIN;
	generation->branch = calloc(tree->count, sizeof *generation->branch);
	if (!generation->branch)
		return fail_errno(err, 0, "freeze", "calloc", "out of memory");
	for (uint32_t i = 1; i < tree->count; i++) {
		const struct tree_entry *entry = &tree->entry[i];
		struct branch *branch = &generation->branch[generation->branches];

		index[i] = (int)generation->branches;
		if (!entry->pid)
			continue;
		branch->parent = entry->parent == PARENT_INIT ? PARENT_INIT : index[entry->parent];
		branch->pid = entry->pid;
		branch->inside = entry->ended ? proc_inside(entry->pid) : entry->process->inside;
		branch->process = entry->process;
		branch->session = number_inside(tree, entry->stat.session);
		branch->group = number_inside(tree, entry->stat.group);
		branch->exit_signal = entry->stat.exit_signal;
		if (entry->ended) {
			if (branch->parent == PARENT_INIT || branch->inside <= 0)
				continue; /* init is just about to wait for it */
			branch->status = entry->stat.exit_status;
			memcpy(branch->name, entry->stat.name, sizeof branch->name);
		} else {
			branch->image = calloc(1, sizeof *branch->image);
			if (!branch->image)
				return fail_errno(err, 0, "freeze", "calloc", "out of memory");
			branch->image->pidfd = -1;
			branch->image->slot = generation->slot;
			keep_place(tree, &entry->stat, branch->image);
			entry->process->images++;
		}
		generation->branches++;
	}
	return 0;
}

static int find_branches(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	if (tree->count <= 1)
		return 0;
	/* Whoever waits for a child to execute a program (vfork(2)) could not be stopped. */
	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->entry[i].process && !tree->entry[i].process->infected &&
		    tree_shares_memory(tree, i))
			return fail(err, AVC_UNSUPPORTED, 0, tree->entry[i].pid, "check", "",
				    "a child process has its parent's memory (CLONE_VM)");
	if (make_branches(tree, generation, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process &&
		    prepare_stopped(tree, generation->branch[i].process, err))
			return -1;
	return 0;
}

/* ---- what is read of them all ------------------------------------------------------------- */

static int keep_branch(struct branch *branch, bool strict, struct mem_seen *seen,
		       struct avc_error *err)
{
	struct process *process = branch->process;

	if (strict)
		branch->image->mapped = files_mapped_prepare(process->pid, process->shm_bytes);
	if (memory_prepare(process, &branch->image->image, seen, err))
		return -1;
	branch->image->threads = process->blocks;
	/* Has to wait for its clone; few have any (MADV_WIPEONFORK). */
	memory_copy_own(process, branch->image->image);
	memory_copy_shared(process, branch->image->image);
	files_mapped_copy(branch->image->mapped);
	return 0;
}

static int keep_branches(struct generation *generation, struct mem_seen *seen,
			 struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process &&
		    keep_branch(&generation->branch[i], generation->mapped != NULL, seen, err))
			return -1;
	return 0;
}

/* The tables do not change while the kernel clones: nobody runs. */
static void capture_files(struct process *process, struct generation *generation)
{
	struct scratch scratch = { -1, -1, 0 };

	files_capture(process, generation, generation->branches > 0, NULL, 0, &scratch,
		      &generation->files_error);
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct branch *branch = &generation->branch[i];
		const struct branch *parent = branch->parent >= 0
						      ? &generation->branch[branch->parent]
						      : NULL;

		if (branch->process)
			files_capture(branch->process, branch->image, true,
				      parent ? parent->image->files : generation->files,
				      parent ? parent->process->pid : process->pid, &scratch,
				      &branch->image->files_error);
	}
	scratch_close(&scratch);
}

/* Whoever is killed has no descriptors any more, which looks like a table with nothing in it.
 * Of those that are still at what they were asked it will be seen then. */
static int see_alive(const struct tree *tree, struct avc_error *err)
{
	for (uint32_t i = 0; i < tree->count; i++) {
		const struct process *process = tree->entry[i].process;
		struct arch_regs ignored;

		if (process && !process->asked && !(i == 0 && process->cloning) &&
		    arch_regs_get(process->pid, &ignored))
			return fail_errno(err, process->pid, "freeze", "ptrace(GETREGS)",
					  "it has ended");
	}
	return 0;
}

/* ---- clones ------------------------------------------------------------------------------- */

static bool has_all_holders(const struct tree *tree)
{
	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->entry[i].process && !tree->entry[i].process->holder)
			return false;
	return true;
}

/* What a process above it adopts would be a child that it never had; it itself sees to that
 * (process_hold_stopped()). */
static int make_holder_missing(struct tree *tree, uint32_t i, struct avc_error *err)
{
	for (int k = tree->entry[i].parent; k >= 0; k = tree->entry[k].parent) {
		struct process *above = tree->entry[k].process;
		struct thread *thread = above ? thread_find(above, above->pid) : NULL;

		if (!thread)
			continue;
		if (!above->paused && !above->descendant && thread_ask(above, thread, err))
			return -1; /* the others were asked just now */
		if (thread->creds.subreaper && process_adopt_no_more(above, err))
			return -1;
	}
	return process_hold_stopped(tree->entry[i].process, tree->init, err);
}

/* Parents come before their children. */
static int make_holders_missing(struct tree *tree, struct avc_error *err)
{
	struct avc_error failed = { 0 };
	int result = 0;

	for (uint32_t i = 1; !result && i < tree->count; i++)
		if (tree->entry[i].process && !tree->entry[i].process->holder)
			result = make_holder_missing(tree, i, err);
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->entry[i].process &&
		    process_adopt_again(tree->entry[i].process, &failed) && !result) {
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

	/* First who waits in its parasite for us: how long the main process takes is not known yet. */
	if (freeze_hear_all(tree, err) ||
	    freeze_await_app_clone(tree->main, main_thread, generation, err) ||
	    freeze_rest_app(main_thread, err) || make_holders_missing(tree, err))
		return -1;
	for (uint32_t i = 1; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;

		if (process && !process->cloning && freeze_start_clone(process, err))
			return -1;
	}
	return 0;
}

static int await_clones(struct generation *generation, struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct branch *branch = &generation->branch[i];

		if (!branch->process)
			continue;
		if (freeze_await_clone(branch->process, &branch->image->template, err))
			return -1;
		branch->image->vm_pages = branch->process->clone_pages;
		branch->image->taken_ns = generation->taken_ns;
	}
	return 0;
}

/* ---- all of it ------------------------------------------------------------------------------ */

int freeze_tree(struct tree *tree, timer_t timer, uint64_t deadline_ns,
		struct generation *generation, struct mem_seen *seen, struct freeze_times *times,
		struct avc_error *err)
{
	struct process *process = tree->main;
	struct avc_error failed = { 0 };
	struct thread *main_thread;
	bool cloned;
	uint64_t start;
	int result;

	*times = (struct freeze_times){ 0 };
	generation->template = 0;
	generation->pidfd = -1;
	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	start = now_ns();
	result = freeze_stop_known(tree, err);
	generation->taken_ns = now_ns();
	times->stop_ns = generation->taken_ns - start;
	if (!result)
		result = freeze_begin_known(tree, generation, err) || freeze_stop_others(tree, err)
				 ? -1
				 : 0;
	/* The deadline is for getting things stopped; the clone of a big process takes its
	 * time. */
	tracee_deadline_set(timer, CLONE_NS);
	if (!result) {
		memory_copy_shared(process, generation->image);
		files_mapped_copy(generation->mapped);
		result = keep_place_of_main(tree, generation, err) ||
					 find_branches(tree, generation, err) ||
					 freeze_begin_others(tree, generation, err) ||
					 keep_branches(generation, seen, err)
				 ? -1
				 : 0;
	}
	/* While main threads are in their parasites: see parasite_will(). */
	if (!result) {
		capture_files(process, generation);
		result = see_alive(tree, err);
	}
	if (!result && !has_all_holders(tree))
		result = clone_missing(tree, generation, err);
	/* Also what was begun before something failed. */
	main_thread = thread_find(process, process->pid);
	if (process->cloning &&
	    freeze_await_app_clone(process, main_thread, generation, result ? &failed : err))
		result = -1;
	cloned = generation->template != 0;
	if (freeze_hear_all(tree, result ? &failed : err))
		result = -1;
	if (!result)
		result = await_clones(generation, err);
	freeze_drop_clones(tree);
	times->clone_ns = now_ns() - generation->taken_ns;
	/* The image is whole.  The main thread first: it would have to share the CPUs with
	 * everybody else. */
	if (main_thread) {
		tracee_deadline_set(timer, NS_PER_S); /* a frozen cgroup, at this very moment */
		if (cloned && main_thread->borrowed)
			(void)freeze_rest_app(main_thread, &failed); /* or it is killed just now */
		thread_let_go(process, main_thread);
	}
	process_let_go(process);
	for (uint32_t i = 0; i < tree->processes; i++)
		process_let_go(tree->process[i]);
	times->freeze_ns = now_ns() - start;
	tracee_deadline_clear(timer);
	rt_priority_end();
	if (!cloned || result)
		return -1;
	process->checkpoints++;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process)
			generation->branch[i].process->checkpoints++;
	if (pending_check(process, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process &&
		    pending_check(generation->branch[i].process, err))
			return -1;
	return 0;
}
