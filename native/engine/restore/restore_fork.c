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

#define TRY_AGAIN_US 200
/* Calls of a parent for one fork: it closes a socket, receives one, and forks. */
#define FORK_CALLS 3
/* Children of one parent that make their own channels. */
#define FEW 2

/* A process to be forked, and its parents. */
struct birth {
	struct restore_tree *restored;
	struct forked *host; /* its parent, unless it is an orphan */
	struct forked *by;   /* that one, or a keeper of it                          */
	pid_t number;
	int exit_signal;
	uint64_t shared; /* struct image                                      */
	bool orphan;
	/* A child of the host, fresh from fork(2), which gives its memory to this one; 0: none. */
	pid_t copy;
	/* What to do meanwhile; NULL: nothing. */
	void (*meanwhile)(void *arg);
	void *arg;
};

static uint64_t flags_of(const struct birth *birth)
{
	return ((uint64_t)birth->exit_signal & CSIGNAL) | birth->shared;
}

void restore_fork_note(struct forked *parent, int exit_signal)
{
	/* clone(2) takes any number of eight bits for a signal. */
	if (exit_signal > 0 && exit_signal < NSIG)
		parent->flush |= UINT64_C(1) << (exit_signal - 1);
}

int restore_fork_await(struct forked *forked, struct avc_error *err)
{
	if (!forked->fresh)
		return 0;
	forked->fresh = false;
	if (tracee_await(forked->pid, NULL, err) != STOP_TRAP)
		return -1;
	return parasite_own(forked->batch.parasite, forked->pid)
		       ? fail_errno(err, forked->pid, "restore", "ptrace(SETOPTIONS)",
				    "it was killed")
		       : 0;
}

int restore_fork_rest(struct forked *forked, struct avc_error *err)
{
	const struct syscall_batch *batch = &forked->batch;
	struct inj_call *runner;

	if (!forked->forking)
		return 0;
	forked->forking = false;
	if (forked->passed < 0)
		return tracee_settle(batch->pid, err);
	runner = &batch->parasite->control->runner;
	call_add(runner, SYS_close, (uint64_t)forked->passed);
	forked->passed = -1;
	return parasite_run(batch->pid, runner, err);
}

/* ---- one fork after the other ----------------------------------------------------------------- */

static uint32_t children_of(const struct restore_tree *restored, const struct forked *host)
{
	uint32_t children = 0;

	for (uint32_t i = 1; i < restored->generation->images; i++)
		children += restored->generation->image[i].process &&
			    &restored->forked[restore_plan_place(restored->generation, i)->host] ==
				    host;
	return children;
}

/* It begins a list of forks, or goes on with it. */
static int list_fork(const struct restore_tree *restored, struct forked *host, uint64_t flags,
		     struct fd_channel *passed, struct avc_error *err)
{
	struct syscall_batch *by = &host->batch;
	struct inj_call *runner = &by->parasite->control->runner;

	if (host->forking && host->calls + FORK_CALLS >= INJ_CALLS_MAX &&
	    restore_fork_rest(host, err))
		return -1;
	if (!host->asked) {
		host->asked = true;
		/* On a busy machine it would compete with its own children, too. */
		boost_begin(by->pid);
		if (children_of(restored, host) > FEW &&
		    syscall_batch_share_fd_channel(by, &host->channel, err))
			return -1;
	}
	if (!host->forking) {
		call_begin(runner, INJ_AFTER_PARK);
		host->calls = 0;
		if (syscall_batch_send(by, runner, err))
			return -1;
	}
	if (host->passed >= 0)
		call_add(runner, SYS_close, (uint64_t)host->passed);
	host->passed = -1;
	syscall_batch_pass_socket(&host->channel, by->parasite, runner, passed);
	call_add(runner, SYS_clone, flags);
	host->calls += FORK_CALLS;
	return 0;
}

/* A child of its own, in its session.  Only the event of the fork is awaited: neither does the
 * parent stop once more before its next fork, nor is the child's stop awaited here. */
static int fork_next(const struct birth *birth, struct forked *forked, struct avc_error *err)
{
	struct restore_tree *restored = birth->restored;
	struct forked *host = birth->host;
	const struct inj_call *runner = &host->batch.parasite->control->runner;
	const bool follows = restored->last_number && restored->last_number + 1 == birth->number;

	if (list_fork(restored, host, flags_of(birth), &forked->inherited, err) ||
	    (!follows && last_pid_set(restored->restore->helper, birth->number - 1, err)))
		return -1;
	/* Unless another task is cloned meanwhile (restore_fork_keeper()). */
	restored->last_number = birth->number;
	/* If that is refused, it rests. */
	host->forking = false;
	if (parasite_run_clone_while(host->batch.pid, runner, birth->meanwhile, birth->arg,
				     &forked->pid, err))
		return -1;
	host->forking = forked->fresh = forked->traced = true;
	syscall_batch_note_passed(runner, &forked->inherited);
	host->passed = forked->inherited.theirs;
	return 0;
}

/* ---- any fork --------------------------------------------------------------------------------- */

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

/* A child, with the wanted PID unless another process has taken it. */
static int fork_once(const struct birth *birth, pid_t *child, struct avc_error *err)
{
	struct restore_tree *restored = birth->restored;
	struct syscall_batch *by = &birth->by->batch;
	struct inj_call *runner = &by->parasite->control->runner;
	/* Siblings' PIDs are often consecutive; a request takes two wake-ups. */
	const bool follows = !birth->orphan && restored->last_number &&
			     restored->last_number + 1 == birth->number;
	const bool sibling = birth->copy || (birth->by != birth->host && !birth->orphan);
	struct syscall_batch from = *by;
	int result;

	restored->last_number = 0;
	/* An orphan's parent has exited: so does an intermediate one. */
	if (birth->orphan &&
	    clone_task(by, runner, CLONE_VM | CLONE_FILES | birth->shared, NULL, &from.pid, err))
		return -1;
	if (birth->copy)
		from.pid = birth->copy;
	result = (!follows && last_pid_set(restored->restore->helper, birth->number - 1, err)) ||
		 clone_task(&from, runner,
			    flags_of(birth) | (birth->copy ? CLONE_VM : 0) |
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

/* Until it has the PID, which a dead process has until init gets a CPU to reap it.  The kernel
 * assigns it at the end of the fork (kernel/fork.c, copy_process()), when everything is copied: a big
 * process may never get it where others fork all the time.  So the first with another PID is kept as
 * a copy.  Handing over its memory takes no time. */
static int give_birth(struct birth *birth, pid_t *child, struct avc_error *err)
{
	struct restore_tree *restored = birth->restored;
	struct syscall_batch *host = &birth->host->batch;
	const struct restore *restore = restored->restore;
	uint64_t since = now_ns();

	for (bool again = birth->copy;
	     !again || restore_number_gets_free(restore, birth->number, &since); again = true) {
		struct avc_error failed = { 0 };
		bool made;

		if (again) {
			restore_go_on(restore);
			usleep(TRY_AGAIN_US);
			restore_fork_note(birth->host, birth->exit_signal);
		}
		*child = 0;
		made = fork_once(birth, child, &failed) == 0;
		if (made && proc_inside(*child) == birth->number) {
			restored->last_number = birth->number;
			return birth->copy ? take_back(host, birth->copy, err) : 0;
		}
		last_pid_free(restore->helper);
		if (made && !birth->copy && !birth->orphan) {
			birth->copy = *child;
			continue;
		}
		if (!made && !*child && !birth->copy) {
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
		if ((birth->copy && take_back(host, birth->copy, err)) ||
		    take_back_untold(host, birth->number, err))
			return -1;
		birth->copy = 0;
	}
	return restore_fail_taken(restore->channel->init, birth->number, err);
}

/* ---- keepers ---------------------------------------------------------------------------------- */

static struct keeper *add_keeper(struct restore_tree *restored, uint32_t host, pid_t session,
				 pid_t pid, struct avc_error *err)
{
	struct keeper *keeper;

	if (!make_room(&restored->keeper, restored->keepers, &restored->keeper_room,
		       sizeof *restored->keeper)) {
		tracee_kill(pid);
		fail_memory(err, pid, "restore");
		return NULL;
	}
	keeper = &restored->keeper[restored->keepers++];
	*keeper = (struct keeper){ host, session, restored->forked[host] };
	keeper->task.forking = false;
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
	    clone_task(batch, &batch->parasite->control->runner,
		       CLONE_VM | CLONE_FILES | CLONE_FS | SIGCHLD, NULL, &pid, err))
		return -1;
	return add_keeper(restored, index, session, pid, err) ? 0 : -1;
}

/* With the PID of a leader that is gone. */
static struct keeper *renew(struct restore_tree *restored, uint32_t host, pid_t number, bool group,
			    struct avc_error *err)
{
	struct birth birth = { .restored = restored,
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

/* In its host's session, and by that itself; otherwise by a keeper, or by an intermediate task. */
static bool is_plain(const struct generation *generation, uint32_t index)
{
	const struct place *place = restore_plan_place(generation, index);

	return generation->image[index].parent != PARENT_INIT && place->host == place->memory &&
	       (place->born == PLACE_ANY || place->born == generation->image[place->host].session);
}

/* Returns whether it has its PID; what it has inherited is noted. */
static bool has_number(struct forked *forked, pid_t number)
{
	struct proc_status status;

	if (proc_status(forked->pid, &status) || status.inside != number)
		return false;
	forked->group = status.group;
	forked->session = status.session;
	return true;
}

/* Its PID was taken: it serves as a copy, if nobody has killed it. */
static pid_t keep_copy(const struct birth *birth, struct forked *forked, struct avc_error *err)
{
	struct avc_error gone = { 0 };
	const pid_t copy = forked->pid;

	forked->traced = false;
	if (restore_fork_await(forked, &gone) == 0)
		return copy;
	restore_fork_note(birth->host, birth->exit_signal);
	return take_back(&birth->host->batch, copy, err) ? -1 : 0;
}

int restore_fork(struct restore_tree *restored, uint32_t index, void (*meanwhile)(void *arg),
		 void *arg, struct avc_error *err)
{
	const struct image *image = &restored->generation->image[index];
	const struct place *place = restore_plan_place(restored->generation, index);
	struct forked *forked = &restored->forked[index];
	struct birth birth = { .restored = restored,
			       .host = &restored->forked[place->host],
			       .number = image->inside,
			       .exit_signal = image->exit_signal,
			       .shared = image->shared,
			       .orphan = image->parent == PARENT_INIT,
			       .meanwhile = meanwhile,
			       .arg = arg };
	const bool plain = is_plain(restored->generation, index);
	pid_t copy;

	forked->batch = birth.host->batch;
	forked->batch.inside = image->inside;
	forked->batch.socket = -1;
	if (plain && fork_next(&birth, forked, err))
		return -1;
	if (plain && has_number(forked, birth.number))
		return 0;
	restored->last_number = 0;
	/* The others use what the parasite has for forks. */
	if (restore_fork_rest(&restored->forked[place->memory], err))
		return -1;
	copy = plain ? keep_copy(&birth, forked, err) : 0;
	birth.copy = copy;
	birth.by = copy < 0 ? NULL : maker_of(restored, place, err);
	if (!birth.by || give_birth(&birth, &forked->pid, err))
		return -1;
	forked->traced = true;
	if (birth.copy != copy)
		close_fd(&forked->inherited.ours); /* by that one only */
	return has_number(forked, birth.number)
		       ? 0
		       : fail_errno(err, forked->pid, "restore", "open(status)", "it was killed");
}

int restore_fork_end(struct restore_tree *restored, struct avc_error *err)
{
	while (restored->keepers) {
		const struct keeper *keeper = &restored->keeper[--restored->keepers];

		if (keeper->session != PLACE_ANY)
			restore_fork_note(&restored->forked[keeper->host], SIGCHLD);
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
