/* SPDX-License-Identifier: Apache-2.0
 *
 * The kernel has no call that gives a process another parent, and a fork of a template is init's
 * child.  So only the main process is forked from its template; the others are forked by their own
 * restored parents, under their own PIDs, and then made into what their templates are (advance()):
 * memory (remap.c), descriptors, signal handlers, credentials.  All of them are tracees that are
 * parked in a parasite until everything is ready.
 *
 * Each of these steps takes a wake-up, and on a busy machine a wait for a CPU.  So they are taken by
 * all children at the same time, while their parent forks the next one.
 */
#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/wait.h>

#include "restore_tree.h"

#define GONE_NS NS_PER_S
#define FILES_SPARE 64

struct restore_tree *restore_tree_new(struct restore *restore, struct avc_error *err)
{
	struct generation *generation = restore->generation;
	struct restore_tree *restored =
		calloc(1, sizeof *restored + generation->images * sizeof *restored->forked);

	if (!restored) {
		fail_memory(err, 0, "restore");
		return NULL;
	}
	restored->restore = restore;
	restored->generation = generation;
	for (uint32_t i = 0; i < generation->images; i++) {
		struct forked *forked = &restored->forked[i];

		forked->pidfd = forked->batch.socket = forked->passed = -1;
		forked->inherited = forked->channel = (struct fd_channel){ -1, -1 };
	}
	if (restore_plan_begin(generation, 0, err) == 0)
		restored->copier = copier_new(err);
	if (!restored->copier) {
		free(restored);
		return NULL;
	}
	return restored;
}

/* A zombie: it exits again, and is not waited for. */
static int make_zombie(struct forked *forked, const struct image *image, struct avc_error *err)
{
	const int signal = WIFSIGNALED(image->status) ? WTERMSIG(image->status) : 0;
	const struct rlimit none = { 0, 0 };
	const uint64_t open_mask = 0;
	struct syscall_batch *batch = &forked->batch;
	avc_remote remote;
	uint8_t *data = syscall_batch_data(batch, &remote);

	memset(data, 0, 64);
	memcpy(data + 32, image->name, sizeof image->name);
	syscall_batch_add(batch, SYS_prctl, PR_SET_NAME, remote + 32);
	if (signal) {
		syscall_batch_add(batch, SYS_rt_sigaction, (uint64_t)signal, remote, 0, 8);
		syscall_batch_soften(batch, NULL); /* SIGKILL's action cannot be changed */
		if (syscall_batch_flush(batch, err))
			return -1;
		prlimit(batch->pid, RLIMIT_CORE, &none, NULL);
		if (ptrace(PTRACE_SETSIGMASK, batch->pid, sizeof open_mask, &open_mask))
			return fail_errno(err, batch->pid, "restore", "ptrace(SETSIGMASK)",
					  "it was killed");
		tracee_signal(batch->pid, signal);
	} else {
		syscall_batch_add(batch, SYS_exit_group, (uint64_t)WEXITSTATUS(image->status));
		call_begin(batch->call, INJ_AFTER_PARK);
		call_add(batch->call, INJ_LIST, parasite_remote(batch->parasite, batch->list),
			 batch->listed);
		batch->listed = 0;
		if (syscall_batch_send(batch, batch->call, err))
			return -1;
	}
	/* SIGKILL kills it where it is. */
	if (signal != SIGKILL && seccomp_go_on(batch->pid, NULL))
		return fail_errno(err, batch->pid, "restore", "ptrace(CONT)", "it was killed");
	for (;;) {
		const struct stop stop = tracee_wait(batch->pid, 0);

		if (stop.kind == STOP_EXIT)
			return 0;
		if (stop.kind == STOP_DEADLINE)
			return fail(err, AVC_DEADLINE, 0, batch->pid, "restore", "",
				    "it did not end again");
		if (stop.kind != STOP_DYING)
			seccomp_go_on(batch->pid, &stop);
	}
}

/* The process whose descriptor table it has. */
static const struct image *owner_of(const struct restore_tree *restored, uint32_t index)
{
	const struct image *image = restored->generation->image;

	return &image[image_table_owner(image, index)];
}

/* Session and group before it has children of its own.  Those inherited from its parent are usually
 * right. */
static int place(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	const pid_t before = restore_plan_place(restored->generation, index)->before;
	struct forked *forked = &restored->forked[index];
	struct syscall_batch *batch = &forked->batch;

	if (image->session == image->inside) {
		if (before != PLACE_ANY && restore_fork_keeper(restored, index, before, err))
			return -1;
		syscall_batch_add(batch, SYS_setsid);
		forked->group = image->inside;
	} else {
		if (image->session > 0 && forked->session != image->session)
			fail(batch->notes, AVC_UNSUPPORTED, 0, image->inside, "restore", "",
			     "process %d is not in the session it was in, whose leader is gone",
			     image->inside);
		if (image->group == image->inside)
			syscall_batch_add(batch, SYS_setpgid);
	}
	return 0;
}

/* The leader of a session gets its terminal before it has children, which inherit it. */
static void take_terminal(struct syscall_batch *batch, const struct image *image,
			  const struct files *files)
{
	const int fd = files_find_device(files, image->stat.tty);

	if (!image->stat.tty || image->session != image->inside)
		return;
	syscall_batch_add(batch, SYS_ioctl, (uint64_t)fd, TIOCSCTTY);
	syscall_batch_soften(batch, "the session that it leads has lost its terminal");
}

/* Restores the foreground group; any process in the session can do it. */
static int put_foreground(struct syscall_batch *batch, const struct image *image,
			  const struct files *files, struct avc_error *err)
{
	const int fd = files_find_device(files, image->stat.tty);
	avc_remote remote;
	pid_t *group = syscall_batch_data(batch, &remote);

	if (!image->stat.tty || image->tty_group <= 0 || fd < 0)
		return 0;
	*group = image->tty_group;
	syscall_batch_add(batch, SYS_ioctl, (uint64_t)fd, TIOCSPGRP, remote);
	syscall_batch_soften(batch, NULL);
	return syscall_batch_flush(batch, err);
}

static int try_group(struct syscall_batch *batch, pid_t group, bool hard, struct avc_error *err)
{
	syscall_batch_add(batch, SYS_setpgid, 0, (uint64_t)group);
	if (!hard)
		syscall_batch_soften(batch, NULL);
	if (syscall_batch_flush(batch, err))
		return -1;
	return batch->list[0].result ? 1 : 0;
}

/* When all exist: joins groups that others lead, or have led. */
static int join_group(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	struct forked *forked = &restored->forked[index];
	struct syscall_batch *batch = &forked->batch;
	int result;

	if (image->group <= 0 || image->group == image->inside || forked->group == image->group)
		return 0;
	result = try_group(batch, image->group, false, err);
	if (result <= 0)
		return result;
	return restore_fork_group(restored, index, image->group, err) ||
			       try_group(batch, image->group, true, err)
		       ? -1
		       : 0;
}

/* ---- from a fork to what its template is -------------------------------------------------- */

static int advance(struct restore_tree *restored, uint32_t index, struct avc_error *err);

/* Where no sibling is any more. */
static int lie_down(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct place *place = restore_plan_place(restored->generation, index);
	struct forked *owner = &restored->forked[place->memory];
	const uint32_t bed = owner->born++ % BATCH_BEDS, before = owner->bed[bed];

	if (before && restored->forked[before].stage == STAGE_MOVES &&
	    advance(restored, before, err))
		return -1;
	owner->bed[bed] = index;
	syscall_batch_lie_down(&restored->forked[index].batch, bed);
	return 0;
}

static int move_in(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	struct forked *forked = &restored->forked[index];
	struct syscall_batch *batch = &forked->batch;

	if (restore_fork_await(forked, err) || lie_down(restored, index, err))
		return -1;
	if (image->shared & CLONE_FILES)
		close_fd(&forked->inherited.ours);
	return (image->shared & CLONE_FILES
			? syscall_batch_make_fd_channel(batch, err)
			: syscall_batch_open_fd_channel(batch, &forked->inherited, &image->table,
							err)) ||
			       syscall_batch_map_parasite(batch, &image->process->parasite, err)
		       ? -1
		       : 0;
}

/* In its own parasite from now on. */
static int map(struct restore_tree *restored, uint32_t index, bool *changed, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	struct syscall_batch *batch = &restored->forked[index].batch;
	const struct remap *plan = restore_plan_of(restored->generation, index, err);

	syscall_batch_enter(batch, &image->process->parasite, image->slot);
	return !plan || process_attrs_take_keys(batch, err) || remap_map(plan, batch, changed, err)
		       ? -1
		       : 0;
}

static int fill(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	struct syscall_batch *batch = &restored->forked[index].batch;
	const struct remap *plan = restore_plan_of(restored->generation, index, err);
	const bool shared = image->shared & CLONE_FILES;

	if (!plan || remap_fill(plan, batch, restored->copier, err) ||
	    process_attrs_put(batch, image, err) || place(restored, index, err) ||
	    (!shared && syscall_batch_put_files(batch, &image->table, err)))
		return -1;
	if (shared)
		syscall_batch_close_fd_channel(batch);
	take_terminal(batch, image, owner_of(restored, index)->files);
	return 0;
}

/* One step, if need be when it has made the calls of the one before.  In the meantime others do
 * theirs. */
static int advance(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	struct forked *forked = &restored->forked[index];
	struct syscall_batch *batch = &forked->batch;
	bool changed = false;

	restore_go_on(restored->restore);
	if (forked->stage == STAGE_FORKED) {
		forked->stage = STAGE_MOVES;
		return move_in(restored, index, err) || syscall_batch_start(batch, err) ? -1 : 0;
	}
	if (syscall_batch_await(batch, err))
		return -1;
	if (forked->stage == STAGE_MOVES) {
		forked->stage = STAGE_MAPS;
		if (map(restored, index, &changed, err))
			return -1;
		if (changed)
			return syscall_batch_start(batch, err);
	}
	if (forked->stage == STAGE_MAPS) {
		forked->stage = STAGE_FILLS;
		return fill(restored, index, err) || syscall_batch_start(batch, err) ? -1 : 0;
	}
	forked->stage = STAGE_WHOLE;
	close_fd(&batch->socket);
	return 0;
}

static bool is_on_its_way(const struct forked *forked)
{
	return forked->stage > STAGE_NONE && forked->stage < STAGE_WHOLE;
}

/* Done while a process forks, which takes long if it is big: finds out how the child will differ
 * from it, and goes on with those before it. */
struct chores {
	struct restore_tree *restored;
	uint32_t child; /* 0: one that will be a zombie                          */
	struct avc_error error;
	int result;
	bool done;
};

static void do_chores(void *arg)
{
	struct chores *chores = arg;
	struct restore_tree *restored = chores->restored;

	if (chores->done)
		return; /* the PID was not the right one */
	chores->done = true;
	if (chores->child && !restore_plan_of(restored->generation, chores->child, &chores->error))
		chores->result = -1;
	for (uint32_t i = 1; !chores->result && i < restored->generation->images; i++)
		if (is_on_its_way(&restored->forked[i]) &&
		    tracee_has_stopped(restored->forked[i].pid))
			chores->result = advance(restored, i, &chores->error);
}

static int finish_copies(struct restore_tree *restored, struct avc_error *err)
{
	while (copier_help(restored->copier))
		restore_go_on(restored->restore);
	return copier_finish(restored->copier, err);
}

/* Only what is whole, and has all its memory, can fork others. */
static int make_whole(struct restore_tree *restored, struct avc_error *err)
{
	bool more = true;

	while (more) {
		more = false;
		for (uint32_t i = 1; i < restored->generation->images; i++) {
			if (!is_on_its_way(&restored->forked[i]))
				continue;
			more = true;
			if (advance(restored, i, err))
				return -1;
		}
	}
	return finish_copies(restored, err);
}

/* Its descriptors are below that, with room for temporary ones. */
static uint32_t files_of(const struct image *image)
{
	const struct fd_table *table = &image->table;

	return (table->count ? (uint32_t)table->entry[table->count - 1].fd : 0) + FILES_SPARE;
}

static int make_one(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	struct forked *forked = &restored->forked[index];
	struct chores chores = { .restored = restored, .child = image->process ? index : 0 };

	restore_go_on(restored->restore);
	if (restore_fork(restored, index, do_chores, &chores, err))
		return -1;
	forked->batch.pid = forked->pid;
	forked->pidfd = proc_pidfd_open(forked->pid);
	if (forked->pidfd < 0)
		return fail_errno(err, forked->pid, "restore", "pidfd_open", "it was killed");
	if (chores.result) {
		*err = chores.error;
		return -1;
	}
	if (image->process) {
		process_attrs_lift_limits(forked->pid, image, files_of(owner_of(restored, index)));
		forked->stage = STAGE_FORKED;
		return 0;
	}
	forked->stage = STAGE_WHOLE;
	return restore_fork_await(forked, err) || place(restored, index, err) ||
			       syscall_batch_flush(&forked->batch, err)
		       ? -1
		       : 0;
}

/* When no process will join a group that they lead any more. */
static int end_zombies(struct restore_tree *restored, struct avc_error *err)
{
	for (uint32_t i = 0; i < restored->generation->images; i++) {
		const struct image *image = &restored->generation->image[i];
		const uint32_t host = restore_plan_place(restored->generation, i)->host;
		struct forked *forked = &restored->forked[i];

		if (image->process)
			continue;
		restore_fork_note(&restored->forked[host], image->exit_signal);
		if (make_zombie(forked, image, err))
			return -1;
		forked->traced = false;
	}
	return 0;
}

/* Discards the signals of zombies that exited again: it has had these already. */
static int flush_signals(struct forked *parent, struct avc_error *err)
{
	struct syscall_batch *batch = &parent->batch;
	avc_remote remote;
	uint64_t *data;

	do {
		data = syscall_batch_data(batch, &remote);
		data[0] = parent->flush;
		data[1] = data[2] = 0;
		syscall_batch_add(batch, SYS_rt_sigtimedwait, remote, 0, remote + 8, 8);
		syscall_batch_soften(batch, NULL);
		if (syscall_batch_flush(batch, err))
			return -1;
	} while (batch->list[0].result > 0);
	return 0;
}

/* As job control does: it stays so when it is released, whatever it does for us until then. */
static int stop_again(pid_t pid, struct avc_error *err)
{
	struct stop stop = { .kind = STOP_NONE };

	tracee_signal(pid, SIGSTOP);
	while (stop.kind != STOP_GROUP) {
		if (seccomp_go_on(pid, &stop))
			return fail_errno(err, pid, "restore", "ptrace(CONT)", "it was killed");
		stop = tracee_wait(pid, 0);
		if (stop.kind == STOP_EXIT || stop.kind == STOP_DYING)
			return fail(err, AVC_GONE, 0, pid, "restore", "", "it was killed");
		if (stop.kind == STOP_DEADLINE)
			return fail(err, AVC_DEADLINE, 0, pid, "restore", "",
				    "it did not stop again");
	}
	return 0;
}

/* Stops what was stopped and waited for, and has the parents wait for it once more: a shell would take
 * it for a new stop. */
static int hear_stops(struct restore_tree *restored, struct avc_error *err)
{
	for (uint32_t i = 1; i < restored->generation->images; i++) {
		const struct image *image = &restored->generation->image[i];
		struct forked *parent;

		if (!image->process || !image->stop_heard || image->parent == PARENT_INIT)
			continue;
		parent = &restored->forked[image->parent];
		if (stop_again(restored->forked[i].pid, err))
			return -1;
		restore_fork_note(parent, SIGCHLD);
		syscall_batch_add(&parent->batch, SYS_waitid, P_PID, (uint64_t)image->inside, 0,
				  WSTOPPED | WNOHANG, 0);
		if (syscall_batch_flush(&parent->batch, err))
			return -1;
	}
	return 0;
}

/* Session and group before it has children; a descendant gets them in become(). */
static int begin_main(struct restore_tree *restored, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[0];
	const struct parasite *parasite = &image->process->parasite;
	const pid_t pid = restored->restore->pid;
	struct inj_slot *slot = parasite_slot(parasite, image->slot);
	struct forked *forked = &restored->forked[0];
	struct syscall_batch *batch = &forked->batch;

	forked->pid = batch->pid = pid;
	forked->traced = true;
	forked->stage = STAGE_WHOLE;
	forked->pidfd = proc_pidfd_open(pid);
	batch->inside = slot->pid;
	batch->notes = &restored->restore->notes;
	syscall_batch_enter(batch, parasite, image->slot);
	if (forked->pidfd < 0 || parasite_own(parasite, pid) || arch_regs_get(pid, &batch->base))
		return fail_errno(err, pid, "restore", "ptrace(GETREGS)", "it was killed");
	if (slot->session_leader)
		syscall_batch_add(batch, SYS_setsid);
	else
		syscall_batch_add(batch, SYS_setpgid, 0, (uint64_t)slot->group);
	/* The group may have been led by one of its own processes, or by one that is gone. */
	if (!slot->session_leader)
		syscall_batch_soften(batch, NULL);
	take_terminal(batch, image, image->files);
	if (syscall_batch_flush(batch, err))
		return -1;
	if (image->group > 0 && image->group != image->inside) {
		struct proc_status status;

		if (proc_status(pid, &status))
			return fail_errno(err, pid, "restore", "open(status)", "it was killed");
		forked->group = status.group;
	}
	slot->placed = 1;
	return 0;
}

/* The processes, when all exist. */
static int join_up(struct restore_tree *restored, struct avc_error *err)
{
	const struct generation *generation = restored->generation;

	for (uint32_t i = 0; i < generation->images; i++)
		if (join_group(restored, i, err))
			return -1;
	if (restore_fork_end(restored, err) || end_zombies(restored, err))
		return -1;
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];

		if (image->process && (i == 0 || image->session == image->inside) &&
		    put_foreground(&restored->forked[i].batch, image, owner_of(restored, i)->files,
				   err))
			return -1;
	}
	if (hear_stops(restored, err))
		return -1;
	for (uint32_t i = 0; i < generation->images; i++)
		if (restored->forked[i].flush && generation->image[i].process &&
		    flush_signals(&restored->forked[i], err))
			return -1;
	return 0;
}

/* None of them forks any more. */
static int end_forks(struct restore_tree *restored, struct avc_error *err)
{
	for (uint32_t i = 0; i < restored->generation->images; i++) {
		struct forked *forked = &restored->forked[i];

		if (restore_fork_rest(forked, err) ||
		    syscall_batch_unshare_fd_channel(&forked->batch, &forked->channel, err))
			return -1;
	}
	boost_end();
	return 0;
}

/* First all children of the main process, then their children: an orphan may come before the one
 * that forks it. */
int restore_tree_make(struct restore_tree *restored, struct avc_error *err)
{
	const struct generation *generation = restored->generation;
	uint32_t left = generation->images - 1, before = 0;

	if (begin_main(restored, err))
		return -1;
	while (left && left != before) {
		before = left;
		for (uint32_t i = 1; i < generation->images; i++) {
			const uint32_t host = restore_plan_place(generation, i)->host;

			if (restored->forked[i].pid || restored->forked[host].stage != STAGE_WHOLE)
				continue;
			/* While it uses its parent's table, nobody else does. */
			if (make_one(restored, i, err) ||
			    (generation->image[i].shared & CLONE_FILES &&
			     make_whole(restored, err)))
				return -1;
			left--;
		}
		if (make_whole(restored, err))
			return -1;
	}
	if (left)
		return fail(err, AVC_KERNEL, ELOOP, 0, "restore", "",
			    "%u processes wait for each other to be made", left);
	return end_forks(restored, err) ? -1 : join_up(restored, err);
}

/* ---- off they go ------------------------------------------------------------------------- */

static int start_one(struct restore_tree *restored, uint32_t index, struct last_pid *helper,
		     struct avc_error *err)
{
	struct forked *forked = &restored->forked[index];

	if (restore_start(&restored->generation->image[index], helper, forked->pid,
			  &forked->sandbox, err))
		return -1;
	forked->traced = false;
	return 0;
}

static int await_one(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	struct forked *forked = &restored->forked[index];
	struct avc_error *notes = &restored->restore->notes;

	attributes_put_back_oom(image->attributes, forked->pid);
	if (restore_await(image, forked->pidfd, forked->sandbox, err))
		return -1;
	restore_note(image, forked->pid, notes);
	return memory_put_back(image, forked->pid, notes, err);
}

/* It needs nothing from us while it restores itself: no TIDs, no permission for calls. */
static bool is_on_its_own(const struct image *image)
{
	return image->threads == 1 && !image->sandboxed && !image->stop_signal;
}

int restore_tree_begin(struct restore_tree *restored, struct avc_error *err)
{
	const struct generation *generation = restored->generation;

	for (uint32_t i = 1; i < generation->images; i++)
		if (generation->image[i].process && is_on_its_own(&generation->image[i]) &&
		    start_one(restored, i, NULL, err))
			return -1;
	return 0;
}

/* Their TIDs are chosen for one process after the other; everything else they do side by side. */
int restore_tree_start(struct restore_tree *restored, struct avc_error *err)
{
	const struct generation *generation = restored->generation;

	for (uint32_t i = 1; i < generation->images; i++) {
		struct forked *forked = &restored->forked[i];

		if (!generation->image[i].process || is_on_its_own(&generation->image[i]))
			continue;
		if (start_one(restored, i, restored->restore->helper, err))
			return -1;
		if (!forked->sandbox)
			restore_await_spawned(&generation->image[i], forked->pidfd);
		else if (await_one(restored, i, err))
			return -1;
	}
	for (uint32_t i = 1; i < generation->images; i++)
		if (generation->image[i].process && !restored->forked[i].sandbox &&
		    await_one(restored, i, err))
			return -1;
	return 0;
}

void restore_tree_go(struct restore_tree *restored)
{
	/* First those stopped by job control: their parents know it. */
	for (int stopped = 1; stopped >= 0; stopped--)
		for (uint32_t i = 1; i < restored->generation->images; i++) {
			const struct image *image = &restored->generation->image[i];

			if (image->process && !image->stop_signal == !stopped)
				restore_go(image, restored->forked[i].sandbox);
		}
}

pid_t restore_tree_pid(const struct restore_tree *restored, uint32_t index)
{
	return restored->forked[index].pid;
}

int restore_tree_pidfd(const struct restore_tree *restored, uint32_t index)
{
	return restored->forked[index].pidfd;
}

static void kill_one(struct forked *forked)
{
	if (forked->sandbox)
		sandbox_end(forked->sandbox);
	else if (forked->pid && forked->traced)
		tracee_kill(forked->pid);
	else if (forked->pidfd >= 0)
		syscall(SYS_pidfd_send_signal, forked->pidfd, SIGKILL, NULL, 0);
	forked->sandbox = NULL;
	forked->traced = false;
}

void restore_tree_kill(struct restore_tree *restored)
{
	restore_fork_kill(restored);
	for (uint32_t i = restored->generation->images; i-- > 0;)
		kill_one(&restored->forked[i]);
	for (uint32_t i = 1; i < restored->generation->images; i++)
		if (restored->forked[i].pidfd >= 0)
			(void)pidfd_await_end(restored->forked[i].pidfd, GONE_NS);
}

void restore_tree_free(struct restore_tree *restored)
{
	boost_end();
	if (!restored)
		return;
	for (uint32_t i = 0; i < restored->generation->images; i++) {
		close_fd(&restored->forked[i].pidfd);
		close_fd(&restored->forked[i].batch.socket);
		close_fd(&restored->forked[i].inherited.ours);
		close_fd(&restored->forked[i].channel.ours);
	}
	copier_free(restored->copier);
	free(restored->keeper);
	free(restored);
}
