/* SPDX-License-Identifier: Apache-2.0
 *
 * Signals for the app's process group (keys.h).
 */
#include <errno.h>
#include <limits.h>
#include <linux/futex.h>
#include <signal.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "init.h"
#include "keys.h"

#define NAME "avckpt-keys"
#define END_NS 20000000 /* how long it has to answer; after that it is stopped, or gets no CPU */
#define NAP_NS 100000
#define ANSWER_NS 100000000  /* the same for a question; nobody is dead then */
#define QUESTION (_NSIG - 1) /* the highest, and so the last of those that are pending */

static struct {
	uint64_t pressed_ns;
	uint32_t answers;
	uint32_t got[_NSIG];
} * heard;                    /* shared with the task */
static uint32_t known[_NSIG]; /* of heard->got */
static pid_t task;

/* The signals come in the order of their numbers: SIGINT and SIGQUIT before init's SIGTERM. */
static _Noreturn void listen_to(pid_t group, pid_t init)
{
	const uint64_t all = ~UINT64_C(0);

	prctl(PR_SET_NAME, NAME);
	prctl(PR_SET_PDEATHSIG, SIGKILL);
	syscall(SYS_close_range, 0, UINT_MAX, 0);
	if (getppid() != init || (group && setpgid(0, group)))
		_exit(0);
	for (;;) {
		siginfo_t info;
		/* glibc's version hides two signals, for which it would return forever. */
		const int sig = (int)syscall(SYS_rt_sigtimedwait, &all, &info, NULL, sizeof all);

		if ((sig == SIGINT || sig == SIGQUIT) && info.si_code == SI_KERNEL)
			__atomic_store_n(&heard->pressed_ns, now_ns(), __ATOMIC_RELEASE);
		if (sig == QUESTION) {
			__atomic_add_fetch(&heard->answers, 1, __ATOMIC_ACQ_REL);
			syscall(SYS_futex, &heard->answers, FUTEX_WAKE, 1, NULL, NULL, 0);
		} else if (sig > 0 && info.si_code == SI_USER) {
			__atomic_add_fetch(&heard->got[sig], 1, __ATOMIC_ACQ_REL);
		}
		if (sig == SIGTERM && info.si_code == SI_USER && info.si_pid == init)
			_exit(0);
	}
}

pid_t keys_listen(pid_t group)
{
	const pid_t init = getpid();

	if (!heard) {
		void *page = mmap(NULL, sizeof *heard, PROT_READ | PROT_WRITE,
				  MAP_SHARED | MAP_ANONYMOUS, -1, 0);

		if (page == MAP_FAILED)
			return 0;
		heard = page;
	}
	memcpy(known, heard->got, sizeof known);
	if (group)
		setpgid(group, group); /* as it does itself, but perhaps not yet */
	task = fork();
	if (task == 0)
		listen_to(group, init);
	if (task < 0)
		task = 0;
	if (task && group)
		setpgid(task, group); /* as it does itself, before anything else happens */
	return task;
}

void keys_ended(pid_t pid)
{
	if (pid == task)
		task = 0;
}

static void end_task(void)
{
	kill(task, SIGKILL);
	while (waitpid(task, NULL, __WALL) < 0 && errno == EINTR)
		;
	task = 0;
}

uint64_t keys_pressed(void)
{
	const struct timespec nap = { .tv_nsec = NAP_NS };
	const uint64_t end_ns = now_ns() + END_NS;
	pid_t ended = 0;

	if (task && kill(task, SIGTERM) == 0)
		while ((ended = waitpid(task, NULL, WNOHANG | __WALL)) == 0 && now_ns() < end_ns)
			nanosleep(&nap, NULL);
	if (task && ended == 0)
		end_task();
	task = 0;
	return heard ? __atomic_load_n(&heard->pressed_ns, __ATOMIC_ACQUIRE) : 0;
}

/* It has got all that was sent to the group before init has read it. */
static bool answers(void)
{
	const uint32_t before = __atomic_load_n(&heard->answers, __ATOMIC_ACQUIRE);
	const struct timespec most = { .tv_nsec = ANSWER_NS };
	const uint64_t end_ns = now_ns() + ANSWER_NS;

	if (kill(task, QUESTION))
		return false;
	while (__atomic_load_n(&heard->answers, __ATOMIC_ACQUIRE) == before) {
		if (now_ns() >= end_ns)
			return false;
		syscall(SYS_futex, &heard->answers, FUTEX_WAIT, before, &most, NULL, 0);
	}
	return true;
}

bool keys_are_heard(void)
{
	return task != 0;
}

bool keys_group_got(int sig)
{
	uint32_t before, now;

	if (!task || sig == QUESTION)
		return false;
	if (!answers()) {
		/* What it hears later must not be taken for another signal. */
		end_task();
		return false;
	}
	before = known[sig];
	now = __atomic_load_n(&heard->got[sig], __ATOMIC_ACQUIRE);
	known[sig] = now;
	return now != before;
}
