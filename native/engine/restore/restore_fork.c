/* SPDX-License-Identifier: Apache-2.0
 *
 * A restored process forks another one: under its PID, and in its session (places.c).
 */
#include <errno.h>
#include <signal.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "restore_tree.h"

#define TRIES 64
#define TRY_AGAIN_US 200

/* A process to be forked, and its parents. */
struct birth {
	struct restore_tree *restored;
	struct forked *host; /* its parent, unless it is an orphan */
	struct forked *by;   /* that one, or a keeper of it                          */
	pid_t number;
	int exit_signal;
	bool orphan;
	/* What to do meanwhile; NULL: nothing. */
	void (*meanwhile)(void *arg);
	void *arg;
};

void restore_fork_note(struct restore_tree *restored, int exit_signal)
{
	/* clone(2) takes any number of eight bits for a signal. */
	if (exit_signal > 0 && exit_signal < NSIG)
		restored->flush |= UINT64_C(1) << (exit_signal - 1);
}

/* One clone of a stopped task that rests in the parasite; *child is in its first stop. */
static int clone_task(struct syscall_batch *batch, struct inj_call *call, uint64_t flags,
		      const struct birth *birth, pid_t *child, struct avc_error *err)
{
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, flags);
	if (syscall_batch_send(batch, call, err) ||
	    parasite_run_clone_while(batch->pid, call, birth ? birth->meanwhile : NULL,
				     birth ? birth->arg : NULL, child, err))
		return -1;
	if (tracee_settle(batch->pid, err) || tracee_await(*child, NULL, err) != STOP_TRAP)
		return -1;
	if (parasite_own(batch->parasite, *child))
		return fail_errno(err, *child, "restore", "ptrace(SETOPTIONS)", "it was killed");
	return 0;
}

/* Removes a child of the host that failed, or was only intermediate. */
static int take_back(struct syscall_batch *host, pid_t child, struct avc_error *err)
{
	const pid_t inside = proc_inside(child);

	tracee_kill(child);
	if (inside <= 0)
		return 0; /* it needs no wait(2) */
	syscall_batch_add(host, SYS_wait4, (uint64_t)inside, 0, __WALL);
	syscall_batch_soften(host, NULL);
	return syscall_batch_flush(host, err);
}

/* A child, with the wanted PID unless another process has taken it.  `copy`: a child of the host,
 * fresh from fork(2), which gives its memory to this one; 0: none. */
static int fork_once(const struct birth *birth, pid_t copy, pid_t *child, struct avc_error *err)
{
	struct restore_tree *restored = birth->restored;
	struct syscall_batch *by = &birth->by->batch;
	struct inj_call *runner = &by->parasite->control->runner;
	/* Siblings' PIDs are often consecutive; a request takes two wake-ups. */
	const bool follows = !birth->orphan && restored->last_number &&
			     restored->last_number + 1 == birth->number;
	const bool sibling = copy || (birth->by != birth->host && !birth->orphan);
	struct syscall_batch from = *by;
	int result;

	restored->last_number = 0;
	/* An orphan's parent has exited: so does an intermediate one. */
	if (birth->orphan && clone_task(by, runner, CLONE_VM | CLONE_FILES, NULL, &from.pid, err))
		return -1;
	if (copy)
		from.pid = copy;
	result = (!follows && last_pid_set(restored->restore->helper, birth->number - 1, err)) ||
		 clone_task(&from, runner,
			    ((uint64_t)birth->exit_signal & CSIGNAL) | (copy ? CLONE_VM : 0) |
				    (sibling ? CLONE_PARENT : 0),
			    birth, child, err);
	if (birth->orphan && take_back(by, from.pid, err))
		return -1;
	return result ? -1 : 0;
}

/* A parent that was killed after it had forked the child, and before it was reported, left it
 * behind. */
static int take_back_untold(struct syscall_batch *host, pid_t inside, struct avc_error *err)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(host->pid, children, CHILDREN_MAX);

	for (int i = 0; i < count; i++)
		if (proc_inside(children[i]) == inside && tracee_is_ours(children[i]))
			return take_back(host, children[i], err);
	return 0;
}

/* Until it has the PID. The kernel assigns it at the end of the fork (kernel/fork.c,
 * copy_process()), when everything is copied: a big process may never get it where others fork all
 * the time.  So the first with another PID is kept as a copy.  Handing over its memory takes no
 * time. */
static int give_birth(const struct birth *birth, pid_t *child, struct avc_error *err)
{
	struct restore_tree *restored = birth->restored;
	struct syscall_batch *host = &birth->host->batch;
	pid_t copy = 0;

	for (int i = 0; i < TRIES; i++) {
		struct avc_error failed = { 0 };
		bool made;

		if (i)
			usleep(TRY_AGAIN_US);
		if (i)
			restore_fork_note(restored, birth->exit_signal);
		*child = 0;
		made = fork_once(birth, copy, child, &failed) == 0;
		if (made && proc_inside(*child) == birth->number) {
			restored->last_number = birth->number;
			return copy ? take_back(host, copy, err) : 0;
		}
		if (made && !copy && !birth->orphan) {
			copy = *child;
			continue;
		}
		if (!made && !*child && !copy) {
			*err = failed;
			return -1;
		}
		if (*child && birth->orphan)
			tracee_kill(*child); /* init's */
		else if (*child && take_back(host, *child, err))
			return -1;
		if (made)
			continue;
		/* One of them was killed, or exceeds a limit on processes. */
		if ((copy && take_back(host, copy, err)) ||
		    take_back_untold(host, birth->number, err))
			return -1;
		copy = 0;
	}
	return fail(err, AVC_KERNEL, EEXIST, birth->number, "restore", "clone",
		    "PID %d is taken by somebody else", birth->number);
}

/* ---- keepers ---------------------------------------------------------------------------------- */

static struct keeper *add_keeper(struct restore_tree *restored, uint32_t host, pid_t session,
				 pid_t pid, struct avc_error *err)
{
	struct keeper *keeper;

	if (!make_room(&restored->keeper, restored->keepers, &restored->keeper_room,
		       sizeof *restored->keeper)) {
		tracee_kill(pid);
		fail_errno(err, pid, "restore", "realloc", "out of memory");
		return NULL;
	}
	keeper = &restored->keeper[restored->keepers++];
	*keeper = (struct keeper){ host, session, restored->forked[host] };
	keeper->task.pid = keeper->task.batch.pid = pid;
	keeper->task.batch.inside = proc_inside(pid);
	keeper->task.batch.socket = keeper->task.pidfd = -1;
	return keeper;
}

static pid_t highest_number(const struct generation *generation)
{
	pid_t highest = 0;

	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].inside > highest)
			highest = generation->image[i].inside;
	return highest;
}

int restore_fork_keeper(struct restore_tree *restored, uint32_t index, pid_t session,
			struct avc_error *err)
{
	struct syscall_batch *batch = &restored->forked[index].batch;
	pid_t pid = 0;

	/* Moved away from PIDs still needed. */
	restored->last_number = 0;
	if (last_pid_set(restored->restore->helper, highest_number(restored->generation), err))
		return -1;

	if (syscall_batch_flush(batch, err) ||
	    clone_task(batch, &batch->parasite->control->runner, CLONE_VM | CLONE_FILES | SIGCHLD,
		       NULL, &pid, err))
		return -1;
	return add_keeper(restored, index, session, pid, err) ? 0 : -1;
}

/* With the PID of a leader that is gone. */
static struct keeper *renew(struct restore_tree *restored, uint32_t host, pid_t number, bool group,
			    struct avc_error *err)
{
	const struct birth birth = { .restored = restored,
				     .host = &restored->forked[host],
				     .by = &restored->forked[host],
				     .number = number,
				     .exit_signal = group ? 0 : SIGCHLD };
	struct keeper *keeper;
	pid_t pid;

	if (give_birth(&birth, &pid, err))
		return NULL;
	keeper = add_keeper(restored, host, group ? PLACE_ANY : number, pid, err);
	if (!keeper)
		return NULL;
	syscall_batch_add(&keeper->task.batch, group ? SYS_setpgid : SYS_setsid);
	return syscall_batch_flush(&keeper->task.batch, err) ? NULL : keeper;
}

int restore_fork_group(struct restore_tree *restored, uint32_t index, pid_t group,
		       struct avc_error *err)
{
	return renew(restored, index, group, true, err) ? 0 : -1;
}

/* The process that forks it: its host, if that is in the session, or a keeper. */
static struct forked *maker_of(struct restore_tree *restored, const struct place *place,
			       struct avc_error *err)
{
	struct keeper *keeper;

	if (place->born == PLACE_ANY ||
	    place->born == restored->generation->image[place->host].session)
		return &restored->forked[place->host];
	for (uint32_t i = 0; i < restored->keepers; i++)
		if (restored->keeper[i].host == place->host &&
		    restored->keeper[i].session == place->born)
			return &restored->keeper[i].task;
	keeper = renew(restored, place->host, place->born, false, err);
	return keeper ? &keeper->task : NULL;
}

int restore_fork(struct restore_tree *restored, uint32_t index, void (*meanwhile)(void *arg),
		 void *arg, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	const struct place *place = restore_plan_place(restored->generation, index);
	struct birth birth = { .restored = restored,
			       .host = &restored->forked[place->host],
			       .by = maker_of(restored, place, err),
			       .number = image->inside,
			       .exit_signal = image->exit_signal,
			       .orphan = image->parent == PARENT_INIT,
			       .meanwhile = meanwhile,
			       .arg = arg };

	return birth.by ? give_birth(&birth, &restored->forked[index].pid, err) : -1;
}

int restore_fork_end(struct restore_tree *restored, struct avc_error *err)
{
	while (restored->keepers) {
		const struct keeper *keeper = &restored->keeper[--restored->keepers];

		if (keeper->session != PLACE_ANY)
			restore_fork_note(restored, SIGCHLD);
		if (take_back(&restored->forked[keeper->host].batch, keeper->task.pid, err))
			return -1;
	}
	return 0;
}

void restore_fork_kill(struct restore_tree *restored)
{
	while (restored->keepers)
		tracee_kill(restored->keeper[--restored->keepers].task.pid);
}
