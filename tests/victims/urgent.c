/* SPDX-License-Identifier: Apache-2.0
 *
 * urgent MS: a thread of real-time priority that beats every half millisecond, and an ordinary one
 * that can be stopped only every MS milliseconds: it waits for a child that lives for so long before
 * it executes a program or ends (vfork(2)).
 */
#include <pthread.h>
#include <sched.h>

#include "victim.h"

static long child_us;

static void *be_slow(void *unused)
{
	(void)unused;
	for (;;) {
		const pid_t child = vfork();

		if (child == 0) {
			usleep((useconds_t)child_us);
			_exit(0);
		}
		must(waitpid(child, NULL, 0) == child, "waitpid");
	}
	return NULL;
}

static void *be_urgent(void *unused)
{
	const struct sched_param first = { .sched_priority = 50 };

	(void)unused;
	if (sched_setscheduler(0, SCHED_FIFO, &first))
		unavailable("SCHED_FIFO");
	for (;;) {
		beat();
		nap_us(500);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	pthread_t thread;

	victim_start(&argc, argv, 1, "MS");
	child_us = atol(argv[1]) * 1000;
	must(!pthread_create(&thread, NULL, be_urgent, NULL), "pthread_create");
	must(!pthread_create(&thread, NULL, be_slow, NULL), "pthread_create");
	nap_us(100000);
	victim_ready();
	for (;;)
		pause();
}
