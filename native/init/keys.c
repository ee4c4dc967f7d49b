/* SPDX-License-Identifier: Apache-2.0
 *
 * The keys of the app's terminal (keys.h).
 */
#include <errno.h>
#include <limits.h>
#include <signal.h>
#include <stdbool.h>
#include <stdlib.h>
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

static uint64_t *pressed_ns; /* shared with the task */
static pid_t task;

/* The signals come in the order of their numbers: SIGINT and SIGQUIT before init's SIGTERM. */
static _Noreturn void listen_to(pid_t app, pid_t init)
{
	const uint64_t all = ~UINT64_C(0);

	prctl(PR_SET_NAME, NAME);
	prctl(PR_SET_PDEATHSIG, SIGKILL);
	syscall(SYS_close_range, 0, UINT_MAX, 0);
	if (getppid() != init || setpgid(0, app))
		_exit(0);
	for (;;) {
		siginfo_t info;
		/* glibc's version hides two signals, for which it would return forever. */
		const int sig = (int)syscall(SYS_rt_sigtimedwait, &all, &info, NULL, sizeof all);

		if ((sig == SIGINT || sig == SIGQUIT) && info.si_code == SI_KERNEL)
			__atomic_store_n(pressed_ns, now_ns(), __ATOMIC_RELEASE);
		if (sig == SIGTERM && info.si_code == SI_USER && info.si_pid == init)
			_exit(0);
	}
}

pid_t keys_listen(pid_t app)
{
	const pid_t init = getpid();

	if (!pressed_ns) {
		void *page = mmap(NULL, sizeof *pressed_ns, PROT_READ | PROT_WRITE,
				  MAP_SHARED | MAP_ANONYMOUS, -1, 0);

		if (page == MAP_FAILED)
			return 0;
		pressed_ns = page;
	}
	setpgid(app, app); /* as it does itself, but perhaps not yet */
	task = fork();
	if (task == 0)
		listen_to(app, init);
	if (task < 0)
		task = 0;
	if (task)
		setpgid(task, app); /* as it does itself, before anything else happens */
	return task;
}

void keys_ended(pid_t pid)
{
	if (pid == task)
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
	if (task && ended == 0) {
		kill(task, SIGKILL);
		while (waitpid(task, NULL, __WALL) < 0 && errno == EINTR)
			;
	}
	task = 0;
	return pressed_ns ? __atomic_load_n(pressed_ns, __ATOMIC_ACQUIRE) : 0;
}
