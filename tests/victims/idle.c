/* SPDX-License-Identifier: Apache-2.0
 *
 * idle MB THREADS [--beat-us N] [--descriptors N] [--thp]: touched memory, blocked threads
 * and descriptors of all kinds, for measuring.  THREADS counts the main one, which beats
 * every N us (1000).  With --thp the memory is of transparent huge pages.
 */
#include <pthread.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/timerfd.h>

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

/* In turn: files, pipes, sockets, socket pairs, and what is behind anonymous inodes. */
static void open_descriptors(long n)
{
	for (long i = 0; i < n;) {
		int ends[2] = { -1, -1 };

		switch (i / 2 % 6) {
		case 0:
			ends[0] = open("/proc/self/exe", O_RDONLY);
			ends[1] = open("/", O_RDONLY | O_DIRECTORY);
			break;
		case 1:
			must(pipe(ends) == 0, "pipe");
			break;
		case 2:
			must(socketpair(AF_UNIX, SOCK_STREAM, 0, ends) == 0, "socketpair");
			break;
		case 3:
			ends[0] = eventfd(3, 0);
			ends[1] = timerfd_create(CLOCK_MONOTONIC, 0);
			break;
		case 4:
			ends[0] = socket(AF_INET, SOCK_STREAM, 0);
			ends[1] = socket(AF_INET, SOCK_DGRAM, 0);
			break;
		case 5:
			ends[0] = epoll_create1(0);
			ends[1] = open("/dev/null", O_RDWR);
			break;
		}
		must(ends[0] >= 0 && ends[1] >= 0, "a descriptor");
		i += 2;
	}
}

int main(int argc, char **argv)
{
	long beat_us = 1000, mb, threads;
	size_t bytes, at;
	uint64_t *memory;
	pthread_attr_t attr;
	bool thp;
	int i;

	thp = victim_flag(&argc, argv, "--thp");
	victim_start(&argc, argv, 2, "MB THREADS [--beat-us N] [--descriptors N] [--thp]");
	for (i = 1; i + 1 < argc; i++)
		if (!strcmp(argv[i], "--beat-us"))
			beat_us = atol(argv[i + 1]);
		else if (!strcmp(argv[i], "--descriptors"))
			open_descriptors(atol(argv[i + 1]));
	mb = atol(argv[1]);
	threads = atol(argv[2]);
	bytes = (size_t)mb << 20;
	memory = victim_memory(bytes, thp);
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
