/* SPDX-License-Identifier: Apache-2.0
 *
 * What every victim has in common: the board and the violation.
 *
 * A victim checks its own invariants all the time.  What it finds broken it says
 * in a line that starts with "VIOLATION: ", on stdout and stderr, counts on the
 * board, and ends with status 99; to a test any violation is a failure.
 *
 * The board (--board FILE) is a page of a file, mapped shared: it is no part of
 * a checkpoint, goes on through restores, and can be read from outside without
 * asking the process for anything.  Without --board it is private.
 *
 * Common options, anywhere on the command line: --board FILE; --seconds N (ends
 * with status 0 after N seconds); --in-child (all of it is done by a child of the
 * process, which passes SIGUSR1 and SIGUSR2 on and ends as its child does).  Once set up,
 * a victim prints "ready".
 */
#ifndef VICTIM_H
#define VICTIM_H

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define BOARD_BYTES 4096
#define BOARD_MAGIC UINT64_C(0x31445242544356) /* "VCTBRD1" in memory */
#define VIOLATION_STATUS 99
#define UNAVAILABLE_STATUS 77 /* this machine cannot do what was asked for */

/* All little-endian, no padding; testkit/board.py reads it. */
struct board {
	uint64_t magic;
	uint64_t starts;     /* how often the program was started (cold) */
	uint64_t pid;        /* as the victim sees itself */
	uint64_t beats;      /* in all, over all restores and starts */
	uint64_t beat_ns;    /* CLOCK_MONOTONIC of the last one */
	uint64_t gap_ns;     /* longest time between two beats; a test may put it
	                      * back to 0 */
	uint64_t gap_end_ns; /* when that gap ended */
	uint64_t violations;
	uint64_t ready;       /* 1 once set up */
	uint64_t counter[64]; /* each victim's own */
};

static struct board private_board;
static struct board *board = &private_board;
static uint64_t victim_end_ns; /* 0: never */

static inline uint64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (uint64_t)ts.tv_sec * 1000000000 + (uint64_t)ts.tv_nsec;
}

/* One thread beats. */
static inline void beat(void)
{
	uint64_t now = now_ns(), last = board->beat_ns;

	if (last && now - last > board->gap_ns) {
		board->gap_end_ns = now;
		board->gap_ns = now - last;
	}
	board->beat_ns = now;
	__atomic_add_fetch(&board->beats, 1, __ATOMIC_RELEASE);
	if (victim_end_ns && now >= victim_end_ns)
		_exit(0);
}

static inline void count(unsigned int which, uint64_t n)
{
	__atomic_add_fetch(&board->counter[which], n, __ATOMIC_RELAXED);
}

__attribute__((format(printf, 1, 2))) static inline void complain(const char *format, ...)
{
	char line[512];
	va_list args;
	int n = snprintf(line, sizeof(line), "VIOLATION: pid %d tid %ld: ", getpid(),
			 syscall(SYS_gettid));
	int m;

	va_start(args, format);
	m = vsnprintf(line + n, sizeof(line) - (size_t)n - 1, format, args);
	va_end(args);
	n += m < (int)sizeof(line) - n - 1 ? m : (int)sizeof(line) - n - 2;
	line[n++] = '\n';
	__atomic_add_fetch(&board->violations, 1, __ATOMIC_RELEASE);
	if (write(STDOUT_FILENO, line, (size_t)n) < 0 || write(STDERR_FILENO, line, (size_t)n) < 0)
		return;
}

#define violation(...)                   \
	do {                             \
		complain(__VA_ARGS__);   \
		_exit(VIOLATION_STATUS); \
	} while (0)

#define CHECK(what, ...)                        \
	do {                                    \
		if (!(what))                    \
			violation(__VA_ARGS__); \
	} while (0)

/* Set-up that has to work: says what did not and ends. */
static inline void must(bool worked, const char *what)
{
	if (worked)
		return;
	fprintf(stderr, "victim: %s: %s\n", what, strerror(errno));
	_exit(1);
}

__attribute__((noreturn)) static inline void unavailable(const char *what)
{
	fprintf(stderr, "victim: %s: %s; not available here\n", what, strerror(errno));
	_exit(UNAVAILABLE_STATUS);
}

/* How many times later than usual things may come: testkit/harness.py, SLOWNESS. */
static inline uint64_t slowness(void)
{
	const char *said = getenv("AVCKPT_SLOWNESS");

	return said && atof(said) > 1 ? (uint64_t)atof(said) : 1;
}

static inline void board_open(const char *path)
{
	int fd = open(path, O_RDWR | O_CREAT | O_CLOEXEC, 0666);

	must(fd >= 0, path);
	must(ftruncate(fd, BOARD_BYTES) == 0, "ftruncate");
	board = (struct board *)mmap(NULL, BOARD_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	must(board != MAP_FAILED, "mmap");
	close(fd);
}

/* Takes "--name" out of argv: was it there? */
static inline bool victim_flag(int *argc, char **argv, const char *name)
{
	int i;

	for (i = 1; i < *argc; i++) {
		if (strcmp(argv[i], name))
			continue;
		memmove(argv + i, argv + i + 1, (size_t)(*argc - i) * sizeof(*argv));
		(*argc)--;
		return true;
	}
	return false;
}

/* How much the kernel maps for it: the vDSO and what belongs to it.  `unmap`: not any more. */
static inline int victim_vdso(pid_t pid, bool unmap)
{
	char path[48], line[512], *name;
	unsigned long start, end;
	int count = 0;
	FILE *maps;

	snprintf(path, sizeof path, "/proc/%d/maps", pid);
	maps = fopen(path, "re");
	must(maps != NULL, path);
	while (fgets(line, sizeof line, maps)) {
		name = strchr(line, '[');
		if (!name || (strncmp(name, "[vdso", 5) && strncmp(name, "[vvar", 5)))
			continue;
		count++;
		must(sscanf(line, "%lx-%lx", &start, &end) == 2, "sscanf");
		must(!unmap || !munmap((void *)start, end - start), "munmap");
	}
	fclose(maps);
	return count;
}

/* Anonymous memory that nothing has touched.  With `thp` of transparent huge pages, as far as
 * there are any; it ends within a page of the other kind. */
static inline void *victim_memory(size_t bytes, bool thp)
{
	void *memory = mmap(NULL, bytes + 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS,
			    -1, 0);

	must(memory != MAP_FAILED, "mmap");
	must(!thp || madvise(memory, bytes, MADV_HUGEPAGE) == 0, "madvise");
	return memory;
}

static pid_t victim_child;

static inline void victim_pass_on(int signal)
{
	if (victim_child)
		kill(victim_child, signal);
}

static inline void victim_go_on_in_child(void)
{
	int status;

	signal(SIGUSR1, victim_pass_on);
	signal(SIGUSR2, victim_pass_on);
	victim_child = fork();
	must(victim_child >= 0, "fork");
	if (victim_child) {
		must(waitpid(victim_child, &status, 0) == victim_child, "waitpid");
		_exit(WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status));
	}
	signal(SIGUSR1, SIG_DFL);
	signal(SIGUSR2, SIG_DFL);
}

/* Takes the common options out of argv and opens the board.  Needs `least`
 * arguments after the program's name, or shows `usage`. */
static inline void victim_start(int *argc, char **argv, int least, const char *usage)
{
	const bool in_child = victim_flag(argc, argv, "--in-child");
	int kept = 1, i;

	for (i = 1; i < *argc; i++) {
		if (!strcmp(argv[i], "--board") && i + 1 < *argc)
			board_open(argv[++i]);
		else if (!strcmp(argv[i], "--seconds") && i + 1 < *argc)
			victim_end_ns = now_ns() + (uint64_t)(atof(argv[++i]) * 1e9);
		else
			argv[kept++] = argv[i];
	}
	argv[kept] = NULL;
	*argc = kept;
	if (kept - 1 < least) {
		fprintf(stderr, "usage: %s %s [--board FILE] [--seconds N] [--in-child]\n", argv[0],
			usage);
		_exit(2);
	}
	if (in_child)
		victim_go_on_in_child();
	board->magic = BOARD_MAGIC;
	board->pid = (uint64_t)getpid();
	board->starts++;
	board->ready = 0;
	board->beat_ns = 0;
}

static inline void victim_ready(void)
{
	__atomic_store_n(&board->ready, 1, __ATOMIC_RELEASE);
	if (write(STDOUT_FILENO, "ready\n", 6) < 0)
		return;
}

/* As many descriptors as the hard limit allows; how many that are. */
static inline rlim_t victim_lift_descriptors(void)
{
	struct rlimit limit;

	must(!getrlimit(RLIMIT_NOFILE, &limit), "getrlimit");
	limit.rlim_cur = limit.rlim_max;
	must(!setrlimit(RLIMIT_NOFILE, &limit), "setrlimit");
	return limit.rlim_max;
}

/* A nap that nothing may cut short. */
static inline void nap_us(long us)
{
	struct timespec ts = { us / 1000000, us % 1000000 * 1000 };
	int err = clock_nanosleep(CLOCK_MONOTONIC, 0, &ts, NULL);

	CHECK(err == 0, "a nap ended with %s", strerror(err));
}

/* xorshift64*: cheap numbers, a state of one's own. */
static inline uint64_t next_random(uint64_t *state)
{
	*state ^= *state >> 12;
	*state ^= *state << 25;
	*state ^= *state >> 27;
	return *state * UINT64_C(0x2545F4914F6CDD1D);
}

/* Which value belongs at a place: a good mixture of two numbers. */
static inline uint64_t mix(uint64_t a, uint64_t b)
{
	uint64_t x = a * UINT64_C(0x9E3779B97F4A7C15) ^ (b + UINT64_C(0x7F4A7C15));

	x ^= x >> 31;
	x *= UINT64_C(0xBF58476D1CE4E5B9);
	return x ^ x >> 27;
}

#endif
