/* SPDX-License-Identifier: Apache-2.0
 *
 * The processes of an app: its main process and everything below it, and orphans that have become
 * init's children.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "process.h"

#define SHARER_NS (100 * NS_PER_MS)

int tree_init(struct tree *tree, struct process *main)
{
	tree->entry = calloc(PROCESSES_MAX, sizeof *tree->entry);
	tree->made = calloc(PROCESSES_MAX, sizeof *tree->made);
	if (!tree->entry || !tree->made ||
	    !make_room(&tree->process, 0, &tree->process_room, sizeof *tree->process))
		return -1;
	tree->process[tree->processes++] = main;
	return 0;
}

/* ---- who there is --------------------------------------------------------------- */

struct looking {
	struct tree *tree;
	int task_dirfd;
	int parent;
	struct avc_error *err;
};

static int add_entry(struct tree *tree, pid_t pid, int parent, struct avc_error *err)
{
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->entry[i].pid == pid)
			return 0; /* its parent has just exited: seen twice */
	if (tree->count == PROCESSES_MAX)
		/* Some may be gone at the next attempt (policy_missed()). */
		return fail(err, AVC_UNSUPPORTED, 0, pid, "look at processes", "",
			    "it has more than %d processes", PROCESSES_MAX);
	tree->entry[tree->count++] = (struct tree_entry){ .pid = pid, .parent = parent };
	return 0;
}

static bool any_cloning(const struct tree *tree)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->cloning)
			return true;
	return false;
}

static bool has_process(const struct tree *tree, pid_t pid)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->leader == pid)
			return true;
	return false;
}

bool tree_has_parasite(const struct tree *tree, avc_remote pc)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (parasite_contains(&tree->process[i]->parasite, pc))
			return true;
	return false;
}

/* A thread of the app reported that it had created it while it was being stopped. */
static bool is_reported(const struct tree *tree, pid_t pid)
{
	for (uint32_t i = 0; i < tree->processes; i++) {
		const struct thread *t = thread_find(tree->process[i], pid);

		if (t && t->attached)
			return true;
	}
	return false;
}

/* 1: its next instruction is in a parasite; 0: it is not. */
static int is_in_parasite(const struct tree *tree, pid_t pid, struct avc_error *err)
{
	const avc_remote pc = tracee_pc(pid);

	if (!pc)
		return fail(err, AVC_RETRY, 0, pid, "look at processes", "",
			    "a process has just been made");
	return tree_has_parasite(tree, pc);
}

/* A clone of ours: of a holder that is cloning, or one that was never reported.  A sibling that a
 * thread of the app has created (CLONE_PARENT) may be a tracee, too. 1 or 0. */
static int is_clone(struct tree *tree, pid_t pid, struct avc_error *err)
{
	int result;

	if (has_process(tree, pid) || !tracee_is_ours(pid))
		return 0;
	/* Where it is can be seen when the kernel has finished it: tree_check_made(). */
	if (any_cloning(tree) && tree->made_count < PROCESSES_MAX) {
		if (is_reported(tree, pid))
			return 0;
		tree->made[tree->made_count++] = pid;
		return 1;
	}
	result = is_in_parasite(tree, pid, err);
	if (result == 1)
		tree_main(tree)->lost |= !any_cloning(tree);
	return result;
}

/* A zombie; not a main thread that has exited before its threads. */
static bool is_zombie(const struct proc_stat *stat)
{
	return (stat->state == 'Z' || stat->state == 'X') && stat->threads < 2;
}

/* Nobody but init waits for it: an orphan of the app's, or a template that has been dropped.  There may
 * be hundreds where init gets no CPU to reap them. */
static bool has_ended(pid_t pid)
{
	struct proc_stat stat;

	if (proc_stat(pid, &stat))
		return !is_shortage(errno);
	return is_zombie(&stat);
}

int tree_check_made(const struct tree *tree, bool (*is_known)(pid_t pid, const void *arg),
		    const void *arg, struct avc_error *err)
{
	for (uint32_t i = 0; i < tree->made_count; i++) {
		int result;

		if (is_known(tree->made[i], arg) || has_ended(tree->made[i]))
			continue;
		result = is_in_parasite(tree, tree->made[i], err);
		if (result == 0) {
			tracee_release_strangers();
			return fail(err, AVC_RETRY, 0, tree->made[i], "look at processes", "",
				    "it was made while the application was being stopped");
		}
		if (result < 0)
			return -1;
	}
	return 0;
}

/* A child of init that does not belong to the app. */
static int is_none(struct tree *tree, pid_t pid, struct avc_error *err)
{
	const bool later = any_cloning(tree) && tree->made_count < PROCESSES_MAX;
	int result;

	if (pid == tree_main(tree)->leader || tree->is_ours(pid, tree->arg) ||
	    (!later && !has_process(tree, pid) && has_ended(pid)))
		return 1;
	result = is_clone(tree, pid, err);
	/* Most are clones, and need not be looked at twice. */
	return result || !later ? result : !has_process(tree, pid) && has_ended(pid);
}

/* Nobody may be left out because we cannot look. */
static int not_listed(pid_t tid, struct avc_error *err)
{
	return is_shortage(errno) ? fail_errno(err, tid, "look at processes", "open(children)",
					       "its children cannot be listed")
				  : 0;
}

/* A child is listed under the thread that forked it. */
static int look_at_task(pid_t tid, void *arg)
{
	const struct looking *look = arg;
	pid_t children[CHILDREN_MAX];
	const int count = proc_children_of(look->task_dirfd, tid, children, CHILDREN_MAX);

	if (count < 0)
		return not_listed(tid, look->err);
	for (int i = 0; i < count; i++)
		if (add_entry(look->tree, children[i], look->parent, look->err))
			return -1;
	return 0;
}

/* A process that has exited shows nothing. */
static int look_below(struct tree *tree, int task_dirfd, int parent, struct avc_error *err)
{
	struct looking look = { tree, task_dirfd, parent, err };

	return proc_numbers(task_dirfd, look_at_task, &look) && err->code ? -1 : 0;
}

/* It has one thread. */
static int look_below_init(struct tree *tree, struct avc_error *err)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(tree->init, children, CHILDREN_MAX);

	if (count < 0)
		return not_listed(tree->init, err);
	for (int i = 0; i < count; i++) {
		const int none = is_none(tree, children[i], err);

		if (none < 0 || (!none && add_entry(tree, children[i], PARENT_INIT, err)))
			return -1;
	}
	return 0;
}

/* ---- processes -------------------------------------------------------------------- */

static struct process *process_new(const struct tree *tree)
{
	const struct process *main = tree_main(tree);
	struct process *process = malloc(sizeof *process);

	if (!process)
		return NULL;
	process_init(process);
	process->descendant = true;
	process->main = main;
	process->shm_bytes = main->shm_bytes;
	process->others = main->others;
	process->tcp_moved = main->tcp_moved;
	process->plain_filters = main->plain_filters;
	process->init = main->init;
	if (!process_make_room(process)) {
		process_free_room(process);
		free(process);
		return NULL;
	}
	return process;
}

static void process_free(struct process *process)
{
	process_unhold(process);
	process_close(process);
	parasite_close(&process->parasite);
	process_free_room(process);
	free(process);
}

static struct process *find_process(const struct tree *tree, pid_t pid, uint64_t start)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->leader == pid && tree->process[i]->start == start)
			return tree->process[i];
	return NULL;
}

/* A thread that forked while it was being stopped created it as our tracee, and it was mistaken for
 * another thread (trace/thread.c, adopt()). */
static void forget_thread(struct process *process, pid_t tid)
{
	struct thread *t = thread_find(process, tid);

	if (t && !t->seen) {
		t->attached = false;
		t->stopped = false;
	}
}

static struct process *add_process(struct tree *tree, pid_t pid, uint64_t start,
				   struct avc_error *err)
{
	struct process *process = NULL;

	/* Those of all generations, too: workers that are replaced all the time are others in each. */
	if (make_room(&tree->process, tree->processes, &tree->process_room, sizeof *tree->process))
		process = process_new(tree);
	if (!process) {
		fail_memory(err, pid, "look at processes");
		return NULL;
	}
	if (process_open(process, pid, proc_inside(pid), err)) {
		process_free(process);
		return NULL;
	}
	process->start = start;
	for (uint32_t i = 0; i < tree->processes; i++)
		forget_thread(tree->process[i], pid);
	tree->process[tree->processes++] = process;
	return process;
}

/* For a known one, open descriptors make this cheaper. */
static int look_at(const struct tree *tree, pid_t pid, struct proc_stat *stat)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->leader == pid &&
		    proc_stat_of(tree->process[i]->stat_fd, stat) == 0)
			return 0;
	return proc_stat(pid, stat);
}

/* It shares with another one for so short a time that a guard may have left it behind when it died
 * just now, as a porter or clone. */
static bool may_be_left(struct tree *tree, pid_t pid)
{
	if (tree->sharer != pid) {
		tree->sharer = pid;
		tree->sharer_since_ns = now_ns();
	}
	return now_ns() - tree->sharer_since_ns < SHARER_NS;
}

/* clone(2): two share what they open, or where they go.  A restored one can only share with the
 * process that forks it: its parent, or for an orphan the main process.  That need not be the other
 * one: its parent may have ended, or left the table to its children.  Only a clone shares, so a new
 * process is compared with all that are known. */
static int check_sharing(struct tree *tree, const struct tree_entry *entry, uint64_t *shared,
			 struct avc_error *err)
{
	const struct process *parent = tree->entry[entry->parent < 0 ? 0 : entry->parent].process;
	/* With its memory, it may be a porter. */
	const bool may_share = parent && !proc_same_memory(entry->pid, parent->leader);
	const bool files = may_share && proc_shares(entry->pid, parent->leader, SHARED_FILES) == 1,
		   folders = may_share &&
			     proc_shares(entry->pid, parent->leader, SHARED_FOLDERS) == 1;

	*shared = (files ? CLONE_FILES : 0) | (folders ? CLONE_FS : 0);
	for (uint32_t i = 0; i < tree->processes; i++) {
		const pid_t other = tree->process[i]->leader;
		const char *what = NULL;

		/* One that has ended is only in generations; and it had that number before. */
		if (!other || other == entry->pid)
			continue;
		if (!files && proc_shares(entry->pid, other, SHARED_FILES) == 1)
			what = "descriptor table (CLONE_FILES)";
		else if (!folders && proc_shares(entry->pid, other, SHARED_FOLDERS) == 1)
			what = "working directory (CLONE_FS)";
		/* Two that are just ending have none; and holders and templates of a guard that died
		 * share theirs until the kernel has ended them. */
		if (!what || proc_is_killed(entry->pid) || proc_is_killed(other))
			continue;
		/* Its porter has yet to leave the table. */
		if (tree->process[i] != parent && proc_same_memory(entry->pid, other))
			return fail(err, AVC_RETRY, 0, entry->pid, "look at processes", "kcmp",
				    "process %d shares its memory with process %d",
				    proc_inside(entry->pid), proc_inside(other));
		return fail(err, may_be_left(tree, entry->pid) ? AVC_RETRY : AVC_UNSUPPORTED, 0,
			    entry->pid, "look at processes", "",
			    "process %d shares its %s with process %d, which is not its parent",
			    proc_inside(entry->pid), what, proc_inside(other));
	}
	return 0;
}

/* One that shared, and may not any more. */
static int check_shared(struct tree *tree, const struct tree_entry *entry, struct avc_error *err)
{
	const uint64_t before = entry->process->shared;

	if (!before)
		return 0;
	if (check_sharing(tree, entry, &entry->process->shared, err))
		return -1;
	return entry->process->shared == before
		       ? 0
		       : fail(err, AVC_RETRY, 0, entry->pid, "look at processes", "kcmp",
			      "process %d shares no longer with its parent",
			      proc_inside(entry->pid));
}

/* One that is new.  If it turns out that it has ended: entry->ending. */
static int open_new(struct tree *tree, struct tree_entry *entry, struct avc_error *err)
{
	struct avc_error gone = { 0 };
	uint64_t shared;

	if (check_sharing(tree, entry, &shared, err))
		return -1;
	if (shared && entry->parent < 0 && may_be_left(tree, entry->pid))
		return fail(err, AVC_RETRY, 0, entry->pid, "look at processes", "kcmp",
			    "process %d may be ending", proc_inside(entry->pid));
	entry->process = add_process(tree, entry->pid, entry->stat.start, &gone);
	if (!entry->process && gone.code != AVC_GONE) {
		*err = gone;
		return -1;
	}
	entry->ending = !entry->process;
	if (entry->process)
		entry->process->shared = shared;
	return 0;
}

/* Any but the main process.  One that has ended has no entry->process. */
static int look_at_entry(struct tree *tree, struct tree_entry *entry, struct avc_error *err)
{
	struct proc_stat stat;

	if (look_at(tree, entry->pid, &stat)) {
		if (is_shortage(errno))
			return fail_errno(err, entry->pid, "look at processes", "open(stat)",
					  "it cannot be seen");
		entry->pid = 0; /* it has just been reaped */
		return 0;
	}
	entry->stat = stat;
	entry->ended = is_zombie(&stat);
	if (entry->ended)
		return 0;
	entry->process = find_process(tree, entry->pid, stat.start);
	return entry->process ? check_shared(tree, entry, err) : open_new(tree, entry, err);
}

int tree_scan(struct tree *tree, struct avc_error *err)
{
	tree->count = 0;
	tree->made_count = 0;
	if (add_entry(tree, tree_main(tree)->leader, PARENT_INIT, err))
		return -1;
	tree->entry[0].process = tree_main(tree);
	if (look_below_init(tree, err))
		return -1;
	for (uint32_t i = 0; i < tree->count; i++) {
		const struct process *process;

		if (i && look_at_entry(tree, &tree->entry[i], err))
			return -1;
		process = tree->entry[i].process;
		/* Thread by thread only if the last checkpoint did not find that it has no child: a
		 * new one is found by the next checkpoint. */
		if (process && !process->childless &&
		    look_below(tree, process->task_dirfd, (int)i, err))
			return -1;
	}
	return 0;
}

/* One that could not be queried is exiting, which is not known yet. */
static bool may_be_reaper(struct process *process)
{
	const struct thread *thread = process ? thread_find(process, process->pid) : NULL;

	return !thread || !thread->known || thread->creds.subreaper;
}

bool tree_has_reaper(const struct tree *tree, uint32_t i)
{
	for (int k = (int)i; k >= 0; k = tree->entry[k].parent)
		if (may_be_reaper(tree->entry[k].process))
			return true;
	return false;
}

bool tree_shares_memory(const struct tree *tree, uint32_t i)
{
	const int parent = tree->entry[i].parent;

	return parent >= 0 && tree->entry[parent].process &&
	       proc_same_memory(tree->entry[i].pid, tree->entry[parent].pid);
}

/* ---- the end of one --------------------------------------------------------------- */

void tree_let_go(struct process *process)
{
	process_unhold(process);
	process_close(process);
}

void tree_sweep(struct tree *tree)
{
	uint32_t kept = 0;

	for (uint32_t i = 0; i < tree->processes; i++) {
		struct process *process = tree->process[i];

		/* One with a thread that is still our tracee has to be waited for. */
		if (process->descendant && !process->pid && !process->images &&
		    !process->thread_count && !process->lost)
			process_free(process);
		else
			tree->process[kept++] = process;
	}
	tree->processes = kept;
}

void tree_free(struct tree *tree)
{
	for (uint32_t i = 1; i < tree->processes; i++)
		process_free(tree->process[i]);
	free(tree->process);
	free(tree->entry);
	free(tree->made);
	tree->process = NULL;
	tree->entry = NULL;
	tree->made = NULL;
	tree->processes = tree->process_room = 0;
	tree->count = 0;
}
