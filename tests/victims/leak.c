/* SPDX-License-Identifier: Apache-2.0
 *
 * leak MB_PER_S MB: has MB of memory, and from SIGUSR1 on leaks so much per second, for ever.
 * It looks again and again at some page of all that it has.  Beats every ms.
 * Board counter 0: MB leaked since it was started, or since what it was restored from.
 */
#include <signal.h>

#include "victim.h"

enum { PAGE = 4096, ROOM_GB = 64 };

static uint8_t *memory;
static size_t pages;
static volatile sig_atomic_t leaking;

static void on_signal(int sig)
{
	(void)sig;
	leaking = 1;
}

static void have(size_t more)
{
	for (size_t i = 0; i < more; i++, pages++)
		*(uint64_t *)(memory + pages * PAGE) = pages + 1;
}

static uint64_t now_us(void)
{
	struct timespec t;

	clock_gettime(CLOCK_MONOTONIC, &t);
	return (uint64_t)t.tv_sec * 1000000 + (uint64_t)t.tv_nsec / 1000;
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_signal, .sa_flags = SA_RESTART };
	uint64_t last = 0, now, seed = 1;
	size_t first, rate;

	victim_start(&argc, argv, 2, "MB_PER_S MB");
	memory = mmap(NULL, (size_t)ROOM_GB << 30, PROT_READ | PROT_WRITE,
		      MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
	must(memory != MAP_FAILED, "mmap");
	rate = (size_t)atol(argv[1]);
	have((size_t)atol(argv[2]) << 8);
	first = pages;
	sigaction(SIGUSR1, &act, NULL);
	victim_ready();
	for (;;) {
		usleep(1000);
		now = now_us();
		if (leaking && last && now - last < 100000)
			have((size_t)((now - last) * (rate << 8) / 1000000));
		last = now;
		seed = seed * 6364136223846793005 + 1442695040888963407;
		CHECK(*(uint64_t *)(memory + (seed >> 20) % pages * PAGE) ==
			      (seed >> 20) % pages + 1,
		      "page %zu has another's contents", (size_t)((seed >> 20) % pages));
		board->counter[0] = (pages - first) >> 8;
		beat();
	}
}
