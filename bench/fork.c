/* SPDX-License-Identifier: Apache-2.0
 *
 * fork MB [--thp]: the yardstick.  Memory as tests/victims/idle.c has it (one anonymous
 * mapping, every page touched), one thread.  For every line on stdin it makes one
 * fork(2), whose child ends at once, and prints how long the call took in the
 * parent, in nanoseconds.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

static uint64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (uint64_t)ts.tv_sec * 1000000000 + (uint64_t)ts.tv_nsec;
}

int main(int argc, char **argv)
{
	const size_t bytes = argc > 1 ? (size_t)atol(argv[1]) << 20 : 0;
	uint64_t *memory;
	char line[16];

	if (argc < 2 || argc > 3 || (argc == 3 && strcmp(argv[2], "--thp") != 0)) {
		fprintf(stderr, "usage: %s MB [--thp]\n", argv[0]);
		return 2;
	}
	memory = mmap(NULL, bytes + 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1,
		      0);
	if (memory == MAP_FAILED) {
		perror("fork: mmap");
		return 1;
	}
	if (argc == 3 && madvise(memory, bytes, MADV_HUGEPAGE)) {
		perror("fork: madvise");
		return 1;
	}
	for (size_t at = 0; at < bytes / 8; at += 512)
		memory[at] = at + 1;
	puts("ready");
	fflush(stdout);
	while (fgets(line, sizeof line, stdin)) {
		const uint64_t start = now_ns();
		const pid_t child = fork();
		const uint64_t took_ns = now_ns() - start;

		if (child == 0)
			_exit(0);
		if (child < 0 || waitpid(child, NULL, 0) != child) {
			perror("fork: fork");
			return 1;
		}
		printf("%llu\n", (unsigned long long)took_ns);
		fflush(stdout);
	}
	return 0;
}
