/* SPDX-License-Identifier: Apache-2.0
 *
 * served FILE [--again]: reads a page of a file, which is another one each time (server --slow), to
 * one page of its memory after the other; a page that holds anything else than what was read last is
 * a violation.  --again: opens the file for each read.
 */
#include "victim.h"

enum { PAGE = 4096, WORDS = PAGE / 8, PAGES = 64, NAP_US = 1000 };

static uint64_t held[PAGES];

static void check(const uint64_t *page, int i)
{
	CHECK(page[0] == held[i] && page[WORDS - 1] == held[i],
	      "page %d holds %lu and %lu instead of %lu", i, page[0], page[WORDS - 1], held[i]);
}

int main(int argc, char **argv)
{
	const bool again = victim_flag(&argc, argv, "--again");
	uint64_t *memory;
	int fd = -1;

	victim_start(&argc, argv, 1, "FILE [--again]");
	memory = victim_memory(PAGES * PAGE, false);
	for (uint64_t laps = 0;; laps++) {
		uint64_t *page = memory + laps % PAGES * WORDS;

		if (fd < 0)
			fd = open(argv[1], O_RDONLY | O_CLOEXEC);
		must(fd >= 0, argv[1]);
		must(pread(fd, page, PAGE, 0) == PAGE, "pread");
		held[laps % PAGES] = *page;
		if (again) {
			close(fd);
			fd = -1;
		}
		for (int i = 0; i < PAGES; i++)
			check(memory + i * WORDS, i);
		if (laps == PAGES)
			victim_ready();
		beat();
		nap_us(NAP_US);
	}
}
