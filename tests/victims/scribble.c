/* SPDX-License-Identifier: Apache-2.0
 *
 * scribble [SEED]: looks for avckpt's parasite in its own memory, and goes on writing there how many calls
 * a thread of its is to make: far more than there is room for.  Other threads come and go, so
 * that there is always one that the guard has to ask while the rest of the process runs.
 *
 * With a seed, it writes anything anywhere in there, as nobody: what the parasite is made to do with
 * that it does with this process's rights.
 *
 * What that does to itself is its own affair.  counter[0] is how many pads it has found.
 */
#include <grp.h>
#include <pthread.h>
#include <sys/prctl.h>

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

static uint64_t random_state;

static uint64_t any(uint64_t below)
{
	return next_random(&random_state) % below;
}

/* Mostly where something is just going on: calls, and the first of what a checkpoint is put in. */
static uint64_t random_place(uint64_t bytes)
{
	const uint64_t chance = any(4);
	const uint64_t within = chance == 0   ? bytes
				: chance == 1 ? INJ_SLOTS_OFFSET - INJ_CODE_BYTES + 8192
					      : sizeof(struct inj_control);

	return any(within < bytes ? within : bytes) & ~UINT64_C(7);
}

static uint64_t random_value(void)
{
	static const uint64_t edges[] = { 0, 1, 0x7fffffff, 0xffffffff, UINT64_MAX, 1ULL << 63 };
	const uint64_t chance = any(4);

	return chance == 0   ? edges[any(sizeof edges / sizeof *edges)]
	       : chance == 1 ? any(512)
	       : chance == 2 ? any(UINT64_C(1) << 32)
			     : next_random(&random_state);
}

static void *scribble_at_random(void *unused)
{
	const struct place place = await_parasite();
	uint8_t *data = (uint8_t *)place.start + INJ_CODE_BYTES;

	count(0, 1);
	for (;;) {
		uint64_t *word = (uint64_t *)(data + random_place(place.bytes));

		if (any(2))
			*(volatile uint32_t *)word = (uint32_t)random_value();
		else
			*(volatile uint64_t *)word = random_value();
		/* Now and then there has to be a checkpoint, too. */
		if (any(64) == 0)
			usleep(any(2000));
	}
	return unused;
}

static void become_nobody(void)
{
	must(setgroups(0, NULL) == 0 && setresgid(65534, 65534, 65534) == 0 &&
		     setresuid(65534, 65534, 65534) == 0 &&
		     prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0,
	     "to be nobody");
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
	if (argc > 1) {
		random_state = strtoull(argv[1], NULL, 10) * 0x9e3779b97f4a7c15 + 1;
		become_nobody();
		start(scribble_at_random);
	} else {
		start(scribble);
	}
	victim_ready();
	for (;;) {
		start(stay_a_while);
		usleep(5000);
		beat();
	}
}
