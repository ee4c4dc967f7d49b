/* SPDX-License-Identifier: Apache-2.0
 *
 * alarm MS: sets alarms and one-shot POSIX timers again and again, MS from now, with
 * handlers, and waits for them: all come, and none early.
 *
 * alarm MS alarm|timer|ticks: one of the two is its watchdog.  It sets it again every 5 ms, and no
 * handler keeps the signal from killing it.  `ticks`: an alarm that would ring again every 1 ms.
 */
#include <signal.h>
#include <sys/time.h>

#include "victim.h"

/* An image is that old at most, and the time up to the alarm is what it was then. */
enum { LATE_MS = 3000 };

static volatile uint64_t due_ns;
static volatile int rung;

static void on_alarm(int sig)
{
	(void)sig;
	rung = 1;
}

static void set_alarm(uint64_t ms, long again_us)
{
	const struct itimerval in = { { 0, again_us },
				      { (time_t)(ms / 1000), (long)(ms % 1000 * 1000) } };

	must(!setitimer(ITIMER_REAL, &in, NULL), "setitimer");
}

static void set_timer(timer_t timer, uint64_t ms)
{
	const struct itimerspec in = { { 0, 0 },
				       { (time_t)(ms / 1000), (long)(ms % 1000 * 1000000) } };

	must(!timer_settime(timer, 0, &in, NULL), "timer_settime");
}

static void watch(const char *what, timer_t timer, uint64_t ms)
{
	for (;;) {
		if (!strcmp(what, "timer"))
			set_timer(timer, ms);
		else
			set_alarm(ms, strcmp(what, "ticks") ? 0 : 1000);
		beat();
		usleep(5000);
	}
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_alarm };
	uint64_t ms, lap;
	timer_t timer;

	victim_start(&argc, argv, 1, "MS [alarm|timer|ticks]");
	ms = (uint64_t)atol(argv[1]);
	must(!timer_create(CLOCK_MONOTONIC, NULL, &timer), "timer_create");
	if (argc > 2) {
		victim_ready();
		watch(argv[2], timer, ms);
	}
	sigaction(SIGALRM, &act, NULL);
	victim_ready();
	for (lap = 0;; lap++) {
		uint64_t now;

		rung = 0;
		due_ns = now_ns() + ms * 1000000;
		if (lap % 2)
			set_alarm(ms, 0);
		else
			set_timer(timer, ms);
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
