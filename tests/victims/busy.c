/* SPDX-License-Identifier: Apache-2.0
 *
 * busy MB: dirties its memory all the time, in ways that only an image of one
 * single instant keeps true.
 *
 * - Pairs: two arrays, written by two threads under a sequence lock, of which
 *   the second is a function of the first.
 * - A chain: one thread counts, the next copies what it sees, the next copies
 *   that.  Nobody may ever be ahead of the one he copies from; pages or threads
 *   taken at different instants are.
 * - Each thread knows in a register what it wrote last to a place of its own.
 */
#include <pthread.h>

#include "victim.h"

enum { WRITERS = 2, LINKS = 4 };

static size_t pairs; /* of each writer */
static uint64_t *first, *second;

static struct {
	_Alignas(4096) volatile uint64_t value;
} sequence[WRITERS], link_at[LINKS], own[WRITERS];

static void *write_pairs(void *arg)
{
	size_t me = (size_t)arg;
	uint64_t random = me + 1, n;

	for (n = 1;; n++) {
		size_t at = me * pairs + next_random(&random) % pairs;
		uint64_t value = next_random(&random);

		CHECK(own[me].value == n - 1, "writer %zu is at %lu, its page at %lu", me, n - 1,
		      own[me].value);
		__atomic_add_fetch(&sequence[me].value, 1, __ATOMIC_SEQ_CST);
		first[at] = value;
		__atomic_thread_fence(__ATOMIC_SEQ_CST);
		second[at] = mix(value, at);
		__atomic_add_fetch(&sequence[me].value, 1, __ATOMIC_SEQ_CST);
		own[me].value = n;
		count(0, 1);
		if (n % 64 == 0)
			nap_us(50); /* be a neighbour */
	}
	return NULL;
}

/* Looks at the reverse order of writing: each is read before the one it copies. */
static void check_chain(void)
{
	uint64_t behind = link_at[LINKS - 1].value;
	int i;

	for (i = LINKS - 2; i >= 0; i--) {
		uint64_t ahead = __atomic_load_n(&link_at[i].value, __ATOMIC_SEQ_CST);

		CHECK(behind <= ahead, "link %d is at %lu, the one it copies at %lu", i + 1, behind,
		      ahead);
		behind = ahead;
	}
}

static void *count_or_copy(void *arg)
{
	size_t me = (size_t)arg;
	uint64_t last = 0, n;

	for (n = 0;; n++) {
		uint64_t value = me ? __atomic_load_n(&link_at[me - 1].value, __ATOMIC_SEQ_CST)
				    : last + 1;

		CHECK(value >= last, "link %zu goes back from %lu to %lu", me, last, value);
		CHECK(link_at[me].value == last, "link %zu wrote %lu and reads %lu", me, last,
		      link_at[me].value);
		__atomic_store_n(&link_at[me].value, value, __ATOMIC_SEQ_CST);
		last = value;
		if (n % 256 == 0)
			nap_us(100);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	uint64_t random = 4711, done = 0;
	pthread_t thread;
	size_t bytes, i;

	victim_start(&argc, argv, 1, "MB");
	bytes = (size_t)atol(argv[1]) << 20;
	pairs = bytes / 16 / WRITERS;
	must(pairs > 0, "MB must be at least 1");
	first = malloc(bytes / 2);
	second = malloc(bytes / 2);
	must(first && second, "malloc");
	for (i = 0; i < pairs * WRITERS; i++) {
		first[i] = i;
		second[i] = mix(i, i);
	}
	for (i = 0; i < WRITERS; i++)
		must(!pthread_create(&thread, NULL, write_pairs, (void *)i), "pthread_create");
	for (i = 0; i < LINKS; i++)
		must(!pthread_create(&thread, NULL, count_or_copy, (void *)i), "pthread_create");
	victim_ready();
	for (i = 0;; i++) {
		size_t at = next_random(&random) % (pairs * WRITERS), me = at / pairs;
		uint64_t before = __atomic_load_n(&sequence[me].value, __ATOMIC_SEQ_CST);
		uint64_t a = __atomic_load_n(&first[at], __ATOMIC_SEQ_CST);
		uint64_t b = __atomic_load_n(&second[at], __ATOMIC_SEQ_CST);

		__atomic_thread_fence(__ATOMIC_SEQ_CST);
		if (!(before & 1) &&
		    __atomic_load_n(&sequence[me].value, __ATOMIC_SEQ_CST) == before) {
			CHECK(b == mix(a, at), "pair %zu does not match: %lx %lx", at, a, b);
			done++;
		}
		check_chain();
		if (i % 128 == 0) {
			beat();
			board->counter[1] = done;
			nap_us(200);
		}
	}
}
