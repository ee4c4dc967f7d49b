/* SPDX-License-Identifier: Apache-2.0
 *
 * terminal [--stopped|--heard]: a shell with jobs on a terminal of its own.
 *
 * The main process holds the other side of a pseudo-terminal, on which a session's
 * leader has two jobs, each a process group of two.  Now and then the leader puts
 * the other job into the foreground, and everybody sees where it is: what the
 * leader has noted in shared memory is what the terminal says.  --stopped: a third
 * job is stopped, as by ^Z; its parent sees that, and nobody continues it.  --heard: the parent
 * has waited for it, which it can do only once; so has the job, of a child that stopped before it.
 * Counter 0: changes of the foreground.
 */
#include <sys/ioctl.h>
#include <termios.h>

#include "family.h"

enum { JOBS = 2, STUCK_LAPS = 10000 };
enum extra { NONE, STOPPED, HEARD };

static struct shared {
	pthread_mutex_t lock;
	pid_t job[JOBS], leader, below;
	volatile uint64_t changes; /* the job in front is this one modulo JOBS */
	volatile uint64_t laps[JOBS * 2 + 1];
} * shared;

static int terminal;

static void check_terminal(void)
{
	pid_t front, wanted;

	must(!pthread_mutex_lock(&shared->lock), "lock");
	front = tcgetpgrp(terminal);
	wanted = shared->job[shared->changes % JOBS];
	if (front != wanted)
		came_apart("the group in the foreground is %d, not %d (%s)", front, wanted,
			   front < 0 ? strerror(errno) : "");
	if (tcgetsid(terminal) != shared->leader)
		came_apart("the terminal's session is %d, not %d", tcgetsid(terminal),
			   shared->leader);
	must(!pthread_mutex_unlock(&shared->lock), "unlock");
}

static _Noreturn void run_job(int job, int which)
{
	for (;;) {
		check_place();
		CHECK(getpgrp() == shared->job[job], "I am of job %d, and my group is %d", job,
		      getpgrp());
		check_terminal();
		shared->laps[job * 2 + which]++;
		nap(1500);
	}
}

static void start_job(int job)
{
	pid_t first = fork(), second;

	if (first == 0) {
		forget_children();
		setpgid(0, 0);
		know_family("job");
		while (!shared->changes)
			nap(500);
		run_job(job, 0);
	}
	add_child(first);
	setpgid(first, first);
	shared->job[job] = first;
	second = fork();
	if (second == 0) {
		forget_children();
		setpgid(0, first);
		know_family("job");
		while (!shared->changes)
			nap(500);
		run_job(job, 1);
	}
	add_child(second);
	setpgid(second, first);
}

static pid_t start_stopped(void)
{
	const pid_t pid = fork();
	siginfo_t info;

	must(pid >= 0, "fork");
	if (pid == 0) {
		setpgid(0, 0);
		for (;;) {
			raise(SIGSTOP);
			if (getppid() != shared->leader)
				_exit(0);
			violation("somebody has continued what is stopped");
		}
	}
	add_child(pid);
	must(waitid(P_PID, (id_t)pid, &info, WSTOPPED | WNOWAIT) == 0, "waitid");
	return pid;
}

static void check_stopped(pid_t pid)
{
	siginfo_t info = { 0 };

	if (waitid(P_PID, (id_t)pid, &info, WSTOPPED | WEXITED | WNOHANG | WNOWAIT) < 0)
		came_apart("the stopped job: %s", strerror(errno));
	if (info.si_pid != pid || info.si_code != CLD_STOPPED || info.si_status != SIGSTOP)
		came_apart("the stopped job %d: %d, code %d, status %d", pid, info.si_pid,
			   info.si_code, info.si_status);
}

/* Field 52 of its stat: the signal of a stop that its parent has not waited for. */
static void check_heard(pid_t pid)
{
	char path[32], text[512] = "", *last;
	FILE *file;

	snprintf(path, sizeof(path), "/proc/%d/stat", pid);
	file = fopen(path, "re");
	if (!file || !fgets(text, sizeof(text), file))
		came_apart("%s: %s", path, strerror(errno));
	fclose(file);
	last = strrchr(text, ' ');
	if (!last || atoi(last + 1))
		came_apart("a stop would be reported again: %s", text);
}

static void await_stop(pid_t pid)
{
	siginfo_t info;

	must(pid >= 0, "fork");
	add_child(pid);
	must(waitid(P_PID, (id_t)pid, &info, WSTOPPED) == 0, "waitid");
}

static _Noreturn void stay_stopped(pid_t parent)
{
	for (;;) {
		raise(SIGSTOP);
		if (getppid() != parent)
			_exit(0);
		violation("somebody has continued what is stopped");
	}
}

static void start_heard(pid_t stopped[2])
{
	stopped[0] = fork();
	if (stopped[0] == 0) {
		const pid_t job = getpid();

		forget_children();
		setpgid(0, 0);
		shared->below = fork();
		if (shared->below == 0)
			stay_stopped(job);
		await_stop(shared->below);
		stay_stopped(shared->leader);
	}
	await_stop(stopped[0]);
	stopped[1] = shared->below;
}

static void change_foreground(uint64_t to)
{
	must(!pthread_mutex_lock(&shared->lock), "lock");
	CHECK(tcsetpgrp(terminal, shared->job[to % JOBS]) == 0, "tcsetpgrp: %s", strerror(errno));
	shared->changes = to;
	must(!pthread_mutex_unlock(&shared->lock), "unlock");
	count(0, 1);
}

static _Noreturn void lead(const char *path, enum extra extra)
{
	pid_t stopped = 0, heard[2] = { 0 };
	uint64_t laps;
	int i;

	forget_children();
	must(setsid() > 0, "setsid");
	terminal = open(path, O_RDWR | O_CLOEXEC); /* becomes the session's own */
	must(terminal >= 0, path);
	signal(SIGTTOU, SIG_IGN); /* tcsetpgrp() from the background */
	know_family("leader");
	shared->leader = getpid();
	for (i = 0; i < JOBS; i++)
		start_job(i);
	if (extra == STOPPED)
		stopped = start_stopped();
	if (extra == HEARD) {
		start_heard(heard);
		watch_sigchld();
	}
	change_foreground(1);
	for (laps = 1;; laps++) {
		check_place();
		if (laps % 8 == 0)
			change_foreground(shared->changes + 1);
		check_terminal();
		if (stopped)
			check_stopped(stopped);
		else
			check_nothing_to_wait_for();
		for (i = 0; i < 2 && heard[i]; i++)
			check_heard(heard[i]);
		check_children_file();
		shared->laps[JOBS * 2]++;
		nap(1000);
	}
}

int main(int argc, char **argv)
{
	const enum extra extra = victim_flag(&argc, argv, "--stopped") ? STOPPED
				 : victim_flag(&argc, argv, "--heard") ? HEARD
								       : NONE;
	uint64_t seen[JOBS * 2 + 1] = { 0 }, ticks[JOBS * 2 + 1] = { 0 };
	pthread_mutexattr_t attr;
	char path[64];
	int master, i;
	pid_t pid;

	victim_start(&argc, argv, 0, "[--stopped|--heard]");
	shared = mmap(NULL, sizeof(*shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1,
		      0);
	must(shared != MAP_FAILED, "mmap");
	pthread_mutexattr_init(&attr);
	pthread_mutexattr_setpshared(&attr, PTHREAD_PROCESS_SHARED);
	must(!pthread_mutex_init(&shared->lock, &attr), "pthread_mutex_init");
	family.main = getpid();
	know_family("terminal");
	master = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
	must(master >= 0 && grantpt(master) == 0 && unlockpt(master) == 0, "posix_openpt");
	must(ptsname_r(master, path, sizeof(path)) == 0, "ptsname_r");
	pid = fork();
	if (pid == 0)
		lead(path, extra);
	add_child(pid);
	watch_sigchld();
	for (i = 0; i <= JOBS * 2; i++)
		while (!shared->laps[i])
			nap(1000);
	victim_ready();
	for (;;) {
		check_place();
		check_nothing_to_wait_for();
		check_children_file();
		for (i = 0; i <= JOBS * 2; i++) {
			ticks[i] = shared->laps[i] == seen[i] ? ticks[i] + 1 : 0;
			seen[i] = shared->laps[i];
			if (ticks[i] >= STUCK_LAPS)
				came_apart("process %d of the terminal is stuck", i);
		}
		beat();
		nap(1500);
	}
}
