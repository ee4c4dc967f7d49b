/* SPDX-License-Identifier: Apache-2.0
 *
 * The kernel has no call that gives a process another parent, and a fork of a template is
 * init's child.  So only the main process is forked from its template; the others are
 * forked by their own restored parents, under their own numbers, and then made what their
 * templates are (become()): memory (remap.c), descriptors, signal handlers, credentials.  All of them
 * are tracees that rest in a parasite until everything is there.
 */
#include <errno.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/wait.h>

#include "restore.h"

#define TRIES 64
#define TRY_AGAIN_US 200
#define STEP_NS (5 * NS_PER_S)
#define FILES_SPARE 64
/* So many children have fd_channel of their own. */
#define FEW 2

struct forked {
	pid_t pid; /* 0: not made yet                                         */
	int pidfd;
	bool traced;
	struct syscall_batch batch;
	struct sandbox *sandbox; /* NULL: it is on its own, and waits to go            */
};

struct restore_tree {
	struct process *main;
	struct generation *generation;
	struct last_pid *helper;
	struct init_channel *channel;
	timer_t timer;
	const struct fd_table *table; /* by branch                            */
	struct copier *copier;
	struct fd_channel fd_channel; /* of the main process's children                  */
	uint64_t flush;               /* signals of children that ended (sigset_t)       */
	pid_t last_number;            /* the number given out last; 0: not known          */
	struct forked first;          /* the main process                              */
	struct forked *forked;        /* by branch                                   */
};

struct restore_tree *restore_tree_new(struct process *main, struct generation *generation,
				      struct last_pid *helper, struct init_channel *channel,
				      timer_t timer, const struct fd_table *table,
				      struct avc_error *err)
{
	struct restore_tree *restored = calloc(1, sizeof *restored);

	if (restored && restore_plan_begin(generation, 0, err) == 0)
		restored->copier = copier_new(err);
	if (restored && restored->copier)
		restored->forked = calloc(generation->branches + 1, sizeof *restored->forked);
	if (!restored || !restored->forked) {
		if (restored)
			copier_free(restored->copier);
		free(restored);
		fail_errno(err, 0, "restore", "calloc", "out of memory");
		return NULL;
	}
	restored->main = main;
	restored->generation = generation;
	restored->helper = helper;
	restored->channel = channel;
	restored->timer = timer;
	restored->table = table;
	restored->fd_channel = (struct fd_channel){ -1, -1 };
	restored->first.pidfd = restored->first.batch.socket = -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		restored->forked[i].pidfd = restored->forked[i].batch.socket = -1;
	return restored;
}

static struct forked *forked_of(struct restore_tree *restored, int branch)
{
	return branch < 0 ? &restored->first : &restored->forked[branch];
}

/* What is done while a process forks, which takes its time if it is big: how the child
 * will differ from it is found out, and its last child is made what it is to be. */
struct chores {
	struct restore_tree *restored;
	int child; /* -1: one that will be a zombie                            */
	int last;  /* -1: none                                               */
	struct avc_error error;
	int result;
	bool done;
};

/* Has ended, or will, and its parent is told. */
static void note_end(struct restore_tree *restored, const struct branch *branch)
{
	/* clone(2) takes any number of eight bits for a signal. */
	if (branch->exit_signal > 0 && branch->exit_signal < NSIG)
		restored->flush |= UINT64_C(1) << (branch->exit_signal - 1);
}

static void do_chores(void *arg);

/* One clone of a stopped task that rests in the parasite; *child is in its first stop. */
static int clone_task(struct syscall_batch *batch, struct inj_call *call, uint64_t flags,
		      struct chores *chores, pid_t *child, struct avc_error *err)
{
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, flags, 0, 0, 0, 0);
	if (parasite_send(batch->parasite, batch->pid, &batch->base, call, err) ||
	    parasite_run_clone_while(batch->pid, call, chores ? do_chores : NULL, chores, child,
				     err))
		return -1;
	if (tracee_settle(batch->pid, err) || tracee_await(*child, NULL, err) != STOP_TRAP)
		return -1;
	if (parasite_own(batch->parasite, *child))
		return fail_errno(err, *child, "restore", "ptrace(SETOPTIONS)", "it was killed");
	return 0;
}

/* A child of the host's that came to nothing, or was only in between. */
static int take_back(struct syscall_batch *host, pid_t child, struct avc_error *err)
{
	const pid_t inside = proc_inside(child);

	tracee_kill(child);
	if (inside <= 0)
		return 0; /* nobody had to wait for it */
	syscall_batch_add(host, SYS_wait4, (uint64_t)inside, 0, __WALL, 0, 0, 0);
	syscall_batch_soften(host, NULL);
	return syscall_batch_flush(host, err);
}

/* A child of the host's, with the number if nobody else has taken it.  `copy`: a child of the
 * host's that is as it came out of fork(2), and gives its memory to this one; 0: there is none. */
static int fork_once(struct restore_tree *restored, struct forked *host,
		     const struct branch *branch, pid_t copy, struct chores *chores, pid_t *child,
		     struct avc_error *err)
{
	struct inj_call *runner = &host->batch.parasite->control->runner;
	const bool orphan = branch->parent == PARENT_INIT;
	/* Siblings' numbers often follow each other; to ask takes two wake-ups. */
	const bool follows = !orphan && restored->last_number &&
			     restored->last_number + 1 == branch->inside;
	struct syscall_batch from = host->batch;
	int result;

	restored->last_number = 0;
	/* An orphan's parent has ended: so does one that is there for that. */
	if (orphan &&
	    clone_task(&host->batch, runner, CLONE_VM | CLONE_FILES, NULL, &from.pid, err))
		return -1;
	if (copy)
		from.pid = copy;
	result = (!follows && last_pid_set(restored->helper, branch->inside - 1, err)) ||
		 clone_task(&from, runner,
			    ((uint64_t)branch->exit_signal & CSIGNAL) |
				    (copy ? CLONE_VM | CLONE_PARENT : 0),
			    chores, child, err);
	if (orphan && take_back(&host->batch, from.pid, err))
		return -1;
	return result ? -1 : 0;
}

/* Who was killed between making it and telling us has left it in the way. */
static int take_back_untold(struct syscall_batch *host, pid_t inside, struct avc_error *err)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(host->pid, children, CHILDREN_MAX);

	for (int i = 0; i < count; i++)
		if (proc_inside(children[i]) == inside && tracee_is_ours(children[i]))
			return take_back(host, children[i], err);
	return 0;
}

/* Until it has the number.  The kernel gives it one at the end of the fork (kernel/fork.c,
 * copy_process()), when everything is copied: what is big may never get it where others fork all
 * the time.  So the first that has another one is kept as a copy.  To give its memory away takes
 * no time. */
static int fork_host(struct restore_tree *restored, struct forked *host,
		     const struct branch *branch, struct chores *chores, pid_t *child,
		     struct avc_error *err)
{
	const bool orphan = branch->parent == PARENT_INIT;
	pid_t copy = 0;

	for (int i = 0; i < TRIES; i++) {
		struct avc_error failed = { 0 };
		bool made;

		if (i)
			usleep(TRY_AGAIN_US);
		if (i)
			note_end(restored, branch);
		*child = 0;
		made = fork_once(restored, host, branch, copy, chores, child, &failed) == 0;
		if (made && proc_inside(*child) == branch->inside) {
			restored->last_number = branch->inside;
			return copy ? take_back(&host->batch, copy, err) : 0;
		}
		if (made && !copy && !orphan) {
			copy = *child;
			continue;
		}
		if (!made && !*child && !copy) {
			*err = failed;
			return -1;
		}
		if (*child && orphan)
			tracee_kill(*child); /* init's */
		else if (*child && take_back(&host->batch, *child, err))
			return -1;
		if (made)
			continue;
		/* One of them was killed, or is one too many where processes are limited. */
		if ((copy && take_back(&host->batch, copy, err)) ||
		    take_back_untold(&host->batch, branch->inside, err))
			return -1;
		copy = 0;
	}
	return fail(err, AVC_KERNEL, EEXIST, branch->inside, "restore", "clone",
		    "PID %d is taken by somebody else", branch->inside);
}

/* Ended, and not waited for: it ends again, and nobody waits for it. */
static int make_zombie(struct forked *forked, const struct branch *branch, struct avc_error *err)
{
	const int signal = WIFSIGNALED(branch->status) ? WTERMSIG(branch->status) : 0;
	const struct rlimit none = { 0, 0 };
	const uint64_t open_mask = 0;
	struct syscall_batch *batch = &forked->batch;
	avc_remote remote;
	uint8_t *data = syscall_batch_data(batch, &remote);

	memset(data, 0, 64);
	memcpy(data + 32, branch->name, sizeof branch->name);
	syscall_batch_add(batch, SYS_prctl, PR_SET_NAME, remote + 32, 0, 0, 0, 0);
	if (signal) {
		syscall_batch_add(batch, SYS_rt_sigaction, (uint64_t)signal, remote, 0, 8, 0, 0);
		syscall_batch_soften(batch, NULL); /* nobody may change that of SIGKILL */
		if (syscall_batch_flush(batch, err))
			return -1;
		prlimit(batch->pid, RLIMIT_CORE, &none, NULL);
		if (ptrace(PTRACE_SETSIGMASK, batch->pid, sizeof open_mask, &open_mask))
			return fail_errno(err, batch->pid, "restore", "ptrace(SETSIGMASK)",
					  "it was killed");
		kill(batch->pid, signal);
	} else {
		syscall_batch_add(batch, SYS_exit_group, (uint64_t)WEXITSTATUS(branch->status), 0,
				  0, 0, 0, 0);
		call_begin(batch->call, INJ_AFTER_PARK);
		call_add(batch->call, INJ_LIST, parasite_remote(batch->parasite, batch->list),
			 batch->listed, 0, 0, 0);
		batch->listed = 0;
		if (parasite_send(batch->parasite, batch->pid, &batch->base, batch->call, err))
			return -1;
	}
	if (seccomp_go_on(batch->pid, NULL))
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

/* Session and group before it has children of its own.  What it has from its parent is
 * right as a rule. */
static int place(struct forked *forked, const struct branch *branch, struct avc_error *err)
{
	struct syscall_batch *batch = &forked->batch;
	struct proc_stat stat;

	if (proc_stat(batch->pid, &stat))
		return fail_errno(err, batch->pid, "restore", "open(stat)", "it was killed");
	if (branch->session == branch->inside) {
		syscall_batch_add(batch, SYS_setsid, 0, 0, 0, 0, 0, 0);
	} else {
		if (branch->session > 0 && proc_inside(stat.session) != branch->session)
			fail(batch->notes, AVC_UNSUPPORTED, 0, branch->inside, "restore", "",
			     "process %d is not in the session it was in, whose leader is gone",
			     branch->inside);
		if (branch->group == branch->inside)
			syscall_batch_add(batch, SYS_setpgid, 0, 0, 0, 0, 0, 0);
	}
	return 0;
}

/* The leader of a session gets its terminal before it has children, who inherit it. */
static void take_terminal(struct syscall_batch *batch, const struct branch *branch)
{
	const int fd = files_find_device(branch->image->files, branch->image->stat.tty);

	if (!branch->image->stat.tty || branch->session != branch->inside)
		return;
	syscall_batch_add(batch, SYS_ioctl, (uint64_t)fd, TIOCSCTTY, 0, 0, 0, 0);
	syscall_batch_soften(batch, "the session that it leads has lost its terminal");
}

/* Whoever was in the foreground is there again; asked for by anybody in the session. */
static int put_foreground(struct syscall_batch *batch, const struct generation *image,
			  struct avc_error *err)
{
	const int fd = files_find_device(image->files, image->stat.tty);
	avc_remote remote;
	pid_t *group = syscall_batch_data(batch, &remote);

	if (!image->stat.tty || image->tty_group <= 0 || fd < 0)
		return 0;
	*group = image->tty_group;
	syscall_batch_add(batch, SYS_ioctl, (uint64_t)fd, TIOCSPGRP, remote, 0, 0, 0);
	syscall_batch_soften(batch, NULL);
	return syscall_batch_flush(batch, err);
}

/* When all are there: into groups that others lead. */
static int join_group(struct forked *forked, const struct branch *branch, struct avc_error *err)
{
	struct syscall_batch *batch = &forked->batch;
	struct proc_stat stat;

	if (proc_stat(batch->pid, &stat))
		return fail_errno(err, batch->pid, "restore", "open(stat)", "it was killed");
	if (branch->group <= 0 || branch->group == branch->inside ||
	    proc_inside(stat.group) == branch->group)
		return 0;
	syscall_batch_add(batch, SYS_setpgid, 0, (uint64_t)branch->group, 0, 0, 0, 0);
	syscall_batch_soften(batch,
			     "it is not in the process group it was in, whose leader is gone");
	return syscall_batch_flush(batch, err);
}

static int become(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	struct branch *branch = &restored->generation->branch[index];
	struct forked *forked = &restored->forked[index];
	struct syscall_batch *batch = &forked->batch;
	const struct remap *plan = restore_plan_of(restored->generation, index, err);
	const bool is_mains = restore_plan_host(restored->generation, index) == PARENT_MAIN;

	if (!plan ||
	    syscall_batch_open_fd_channel(batch, is_mains ? &restored->fd_channel : NULL, err))
		return -1;
	if (syscall_batch_change_parasite(batch, branch->process, branch->image->slot, err) ||
	    process_attrs_take_keys(batch, err) ||
	    remap_apply(plan, batch, restored->copier, err) ||
	    process_attrs_put(batch, branch, err) || place(forked, branch, err) ||
	    syscall_batch_put_files(batch, &restored->table[index], err))
		return -1;
	take_terminal(batch, branch);
	if (syscall_batch_flush(batch, err))
		return -1;
	close_fd(&batch->socket);
	return 0;
}

static void do_chores(void *arg)
{
	struct chores *chores = arg;
	struct restore_tree *restored = chores->restored;

	if (chores->done)
		return; /* the number was not the right one */
	chores->done = true;
	if (chores->child >= 0 &&
	    !restore_plan_of(restored->generation, (uint32_t)chores->child, &chores->error))
		chores->result = -1;
	else if (chores->last >= 0)
		chores->result = become(restored, (uint32_t)chores->last, &chores->error);
}

/* How long all of it takes depends on how much there is: deadlines are for each step. */
static void go_on(struct restore_tree *restored)
{
	tracee_deadline_set(restored->timer, STEP_NS);
	init_channel_working(restored->channel);
}

static int finish_copies(struct restore_tree *restored, struct avc_error *err)
{
	while (copier_help(restored->copier))
		go_on(restored);
	return copier_finish(restored->copier, err);
}

/* What it has open is below that, with some for those that are only on their way. */
static uint32_t files_of(const struct restore_tree *restored, uint32_t index)
{
	const struct fd_table *table = &restored->table[index];

	return (table->count ? (uint32_t)table->entry[table->count - 1].fd : 0) + FILES_SPARE;
}

/* `last` is the one that was forked last and is not yet what it is to be; -1: none. */
static int make_member(struct restore_tree *restored, uint32_t index, int *last,
		       struct avc_error *err)
{
	const struct branch *branch = &restored->generation->branch[index];
	const int host = restore_plan_host(restored->generation, index);
	struct forked *forked = &restored->forked[index], *by = forked_of(restored, host);
	struct chores chores = { .restored = restored };

	go_on(restored);
	/* It has to be itself before it has children. */
	if (*last >= 0 && host == *last) {
		if (become(restored, (uint32_t)*last, err))
			return -1;
		*last = -1;
	}
	/* ... and have all its memory. */
	if (host >= 0 && finish_copies(restored, err))
		return -1;
	chores.child = branch->process ? (int)index : -1;
	chores.last = *last;
	*last = -1;
	if (fork_host(restored, by, branch, &chores, &forked->pid, err))
		return -1;
	forked->traced = true;
	forked->batch = by->batch;
	forked->batch.pid = forked->pid;
	forked->batch.inside = branch->inside;
	forked->batch.socket = -1;
	forked->pidfd = proc_pidfd_open(forked->pid);
	if (forked->pidfd < 0)
		return fail_errno(err, forked->pid, "restore", "pidfd_open", "it was killed");
	if (chores.result) {
		*err = chores.error;
		return -1;
	}
	if (branch->process) {
		process_attrs_lift_limits(forked->pid, branch, files_of(restored, index));
		*last = (int)index;
		return 0;
	}
	return place(forked, branch, err) || syscall_batch_flush(&forked->batch, err) ? -1 : 0;
}

/* When nobody is to join a group that they lead any more. */
static int end_zombies(struct restore_tree *restored, struct avc_error *err)
{
	for (uint32_t i = 0; i < restored->generation->branches; i++) {
		const struct branch *branch = &restored->generation->branch[i];
		struct forked *forked = &restored->forked[i];

		if (branch->process)
			continue;
		note_end(restored, branch);
		if (make_zombie(forked, branch, err))
			return -1;
		forked->traced = false;
	}
	return 0;
}

/* Those that have ended again have told their parents, who know it already. */
static int flush_signals(struct restore_tree *restored, struct syscall_batch *batch,
			 struct avc_error *err)
{
	avc_remote remote;
	uint64_t *data;

	do {
		data = syscall_batch_data(batch, &remote);
		data[0] = restored->flush;
		data[1] = data[2] = 0;
		syscall_batch_add(batch, SYS_rt_sigtimedwait, remote, 0, remote + 8, 8, 0, 0);
		syscall_batch_soften(batch, NULL);
		if (syscall_batch_flush(batch, err))
			return -1;
	} while (batch->list[0].result > 0);
	return 0;
}

int restore_tree_make(struct restore_tree *restored, pid_t main_pid, struct avc_error *notes,
		      struct avc_error *err)
{
	struct generation *generation = restored->generation;
	struct inj_slot *slot = parasite_slot(&restored->main->parasite, generation->slot);
	struct forked *first = &restored->first;
	int last = -1;

	first->pid = first->batch.pid = main_pid;
	first->traced = true;
	first->pidfd = proc_pidfd_open(main_pid);
	first->batch.inside = slot->pid;
	first->batch.notes = notes;
	syscall_batch_enter(&first->batch, &restored->main->parasite, generation->slot);
	if (first->pidfd < 0 || parasite_own(&restored->main->parasite, main_pid) ||
	    arch_regs_get(main_pid, &first->batch.base))
		return fail_errno(err, main_pid, "restore", "ptrace(GETREGS)", "it was killed");
	if (slot->session_leader)
		syscall_batch_add(&first->batch, SYS_setsid, 0, 0, 0, 0, 0, 0);
	else
		syscall_batch_add(&first->batch, SYS_setpgid, 0, (uint64_t)slot->group, 0, 0, 0, 0);
	if (syscall_batch_flush(&first->batch, err))
		return -1;
	slot->placed = 1;
	restored->last_number = slot->pid;
	if (generation->branches > FEW &&
	    syscall_batch_share_fd_channel(&first->batch, &restored->fd_channel, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (make_member(restored, i, &last, err))
			return -1;
	if (last >= 0 && become(restored, (uint32_t)last, err))
		return -1;
	if (syscall_batch_unshare_fd_channel(&first->batch, &restored->fd_channel, err))
		return -1;
	if (finish_copies(restored, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (join_group(&restored->forked[i], &generation->branch[i], err))
			return -1;
	if (end_zombies(restored, err))
		return -1;
	for (int i = -1; i < (int)generation->branches; i++)
		if ((i < 0 || (generation->branch[i].process &&
			       generation->branch[i].session == generation->branch[i].inside)) &&
		    put_foreground(&forked_of(restored, i)->batch,
				   i < 0 ? generation : generation->branch[i].image, err))
			return -1;
	for (int i = -1; restored->flush && i < (int)generation->branches; i++)
		if ((i < 0 || generation->branch[i].process) &&
		    flush_signals(restored, &forked_of(restored, i)->batch, err))
			return -1;
	return 0;
}

/* ---- off they go ------------------------------------------------------------------------- */

static int start_member(struct restore_tree *restored, uint32_t index, struct avc_error *err)
{
	struct branch *branch = &restored->generation->branch[index];
	struct forked *forked = &restored->forked[index];

	if (restore_start(branch->process, branch->image, restored->helper, forked->pid,
			  &forked->sandbox, err))
		return -1;
	forked->traced = false;
	return 0;
}

static int await_member(struct restore_tree *restored, uint32_t index, struct avc_error *notes,
			struct avc_error *err)
{
	struct branch *branch = &restored->generation->branch[index];
	struct forked *forked = &restored->forked[index];

	if (restore_await(branch->process, branch->image, forked->pid, forked->sandbox, err))
		return -1;
	restore_note(branch->process, branch->image, forked->pid, notes);
	return memory_put_back(branch->process, branch->image, forked->pid, notes, err);
}

/* It asks nothing of us while it puts itself together: no numbers for threads, no
 * permission for calls. */
static bool is_on_its_own(const struct generation *image)
{
	return image->threads == 1 && !image->sandboxed && !image->stop_signal;
}

int restore_tree_start(struct restore_tree *restored, struct avc_error *notes,
		       struct avc_error *err)
{
	const struct generation *generation = restored->generation;

	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process && is_on_its_own(generation->branch[i].image) &&
		    start_member(restored, i, err))
			return -1;
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process &&
		    ((!is_on_its_own(generation->branch[i].image) &&
		      start_member(restored, i, err)) ||
		     await_member(restored, i, notes, err)))
			return -1;
	return 0;
}

void restore_tree_go(struct restore_tree *restored)
{
	/* First those that are stopped: their parents know it. */
	for (int stopped = 1; stopped >= 0; stopped--)
		for (uint32_t i = 0; i < restored->generation->branches; i++) {
			struct branch *branch = &restored->generation->branch[i];

			if (branch->process && !branch->image->stop_signal == !stopped)
				restore_go(branch->process, branch->image,
					   restored->forked[i].sandbox);
		}
}

pid_t restore_tree_pid(const struct restore_tree *restored, uint32_t branch)
{
	return restored->forked[branch].pid;
}

static void kill_member(struct forked *forked)
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
	for (uint32_t i = restored->generation->branches; i-- > 0;)
		kill_member(&restored->forked[i]);
	kill_member(&restored->first);
	for (uint32_t i = 0; i < restored->generation->branches; i++) {
		struct pollfd gone = { .fd = restored->forked[i].pidfd, .events = POLLIN };

		if (gone.fd >= 0)
			poll(&gone, 1, 1000);
	}
}

void restore_tree_free(struct restore_tree *restored)
{
	if (!restored)
		return;
	for (uint32_t i = 0; i < restored->generation->branches; i++) {
		close_fd(&restored->forked[i].pidfd);
		close_fd(&restored->forked[i].batch.socket);
	}
	copier_free(restored->copier);
	close_fd(&restored->fd_channel.ours);
	close_fd(&restored->first.pidfd);
	free(restored->forked);
	free(restored);
}
