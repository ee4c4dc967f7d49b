/* SPDX-License-Identifier: Apache-2.0
 *
 * Landlock domains (landlock(7)).  A restored thread or process inherits that of the main process,
 * and cannot be put into one of its own: it would be free of what had confined it, so it is refused.
 *
 * No call tells which domain a task is in.  But in none may a task look at one outside of it
 * (ptrace(2), PTRACE_MODE_READ; security/landlock/task.c).  So a process is asked to look at the
 * main one, and a thread of that at its holder, since a process may always look at itself.  What
 * else can forbid that is known: other users, more capabilities, a process that is not dumpable.
 */
#include <errno.h>
#include <linux/capability.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>

#include "process.h"

void fence_ask(const struct process *process, struct inj_call *call, avc_remote out,
	       struct questions *questions)
{
	const pid_t seen = process->main ? process->main->inside : process->holder_inside;

	questions->dumpable = call_add(call, SYS_prctl, PR_GET_DUMPABLE);
	questions->sight = seen ? call_add(call, SYS_get_robust_list, (uint64_t)seen, out, out + 8)
				: NULL;
}

/* Whether it could look at that one, were it in no domain; and whether it could enter one
 * (landlock_restrict_self(2)). */
static bool has_the_right(const struct process *process, const struct thread *thread)
{
	const struct process *seen = process->main ? process->main : process;
	struct proc_status own, other;

	if (seen->undumpable || proc_status(thread->tid, &own) ||
	    proc_status(process->main ? seen->pid : process->holder, &other))
		return false;
	for (int i = 0; i < 3; i++)
		if (other.uid[i] != own.uid[0] || other.gid[i] != own.gid[0])
			return false;
	return !(other.caps[STATUS_PERMITTED] & ~own.caps[STATUS_PERMITTED]) &&
	       (own.no_new_privs || own.caps[STATUS_BOUNDING] >> CAP_SYS_ADMIN & 1);
}

/* The main process may have entered one since its holder was made: that is made again, once. */
static int renew_holder(struct process *process, struct avc_error *err)
{
	process->doubtful = process->renewed = true;
	return fail(err, AVC_RETRY, 0, process->pid, "read state", "",
		    "it may have just entered a Landlock domain");
}

int fence_answer(struct process *process, struct thread *thread, const struct questions *questions,
		 struct avc_error *err)
{
	const bool is_main = !process->main && thread->tid == process->pid;
	const bool blind = !is_main && (process->main ? process->main : process)->blind;
	bool fenced;

	process->undumpable = questions->dumpable->result != 1;
	fenced = questions->sight && questions->sight->result == -EPERM && !blind &&
		 has_the_right(process, thread);
	if (fenced && !process->main && !process->renewed)
		return renew_holder(process, err);
	if (is_main) {
		/* Of a new holder that can only be the doing of another security module. */
		process->blind = fenced;
		process->renewed = fenced;
	} else {
		thread->creds.fenced = fenced;
	}
	return 0;
}
