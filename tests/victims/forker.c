/* SPDX-License-Identifier: Apache-2.0
 *
 * forker [AFTER_SECONDS [FOR_SECONDS]]: has a child process, from AFTER_SECONDS
 * after its start (0) for FOR_SECONDS (0: for ever).  The child beats on counter
 * 0; the parent sees that its child is its child, and that it is reaped once.
 */
#include <signal.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "victim.h"

int main(int argc, char **argv)
{
	uint64_t from_ns, to_ns = 0;
	pid_t child = 0, me;
	int status;

	victim_start(&argc, argv, 0, "[AFTER_SECONDS [FOR_SECONDS]]");
	me = getpid();
	from_ns = now_ns() + (uint64_t)((argc > 1 ? atof(argv[1]) : 0) * 1e9);
	if (argc > 2 && atof(argv[2]) > 0)
		to_ns = from_ns + (uint64_t)(atof(argv[2]) * 1e9);
	victim_ready();
	for (;;) {
		if (!child && now_ns() >= from_ns) {
			child = fork();
			must(child >= 0, "fork");
			if (child == 0) {
				prctl(PR_SET_PDEATHSIG, SIGKILL);
				for (;;) {
					CHECK(getppid() == me, "my parent is %d", getppid());
					count(0, 1);
					nap_us(1000);
				}
			}
			board->counter[1] = (uint64_t)child;
		}
		if (child > 0)
			CHECK(waitpid(child, &status, WNOHANG) == 0, "the child %d is gone", child);
		if (child > 0 && to_ns && now_ns() >= to_ns) {
			kill(child, SIGKILL);
			CHECK(waitpid(child, &status, 0) == child, "waitpid: %s", strerror(errno));
			CHECK(waitpid(-1, NULL, WNOHANG) == -1 && errno == ECHILD,
			      "there is another child");
			child = -1;
			board->counter[1] = 0;
		}
		beat();
		nap_us(1000);
	}
}
