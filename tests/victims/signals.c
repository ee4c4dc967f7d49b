/* SPDX-License-Identifier: Apache-2.0
 *
 * signals N [--pending]: N threads, each with a signal mask and an alternate stack
 * of its own, which send themselves signals and see that the handler ran where and
 * how it should, and that nothing has changed after it.  With --pending signals
 * also stay pending for a while, blocked.
 */
#include <pthread.h>
#include <signal.h>

#include "victim.h"

enum { STACK_BYTES = 64 << 10, GUARDS = 3 };

static pid_t main_pid;
static bool keep_pending;
static _Thread_local char *my_stack;
static _Thread_local volatile uint64_t my_handled;
static _Thread_local volatile int my_last;

/* Handlers and flags that stay as they are for ever. */
static void on_usr1(int sig, siginfo_t *info, void *context);
static void on_usr2(int sig, siginfo_t *info, void *context);
static void on_realtime(int sig, siginfo_t *info, void *context);

static const struct disposition {
	int sig, flags, masked;
	void (*handler)(int, siginfo_t *, void *);
} dispositions[GUARDS] = {
	{ SIGUSR1, SA_SIGINFO | SA_ONSTACK, SIGUSR2, on_usr1 },
	{ SIGUSR2, SA_SIGINFO | SA_ONSTACK | SA_NODEFER, SIGALRM, on_usr2 },
	{ 44, SA_SIGINFO | SA_ONSTACK | SA_RESTART, SIGUSR1, on_realtime },
};

static void check_handler(int sig, int masked, int code, pid_t sender)
{
	sigset_t now;
	char here;

	CHECK(&here >= my_stack && &here < my_stack + STACK_BYTES,
	      "the handler of %d runs at %p, not on the stack at %p", sig, (void *)&here,
	      (void *)my_stack);
	pthread_sigmask(SIG_BLOCK, NULL, &now);
	CHECK(sigismember(&now, masked) == 1, "the handler of %d does not block %d", sig, masked);
	CHECK(code == SI_TKILL && sender == main_pid, "signal %d has code %d from %d", sig, code,
	      sender);
	my_last = sig;
	my_handled++;
}

static void on_usr1(int sig, siginfo_t *info, void *context)
{
	(void)context;
	check_handler(sig, SIGUSR2, info->si_code, info->si_pid);
}

static void on_usr2(int sig, siginfo_t *info, void *context)
{
	(void)context;
	check_handler(sig, SIGALRM, info->si_code, info->si_pid);
}

static void on_realtime(int sig, siginfo_t *info, void *context)
{
	(void)context;
	check_handler(sig, SIGUSR1, info->si_code, info->si_pid);
}

static void check_dispositions(void)
{
	struct sigaction act;
	int i;

	for (i = 0; i < GUARDS; i++) {
		const struct disposition *d = &dispositions[i];

		CHECK(!sigaction(d->sig, NULL, &act), "sigaction: %s", strerror(errno));
		CHECK(act.sa_sigaction == d->handler, "signal %d has another handler", d->sig);
		CHECK((act.sa_flags & ~0x04000000) == d->flags, "signal %d has flags %x", d->sig,
		      (unsigned int)act.sa_flags);
		CHECK(sigismember(&act.sa_mask, d->masked) == 1, "signal %d has another mask",
		      d->sig);
	}
	CHECK(!sigaction(SIGHUP, NULL, &act) && act.sa_handler == SIG_IGN, "SIGHUP is not ignored");
}

static void check_mask(const sigset_t *wanted, size_t me)
{
	sigset_t now;
	int sig;

	pthread_sigmask(SIG_BLOCK, NULL, &now);
	for (sig = 1; sig < NSIG; sig++)
		CHECK(sigismember(&now, sig) == sigismember(wanted, sig),
		      "thread %zu: signal %d is %sblocked", me, sig,
		      sigismember(&now, sig) ? "" : "not ");
}

static void check_stack(void)
{
	stack_t now;

	CHECK(!sigaltstack(NULL, &now), "sigaltstack: %s", strerror(errno));
	CHECK(now.ss_sp == my_stack && now.ss_size == STACK_BYTES && now.ss_flags == 0,
	      "the alternate stack is %p, %zu, %x, not %p", now.ss_sp, now.ss_size,
	      (unsigned int)now.ss_flags, (void *)my_stack);
}

static void send_self(int sig)
{
	CHECK(!syscall(SYS_tgkill, main_pid, syscall(SYS_gettid), sig), "tgkill: %s",
	      strerror(errno));
}

/* Blocked in this thread: it pends, is seen, and is handled when let through. */
static void pend(int sig, uint64_t *random)
{
	uint64_t before = my_handled;
	sigset_t one, pending;

	sigemptyset(&one);
	sigaddset(&one, sig);
	pthread_sigmask(SIG_BLOCK, &one, NULL);
	send_self(sig);
	nap_us((long)(next_random(random) % 2000));
	CHECK(my_handled == before, "signal %d got through the mask", sig);
	CHECK(!sigpending(&pending) && sigismember(&pending, sig),
	      "signal %d does not pend any more", sig);
	pthread_sigmask(SIG_UNBLOCK, &one, NULL);
	CHECK(my_handled == before + 1 && my_last == sig, "signal %d was lost while it was pending",
	      sig);
}

static void *work(void *arg)
{
	size_t me = (size_t)arg;
	uint64_t random = me + 5, laps;
	stack_t stack = { .ss_size = STACK_BYTES };
	sigset_t mask;

	my_stack = malloc(STACK_BYTES);
	must(my_stack, "malloc");
	stack.ss_sp = my_stack;
	must(!sigaltstack(&stack, NULL), "sigaltstack");
	/* No two threads in a row have the same mask. */
	sigemptyset(&mask);
	sigaddset(&mask, (int)(46 + me % 16));
	if (me & 1)
		sigaddset(&mask, SIGWINCH);
	if (me & 2)
		sigaddset(&mask, SIGTERM);
	pthread_sigmask(SIG_SETMASK, &mask, NULL);
	for (laps = 0;; laps++) {
		const struct disposition *d = &dispositions[laps % GUARDS];
		uint64_t before = my_handled;

		check_mask(&mask, me);
		check_stack();
		check_dispositions();
		send_self(d->sig);
		CHECK(my_handled == before + 1 && my_last == d->sig,
		      "signal %d was not handled at once", d->sig);
		send_self(SIGHUP);
		if (keep_pending)
			pend(d->sig, &random);
		check_mask(&mask, me);
		count(0, 1);
		nap_us((long)(next_random(&random) % 1000));
	}
	return NULL;
}

int main(int argc, char **argv)
{
	long n, i;

	keep_pending = victim_flag(&argc, argv, "--pending");
	victim_start(&argc, argv, 1, "N [--pending]");
	n = atol(argv[1]);
	main_pid = getpid();
	for (i = 0; i < GUARDS; i++) {
		struct sigaction act = { .sa_sigaction = dispositions[i].handler,
					 .sa_flags = dispositions[i].flags };

		sigemptyset(&act.sa_mask);
		sigaddset(&act.sa_mask, dispositions[i].masked);
		must(!sigaction(dispositions[i].sig, &act, NULL), "sigaction");
	}
	signal(SIGHUP, SIG_IGN);
	for (i = 0; i < n; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, work, (void *)i), "pthread_create");
	}
	victim_ready();
	for (;;) {
		beat();
		nap_us(1000);
	}
}
