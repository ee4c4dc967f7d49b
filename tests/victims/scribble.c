/* SPDX-License-Identifier: Apache-2.0
 *
 * scribble: looks for avckpt's parasite in its own memory, and goes on writing there how many calls
 * a thread of its is to make: far more than there is room for.  Other threads come and go, so
 * that there is always one that the guard has to ask while the rest of the process runs.
 *
 * What that does to itself is its own affair.  counter[0] is how many pads it has found.
 */
#include <pthread.h>

#include "parasite.h"
#include "victim.h"

#define FIRST_PAD (UINT64_C(32) << 40)
#define FAR_TOO_MANY 0x00ffffff

/* NULL: there is none yet. */
static struct inj_control *find_parasite(void)
{
	struct inj_control *found = NULL;
	FILE *maps = fopen("/proc/self/maps", "re");
	char line[512];
	uint64_t start;

	must(maps != NULL, "/proc/self/maps");
	while (!found && fgets(line, sizeof(line), maps))
		if (sscanf(line, "%lx-%*x r-x", &start) == 1 && start >= FIRST_PAD &&
		    start % (UINT64_C(64) << 20) == 0)
			found = (struct inj_control *)(start + INJ_CODE_BYTES);
	fclose(maps);
	return found;
}

static void *scribble(void *unused)
{
	struct inj_control *control;

	while (!(control = find_parasite()) || control->magic != INJ_MAGIC)
		usleep(1000);
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
