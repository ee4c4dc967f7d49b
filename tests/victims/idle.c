/* SPDX-License-Identifier: Apache-2.0
 *
 * idle MB THREADS [--beat-us N]: touched memory and blocked threads, for
 * measuring.  THREADS counts the main one, which beats every N us (1000).
 */
#include <pthread.h>

#include "victim.h"

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t never = PTHREAD_COND_INITIALIZER;

static void *block(void *unused)
{
	(void)unused;
	pthread_mutex_lock(&lock);
	for (;;)
		pthread_cond_wait(&never, &lock);
	return NULL;
}

int main(int argc, char **argv)
{
	long beat_us = 1000, mb, threads;
	size_t bytes, at;
	uint64_t *memory;
	pthread_attr_t attr;
	int i;

	victim_start(&argc, argv, 2, "MB THREADS [--beat-us N]");
	for (i = 1; i + 1 < argc; i++)
		if (!strcmp(argv[i], "--beat-us"))
			beat_us = atol(argv[i + 1]);
	mb = atol(argv[1]);
	threads = atol(argv[2]);
	bytes = (size_t)mb << 20;
	memory = mmap(NULL, bytes + 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1,
		      0);
	must(memory != MAP_FAILED, "mmap");
	for (at = 0; at < bytes / 8; at += 512)
		memory[at] = mix(at, 1);
	pthread_attr_init(&attr);
	pthread_attr_setstacksize(&attr, 64 << 10);
	for (i = 1; i < threads; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, &attr, block, NULL), "pthread_create");
	}
	victim_ready();
	for (at = 0;; at = at + 1 < bytes / 4096 ? at + 1 : 0) {
		if (bytes)
			CHECK(memory[at * 512] == mix(at * 512, 1), "page %zu holds %lx", at,
			      memory[at * 512]);
		beat();
		nap_us(beat_us);
	}
}
