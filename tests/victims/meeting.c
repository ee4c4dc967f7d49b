/* SPDX-License-Identifier: Apache-2.0
 *
 * meeting: two threads begin to sleep for 1.2 s at the same instant, which is told by counter[1], and
 * then do something for 8 ms that the other must not do meanwhile: abort().  If they have not met,
 * counter[0] is 2.  A restore from an image where they sleep has them meet again.
 */
#include <pthread.h>

#include "victim.h"

#define SLEEP_US 1200000
#define INSIDE_US 8000

static pthread_barrier_t begin;
static int inside;

static void *sleep_and_enter(void *unused)
{
	(void)unused;
	pthread_barrier_wait(&begin);
	board->counter[1] = 1;
	usleep(SLEEP_US);
	if (__atomic_fetch_add(&inside, 1, __ATOMIC_SEQ_CST))
		abort();
	usleep(INSIDE_US);
	__atomic_fetch_sub(&inside, 1, __ATOMIC_SEQ_CST);
	count(0, 1);
	return NULL;
}

int main(int argc, char **argv)
{
	pthread_t threads[2];

	victim_start(&argc, argv, 0, "");
	pthread_barrier_init(&begin, NULL, 2);
	victim_ready();
	for (int i = 0; i < 2; i++)
		must(!pthread_create(&threads[i], NULL, sleep_and_enter, NULL), "pthread_create");
	for (;;) {
		usleep(1000);
		beat();
	}
}
