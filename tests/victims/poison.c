/* SPDX-License-Identifier: Apache-2.0
 *
 * poison CRASH_MS: beats; SIGUSR1 poisons its state: from then on, and from every
 * restore of a poisoned image, it crashes CRASH_MS of its own run time later.
 * SIGUSR2 makes it hang: it stops to beat and to touch the file `alive` (--alive
 * FILE), which a health check looks at, until it is killed.
 *
 * Run time counts in loops of 1 ms, so that a restored process has its whole
 * fuse again, as a deterministic bug has.  counter[0] is how often the board saw
 * a poisoned run start.
 */
#include <signal.h>
#include <sys/stat.h>

#include "victim.h"

static volatile sig_atomic_t poisoned, hung;

static void on_signal(int sig)
{
	if (sig == SIGUSR1)
		poisoned = 1;
	else
		hung = 1;
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_signal, .sa_flags = SA_RESTART };
	long fuse, loops = 0;
	const char *alive = NULL;

	victim_start(&argc, argv, 1, "CRASH_MS [--alive FILE]");
	fuse = atol(argv[1]);
	for (int i = 2; i + 1 < argc; i++)
		if (!strcmp(argv[i], "--alive"))
			alive = argv[i + 1];
	sigaction(SIGUSR1, &act, NULL);
	sigaction(SIGUSR2, &act, NULL);
	victim_ready();
	for (;;) {
		usleep(1000); /* cut short by the signals above */
		if (hung)
			continue;
		beat();
		if (alive && loops % 50 == 0) {
			int fd = open(alive, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);

			must(fd >= 0, alive);
			close(fd);
		}
		loops++;
		if (poisoned && fuse-- <= 0)
			abort();
	}
}
