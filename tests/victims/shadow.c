/* SPDX-License-Identifier: Apache-2.0
 *
 * shadow: its child executes it again, and has memory where its parent has its vDSO.  The kernel
 * puts new memory of a restored child there by itself, because that looks for room where its parent
 * does (mm_struct.mmap_base).
 *
 * counter[0]: how often the child has looked at its memory.
 */
#include "victim.h"

#define WORD 8

static void find_vdso(unsigned long *start, unsigned long *end)
{
	FILE *maps = fopen("/proc/self/maps", "re");
	unsigned long from, to;
	char line[512];

	must(maps != NULL, "maps");
	while (fgets(line, sizeof line, maps)) {
		if (!strstr(line, "[vvar") && !strstr(line, "[vdso]"))
			continue;
		must(sscanf(line, "%lx-%lx", &from, &to) == 2, "sscanf");
		*start = *end ? *start : from;
		*end = to;
	}
	fclose(maps);
	must(*end != 0, "a vDSO");
}

static void live(char **argv)
{
	const unsigned long start = strtoul(argv[2], NULL, 16), end = strtoul(argv[3], NULL, 16);
	uint64_t *memory;

	board_open(argv[4]);
	memory = mmap((void *)start, end - start, PROT_READ | PROT_WRITE,
		      MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED_NOREPLACE, -1, 0);
	if (memory != (uint64_t *)start) /* something of its own is there */
		execv("/proc/self/exe", argv);
	for (size_t i = 0; i < (end - start) / WORD; i++)
		memory[i] = start + i;
	for (;;) {
		for (size_t i = 0; i < (end - start) / WORD; i++)
			CHECK(memory[i] == start + i, "word %zu is %lx", i, memory[i]);
		count(0, 1);
		nap_us(1000);
	}
}

int main(int argc, char **argv)
{
	char from[32], to[32], *path = NULL;
	unsigned long start = 0, end = 0;
	pid_t child;

	if (argc == 5 && !strcmp(argv[1], "--child"))
		live(argv);
	for (int i = 1; i + 1 < argc; i++)
		if (!strcmp(argv[i], "--board"))
			path = argv[i + 1];
	victim_start(&argc, argv, 0, "");
	must(path != NULL, "--board");
	find_vdso(&start, &end);
	snprintf(from, sizeof from, "%lx", start);
	snprintf(to, sizeof to, "%lx", end);
	child = fork();
	must(child >= 0, "fork");
	if (child == 0) {
		execl("/proc/self/exe", "shadow", "--child", from, to, path, NULL);
		must(false, "execl");
	}
	while (!board->counter[0])
		nap_us(1000);
	victim_ready();
	for (;;) {
		beat();
		nap_us(1000);
		CHECK(waitpid(child, NULL, WNOHANG) == 0, "its child has ended");
	}
}
