/* SPDX-License-Identifier: Apache-2.0
 *
 * sandbox [--kill] [--late]: puts itself under a seccomp filter that allows little more than
 * sleeping and looking at the clock; anything else is EPERM, with --kill the end, even the call by
 * which the kernel continues a sleep, restart_syscall(2).  Two threads see that the filter holds.
 * With --late it does so when it gets SIGUSR1, counts in counter 1 that it has, and allows that one
 * call: a thread may be on its way back to its sleep when another one installs the filter for it.
 */
#include <pthread.h>

#include "confine.h"

static bool kills, late;
static volatile bool started, confined;
static bool wanted;

static void confine(void)
{
	struct sock_filter filter[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		ALLOW(SYS_clock_nanosleep),
		ALLOW(late ? SYS_restart_syscall : SYS_clock_nanosleep),
		ALLOW(SYS_clock_gettime),
		ALLOW_HOMEWARD,
		ALLOW(SYS_write),
		ALLOW(SYS_gettid),
		ALLOW(SYS_getpid),
		ALLOW(SYS_exit_group),
		BPF_STMT(BPF_RET | BPF_K,
			 kills ? SECCOMP_RET_KILL_PROCESS : SECCOMP_RET_ERRNO | EPERM),
	};

	install_filter(filter, sizeof(filter) / sizeof(*filter), SECCOMP_FILTER_FLAG_TSYNC);
}

static void check(void)
{
	/* One of these checkpoints call, too.  The other filter would end it: that it is there shows
	 * when a test looks. */
	if (!kills && confined)
		for (int i = 0; i < 100; i++)
			CHECK(syscall(i % 2 ? SYS_getppid : SYS_getresuid, 0, 0, 0) < 0 &&
				      errno == EPERM,
			      "the filter is gone (%d)", errno);
	count(0, 1);
}

static void *work(void *arg)
{
	(void)arg;
	started = true;
	for (;;) {
		nap_us(1000);
		check();
	}
	return NULL;
}

/* Blocked: it interrupts nothing. */
static bool is_wanted(const sigset_t *asked)
{
	const struct timespec now = { 0 };

	return wanted || sigtimedwait(asked, NULL, &now) == SIGUSR1;
}

int main(int argc, char **argv)
{
	pthread_t thread;
	sigset_t asked;

	kills = victim_flag(&argc, argv, "--kill");
	late = victim_flag(&argc, argv, "--late");
	wanted = !late;
	victim_start(&argc, argv, 0, "[--kill] [--late]");
	sigemptyset(&asked);
	sigaddset(&asked, SIGUSR1);
	must(!pthread_sigmask(SIG_BLOCK, &asked, NULL), "pthread_sigmask");
	must(!pthread_create(&thread, NULL, work, NULL), "pthread_create");
	while (!started)
		nap_us(1000);
	if (!wanted)
		victim_ready();
	for (;;) {
		if (!confined && is_wanted(&asked)) {
			confine();
			confined = true;
			count(1, 1);
			victim_ready();
		}
		nap_us(1000);
		check();
		beat();
	}
}
