/* SPDX-License-Identifier: Apache-2.0
 *
 * pkeys N: N threads with rights of their own to memory under protection keys (pkeys(7)):
 * each can read what it could read, and write what it could write, and nothing else.  The
 * keys stay allocated, one below them stays free, and code that can only be executed, which the
 * kernel does by a key of its own, cannot be read.  Needs a CPU and a kernel with protection keys.
 */
#include <pthread.h>
#include <setjmp.h>
#include <signal.h>

#include "victim.h"

enum { KEYS = 3 };

static int key[KEYS];
static volatile uint64_t *page[KEYS];
static volatile uint64_t *code;
static __thread sigjmp_buf trap;

static void on_fault(int signal)
{
	siglongjmp(trap, signal);
}

static bool faults(volatile uint64_t *at, bool by_writing)
{
	if (sigsetjmp(trap, 1))
		return true;
	if (by_writing)
		*at = *at;
	else
		(void)*at;
	return false;
}

static unsigned int right(long thread, int which)
{
	static const unsigned int rights[] = { 0, PKEY_DISABLE_WRITE, PKEY_DISABLE_ACCESS };

	return rights[(thread + which) % 3];
}

/* A handler begins with the rights of a new thread, and we have left it by a jump. */
static void take_rights(long me)
{
	for (int i = 0; i < KEYS; i++)
		must(!pkey_set(key[i], right(me, i)), "pkey_set");
}

static void *work(void *arg)
{
	const long me = (long)arg;

	take_rights(me);
	for (;;) {
		for (int i = 0; i < KEYS; i++) {
			CHECK((unsigned int)pkey_get(key[i]) == right(me, i),
			      "key %d: rights %d instead of %u", key[i], pkey_get(key[i]),
			      right(me, i));
			CHECK(faults(page[i], false) == (right(me, i) == PKEY_DISABLE_ACCESS),
			      "key %d: reading", key[i]);
			take_rights(me);
			CHECK(faults(page[i], true) == (right(me, i) != 0), "key %d: writing",
			      key[i]);
			take_rights(me);
		}
		CHECK(faults(code, false), "code that can only be executed was read");
		take_rights(me);
		((void (*)(void))code)();
		nap_us(500);
	}
	return NULL;
}

static void make_code(void)
{
	code = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	must(code != MAP_FAILED, "mmap");
	*(volatile uint8_t *)code = 0xc3; /* ret */
	must(!mprotect((void *)code, 4096, PROT_EXEC), "mprotect");
}

int main(int argc, char **argv)
{
	struct sigaction action = { .sa_handler = on_fault };
	long n;
	int lowest;

	victim_start(&argc, argv, 1, "N");
	lowest = pkey_alloc(0, 0);
	for (int i = 0; i < KEYS; i++) {
		key[i] = pkey_alloc(0, 0);
		if (key[i] < 0)
			unavailable("pkey_alloc");
		page[i] = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1,
			       0);
		must(page[i] != MAP_FAILED &&
			     !pkey_mprotect((void *)page[i], 4096, PROT_READ | PROT_WRITE, key[i]),
		     "pkey_mprotect");
	}
	make_code();
	pkey_free(lowest);
	sigaction(SIGSEGV, &action, NULL);
	n = atol(argv[1]);
	for (long i = 0; i < n; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, work, (void *)i), "pthread_create");
	}
	victim_ready();
	for (;;) {
		const int one_more = pkey_alloc(0, 0);

		CHECK(one_more == lowest, "key %d is free, not %d", one_more, lowest);
		pkey_free(one_more);
		beat();
		nap_us(1000);
	}
}
