/* SPDX-License-Identifier: Apache-2.0
 *
 * alarm MS: sets alarms and one-shot POSIX timers again and again, MS from now, with
 * handlers, and waits for them: none may come early or late by more than a checkpoint
 * or a restore takes.
 */
#include <signal.h>
#include <sys/time.h>

#include "victim.h"

enum { LATE_MS = 400 };

static volatile uint64_t due_ns;
static volatile int rung;

static void on_alarm(int sig)
{
	(void)sig;
	rung = 1;
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_alarm };
	uint64_t ms, lap;
	timer_t timer;

	victim_start(&argc, argv, 1, "MS");
	ms = (uint64_t)atol(argv[1]);
	sigaction(SIGALRM, &act, NULL);
	must(!timer_create(CLOCK_MONOTONIC, NULL, &timer), "timer_create");
	victim_ready();
	for (lap = 0;; lap++) {
		const struct timespec in = { (time_t)(ms / 1000), (long)(ms % 1000 * 1000000) };
		const struct itimerval alarm_in = { { 0, 0 }, { in.tv_sec, in.tv_nsec / 1000 } };
		const struct itimerspec timer_in = { { 0, 0 }, in };
		uint64_t now;

		rung = 0;
		due_ns = now_ns() + ms * 1000000;
		if (lap % 2)
			must(!setitimer(ITIMER_REAL, &alarm_in, NULL), "setitimer");
		else
			must(!timer_settime(timer, 0, &timer_in, NULL), "timer_settime");
		while (!rung) {
			beat();
			usleep(500);
			CHECK(now_ns() < due_ns + LATE_MS * slowness() * UINT64_C(1000000),
			      "%s has not come", lap % 2 ? "an alarm" : "a POSIX timer");
		}
		now = now_ns();
		CHECK(now + 1000000 > due_ns, "%s came %ld us early",
		      lap % 2 ? "an alarm" : "a POSIX timer", (long)(due_ns - now) / 1000);
		count(0, 1);
	}
}
