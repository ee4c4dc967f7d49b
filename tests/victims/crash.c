/* SPDX-License-Identifier: Apache-2.0
 *
 * crash [HOW SECONDS] [--threads N]: SIGUSR1 makes it fault, SIGUSR2 abort(), SIGHUP exit(3),
 * from its main loop, not from the handler.  With HOW (segv, abort, exit, fpe,
 * ill, kill) it does so by itself, SECONDS after its start.  Beats every 1 ms.
 * With N threads all of them crash at that time, whoever comes first.
 */
#include <pthread.h>
#include <signal.h>

#include "victim.h"

static volatile sig_atomic_t asked;
static int *volatile nowhere = (int *)8; /* the compiler must not know */

static void on_signal(int sig)
{
	asked = sig;
}

static void crash(const char *how)
{
	if (!strcmp(how, "segv"))
		*nowhere = 1;
	if (!strcmp(how, "abort"))
		abort();
	if (!strcmp(how, "exit"))
		exit(3);
	if (!strcmp(how, "fpe"))
		raise(SIGFPE);
	if (!strcmp(how, "ill"))
		__builtin_trap();
	if (!strcmp(how, "kill"))
		raise(SIGKILL);
	fprintf(stderr, "crash: no way to crash is called %s\n", how);
	_exit(2);
}

static uint64_t crash_ns;
static const char *crash_how;

static void *crash_in_time(void *unused)
{
	(void)unused;
	for (;;) {
		nap_us(500);
		if (crash_ns && now_ns() >= crash_ns)
			crash(crash_how);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	bool many = victim_flag(&argc, argv, "--threads");
	struct sigaction act = { .sa_handler = on_signal, .sa_flags = SA_RESTART };
	pthread_t thread;
	long i;

	victim_start(&argc, argv, 0, "[HOW SECONDS] [--threads N]");
	if (argc > 2)
		crash_ns = now_ns() + (uint64_t)(atof(argv[2]) * 1e9);
	crash_how = argv[1];
	for (i = 0; many && argc > 1 && i < atol(argv[argc - 1]); i++)
		must(!pthread_create(&thread, NULL, crash_in_time, NULL), "pthread_create");
	sigaction(SIGUSR1, &act, NULL);
	sigaction(SIGUSR2, &act, NULL);
	sigaction(SIGHUP, &act, NULL);
	victim_ready();
	for (;;) {
		usleep(1000); /* cut short by the signals above */
		beat();
		if (asked)
			crash(asked == SIGUSR1 ? "segv" : asked == SIGUSR2 ? "abort" : "exit");
		if (crash_ns && now_ns() >= crash_ns)
			crash(argv[1]);
	}
}
