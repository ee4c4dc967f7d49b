/* SPDX-License-Identifier: Apache-2.0
 *
 * fenced [--whole] [--in-thread] MB: at SIGUSR1 it enters a Landlock domain in which it may open
 * nothing for writing (landlock(7)), at the next one another below that, and so on.  From then on it
 * checks that it cannot, as often as it remembers that it must not.
 *
 * --whole: it is in another one from the start, before it has children and threads
 * --in-thread: a thread of it enters them, and checks
 *
 * counter 0: the number of domains that it is in.
 */
#include <linux/landlock.h>
#include <pthread.h>
#include <sys/prctl.h>

#include "victim.h"

static int fences;

static void enter(uint64_t forbidden)
{
	const struct landlock_ruleset_attr none = { .handled_access_fs = forbidden };
	const int ruleset = (int)syscall(SYS_landlock_create_ruleset, &none, sizeof none, 0);

	if (ruleset < 0)
		unavailable("landlock_create_ruleset");
	must(!syscall(SYS_landlock_restrict_self, ruleset, 0), "landlock_restrict_self");
	close(ruleset);
}

static void *live(void *arg)
{
	const struct timespec nap = { 0, 1000000 };
	sigset_t usr1;

	(void)arg;
	sigemptyset(&usr1);
	sigaddset(&usr1, SIGUSR1);
	for (;;) {
		int fd;

		if (sigtimedwait(&usr1, NULL, &nap) == SIGUSR1) {
			enter(LANDLOCK_ACCESS_FS_WRITE_FILE);
			fences++;
		}
		board->counter[0] = (uint64_t)fences;
		fd = open("/dev/null", O_WRONLY | O_CLOEXEC);
		CHECK((fd < 0) == (fences > 0), "in %d domains, and open said %d", fences, fd);
		if (fd >= 0)
			close(fd);
		beat();
	}
	return NULL;
}

int main(int argc, char **argv)
{
	const bool whole = victim_flag(&argc, argv, "--whole"),
		   in_thread = victim_flag(&argc, argv, "--in-thread");
	pthread_t thread;
	sigset_t usr1;
	size_t bytes;

	/* So that its domain is all that changes. */
	must(!prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "PR_SET_NO_NEW_PRIVS");
	if (whole)
		enter(LANDLOCK_ACCESS_FS_MAKE_CHAR);
	victim_start(&argc, argv, 1, "MB");
	bytes = (size_t)atol(argv[1]) << 20;
	memset(victim_memory(bytes, false), 1, bytes);
	sigemptyset(&usr1);
	sigaddset(&usr1, SIGUSR1);
	must(!sigprocmask(SIG_BLOCK, &usr1, NULL), "sigprocmask");
	if (in_thread)
		must(!pthread_create(&thread, NULL, live, NULL), "pthread_create");
	victim_ready();
	while (in_thread)
		pause();
	live(NULL);
}
