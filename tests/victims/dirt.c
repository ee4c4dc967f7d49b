/* SPDX-License-Identifier: Apache-2.0
 *
 * dirt MB THREADS [--rate KB_PER_S] [--maps] [--grows]: memory that is written at random, all the
 * time, and read again.
 *
 * Each thread has a part of MB, and a table that says what stands in each page of it; a page that
 * holds anything else is a violation, and so is memory of another moment than the registers.  It
 * writes pages, gives some back (MADV_DONTNEED) and protects some for a while.  With --maps it also
 * unmaps and maps again, moves mappings, grows and shrinks the heap, has mappings that come and go or
 * stay, guard pages, pages of a file that it writes and gives back, and deep stacks.  With --grows
 * a mapping of its own grows downwards (MAP_GROWSDOWN).  KB_PER_S (0: as fast as it can) of all
 * threads together.
 */
#include <pthread.h>
#include <sys/mman.h>

#include "victim.h"

#define PAGE 4096
#define WORDS (PAGE / 8)
#ifndef MADV_GUARD_INSTALL
#define MADV_GUARD_INSTALL 102
#define MADV_GUARD_REMOVE 103
#endif
enum {
	THREADS_MAX = 64,
	RUN_MAX = 16,
	DEPTH_MAX = 24,
	NAP_US = 1000,
	BLOCKS = 8,
	BLOCK_PAGES_MAX = 96,
	FILE_PAGES = 64,
	GROWN_MAX = 1024 /* RLIMIT_STACK, mostly 8 MB, holds for any mapping that grows */
};

static size_t part_pages;
static int threads;
static uint64_t rate;
static bool with_maps, grows;

/* A mapping that stays for a while. */
struct block {
	uint64_t *at, stamp;
	size_t pages;
	bool read_only;
};

struct part {
	int index;
	struct block block[BLOCKS];
	uint64_t *file, file_stamp[FILE_PAGES]; /* mapped privately; 0: as in the file    */
	uint64_t *heap_at, heap_stamp; /* of the first part: what the heap has grown by     */
	uint64_t random, stamps, laps;
	char *memory;
	uint64_t *expected; /* by page; 0: nothing was written                 */
};

static char *page_of(const struct part *part, size_t i)
{
	return part->memory + i * PAGE;
}

static void write_page(struct part *part, size_t i)
{
	volatile uint64_t *page = (uint64_t *)page_of(part, i);
	const uint64_t stamp = mix(++part->stamps, (uint64_t)part->index);

	part->expected[i] = stamp;
	page[0] = stamp;
	page[stamp % (WORDS - 2) + 1] = stamp;
	page[WORDS - 1] = stamp;
}

static void check_page(const struct part *part, size_t i)
{
	const uint64_t *page = (const uint64_t *)page_of(part, i), stamp = part->expected[i];
	const size_t middle = stamp % (WORDS - 2) + 1;

	CHECK(page[0] == stamp && page[WORDS - 1] == stamp && (!stamp || page[middle] == stamp),
	      "page %zu of part %d holds %lx %lx %lx instead of %lx", i, part->index, page[0],
	      page[middle], page[WORDS - 1], stamp);
}

static void forget(struct part *part, size_t first, size_t count)
{
	memset(part->expected + first, 0, count * sizeof *part->expected);
}

/* Some pages one behind the other. */
static size_t choose(struct part *part, size_t *first)
{
	const size_t most = part_pages < RUN_MAX ? part_pages : RUN_MAX;
	const size_t pages = 1 + next_random(&part->random) % most;

	*first = next_random(&part->random) % (part_pages - pages + 1);
	return pages;
}

static void give_back(struct part *part)
{
	size_t first, pages = choose(part, &first);

	must(!madvise(page_of(part, first), pages * PAGE, MADV_DONTNEED), "madvise");
	forget(part, first, pages);
}

static void protect(struct part *part)
{
	size_t first, pages = choose(part, &first);

	must(!mprotect(page_of(part, first), pages * PAGE, PROT_NONE), "mprotect");
	nap_us(50);
	must(!mprotect(page_of(part, first), pages * PAGE, PROT_READ), "mprotect");
	for (size_t i = 0; i < pages; i++)
		check_page(part, first + i);
	must(!mprotect(page_of(part, first), pages * PAGE, PROT_READ | PROT_WRITE), "mprotect");
}

/* ---- --maps ---------------------------------------------------------------------------------- */

static void map_again(struct part *part)
{
	size_t first, pages = choose(part, &first);
	char *at = page_of(part, first);

	/* Else another thread may get the place. */
	if (threads == 1 && next_random(&part->random) & 1)
		must(!munmap(at, pages * PAGE), "munmap");
	must(mmap(at, pages * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED,
		  -1, 0) == at,
	     "mmap");
	forget(part, first, pages);
}

/* Somewhere else, for a moment. */
static void move(struct part *part)
{
	size_t first, pages = choose(part, &first);
	char *at = page_of(part, first), *away;

	away = mmap(NULL, pages * PAGE, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	must(away != MAP_FAILED, "mmap");
	/* What was split must not be moved in one piece (mremap(2)). */
	for (size_t i = 0; i < pages; i++)
		must(mremap(at + i * PAGE, PAGE, PAGE,
			    MREMAP_MAYMOVE | MREMAP_FIXED | MREMAP_DONTUNMAP,
			    away + i * PAGE) == away + i * PAGE,
		     "mremap");
	nap_us(50);
	for (size_t i = 0; i < pages; i++)
		must(mremap(away + i * PAGE, PAGE, PAGE, MREMAP_MAYMOVE | MREMAP_FIXED,
			    at + i * PAGE) == at + i * PAGE,
		     "mremap");
}

static void come_and_go(struct part *part)
{
	const size_t pages = 1 + next_random(&part->random) % 64;
	const uint64_t stamp = next_random(&part->random);
	uint64_t *at = mmap(NULL, pages * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS,
			    -1, 0);

	must(at != MAP_FAILED, "mmap");
	for (size_t i = 0; i < pages; i++)
		at[i * WORDS] = mix(stamp, i);
	nap_us(100);
	for (size_t i = 0; i < pages; i++)
		CHECK(at[i * WORDS] == mix(stamp, i), "page %zu of a new mapping holds %lx", i,
		      at[i * WORDS]);
	must(!munmap(at, pages * PAGE), "munmap");
}

static void guard(struct part *part)
{
	size_t first, pages = choose(part, &first);
	char *at = page_of(part, first);

	if (madvise(at, pages * PAGE, MADV_GUARD_INSTALL))
		return; /* since Linux 6.13 */
	forget(part, first, pages);
	nap_us(50);
	must(!madvise(at, pages * PAGE, MADV_GUARD_REMOVE), "madvise");
	for (size_t i = 0; i < pages; i++)
		check_page(part, first + i);
}

/* Only one thread may: the heap is everybody's. */
static void grow_heap(struct part *part)
{
	const size_t bytes = PAGE * (1 + next_random(&part->random) % 32);
	const uint64_t stamp = next_random(&part->random);
	uint64_t *at = sbrk((intptr_t)bytes);

	must(at != (void *)-1, "sbrk");
	for (size_t i = 0; i < bytes / 8; i += WORDS)
		at[i] = mix(stamp, i);
	nap_us(50);
	for (size_t i = 0; i < bytes / 8; i += WORDS)
		CHECK(at[i] == mix(stamp, i), "the heap holds %lx", at[i]);
	/* Somebody else's allocation may be behind it by now. */
	if (sbrk(0) == (char *)at + bytes)
		must(sbrk(-(intptr_t)bytes) != (void *)-1, "sbrk");
}

static void fill(uint64_t *at, size_t from, size_t pages, uint64_t stamp)
{
	for (size_t i = from; i < pages; i++)
		at[i * WORDS] = mix(stamp, i);
}

static void check_filled(const uint64_t *at, size_t pages, uint64_t stamp)
{
	for (size_t i = 0; i < pages; i++)
		CHECK(at[i * WORDS] == mix(stamp, i), "page %zu of a block holds %lx", i,
		      at[i * WORDS]);
}

static void map_file(struct part *part)
{
	FILE *file = tmpfile();

	must(file != NULL, "tmpfile");
	for (uint64_t i = 0; i < FILE_PAGES; i++)
		must(pwrite(fileno(file), &i, sizeof i, (off_t)(i * PAGE)) == sizeof i, "pwrite");
	must(!ftruncate(fileno(file), (off_t)FILE_PAGES * PAGE), "ftruncate");
	part->file = mmap(NULL, (size_t)FILE_PAGES * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE,
			  fileno(file), 0);
	must(part->file != MAP_FAILED, "mmap");
	fclose(file);
}

static void change_file(struct part *part)
{
	const uint64_t stamp = next_random(&part->random);
	const size_t first = stamp % FILE_PAGES;
	size_t pages = 1 + (stamp >> 8) % RUN_MAX;

	if (pages > FILE_PAGES - first)
		pages = FILE_PAGES - first;
	for (size_t i = first; i < first + pages; i++) {
		const uint64_t expected = part->file_stamp[i] ? part->file_stamp[i] : i;

		CHECK(part->file[i * WORDS] == expected, "page %zu of a file holds %lx", i,
		      part->file[i * WORDS]);
	}
	if (stamp >> 63) {
		must(!madvise(part->file + first * WORDS, pages * PAGE, MADV_DONTNEED), "madvise");
		memset(part->file_stamp + first, 0, pages * sizeof *part->file_stamp);
	} else {
		part->file[first * WORDS] = part->file_stamp[first] = stamp;
	}
}

/* By one page, as by a thread whose stack that is. */
static void grow_down(void)
{
	static char *top;
	static uint64_t pages;

	if (!top) {
		top = mmap((void *)0x500000000000, PAGE, PROT_READ | PROT_WRITE,
			   MAP_PRIVATE | MAP_ANONYMOUS | MAP_GROWSDOWN, -1, 0);
		must(top != MAP_FAILED, "mmap");
		top += PAGE;
	}
	pages++;
	*(volatile uint64_t *)(top - pages * PAGE) = pages;
	for (uint64_t i = 1; i <= pages; i++) {
		const uint64_t holds = *(uint64_t *)(top - i * PAGE);

		CHECK(holds == i, "page %lu of what grows holds %lx", i, holds);
	}
	if (pages < GROWN_MAX)
		return;
	must(!munmap(top - pages * PAGE, pages * PAGE), "munmap");
	top = NULL;
	pages = 0;
}

/* As malloc(3) does: a block comes, grows, is protected, goes. */
static void change_block(struct part *part)
{
	struct block *block = &part->block[next_random(&part->random) % BLOCKS];
	const uint64_t stamp = next_random(&part->random);
	const size_t pages = 1 + stamp % BLOCK_PAGES_MAX, was = block->pages;
	void *at;

	check_filled(block->at, was, block->stamp);
	if (was && stamp >> 60 < 4) {
		block->read_only = !block->read_only;
		must(!mprotect(block->at, was * PAGE,
			       block->read_only ? PROT_READ : PROT_READ | PROT_WRITE),
		     "mprotect");
	} else if (was && !block->read_only && stamp >> 60 < 10) {
		at = mremap(block->at, was * PAGE, pages * PAGE, MREMAP_MAYMOVE);
		if (at == MAP_FAILED)
			return; /* it is two to the kernel, where it is watched in part */
		block->at = at;
		block->pages = pages;
		fill(block->at, was, pages, block->stamp);
	} else {
		must(!was || !munmap(block->at, was * PAGE), "munmap");
		at = mmap(NULL, pages * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS,
			  -1, 0);
		must(at != MAP_FAILED, "mmap");
		*block = (struct block){ .at = at, .stamp = stamp, .pages = pages };
		fill(block->at, 0, pages, stamp);
	}
}

/* By a page and some, which stays until the next time. */
static void step_heap(struct part *part)
{
	enum { BYTES = PAGE + 64 };
	uint64_t *at = part->heap_at;

	if (at) {
		CHECK(*at == part->heap_stamp, "the heap holds %lx", *at);
		part->heap_at = NULL;
		if (sbrk(0) == (char *)at + BYTES)
			must(sbrk(-BYTES) != (void *)-1, "sbrk");
		return;
	}
	at = sbrk(BYTES);
	must(at != (void *)-1, "sbrk");
	part->heap_at = at;
	part->heap_stamp = *at = next_random(&part->random);
}

__attribute__((noinline)) static uint64_t dive(int depth, uint64_t stamp)
{
	volatile uint64_t here[WORDS];
	uint64_t below;

	for (size_t i = 0; i < WORDS; i += 64)
		here[i] = mix(stamp, i + (size_t)depth);
	below = depth ? dive(depth - 1, stamp) : (nap_us(50), stamp);
	for (size_t i = 0; i < WORDS; i += 64)
		CHECK(here[i] == mix(stamp, i + (size_t)depth), "the stack holds %lx", here[i]);
	return below;
}

/* ---- all of it --------------------------------------------------------------------------------- */

static void change_maps(struct part *part)
{
	const uint64_t stamp = next_random(&part->random);

	switch (stamp % 9) {
	case 0:
		map_again(part);
		return;
	case 1:
		move(part);
		return;
	case 2:
		come_and_go(part);
		return;
	case 3:
		guard(part);
		return;
	case 4:
		if (!part->index)
			grow_heap(part);
		return;
	case 5:
		change_block(part);
		return;
	case 6:
		if (!part->index)
			step_heap(part);
		return;
	case 7:
		change_file(part);
		return;
	default:
		CHECK(dive((int)((stamp >> 8) % DEPTH_MAX), stamp) == stamp, "the stack is torn");
	}
}

static void step(struct part *part)
{
	const uint64_t what = next_random(&part->random) % 1024;

	if (what == 0)
		give_back(part);
	else if (what == 1)
		protect(part);
	else if (what < 12 && with_maps)
		change_maps(part);
	else
		write_page(part, next_random(&part->random) % part_pages);
	check_page(part, next_random(&part->random) % part_pages);
}

/* The value is in a register meanwhile, and nowhere else. */
static __attribute__((noinline)) uint64_t nap_with(uint64_t value)
{
	nap_us(NAP_US);
	__asm__ volatile("" : "+r"(value));
	return value;
}

static void *work(void *arg)
{
	struct part *part = arg;
	const uint64_t start = now_ns();
	uint64_t steps = 0, laps = 0;

	for (;; laps++) {
		const uint64_t elapsed_us = (now_ns() - start) / 1000;
		const uint64_t due = rate ? elapsed_us * rate / (uint64_t)threads / 4 / 1000000
					  : steps + 256;

		CHECK(part->laps++ == laps, "lap %lu, in memory %lu", laps, part->laps - 1);
		/* After a restore much is due. */
		if (due > steps + 4096)
			steps = due - 4096;
		for (; steps < due; steps++)
			step(part);
		if (!part->index && grows)
			grow_down();
		if (!part->index)
			beat();
		if (rate)
			laps = nap_with(laps);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	static struct part parts[THREADS_MAX];
	pthread_attr_t attr;

	with_maps = victim_flag(&argc, argv, "--maps");
	grows = victim_flag(&argc, argv, "--grows");
	victim_start(&argc, argv, 2, "MB THREADS [--rate KB_PER_S] [--maps] [--grows]");
	if (argc > 4 && !strcmp(argv[3], "--rate"))
		rate = strtoull(argv[4], NULL, 10);
	threads = atoi(argv[2]) < THREADS_MAX ? atoi(argv[2]) : THREADS_MAX;
	part_pages = ((size_t)atol(argv[1]) << 20) / PAGE / (size_t)threads;
	pthread_attr_init(&attr);
	pthread_attr_setstacksize(&attr, 256 << 10);
	for (int i = 0; i < threads; i++) {
		struct part *part = &parts[i];

		part->index = i;
		part->random = mix((uint64_t)i + 1, 7);
		part->memory = victim_memory(part_pages * PAGE, false);
		part->expected = calloc(part_pages, sizeof *part->expected);
		must(part->expected != NULL, "calloc");
		for (size_t k = 0; k < part_pages; k++)
			write_page(part, k);
		if (with_maps)
			map_file(part);
	}
	for (int i = 1; i < threads; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, &attr, work, &parts[i]), "pthread_create");
	}
	victim_ready();
	work(&parts[0]);
}
