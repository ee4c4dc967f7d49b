/* SPDX-License-Identifier: Apache-2.0
 *
 * Scenarios: state of a kind, disturbed after a checkpoint and looked at after a restore.
 *
 *   PROGRAM SCENARIO FOLDER
 *
 * SIGUSR1 disturbs, as told by the scenario; the board counts it (counter 0 before, counter 2
 * when it is done), but the process's own memory forgets it with a restore.  A process that
 * finds the board ahead of its memory was restored: it verifies that everything is as it was
 * set up, counts that (counter 1), and goes on.  Files are made in FOLDER.
 */
#ifndef SCENARIO_H
#define SCENARIO_H

#include <signal.h>

#include "victim.h"

struct scenario {
	const char *name;
	void (*setup)(void), (*disturb)(void), (*verify)(void);
};

static const char *folder;
static volatile sig_atomic_t asked;
static int fd[64];
static char scratch[65536];

static inline char *path_of(const char *name)
{
	static char path[8][512];
	static int next;
	char *p = path[next++ % 8];

	snprintf(p, sizeof path[0], "%s/%s", folder, name);
	return p;
}

static inline int make_file(const char *name, const char *text, int flags)
{
	int f = open(path_of(name), O_WRONLY | O_CREAT | O_TRUNC, 0600);

	must(f >= 0 && write(f, text, strlen(text)) == (ssize_t)strlen(text), name);
	close(f);
	f = open(path_of(name), flags);
	must(f >= 0, name);
	return f;
}

static inline bool is_open(int f)
{
	return fcntl(f, F_GETFD) >= 0;
}

static inline void expect_text(int f, const char *text, const char *what)
{
	const ssize_t n = read(f, scratch, sizeof scratch - 1);

	scratch[n > 0 ? n : 0] = 0;
	CHECK(n == (ssize_t)strlen(text) && !strcmp(scratch, text),
	      "%s: read %zd (%s) \"%.40s\" instead of \"%.40s\"", what, n,
	      n < 0 ? strerror(errno) : "", scratch, text);
}

/* For a scenario that does without a step. */
static inline void nothing(void)
{
}

static inline void on_signal(int signal)
{
	(void)signal;
	asked = 1;
}

/* The whole of main(). */
static inline _Noreturn void play(int argc, char **argv, const struct scenario *scenarios, size_t n)
{
	const struct scenario *scenario = NULL;
	uint64_t disturbed = 0;

	victim_start(&argc, argv, 2, "SCENARIO FOLDER");
	folder = argv[2];
	for (size_t i = 0; i < n; i++)
		if (!strcmp(argv[1], scenarios[i].name))
			scenario = &scenarios[i];
	must(scenario != NULL, "no such scenario");
	sigaction(SIGUSR1, &(struct sigaction){ .sa_handler = on_signal, .sa_flags = SA_RESTART },
		  NULL);
	scenario->setup();
	victim_ready();
	for (;;) {
		const struct timespec pause = { 0, 1000000 };

		nanosleep(&pause, NULL);
		beat();
		if (board->counter[0] > disturbed) {
			disturbed = board->counter[0];
			scenario->verify();
			count(1, 1);
		}
		if (asked) {
			asked = 0;
			disturbed++;
			count(0, 1);
			scenario->disturb();
			count(2, 1);
		}
	}
}

#endif
