/* SPDX-License-Identifier: Apache-2.0
 *
 * Real-time priority. While an app is stopped, or dead, it waits for its guard; on a busy machine
 * the guard must not wait for a time slice, nor lose the CPU to each thread that it wakes. So it
 * becomes a real-time thread for those moments.
 *
 * Therefore, between rt_priority_begin() and rt_priority_end() the guard must not spin on another
 * task, which may need this very CPU.
 */
#include <sched.h>

#include "base.h"

static __thread struct {
	int depth, policy;
	struct sched_param param;
	bool changed;
} before;

void rt_priority_begin(void)
{
	const struct sched_param lowest = { .sched_priority = sched_get_priority_min(SCHED_FIFO) };

	if (before.depth++)
		return;
	before.policy = sched_getscheduler(0);
	/* Keeps a real-time policy that was set from outside. Without CAP_SYS_NICE, or in a cgroup
	 * without real-time budget, the guard keeps its priority, and is slower. */
	before.changed = before.policy != SCHED_FIFO && before.policy != SCHED_RR &&
			 before.policy != SCHED_DEADLINE && sched_getparam(0, &before.param) == 0 &&
			 sched_setscheduler(0, SCHED_FIFO, &lowest) == 0;
}

void rt_priority_end(void)
{
	if (--before.depth == 0 && before.changed)
		sched_setscheduler(0, before.policy, &before.param);
}

bool rt_priority_lend(pid_t pid)
{
	const struct sched_param lowest = { .sched_priority = sched_get_priority_min(SCHED_FIFO) };

	return pid > 0 && sched_getscheduler(pid) == SCHED_OTHER &&
	       sched_setscheduler(pid, SCHED_FIFO | SCHED_RESET_ON_FORK, &lowest) == 0;
}

void rt_priority_reclaim(pid_t pid)
{
	const struct sched_param none = { 0 };

	if (pid > 0 && sched_getscheduler(pid) == (SCHED_FIFO | SCHED_RESET_ON_FORK))
		sched_setscheduler(pid, SCHED_OTHER, &none);
}

void rt_priority_begin_lent(void)
{
	if (!before.depth++) {
		before.policy = SCHED_OTHER;
		before.param = (struct sched_param){ 0 };
		before.changed = true;
	}
}

bool rt_priority_is(void)
{
	return before.depth > 0;
}

void rt_priority_unshare(pid_t tid)
{
	const struct sched_param none = { 0 };

	if (sched_getscheduler(tid) == SCHED_FIFO)
		sched_setscheduler(tid, SCHED_OTHER, &none);
}

void rt_priority_share(pid_t tid)
{
	struct sched_param param;
	const int policy = sched_getscheduler(0);

	if (policy >= 0 && sched_getparam(0, &param) == 0)
		sched_setscheduler(tid, policy, &param);
}
