/* SPDX-License-Identifier: Apache-2.0
 *
 *   crowd KIND PROCESSES MANY
 *
 * PROCESSES children, each with much of what a checkpoint might have to keep:
 *
 *   shared   MANY areas of shared memory of its own, of a page each
 *   wiped    MANY MB of memory that is wiped in forks (MADV_WIPEONFORK), never touched
 */
#include "victim.h"

static void *map(size_t bytes, int protection, int flags)
{
	void *at = mmap(NULL, bytes, protection, flags | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);

	must(at != MAP_FAILED, "mmap");
	return at;
}

static void have(const char *kind, size_t many)
{
	if (!strcmp(kind, "wiped"))
		must(!madvise(map(many << 20, PROT_READ | PROT_WRITE, MAP_PRIVATE), many << 20,
			      MADV_WIPEONFORK),
		     "MADV_WIPEONFORK");
	else
		for (size_t i = 0; i < many; i++) {
			*(int *)map(4096, PROT_READ | PROT_WRITE, MAP_SHARED) = 1;
			/* Between them, or the kernel makes one of them. */
			map(4096, PROT_NONE, MAP_PRIVATE);
		}
}

int main(int argc, char **argv)
{
	volatile uint64_t *there;
	int processes;

	victim_start(&argc, argv, 3, "KIND PROCESSES MANY");
	processes = atoi(argv[2]);
	there = map(4096, PROT_READ | PROT_WRITE, MAP_SHARED);
	for (int i = 0; i < processes; i++) {
		const pid_t child = fork();

		must(child >= 0, "fork");
		if (child)
			continue;
		have(argv[1], (size_t)atol(argv[3]));
		__atomic_add_fetch(there, 1, __ATOMIC_RELEASE);
		for (;;)
			pause();
	}
	while (*there < (uint64_t)processes)
		usleep(1000);
	victim_ready();
	for (;;) {
		beat();
		usleep(1000);
	}
}
