/* SPDX-License-Identifier: Apache-2.0
 *
 * One checkpoint.  Every thread of every known process is stopped; then, and only then, the
 * processes are cloned: the main one by its main thread, the others by their holders, which share
 * their memory (holder.c).  While the kernel does that, the state of this instant is read.  Then
 * everything is released.  What can wait is done afterwards (generation.c).
 */
#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "freeze.h"

#define STOPPED_NS (2 * NS_PER_S)
#define CLONES 4 /* times as long as they are expected to take                         */

/* ---- who there is ------------------------------------------------------------------------- */

/* One that was found while everything was stopped is not infected yet. */
static int prepare_stopped(const struct tree *tree, const struct generation *generation, uint32_t i,
			   struct avc_error *err)
{
	struct process *process = generation->image[i].process;
	const int above = generation->image[i].parent;
	const struct process *parent = above >= 0 ? generation->image[above].process : NULL;
	struct proc_status status;

	if (process->pid != process->leader)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "freeze", "",
			    "the main thread of process %d has ended", process->inside);
	if (!process->infected) {
		/* Nobody has counted them yet (support_check()): 0 would look afterwards as if it had
		 * got some since. */
		if (proc_status_of(process->status_fd, process->pid, &status))
			return fail_errno(err, process->pid, "freeze", "open(status)",
					  "it has ended");
		process->filters = status.seccomp_filters;
		if (process_infect_stopped(process, tree->slots, err))
			return -1;
		memory_expect(process, parent ? parent : tree_main(tree));
	}
	return process->files_image ? 0 : files_prepare(process, NULL, err);
}

/* The PID of the leader of a session or group, inside; 0: not of the app, or gone. */
static pid_t number_inside(const struct tree *tree, pid_t pid)
{
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->entry[i].pid == pid)
			return tree->entry[i].process ? tree->entry[i].process->inside
						      : proc_inside(pid);
	return 0;
}

/* The same for a group whose leader is outside of the app, too, if visible. */
static pid_t group_inside(const struct tree *tree, pid_t group)
{
	const pid_t inside = group > 0 ? number_inside(tree, group) : 0;

	return inside || group <= 0 ? inside : proc_inside(group);
}

/* A leader that is not of the app: either it is gone, and the PID is not reused while its session
 * has members; or it is outside (`podman exec`), and its session cannot be joined. */
static pid_t session_of_other(const struct tree_entry *entry, const struct proc_status *status,
			      struct image *image)
{
	struct proc_stat leader;

	if (proc_stat(entry->stat.session, &leader))
		return status->session;
	if (entry->process)
		fail(&image->notice, AVC_UNSUPPORTED, 0, entry->pid, "freeze", "",
		     "process %d is in a session that is led from outside of the application, and "
		     "will be in another one after a restore",
		     image->inside);
	return 0;
}

/* Now, while all are stopped: right after, it may be in another group, or the group's leader may be
 * gone. */
static void keep_place(const struct tree *tree, const struct tree_entry *entry,
		       const struct image *main, struct image *image)
{
	const struct proc_stat *stat = &entry->stat, *of_main = &tree->entry[0].stat;
	struct proc_status status = { 0 };
	pid_t session = number_inside(tree, stat->session), group;

	image->pid = entry->pid;
	image->inside = entry->ended ? proc_inside(entry->pid) : entry->process->inside;
	image->stat = *stat;
	group = number_inside(tree, stat->group);
	if (!group && image != main && stat->group == of_main->group)
		group = main->group;
	/* The kernel knows the numbers inside, whichever process had them. */
	if (!group || (!session && stat->session != of_main->session))
		(void)proc_status(entry->pid, &status);
	if (!session && stat->session != of_main->session)
		session = session_of_other(entry, &status, image);
	image->session = session;
	image->group = group ? group : status.group;
	image->tty_group = stat->tty ? group_inside(tree, stat->tty_group) : 0;
	image->exit_signal = stat->exit_signal;
}

/* The processes found become the images, in the same order. */
static int make_images(const struct tree *tree, struct generation *generation,
		       struct avc_error *err)
{
	const uint32_t slot = generation->image[0].slot;
	int index[PROCESSES_MAX];

	if (proc_stat_of(tree_main(tree)->stat_fd, &tree->entry[0].stat))
		return fail_errno(err, tree_main(tree)->pid, "freeze", "read(stat)",
				  "it has ended");
	if (generation_make_room(generation, tree->count, err))
		return -1;
	shortage_begin();
	keep_place(tree, &tree->entry[0], &generation->image[0], &generation->image[0]);
	index[0] = 0;
	for (uint32_t i = 1; i < tree->count; i++) {
		const struct tree_entry *entry = &tree->entry[i];
		struct image *image = &generation->image[generation->images];

		index[i] = (int)generation->images;
		if (!entry->pid)
			continue;
		*image = (struct image){
			.process = entry->process,
			.shared = entry->process ? entry->process->shared : 0,
			.adopts = entry->process && entry->process->adopts,
			.parent = entry->parent == PARENT_INIT ? PARENT_INIT : index[entry->parent],
			.pidfd = -1,
			.slot = slot,
		};
		keep_place(tree, entry, &generation->image[0], image);
		if (entry->ended) {
			if (image->parent == PARENT_INIT || image->inside <= 0)
				continue; /* init is just about to wait for it */
			image->status = entry->stat.exit_status;
			memcpy(image->name, entry->stat.name, sizeof image->name);
		} else {
			entry->process->images++;
		}
		generation->images++;
	}
	/* A leader that could not be seen is none that is gone. */
	return shortage_check(err, "freeze");
}

static int find_others(struct tree *tree, struct generation *generation, struct avc_error *err)
{
	/* A process that waits for a child to execute a program (vfork(2)) could not be stopped. */
	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->entry[i].process && !tree->entry[i].process->infected &&
		    tree_shares_memory(tree, i))
			return fail(err, AVC_UNSUPPORTED, 0, tree->entry[i].pid, "check", "",
				    "a child process has its parent's memory (CLONE_VM)");
	if (make_images(tree, generation, err))
		return -1;
	for (uint32_t i = 1; i < generation->images; i++)
		if (generation->image[i].process && prepare_stopped(tree, generation, i, err))
			return -1;
	return 0;
}

/* ---- what is read of them all ------------------------------------------------------------- */

/* What the main process needs for that was prepared before the freeze (guard_checkpoint.c). */
static int keep(struct image *image, bool strict, struct mem_seen *seen, struct avc_error *err)
{
	struct process *process = image->process;

	if (process->descendant) {
		if (strict)
			image->mapped = files_mapped_prepare(process->pid, process->shm_bytes,
							     &seen->leases);
		if (memory_prepare(process, &image->memory, seen, err))
			return -1;
		/* Has to wait for its clone; few have any (MADV_WIPEONFORK). */
		memory_copy_own(process, image->memory);
	}
	image->threads = process->blocks;
	memory_copy_shared(process, image->memory);
	files_mapped_copy(image->mapped);
	return 0;
}

static int keep_all(struct generation *generation, struct mem_seen *seen, struct avc_error *err)
{
	const bool strict = generation->image[0].mapped != NULL;

	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].process && keep(&generation->image[i], strict, seen, err))
			return -1;
	return 0;
}

/* A killed process has no descriptors any more, which looks like an empty table.  Those still
 * answering queries are checked then. */
static int see_alive(const struct tree *tree, struct avc_error *err)
{
	for (uint32_t i = 0; i < tree->count; i++) {
		const struct process *process = tree->entry[i].process;
		struct arch_regs ignored;

		if (process && !process->asked && !(!process->descendant && process->cloning) &&
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

/* An ancestor that adopts orphans would get a child that it never had; the process itself prevents
 * that (process_hold_stopped()). */
static int make_holder_missing(struct tree *tree, uint32_t i, struct avc_error *err)
{
	for (int k = tree->entry[i].parent; k >= 0; k = tree->entry[k].parent) {
		struct process *above = tree->entry[k].process;
		struct thread *thread = above ? thread_find(above, above->pid) : NULL;

		if (!thread)
			continue;
		if (!above->paused && !above->descendant && thread_ask(above, thread, err))
			return -1; /* the others were asked just now */
		if (thread->creds.subreaper && process_pause_adoption(above, err))
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
		    process_resume_adoption(tree->entry[i].process, &failed) && !result) {
			*err = failed;
			result = -1;
		}
	return result;
}

/* Their main threads clone the holders, and have to be idle for that, as well as those of the
 * processes above them. */
static int clone_missing(struct freeze *freeze, struct avc_error *err)
{
	struct tree *tree = freeze->tree;
	struct process *main = tree_main(tree);

	/* First the threads that wait for us in their parasites: how long the main process takes is
	 * not known yet. */
	if (freeze_await_answers(tree, err) ||
	    (main->cloning &&
	     (freeze_await_clone(main, &freeze->generation->image[0].template, err) ||
	      freeze_park_main(main, thread_find(main, main->pid), err))) ||
	    make_holders_missing(tree, err))
		return -1;
	for (uint32_t i = 1; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;

		if (process && !process->cloning && !process->recycling &&
		    freeze_start_clone(process, freeze->generation->image[0].slot, err))
			return -1;
	}
	return 0;
}

static int await_clones(struct generation *generation, struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		struct image *image = &generation->image[i];

		if (!image->process)
			continue;
		if (image->process->cloning &&
		    freeze_await_clone(image->process, &image->template, err))
			return -1;
		image->vm_pages = image->process->clone_pages;
		image->taken_ns = generation->taken_ns;
	}
	return 0;
}

static bool is_template(pid_t pid, const void *arg)
{
	const struct generation *generation = arg;

	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].template == pid)
			return true;
	return false;
}

/* ---- all of it ------------------------------------------------------------------------------ */

static int stop_and_begin(struct freeze *freeze, struct avc_error *err)
{
	const uint64_t start = now_ns();
	const int result = freeze_stop_known(freeze->tree, err);

	freeze->generation->taken_ns = now_ns();
	freeze->stop_ns = freeze->generation->taken_ns - start;
	return result || freeze_begin_known(freeze, err) || freeze_stop_others(freeze->tree, err)
		       ? -1
		       : 0;
}

static int read_and_clone(struct freeze *freeze, struct avc_error *err)
{
	struct generation *generation = freeze->generation;

	if (find_others(freeze->tree, generation, err) || freeze_begin_others(freeze, err))
		return -1;
	/* The tables do not change while the kernel clones: no task runs.  While main threads are in
	 * their parasites: see parasite_set_undo(). */
	files_capture(generation->image, generation->images);
	if (!freeze->meet)
		generation->ends = files_ends_keep_own(generation->image, generation->images);
	/* What is mapped cannot be opened while the kernel clones its memory. */
	if (keep_all(generation, &freeze->seen, err) ||
	    dirty_capture(freeze->dirty, generation, err))
		return -1;
	if (see_alive(freeze->tree, err))
		return -1;
	return has_all_holders(freeze->tree) ? 0 : clone_missing(freeze, err);
}

/* Also what was begun before a failure: *template is set as soon as the main process is cloned. */
static int hear_and_await(struct freeze *freeze, int result, struct avc_error *err)
{
	struct process *main = tree_main(freeze->tree);
	struct avc_error failed = { 0 };

	if (main->cloning && freeze_await_clone(main, &freeze->generation->image[0].template,
						result ? &failed : err))
		result = -1;
	if (freeze_await_answers(freeze->tree, result ? &failed : err))
		result = -1;
	if (!result)
		result = await_clones(freeze->generation, err) ||
					 tree_check_made(freeze->tree, is_template,
							 freeze->generation, err)
				 ? -1
				 : 0;
	freeze_drop_clones(freeze->tree);
	return result;
}

/* Other members may take long to stop, and a thread that waits in its parasite would return before
 * that. */
static int rest_all(struct freeze *freeze, struct avc_error *err)
{
	struct process *main = tree_main(freeze->tree);

	for (uint32_t i = 0; i < freeze->tree->processes; i++) {
		struct process *process = freeze->tree->process[i];

		for (uint32_t k = 0; k < process->thread_count; k++) {
			struct thread *thread = &process->threads[k];
			const bool is_main = process == main && thread->tid == main->pid;

			if (thread->borrowed && (is_main ? freeze_park_main(main, thread, err)
							 : thread_give_back(thread, err)))
				return -1;
		}
	}
	return 0;
}

static int meet_others(struct freeze *freeze, int result, struct avc_error *err)
{
	struct avc_error failed = { 0 };
	uint64_t start;

	if (!freeze->meet)
		return result;
	if (!result)
		result = rest_all(freeze, err);
	boost_end();
	start = now_ns();
	if (freeze->meet(freeze->arg, result ? NULL : freeze->generation, result ? &failed : err))
		result = -1;
	freeze->wait_ns = now_ns() - start;
	return result;
}

/* The main thread first: otherwise it would have to share the CPUs with all others. */
static void let_go(struct freeze *freeze)
{
	struct process *main = tree_main(freeze->tree);
	struct thread *main_thread = thread_find(main, main->pid);
	struct avc_error ignored = { 0 };

	seccomp_own_forget(main);
	if (main_thread) {
		/* A frozen cgroup, at this very moment. */
		tracee_deadline_set(freeze->timer, NS_PER_S);
		if (freeze->generation->image[0].template && main_thread->borrowed)
			(void)freeze_park_main(main, main_thread,
					       &ignored); /* or it is killed just now */
		thread_let_go(main, main_thread);
	}
	for (uint32_t i = 0; i < freeze->tree->processes; i++)
		process_let_go(freeze->tree->process[i]);
}

int freeze_tree(struct freeze *freeze, struct avc_error *err)
{
	struct generation *generation = freeze->generation;
	uint64_t start;
	int result;

	rt_priority_begin();
	/* The others stay stopped until it has got a CPU to stop, to be cloned and to come home. */
	if (freeze->meet)
		boost_begin(tree_main(freeze->tree)->pid);
	result = freeze_stop_prepare(freeze->tree, err);
	tracee_deadline_set(freeze->timer, freeze->deadline_ns);
	start = generation->taken_ns = now_ns();
	if (!result)
		result = stop_and_begin(freeze, err);
	/* That was for stopping; the clone of a big process may take longer. */
	tracee_deadline_set(freeze->timer,
			    STOPPED_NS + CLONES * freeze_clones_time_ns(freeze->tree));
	if (!result)
		result = read_and_clone(freeze, err);
	result = hear_and_await(freeze, result, err);
	freeze->clone_ns = now_ns() - generation->taken_ns;
	result = meet_others(freeze, result, err);
	let_go(freeze);
	freeze->freeze_ns = now_ns() - start;
	tracee_deadline_clear(freeze->timer);
	rt_priority_end();
	if (result)
		return -1;
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].process)
			generation->image[i].process->checkpoints++;
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].process &&
		    pending_check(generation->image[i].process, err))
			return -1;
	return 0;
}
