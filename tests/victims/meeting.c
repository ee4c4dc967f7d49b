/* SPDX-License-Identifier: Apache-2.0
 *
 * meeting: two threads begin to sleep for 0.6 s at the same instant, which is told by counter[1], so
 * that they wake at the same time, also after a restore from an image where they sleep.  When each
 * has woken is in counter[2] and counter[3] (CLOCK_MONOTONIC, ns); counter[0] counts.
 */
#include <pthread.h>

#include "victim.h"

#define SLEEP_US 600000

static pthread_barrier_t begin;

static void *sleep_and_tell(void *number)
{
	pthread_barrier_wait(&begin);
	board->counter[1] = 1;
	usleep(SLEEP_US);
	board->counter[2 + (uintptr_t)number] = now_ns();
	count(0, 1);
	for (;;)
		pause();
	return NULL;
}

int main(int argc, char **argv)
{
	pthread_t threads[2];

	victim_start(&argc, argv, 0, "");
	pthread_barrier_init(&begin, NULL, 2);
	victim_ready();
	for (uintptr_t i = 0; i < 2; i++)
		must(!pthread_create(&threads[i], NULL, sleep_and_tell, (void *)i),
		     "pthread_create");
	for (;;) {
		usleep(1000);
		beat();
	}
}
