/* SPDX-License-Identifier: Apache-2.0
 *
 * ledger HOW FOLDER: on SIGUSR1 it does to its files what programs do (ways[]), as a log, or as a
 * database.
 *
 * counter[0]: how often.
 */
#include <signal.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/wait.h>

#include "victim.h"

enum { SMALL = 8192, BIG = 262144 };

static volatile sig_atomic_t asked;
static const char *folder;
static char text[BIG];
static int fd = -1;
static uint8_t *mapping;
static pid_t child;

static void ask(int signum)
{
	(void)signum;
	asked = 1;
}

static char *path_of(const char *name)
{
	static char path[2][512];
	static int next;
	char *p = path[next++ % 2];

	snprintf(p, sizeof path[0], "%s/%s", folder, name);
	return p;
}

static int make(const char *name, size_t bytes, int flags)
{
	const int made = open(path_of(name), flags | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
	const int filled = open(path_of(name), O_WRONLY | O_CLOEXEC);

	must(made >= 0 && write(filled, text, bytes) == (ssize_t)bytes, name);
	close(filled);
	return made;
}

static void write_on(void)
{
	must(write(fd, "line\n", 5) == 5, "write");
}

static void appended(void)
{
	fd = make("data", SMALL, O_WRONLY | O_APPEND);
}

static void output(void)
{
	fd = make("data", 0, O_WRONLY);
	must(write(fd, text, 100) == 100, "write");
}

static void recording(void)
{
	fd = make("data", 0, O_RDWR);
	must(write(fd, text, 100) == 100, "write");
}

/* As a worker of gunicorn: its master looks at the time of a file that has no name. */
static void pulse(void)
{
	fd = make("data", 0, O_RDWR);
	unlink(path_of("data"));
}

static void touch(void)
{
	must(futimens(fd, NULL) == 0, "futimens");
}

static void database(void)
{
	fd = make("data", SMALL, O_RDWR);
}

/* As InnoDB's log, whose descriptor stands at its end. */
static void database_at_its_end(void)
{
	database();
	lseek(fd, 0, SEEK_END);
}

static void read_back(void)
{
	must(read(fd, text, 100) == 100, "read");
}

static void write_in_place(void)
{
	must(pwrite(fd, "x", 1, 100) == 1, "pwrite");
}

/* As SQLite does in its WAL, whose descriptor stays where it was. */
static void extend(void)
{
	must(pwrite(fd, text, 100, lseek(fd, 0, SEEK_END)) == 100, "pwrite");
	lseek(fd, 0, SEEK_SET);
}

static void write_and_close(void)
{
	write_in_place();
	close(fd);
}

/* As etcd does with its log. */
static void locked(void)
{
	fd = make("data", SMALL, O_WRONLY);
	must(flock(fd, LOCK_EX) == 0, "flock");
}

static void map(size_t bytes)
{
	fd = make("data", bytes, O_RDWR);
	mapping = (uint8_t *)mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	must(mapping != MAP_FAILED, "mmap");
	mapping[5000] = 'b'; /* dirty: its time does not change any more */
}

static void map_small(void)
{
	map(SMALL);
}

static void map_big(void)
{
	map(BIG);
}

static void write_mapping(void)
{
	mapping[5000]++;
}

/* As sem_open(3) does: nothing is open any more. */
static void map_named(void)
{
	map(SMALL);
	close(fd);
}

static void unlink_it(void)
{
	must(unlink(path_of("data")) == 0, "unlink");
}

static void delete (void)
{
	close(fd);
	unlink_it();
}

static void scratch(void)
{
	database();
	unlink_it();
}

static void close_it(void)
{
	close(fd);
}

static void rotate(void)
{
	write_on();
	close(fd);
	must(rename(path_of("data"), path_of("data.1")) == 0, "rename");
	appended();
}

static void config_file(void)
{
	fd = make("data", SMALL, O_RDONLY);
}

static void replace(void)
{
	close(fd);
	close(make("new", SMALL, O_WRONLY));
	must(rename(path_of("new"), path_of("data")) == 0, "rename");
}

static void worker(void)
{
	const struct timespec nap = { .tv_nsec = 2000000 };

	child = fork();
	must(child >= 0, "fork");
	if (child)
		return;
	database();
	for (;;) {
		if (asked) {
			asked = 0;
			write_in_place();
			count(0, 1);
		}
		nanosleep(&nap, NULL);
	}
}

static void ask_worker(void)
{
	kill(child, SIGUSR1);
	count(0, -1); /* the child says when it is done */
}

static const struct way {
	const char *name;
	void (*setup)(void), (*write)(void);
} ways[] = {
	{ "append", appended, write_on },         { "output", output, write_on },
	{ "recording", recording, write_on },     { "rotate", appended, rotate },
	{ "read", database, read_back },          { "status", map_small, write_mapping },
	{ "replace", config_file, replace },      { "pulse", pulse, touch },
	{ "in-place", database, write_in_place }, { "extend", database, extend },
	{ "close", database, write_and_close },   { "at-end", database_at_its_end, write_in_place },
	{ "locked", locked, write_in_place },     { "mapped", map_big, write_mapping },
	{ "temporary", output, delete },          { "scratch", scratch, close_it },
	{ "worker", worker, ask_worker },         { "named", map_named, unlink_it },
};

int main(int argc, char **argv)
{
	const struct timespec nap = { .tv_nsec = 2000000 };
	const struct way *way = ways;

	victim_start(&argc, argv, 2, "HOW FOLDER");
	folder = argv[2];
	memset(text, 'a', sizeof text);
	while (strcmp(way->name, argv[1]))
		must(++way < ways + sizeof ways / sizeof *ways, argv[1]);
	signal(SIGUSR1, ask);
	way->setup();
	victim_ready();
	for (;;) {
		if (asked) {
			asked = 0;
			way->write();
			count(0, 1);
		}
		beat();
		nanosleep(&nap, NULL); /* SIGUSR1 cuts it short */
	}
}
