/* SPDX-License-Identifier: Apache-2.0
 *
 * A task that everybody waits for gets the guard's priority by priority inheritance (futex(2),
 * FUTEX_LOCK_PI): a thread of the guard waits for a lock that the task seems to hold.  So nothing is
 * changed that the task could see or pass on: a real-time policy has no timer slack, and its
 * children would have none by default (PR_SET_TIMERSLACK, Linux 6.13).  If the guard dies, it ends.
 */
#include <linux/futex.h>
#include <pthread.h>
#include <signal.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "trace.h"

static struct {
	pthread_t thread;
	uint32_t owner; /* the lock: its TID                                      */
	bool on;
} boost;

/* Not a private lock: its owner is another process. */
static void *wait_for(void *lock)
{
	syscall(SYS_futex, lock, FUTEX_LOCK_PI, 0, NULL, NULL, 0);
	return NULL;
}

void boost_begin(pid_t tid)
{
	boost_end();
	if (!rt_priority_is())
		return;
	__atomic_store_n(&boost.owner, (uint32_t)tid, __ATOMIC_RELEASE);
	boost.on = pthread_create(&boost.thread, NULL, wait_for, &boost.owner) == 0;
}

void boost_end(void)
{
	if (!boost.on)
		return;
	boost.on = false;
	/* The call begins anew after a signal, and then nobody holds the lock. */
	__atomic_store_n(&boost.owner, 0, __ATOMIC_RELEASE);
	pthread_kill(boost.thread, tracee_timer_signal());
	pthread_join(boost.thread, NULL);
}
