/* SPDX-License-Identifier: Apache-2.0
 *
 * pending N: N threads that keep signals pending: each queues some to itself, with
 * values, naps, and takes them: all must be there, in order, with value, code and
 * sender.  One more does so for the whole process, one waits in sigsuspend(2) for
 * what another sends, with a mask that holds during that call only.
 */
#include <pthread.h>
#include <signal.h>

#include "victim.h"

enum { AT_ONCE = 12 };

static pid_t main_pid;
static volatile uint64_t suspended_seen;
static pthread_t suspended;

static void queue(int sig, bool to_thread, int64_t value)
{
	siginfo_t info = { .si_signo = sig, .si_code = to_thread ? -7 : SI_QUEUE };

	info.si_pid = main_pid;
	info.si_uid = 1234;
	info.si_value.sival_ptr = (void *)value;
	if (to_thread)
		must(!syscall(SYS_rt_tgsigqueueinfo, main_pid, syscall(SYS_gettid), sig, &info),
		     "rt_tgsigqueueinfo");
	else
		must(!syscall(SYS_rt_sigqueueinfo, main_pid, sig, &info), "rt_sigqueueinfo");
}

static void take(int sig, bool to_thread, int64_t value)
{
	const struct timespec now = { 0 };
	siginfo_t info;
	sigset_t set;
	int got;

	sigemptyset(&set);
	sigaddset(&set, sig);
	got = sigtimedwait(&set, &info, &now);
	CHECK(got == sig, "signal %d with value %ld was lost: %s", sig, value, strerror(errno));
	CHECK((int64_t)info.si_value.sival_ptr == value, "signal %d has value %p, not %ld", sig,
	      info.si_value.sival_ptr, value);
	CHECK(info.si_code == (to_thread ? -7 : SI_QUEUE), "signal %d has code %d", sig,
	      info.si_code);
	CHECK(info.si_pid == main_pid && info.si_uid == 1234, "signal %d is from %d, %d", sig,
	      info.si_pid, info.si_uid);
}

static void nothing_more(int sig)
{
	const struct timespec now = { 0 };
	sigset_t set;

	sigemptyset(&set);
	sigaddset(&set, sig);
	CHECK(sigtimedwait(&set, NULL, &now) < 0 && errno == EAGAIN,
	      "signal %d came once too often", sig);
}

static void *work(void *arg)
{
	const size_t me = (size_t)arg;
	const bool to_thread = me != 0;
	const int sig = SIGRTMIN + 2 + (int)(me % 20);
	uint64_t random = me + 7, lap;

	for (lap = 0;; lap++) {
		const int64_t n = 1 + (int64_t)(next_random(&random) % AT_ONCE);
		int64_t i;

		for (i = 0; i < n; i++)
			queue(sig, to_thread, (int64_t)lap * 100 + i);
		/* One that is not queued, and stays. */
		CHECK(!kill(main_pid, SIGUSR2), "kill: %s", strerror(errno));
		nap_us(500 + (long)(next_random(&random) % 3000));
		for (i = 0; i < n; i++)
			take(sig, to_thread, (int64_t)lap * 100 + i);
		nothing_more(sig);
		count(0, 1);
	}
	return NULL;
}

static void on_suspended(int sig)
{
	(void)sig;
	suspended_seen++;
}

static void *suspend(void *arg)
{
	sigset_t before, during, now;
	int sig;

	(void)arg;
	pthread_sigmask(SIG_BLOCK, NULL, &before);
	during = before;
	sigdelset(&during, SIGUSR1);
	for (;;) {
		const uint64_t seen = suspended_seen;

		CHECK(sigsuspend(&during) < 0 && errno == EINTR, "sigsuspend: %s", strerror(errno));
		CHECK(suspended_seen > seen, "sigsuspend ended without a signal");
		pthread_sigmask(SIG_BLOCK, NULL, &now);
		for (sig = 1; sig < NSIG; sig++)
			CHECK(sigismember(&now, sig) == sigismember(&before, sig),
			      "after sigsuspend signal %d is %sblocked", sig,
			      sigismember(&now, sig) ? "" : "not ");
		count(1, 1);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_suspended };
	sigset_t all;
	long n, i;

	victim_start(&argc, argv, 1, "N");
	n = atol(argv[1]);
	main_pid = getpid();
	sigfillset(&all);
	pthread_sigmask(SIG_BLOCK, &all, NULL);
	sigaction(SIGUSR1, &act, NULL);
	for (i = 0; i <= n; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, work, (void *)i), "pthread_create");
	}
	must(!pthread_create(&suspended, NULL, suspend, NULL), "pthread_create");
	victim_ready();
	for (i = 0;; i++) {
		beat();
		nap_us(1000);
		if (i % 8 == 0)
			must(!pthread_kill(suspended, SIGUSR1), "pthread_kill");
	}
}
