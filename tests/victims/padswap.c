/* SPDX-License-Identifier: Apache-2.0
 *
 * padswap FILE: from SIGUSR1 on, it replaces avckpt's parasite by a mapping of FILE, which it may
 * only read, as soon as one is brought in, and goes on doing so.
 *
 * For that it has to know where the parasite will come and how large it is.  The size it takes from
 * a first one, whose guard has died by then.  It leaves no other place but the kernel's choice, and
 * asks the kernel for that beforehand.  counter[0] says that it has seen the first one, counter[1]
 * that it lies in wait, counter[2] how often it has replaced the second one.
 */
#include <pthread.h>

#include "parasite_place.h"

static struct place place;
static int file;
static volatile sig_atomic_t asked;

static void ask(int signal)
{
	(void)signal;
	asked = 1;
}

static void occupy(uint64_t start, uint64_t end)
{
	void *at = mmap((void *)start, end - start, PROT_NONE,
			MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE | MAP_FIXED, -1, 0);

	must(at != MAP_FAILED, "mmap");
}

/* Where the kernel puts the next one of that size. */
static void *next_place(int flags)
{
	void *at = mmap((void *)PLACES_START, place.bytes, PROT_NONE,
			flags | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);

	must(at != MAP_FAILED && munmap(at, place.bytes) == 0, "mmap");
	return at;
}

static void *lie_in_wait(void *unused)
{
	unsigned char pages[2];
	void *at, *other;

	(void)unused;
	occupy(PLACES_START, place.start);
	occupy(place.start + place.bytes, PLACES_END);
	at = next_place(MAP_SHARED);
	other = next_place(MAP_PRIVATE); /* may be of huge pages, which have their own places */
	count(1, 1);
	while (mincore(at, 4096, pages) < 0) {
		if (other != at && mincore(other, 4096, pages) == 0) {
			at = other;
			break;
		}
	}
	for (;;) {
		must(mmap(at, place.bytes, PROT_READ, MAP_SHARED | MAP_FIXED, file, 0) == at,
		     "mmap");
		count(2, 1);
	}
	return unused;
}

int main(int argc, char **argv)
{
	pthread_t thread;

	victim_start(&argc, argv, 1, "FILE");
	signal(SIGUSR1, ask);
	file = open(argv[1], O_RDONLY | O_CLOEXEC);
	must(file >= 0, argv[1]);
	victim_ready();
	place = await_parasite();
	count(0, 1);
	while (!asked) {
		usleep(5000);
		beat();
	}
	must(pthread_create(&thread, NULL, lie_in_wait, NULL) == 0, "pthread_create");
	for (;;) {
		usleep(5000);
		beat();
	}
}
