/* SPDX-License-Identifier: Apache-2.0
 *
 * ambush: while one of its threads is in the parasite, puts all of them under a seccomp filter that
 * kills at the calls of a checkpoint (SECCOMP_FILTER_FLAG_TSYNC).  Its main thread watches for that
 * moment from SIGUSR1 on, and makes it longer; another one creates threads that are new to the guard,
 * one after the other.  At SIGUSR2 it no longer waits for it.
 *
 * counter[0]: it has installed it, counter[1]: while a thread was in the parasite.
 */
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <pthread.h>
#include <stddef.h>
#include <sys/prctl.h>

#include "parasite_place.h"

#define KILL(nr)                                         \
	BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (nr), 0, 1), \
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS)

enum { THREAD_US = 20000, NEXT_US = 2000, LATE = 6 };

static struct timespec a_while = { .tv_nsec = 3000000 };

static volatile sig_atomic_t asked[2];

static void ask(int signal)
{
	asked[signal == SIGUSR2] = 1;
}

static void *live(void *arg)
{
	nap_us(THREAD_US);
	return arg;
}

static void *breed(void *arg)
{
	pthread_attr_t detached;
	pthread_t thread;

	(void)arg;
	must(!pthread_attr_init(&detached), "pthread_attr_init");
	must(!pthread_attr_setdetachstate(&detached, PTHREAD_CREATE_DETACHED), "detached");
	must(!pthread_attr_setstacksize(&detached, 64 * 1024), "a small stack");
	for (;;) {
		must(!pthread_create(&thread, &detached, live, NULL), "pthread_create");
		nap_us(NEXT_US);
		beat();
	}
	return NULL;
}

static void confine(void)
{
	struct sock_filter filter[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		KILL(SYS_prctl),
		KILL(SYS_sigaltstack),
		KILL(SYS_capget),
		KILL(SYS_getgroups),
		KILL(SYS_ppoll),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
	};
	struct sock_fprog program = { sizeof(filter) / sizeof(*filter), filter };

	must(!syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_TSYNC, &program),
	     "seccomp");
}

/* A thread that was sent there sleeps before one of its last calls. */
static bool is_in(struct inj_call *call)
{
	struct inj_syscall *late = &call->call[LATE];

	if (__atomic_load_n(&call->done, __ATOMIC_RELAXED) ||
	    __atomic_load_n(&call->call[0].nr, __ATOMIC_RELAXED) != SYS_prctl ||
	    __atomic_load_n(&call->count, __ATOMIC_RELAXED) <= LATE + 1)
		return false;
	late->arg[0] = (uint64_t)&a_while;
	late->arg[1] = 0;
	__atomic_store_n(&late->nr, SYS_nanosleep, __ATOMIC_RELEASE);
	/* Not if this thread was stopped meanwhile, and all of it was over. */
	return __atomic_load_n(&call->call[LATE - 1].result, __ATOMIC_ACQUIRE) != -ENOSYS &&
	       !__atomic_load_n(&call->done, __ATOMIC_ACQUIRE);
}

int main(int argc, char **argv)
{
	pthread_t thread;
	struct place place;
	struct inj_control *control;
	sigset_t orders;

	victim_start(&argc, argv, 0, "");
	must(signal(SIGUSR1, ask) != SIG_ERR && signal(SIGUSR2, ask) != SIG_ERR, "signal");
	sigemptyset(&orders);
	sigaddset(&orders, SIGUSR1);
	sigaddset(&orders, SIGUSR2);
	must(!prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "PR_SET_NO_NEW_PRIVS");
	victim_ready();
	place = await_parasite();
	control = (struct inj_control *)(place.start + INJ_CODE_BYTES);
	/* They go to the main thread. */
	must(!pthread_sigmask(SIG_BLOCK, &orders, NULL), "pthread_sigmask");
	must(!pthread_create(&thread, NULL, breed, NULL), "pthread_create");
	must(!pthread_sigmask(SIG_UNBLOCK, &orders, NULL), "pthread_sigmask");
	while (!asked[0])
		usleep(1000);
	while (!asked[1] && !is_in(&control->runner))
		;
	count(1, !asked[1]);
	confine();
	count(0, 1);
	for (;;)
		pause();
}
