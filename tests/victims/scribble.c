/* SPDX-License-Identifier: Apache-2.0
 *
 * scribble: looks for avckpt's parasite in its own memory, and goes on writing there how many calls
 * a thread of its is to make: far more than there is room for.  Other threads come and go, so
 * that there is always one that the guard has to ask while the rest of the process runs.
 *
 * What that does to itself is its own affair.  counter[0] is how many pads it has found.
 */
#include <pthread.h>

#include "parasite_place.h"

#define FAR_TOO_MANY 0x00ffffff

static void *scribble(void *unused)
{
	struct inj_control *control =
		(struct inj_control *)(await_parasite().start + INJ_CODE_BYTES);

	count(0, 1);
	for (;;)
		__atomic_store_n(&control->runner.count, FAR_TOO_MANY, __ATOMIC_RELAXED);
	return unused;
}

static void *stay_a_while(void *unused)
{
	usleep(50000);
	return unused;
}

static void start(void *(*run)(void *))
{
	pthread_t thread;

	must(pthread_create(&thread, NULL, run, NULL) == 0 && pthread_detach(thread) == 0,
	     "pthread_create");
}

int main(int argc, char **argv)
{
	victim_start(&argc, argv, 0, "");
	start(scribble);
	victim_ready();
	for (;;) {
		start(stay_a_while);
		usleep(5000);
		beat();
	}
}
