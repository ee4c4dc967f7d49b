/* SPDX-License-Identifier: Apache-2.0
 *
 * prefork WORKERS MB [--touch KB] [--private MB] [--sparse] [--thp]: a server that loads its
 * data and then forks its workers, which share it.
 *
 * Each worker has changed the first KB kilobytes (64) of the data for itself, and
 * goes on reading all of it.  With --private MB the workers execute the program
 * anew and have MB of memory of their own instead.  With --sparse they have
 * given back every other page.  With --thp the shared data is in transparent huge pages.
 * Counter 0: pages read by workers; 2, 3: forks (family.h); 7 + i: laps of worker i (the
 * first 24).
 */
#include "family.h"

enum { PAGE_WORDS = 512 };

static uint64_t *memory;
static size_t pages, touched;
static bool sparse, thp;
static const char *board_path;

static void fill(size_t mb)
{
	size_t page;

	pages = mb << 8;
	memory = victim_memory(mb << 20, thp);
	for (page = 0; page < pages; page++)
		memory[page * PAGE_WORDS] = mix(page, 1);
}

static uint64_t belongs(size_t page, int worker)
{
	if (sparse && worker && page % 2)
		return 0;
	return mix(page, page < touched && worker ? (uint64_t)worker + 1 : 1);
}

static _Noreturn void work(int number)
{
	uint64_t random = (uint64_t)number + 1, laps;
	size_t page;

	for (page = 1; sparse && page < pages; page += 2)
		must(madvise(memory + page * PAGE_WORDS, 4096, MADV_DONTNEED) == 0, "madvise");
	for (page = 0; page < touched && page < pages; page += sparse ? 2 : 1)
		memory[page * PAGE_WORDS] = belongs(page, number);
	time_forks();
	for (laps = 1;; laps++) {
		int i;

		check_place();
		for (i = 0; i < 16 && pages; i++) {
			page = next_random(&random) % (i % 4 || !touched ? pages : touched);
			CHECK(memory[page * PAGE_WORDS] == belongs(page, number),
			      "page %zu of worker %d holds %lx", page, number,
			      memory[page * PAGE_WORDS]);
		}
		count(0, 16);
		if (number <= 24)
			board->counter[7 + number] = laps;
		nap(5000);
	}
}

/* prefork --worker NUMBER MB MAIN [BOARD] */
static _Noreturn void work_execed(char **argv)
{
	if (argv[5])
		board_open(argv[5]);
	family.main = atoi(argv[4]);
	know_family("worker");
	fill((size_t)atol(argv[3]));
	work(atoi(argv[2]));
}

static void start(int number, long private_mb)
{
	char n[3][24];
	char *argv[] = {
		(char *)"prefork", (char *)"--worker", n[0], n[1], n[2], (char *)board_path, NULL
	};
	pid_t pid = fork();

	if (pid) {
		add_child(pid);
		return;
	}
	forget_children();
	know_family("worker");
	if (private_mb < 0)
		work(number);
	snprintf(n[0], sizeof(n[0]), "%d", number);
	snprintf(n[1], sizeof(n[1]), "%ld", private_mb);
	snprintf(n[2], sizeof(n[2]), "%d", family.main);
	execv("/proc/self/exe", argv);
	must(false, "execv");
}

int main(int argc, char **argv)
{
	long private_mb = -1;
	int workers, i;
	size_t page = 0;

	if (argc > 4 && !strcmp(argv[1], "--worker"))
		work_execed(argv);
	sparse = victim_flag(&argc, argv, "--sparse");
	thp = victim_flag(&argc, argv, "--thp");
	touched = 16;
	for (i = 1; i + 1 < argc; i++) {
		if (!strcmp(argv[i], "--touch"))
			touched = (size_t)atol(argv[i + 1]) / 4;
		else if (!strcmp(argv[i], "--private"))
			private_mb = atol(argv[i + 1]);
		else if (!strcmp(argv[i], "--board"))
			board_path = argv[i + 1];
	}
	victim_start(&argc, argv, 2, "WORKERS MB [--touch KB] [--private MB] [--sparse] [--thp]");
	workers = atoi(argv[1]);
	family.main = getpid();
	know_family("prefork");
	watch_sigchld();
	fill((size_t)atol(argv[2]));
	for (i = 1; i <= workers; i++)
		start(i, private_mb);
	for (i = 1; i <= workers && i <= 24; i++)
		while (!__atomic_load_n(&board->counter[7 + i], __ATOMIC_RELAXED) && board_path)
			nap(1000);
	time_forks();
	victim_ready();
	for (;; page = page + 1 < pages ? page + 1 : 0) {
		check_place();
		check_nothing_to_wait_for();
		if (pages)
			CHECK(memory[page * PAGE_WORDS] == belongs(page, 0), "page %zu holds %lx",
			      page, memory[page * PAGE_WORDS]);
		beat();
		nap(1000);
	}
}
