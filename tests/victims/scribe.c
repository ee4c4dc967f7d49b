/* SPDX-License-Identifier: Apache-2.0
 *
 * scribe HOW FILE: on SIGUSR1 it writes into FILE, or nearly, and has it open neither
 * before nor afterwards.
 *
 *   closed       opens, writes, closes
 *   child        has a child do it
 *   read         opens it for writing, but only reads
 *   mapped       through a mapping that it has from the start
 *   same         the same, but what it writes is there already
 *   late         through a mapping that it makes now, and keeps
 *
 * counter[0]: how often.
 */
#include <signal.h>
#include <sys/wait.h>

#include "victim.h"

enum { BYTES = 8192 };

static volatile sig_atomic_t asked;
static const char *how, *path;
static uint8_t *mapping;

static void ask(int signum)
{
	(void)signum;
	asked = 1;
}

static bool is(const char *word)
{
	return !strcmp(how, word);
}

static void write_and_close(void)
{
	int fd = open(path, O_RDWR | O_CLOEXEC);

	must(fd >= 0 && pwrite(fd, "x", 1, 100) == 1 && close(fd) == 0, path);
}

static void map(void)
{
	int fd = open(path, O_RDWR | O_CLOEXEC);

	must(fd >= 0, path);
	mapping = (uint8_t *)mmap(NULL, BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	must(mapping != MAP_FAILED, "mmap");
	close(fd);
}

static void do_it(void)
{
	char byte;

	if (is("closed")) {
		write_and_close();
	} else if (is("child")) {
		const pid_t child = fork();

		if (child == 0) {
			write_and_close();
			_exit(0);
		}
		must(child > 0 && waitpid(child, NULL, 0) == child, "child");
	} else if (is("read")) {
		int fd = open(path, O_RDWR | O_CLOEXEC);

		must(fd >= 0 && pread(fd, &byte, 1, 0) == 1 && close(fd) == 0, path);
	} else {
		if (is("late"))
			map();
		mapping[5000] = is("same") ? 'a' : 'x';
	}
	count(0, 1);
}

int main(int argc, char **argv)
{
	const struct timespec nap = { .tv_nsec = 2000000 };
	int fd;
	char text[BYTES];

	victim_start(&argc, argv, 2, "HOW FILE");
	how = argv[1];
	path = argv[2];
	memset(text, 'a', sizeof text);
	fd = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
	must(fd >= 0 && write(fd, text, sizeof text) == sizeof text && close(fd) == 0, path);
	if (is("mapped") || is("same")) {
		map();
		mapping[5000] = 'a'; /* dirty: its time does not change any more */
	}
	signal(SIGUSR1, ask);
	victim_ready();
	for (;;) {
		if (asked) {
			asked = 0;
			do_it();
		}
		beat();
		nanosleep(&nap, NULL); /* SIGUSR1 cuts it short */
	}
}
