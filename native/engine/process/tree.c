/* SPDX-License-Identifier: Apache-2.0
 *
 * The processes of an app: its main process and everything below it, and what has
 * become init's because its parent is gone.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "process.h"

/* ---- who there is --------------------------------------------------------------- */

struct looking {
	struct tree *tree;
	int task_dirfd;
	int parent;
	struct avc_error *err;
};

static int add_kin(struct tree *tree, pid_t pid, int parent, struct avc_error *err)
{
	if (tree->count == PROCESSES_MAX)
		return fail(err, AVC_UNSUPPORTED, 0, tree->main->pid, "look at processes", "",
			    "it has more than %d processes", PROCESSES_MAX);
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->kin[i].pid == pid)
			return 0; /* its parent has just gone: seen twice */
	tree->kin[tree->count++] = (struct kin){ .pid = pid, .parent = parent };
	return 0;
}

static bool any_cloning(const struct tree *tree)
{
	bool cloning = tree->main->cloning;

	for (uint32_t i = 0; i < tree->members; i++)
		cloning |= tree->member[i]->cloning;
	return cloning;
}

static bool is_member(const struct tree *tree, pid_t pid)
{
	for (uint32_t i = 0; i < tree->members; i++)
		if (tree->member[i]->leader == pid)
			return true;
	return false;
}

/* A clone of ours: of a holder that is at it, or one of which we never heard. */
static bool is_clone(const struct tree *tree, pid_t pid)
{
	if (is_member(tree, pid) || !tracee_is_ours(pid))
		return false;
	tree->main->lost |= !any_cloning(tree);
	return true;
}

/* A child hangs on the thread that forked it. */
static int look_at_task(pid_t tid, void *arg)
{
	const struct looking *look = arg;
	struct tree *tree = look->tree;
	pid_t children[CHILDREN_MAX];
	const int count = proc_children_of(look->task_dirfd, tid, children, CHILDREN_MAX);

	for (int i = 0; i < count; i++) {
		if (look->parent == PARENT_INIT &&
		    (children[i] == tree->main->leader || tree->is_ours(children[i], tree->arg) ||
		     is_clone(tree, children[i])))
			continue;
		if (add_kin(tree, children[i], look->parent, look->err))
			return -1;
	}
	return 0;
}

/* Of one that has ended there is nothing to be seen. */
static int look_below(struct tree *tree, int task_dirfd, int parent, struct avc_error *err)
{
	struct looking look = { tree, task_dirfd, parent, err };

	return proc_tasks(task_dirfd, look_at_task, &look) && err->code ? -1 : 0;
}

static int look_below_init(struct tree *tree, struct avc_error *err)
{
	int task_dirfd = proc_open(tree->init, "task", O_RDONLY | O_DIRECTORY), result;

	if (task_dirfd < 0)
		return 0;
	result = look_below(tree, task_dirfd, PARENT_INIT, err);
	close(task_dirfd);
	return result;
}

/* Ended, and not waited for; a main thread that has gone before its threads is not. */
static bool is_zombie(const struct proc_stat *stat)
{
	return (stat->state == 'Z' || stat->state == 'X') && stat->threads < 2;
}

/* ---- targets -------------------------------------------------------------------- */

static struct target *target_new(const struct tree *tree)
{
	const struct target *main = tree->main;
	struct target *target = malloc(sizeof *target);

	if (!target)
		return NULL;
	target_init(target);
	target->descendant = true;
	target->shm_bytes = main->shm_bytes;
	target->others = main->others;
	target->tcp_moved = main->tcp_moved;
	target->plain_filters = main->plain_filters;
	target->init = main->init;
	if (!target_make_room(target)) {
		target_free_room(target);
		free(target);
		return NULL;
	}
	return target;
}

static void target_free(struct target *target)
{
	unhold(target);
	target_close(target);
	parasite_close(&target->parasite);
	target_free_room(target);
	free(target);
}

static struct target *find_member(const struct tree *tree, pid_t pid, uint64_t start)
{
	for (uint32_t i = 0; i < tree->members; i++)
		if (tree->member[i]->leader == pid && tree->member[i]->start == start)
			return tree->member[i];
	return NULL;
}

/* A thread of ours that forked while it was being stopped has brought it forth as our
 * tracee, and it was taken for one more thread (trace/thread.c, adopt()). */
static void forget_thread(struct target *target, pid_t tid)
{
	struct thread *t = thread_find(target, tid);

	if (t && !t->seen) {
		t->attached = false;
		t->stopped = false;
	}
}

static struct target *add_member(struct tree *tree, pid_t pid, uint64_t start,
				 struct avc_error *err)
{
	struct target *target;

	if (tree->members == 2 * PROCESSES_MAX) {
		fail(err, AVC_UNSUPPORTED, 0, tree->main->pid, "look at processes", "",
		     "it has had too many processes since the oldest generation");
		return NULL;
	}
	target = target_new(tree);
	if (!target) {
		fail_errno(err, pid, "look at processes", "malloc", "out of memory");
		return NULL;
	}
	if (target_open(target, pid, proc_inside(pid), err)) {
		target_free(target);
		return NULL;
	}
	target->start = start;
	forget_thread(tree->main, pid);
	for (uint32_t i = 0; i < tree->members; i++)
		forget_thread(tree->member[i], pid);
	tree->member[tree->members++] = target;
	return target;
}

/* What is kept open of one that is known takes less to look at. */
static int look_at(const struct tree *tree, pid_t pid, struct proc_stat *stat)
{
	for (uint32_t i = 0; i < tree->members; i++)
		if (tree->member[i]->leader == pid &&
		    proc_stat_of(tree->member[i]->stat_fd, stat) == 0)
			return 0;
	return proc_stat(pid, stat);
}

/* clone(2): what one of them opens, or where it goes, is the other's, too; those that are
 * restored have tables and directories of their own. */
static int check_sharing(const struct tree *tree, const struct kin *kin, struct avc_error *err)
{
	const struct target *parent = kin->parent >= 0 ? tree->kin[kin->parent].target : NULL;
	const char *what = NULL;

	if (parent && proc_shares(kin->pid, parent->pid, SHARED_FILES) == 1)
		what = "descriptor table (CLONE_FILES)";
	else if (parent && proc_shares(kin->pid, parent->pid, SHARED_FOLDERS) == 1)
		what = "working directory (CLONE_FS)";
	/* Two that are just ending have none. */
	if (!what || proc_is_exiting(kin->pid))
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, kin->pid, "look at processes", "",
		    "process %d shares its %s with its parent", proc_inside(kin->pid), what);
}

int tree_look(struct tree *tree, struct avc_error *err)
{
	tree->count = 0;
	if (add_kin(tree, tree->main->leader, PARENT_INIT, err))
		return -1;
	tree->kin[0].target = tree->main;
	if (look_below_init(tree, err))
		return -1;
	for (uint32_t i = 0; i < tree->count; i++) {
		struct kin *kin = &tree->kin[i];
		struct proc_stat stat;

		if (i && look_at(tree, kin->pid, &stat)) {
			kin->pid = 0; /* it was waited for just now */
			continue;
		}
		if (i)
			kin->stat = stat;
		if (i && is_zombie(&stat)) {
			kin->ended = true;
			continue;
		}
		if (i) {
			kin->target = find_member(tree, kin->pid, stat.start);
			if (!kin->target) {
				struct avc_error gone = { 0 };

				if (check_sharing(tree, kin, err))
					return -1;
				kin->target = add_member(tree, kin->pid, stat.start, &gone);
				if (!kin->target && gone.code != AVC_GONE) {
					*err = gone;
					return -1;
				}
				if (!kin->target) {
					kin->ending = true;
					continue;
				}
			}
		}
		/* Thread by thread only when the last checkpoint did not find that it
		 * has none: then the next one will find that it has. */
		if (!kin->target->childless &&
		    look_below(tree, kin->target->task_dirfd, (int)i, err))
			return -1;
	}
	return 0;
}

/* Who could not be asked is just ending, and nobody knows of it yet: what is found here also
 * holds for the one that is restored in its place (guard_death.c, hold_all()). */
static bool may_be_reaper(struct target *target)
{
	const struct thread *thread = target ? thread_find(target, target->pid) : NULL;

	return !thread || !thread->known || thread->creds.subreaper;
}

bool tree_has_reaper(const struct tree *tree, uint32_t i)
{
	for (int k = (int)i; k >= 0; k = tree->kin[k].parent)
		if (may_be_reaper(tree->kin[k].target))
			return true;
	return false;
}

bool tree_shares_memory(const struct tree *tree, uint32_t i)
{
	const int parent = tree->kin[i].parent;

	return parent >= 0 && tree->kin[parent].target &&
	       proc_same_memory(tree->kin[i].pid, tree->kin[parent].pid);
}

/* ---- the end of one --------------------------------------------------------------- */

void tree_let_go(struct target *target)
{
	unhold(target);
	target_close(target);
}

void tree_sweep(struct tree *tree)
{
	uint32_t kept = 0;

	for (uint32_t i = 0; i < tree->members; i++) {
		struct target *target = tree->member[i];

		/* One of which a thread is still ours has to be waited for. */
		if (!target->pid && !target->images && !target->thread_count && !target->lost)
			target_free(target);
		else
			tree->member[kept++] = target;
	}
	tree->members = kept;
}

void tree_free(struct tree *tree)
{
	for (uint32_t i = 0; i < tree->members; i++)
		target_free(tree->member[i]);
	free(tree->member);
	free(tree->kin);
	tree->member = NULL;
	tree->kin = NULL;
	tree->members = 0;
	tree->count = 0;
}
