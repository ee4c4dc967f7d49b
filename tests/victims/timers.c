/* SPDX-License-Identifier: Apache-2.0
 *
 * timers [MANY]: timers of every kind, which must go on ticking and keep their ids, signals,
 * values, threads and deadlines.
 *
 * - setitimer: ITIMER_REAL that ticks, ITIMER_PROF that ticks (this burns some CPU),
 *   ITIMER_VIRTUAL an hour ahead
 * - POSIX timers with gaps in their ids: one that ticks with a value, one to a thread
 *   (SIGEV_THREAD_ID), one on CPU time, one an hour ahead that was never due, one that
 *   was made and never set; and MANY like that
 */
#include <pthread.h>
#include <signal.h>
#include <sys/time.h>

#include "victim.h"

#ifndef sigev_notify_thread_id
#define sigev_notify_thread_id _sigev_un._tid
#endif

enum { TICK_MS = 7, LATE_MS = 1500, VALUE = 0x1234567, HOUR_S = 3600, KINDS = 4, IDS = 12 };
enum { REAL, PROF, POSIX, THREAD };

static volatile uint64_t last[KINDS];
static volatile pid_t thread_tid;
static int ids[5]; /* kernel's: posix, thread, cpu, hour, idle */
static int deleted;
static int many, more[1000];

static void tick(int kind)
{
	last[kind] = now_ns();
	count((unsigned int)kind, 1);
}

static void on_alarm(int sig)
{
	tick(sig == SIGALRM ? REAL : PROF);
}

static void on_posix(int sig, siginfo_t *info, void *context)
{
	(void)context;
	CHECK(info->si_code == SI_TIMER && info->si_value.sival_int == VALUE &&
		      info->si_timerid == ids[0],
	      "signal %d of timer %d has code %d, value %x", sig, info->si_timerid, info->si_code,
	      (unsigned int)info->si_value.sival_int);
	tick(POSIX);
}

static void on_thread(int sig, siginfo_t *info, void *context)
{
	(void)context;
	CHECK(syscall(SYS_gettid) == thread_tid, "signal %d of timer %d is for thread %d", sig,
	      info->si_timerid, thread_tid);
	CHECK(info->si_timerid == ids[1], "signal %d is of timer %d, not %d", sig, info->si_timerid,
	      ids[1]);
	tick(THREAD);
}

static void *wait_for_ticks(void *arg)
{
	(void)arg;
	thread_tid = (pid_t)syscall(SYS_gettid);
	for (;;)
		pause();
	return NULL;
}

static int make(clockid_t clock, int notify, int sig, pid_t tid)
{
	struct sigevent event = { .sigev_notify = notify,
				  .sigev_signo = sig,
				  .sigev_value.sival_int = VALUE };
	int id;

	if (tid)
		event.sigev_notify_thread_id = tid;
	must(!syscall(SYS_timer_create, clock, &event, &id), "timer_create");
	return id;
}

static void set(int id, int64_t first_ms, int64_t interval_ms)
{
	struct itimerspec spec = { { interval_ms / 1000, interval_ms % 1000 * 1000000 },
				   { first_ms / 1000, first_ms % 1000 * 1000000 } };

	must(!syscall(SYS_timer_settime, id, 0, &spec, NULL), "timer_settime");
}

/* More handlers in the way of sleeping than nap_us() can stand. */
static void rest_us(long us)
{
	struct timespec end;

	clock_gettime(CLOCK_MONOTONIC, &end);
	end.tv_nsec += us * 1000;
	if (end.tv_nsec >= 1000000000) {
		end.tv_sec++;
		end.tv_nsec -= 1000000000;
	}
	while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &end, NULL) == EINTR)
		;
}

/* Where a restore came after it was asked, at `asked`, the answer is older than the time is now. */
static void check_left(const char *what, int64_t s, int64_t ns, uint64_t asked, uint64_t deadline)
{
	const uint64_t now = now_ns();
	const int64_t left = s * 1000000000 + ns, wanted = (int64_t)(deadline - now),
		      off = (int64_t)slowness() * 50000000;

	if (now - asked > (uint64_t)off)
		return;
	CHECK(left > 0, "%s does not run any more", what);
	CHECK(left - wanted < off && wanted - left < off, "%s has %ld ms left, not %ld", what,
	      (long)(left / 1000000), (long)(wanted / 1000000));
}

static void check(uint64_t deadline)
{
	static const char *const names[KINDS] = { "ITIMER_REAL", "ITIMER_PROF", "a POSIX timer",
						  "a POSIX timer to a thread" };
	struct itimerspec spec;
	struct itimerval virt;
	uint64_t asked;
	int i;

	for (i = 0; i < KINDS; i++) {
		const uint64_t at = last[i]; /* read first: a tick may come now */

		CHECK(now_ns() - at < LATE_MS * slowness() * UINT64_C(1000000),
		      "%s has stopped ticking", names[i]);
	}
	CHECK(!getitimer(ITIMER_VIRTUAL, &virt) && virt.it_value.tv_sec > HOUR_S - 600 &&
		      virt.it_value.tv_sec <= HOUR_S,
	      "ITIMER_VIRTUAL has %ld s left", virt.it_value.tv_sec);
	for (i = 0; i < 5; i++)
		CHECK(!syscall(SYS_timer_gettime, ids[i], &spec), "timer %d is lost: %s", ids[i],
		      strerror(errno));
	CHECK(!spec.it_value.tv_sec && !spec.it_value.tv_nsec && !spec.it_interval.tv_nsec,
	      "timer %d was never set", ids[4]);
	syscall(SYS_timer_gettime, ids[2], &spec);
	CHECK(spec.it_value.tv_sec > HOUR_S - 600 && spec.it_value.tv_sec <= HOUR_S &&
		      spec.it_interval.tv_sec == 77,
	      "a timer of CPU time has %ld s left, and %ld", spec.it_value.tv_sec,
	      spec.it_interval.tv_sec);
	asked = now_ns();
	syscall(SYS_timer_gettime, ids[3], &spec);
	check_left("a POSIX timer", spec.it_value.tv_sec, spec.it_value.tv_nsec, asked, deadline);
	for (i = 0; i < many; i++)
		CHECK(!syscall(SYS_timer_gettime, more[i], &spec), "timer %d is lost: %s", more[i],
		      strerror(errno));
	CHECK(syscall(SYS_timer_gettime, deleted, &spec) < 0 && errno == EINVAL,
	      "timer %d is there again", deleted);
}

static void burn(void)
{
	const uint64_t end = now_ns() + 1000000;

	while (now_ns() < end)
		;
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_alarm, .sa_flags = SA_RESTART };
	const struct itimerval ticking = { { 0, TICK_MS * 1000 }, { 0, TICK_MS * 1000 } };
	const struct itimerval ahead = { { 1, 0 }, { HOUR_S, 0 } };
	int made[IDS], i;
	uint64_t deadline;
	pthread_t thread;

	victim_start(&argc, argv, 0, "[MANY]");
	many = argc > 1 ? atoi(argv[1]) : 0;
	must(many <= (int)(sizeof more / sizeof *more), "so many");
	sigaction(SIGALRM, &act, NULL);
	sigaction(SIGPROF, &act, NULL);
	act = (struct sigaction){ .sa_sigaction = on_posix, .sa_flags = SA_RESTART | SA_SIGINFO };
	sigaction(SIGRTMIN + 1, &act, NULL);
	act.sa_sigaction = on_thread;
	sigaction(SIGRTMIN + 2, &act, NULL);
	must(!pthread_create(&thread, NULL, wait_for_ticks, NULL), "pthread_create");
	while (!thread_tid)
		rest_us(1000);
	for (i = 0; i < IDS; i++)
		made[i] = make(CLOCK_MONOTONIC, SIGEV_NONE, 0, 0);
	for (i = 0; i < IDS; i++)
		must(!syscall(SYS_timer_delete, made[i]), "timer_delete");
	ids[0] = make(CLOCK_REALTIME, SIGEV_SIGNAL, SIGRTMIN + 1, 0);
	deleted = make(CLOCK_MONOTONIC, SIGEV_SIGNAL, SIGRTMIN + 1, 0);
	ids[1] = make(CLOCK_MONOTONIC, SIGEV_THREAD_ID, SIGRTMIN + 2, thread_tid);
	ids[2] = make(CLOCK_PROCESS_CPUTIME_ID, SIGEV_SIGNAL, SIGUSR1, 0);
	must(!syscall(SYS_timer_delete, deleted), "timer_delete");
	ids[3] = make(CLOCK_BOOTTIME, SIGEV_SIGNAL, SIGUSR1, 0);
	ids[4] = make(CLOCK_MONOTONIC, SIGEV_NONE, 0, 0);
	for (i = 0; i < many; i++)
		more[i] = make(CLOCK_MONOTONIC, SIGEV_SIGNAL, SIGRTMIN + 1, 0);
	for (i = 0; i < KINDS; i++)
		last[i] = now_ns();
	set(ids[0], TICK_MS, TICK_MS);
	set(ids[1], TICK_MS, TICK_MS);
	set(ids[2], HOUR_S * 1000, 77000);
	set(ids[3], HOUR_S * 1000, 0);
	deadline = now_ns() + HOUR_S * UINT64_C(1000000000);
	must(!setitimer(ITIMER_REAL, &ticking, NULL) && !setitimer(ITIMER_PROF, &ticking, NULL) &&
		     !setitimer(ITIMER_VIRTUAL, &ahead, NULL),
	     "setitimer");
	victim_ready();
	for (;;) {
		check(deadline);
		burn();
		beat();
		rest_us(1000);
	}
}
