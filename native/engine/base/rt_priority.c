/* SPDX-License-Identifier: Apache-2.0
 *
 * Real-time priority. While an app is stopped, or dead, it waits for its guard; on a busy machine
 * the guard must not wait for a time slice, nor lose the CPU to each thread that it wakes. So it
 * becomes a real-time thread for those moments.
 *
 * Therefore, between rt_priority_begin() and rt_priority_end() the guard must not spin on another
 * task, which may need this very CPU.  And the application, which may be hostile, decides how much there
 * is to do: what takes too much CPU time is done with an ordinary priority, or a few containers could
 * keep all others from every CPU.
 *
 * SCHED_RR, not SCHED_FIFO.  The kernel, too, spins on other tasks: who opens or reaps in /proc what has
 * just ended waits in a loop for names that another task is freeing (fs/dcache.c,
 * shrink_dcache_parent()).  If that one is a guard or an init as well, it waits for a CPU behind the
 * first, and with SCHED_FIFO for ever: two of those once kept two CPUs for 25 minutes.
 */
#include <sched.h>
#include <time.h>

#include "base.h"

#define MOST_NS (200 * NS_PER_MS) /* of CPU time */
#define LENT (SCHED_RR | SCHED_RESET_ON_FORK)

static __thread struct {
	int depth, policy;
	struct sched_param param;
	bool changed;
	bool spent;      /* it was too long                                             */
	uint64_t end_ns; /* before that it cannot have been                         */
	uint64_t ran_ns;
} before;

static void count_from_now(void)
{
	before.spent = false;
	before.end_ns = now_ns() + MOST_NS;
	before.ran_ns = clock_ns(CLOCK_THREAD_CPUTIME_ID);
}

void rt_priority_begin(void)
{
	const struct sched_param lowest = { .sched_priority = sched_get_priority_min(SCHED_RR) };

	if (before.depth++)
		return;
	count_from_now();
	before.policy = sched_getscheduler(0);
	/* Keeps a real-time policy that was set from outside. Without CAP_SYS_NICE, or in a cgroup
	 * without real-time budget, the guard keeps its priority, and is slower. */
	before.changed = before.policy != SCHED_FIFO && before.policy != SCHED_RR &&
			 before.policy != SCHED_DEADLINE && sched_getparam(0, &before.param) == 0 &&
			 sched_setscheduler(0, SCHED_RR, &lowest) == 0;
}

void rt_priority_end(void)
{
	if (--before.depth == 0 && before.changed)
		sched_setscheduler(0, before.policy, &before.param);
}

void rt_priority_step(void)
{
	uint64_t now, ran;

	if (!before.depth || !before.changed)
		return;
	now = now_ns();
	if (now < before.end_ns)
		return;
	ran = clock_ns(CLOCK_THREAD_CPUTIME_ID) - before.ran_ns;
	if (ran < MOST_NS) {
		before.end_ns = now + MOST_NS - ran;
		return;
	}
	before.changed = false;
	before.spent = true;
	sched_setscheduler(0, before.policy, &before.param);
}

bool rt_priority_give(pid_t tid)
{
	const struct sched_param lowest = { .sched_priority = sched_get_priority_min(SCHED_RR) };

	return sched_setscheduler(tid, LENT, &lowest) == 0;
}

bool rt_priority_lend(pid_t pid)
{
	return pid > 0 && sched_getscheduler(pid) == SCHED_OTHER && rt_priority_give(pid);
}

/* If it still has that policy. */
static void take_back(pid_t pid, int policy)
{
	const struct sched_param none = { 0 };

	if (pid > 0 && sched_getscheduler(pid) == policy)
		sched_setscheduler(pid, SCHED_OTHER, &none);
}

void rt_priority_reclaim(pid_t pid)
{
	take_back(pid, LENT);
}

void rt_priority_begin_lent(void)
{
	if (!before.depth++) {
		before.policy = SCHED_OTHER;
		before.param = (struct sched_param){ 0 };
		before.changed = true;
		count_from_now();
	}
}

bool rt_priority_is(void)
{
	return before.depth > 0 && !before.spent;
}

void rt_priority_unshare(pid_t tid)
{
	take_back(tid, SCHED_RR);
}

void rt_priority_share(pid_t tid)
{
	struct sched_param param;
	const int policy = sched_getscheduler(0);

	if (policy >= 0 && sched_getparam(0, &param) == 0)
		sched_setscheduler(tid, policy, &param);
}
