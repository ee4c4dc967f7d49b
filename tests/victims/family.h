/* SPDX-License-Identifier: Apache-2.0
 *
 * What the victims of several processes have in common: each process knows its
 * place and its children, and compares that with what the kernel says.
 *
 * When the main process is killed its children live on for a moment: they find
 * themselves with another parent, and pipes closed, until the guard has killed
 * them, too.  That is no fault; the same with a main process that lives is one.
 * So whoever finds such a thing waits (came_apart) before it complains.
 *
 * With VICTIM_TIME_FORKS in the environment each measures once what a plain fork(2) of
 * it takes.  Counter 2: the sum, in ns; 3: how many have done so.
 */
#ifndef FAMILY_H
#define FAMILY_H

#include <dirent.h>
#include <pthread.h>
#include <signal.h>
#include <sys/file.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "victim.h"

enum { CHILDREN_MAX = 256, APART_S = 4 };

/* Of this process. */
static struct {
	pid_t main, pid, parent, group, session;
	char name[16];
	pid_t child[CHILDREN_MAX];
	int children;
} family;

static volatile uint64_t sigchlds;

static inline bool is_alive(pid_t pid)
{
	char path[32], text[128], *end;
	FILE *file;
	size_t n;

	snprintf(path, sizeof(path), "/proc/%d/stat", pid);
	file = fopen(path, "re");
	if (!file)
		return false;
	n = fread(text, 1, sizeof(text) - 1, file);
	fclose(file);
	text[n] = 0;
	end = strrchr(text, ')');
	return end && end[1] && end[2] != 'Z' && end[2] != 'X';
}

/* Something that is a fault unless all of us are about to be killed. */
__attribute__((format(printf, 1, 2))) static _Noreturn void came_apart(const char *format, ...)
{
	const bool is_main = getpid() == family.main;
	const int naps = is_main ? 50 : APART_S * 100;
	struct timespec ts = { 0, 10000000 };
	char text[256];
	va_list args;
	int i;

	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	for (i = 0; i < naps; i++)
		clock_nanosleep(CLOCK_MONOTONIC, 0, &ts, NULL);
	if (is_main || is_alive(family.main))
		violation("%s", text);
	_exit(0);
}

/* To be called by the main thread when it has what it is going to have, and no other thread
 * waits for children yet. */
static inline void time_forks(void)
{
	enum { TIMES = 21 };
	uint64_t taken[TIMES], t;
	int one_by_one, i, k;

	if (!getenv("VICTIM_TIME_FORKS"))
		return;
	one_by_one = open("/proc/self/exe", O_RDONLY | O_CLOEXEC);
	must(one_by_one >= 0 && flock(one_by_one, LOCK_EX) == 0, "flock");
	for (i = 0; i < TIMES; i++) {
		const uint64_t start = now_ns();
		const pid_t pid = (pid_t)syscall(SYS_clone, 0, 0, 0, 0, 0); /* no SIGCHLD */

		if (pid == 0)
			_exit(0);
		t = now_ns() - start;
		must(pid > 0 && waitpid(pid, NULL, __WALL) == pid, "clone");
		for (k = i; k > 0 && taken[k - 1] > t; k--)
			taken[k] = taken[k - 1];
		taken[k] = t;
	}
	close(one_by_one);
	count(2, taken[TIMES / 2]);
	count(3, 1);
}

static inline void on_sigchld(int sig, siginfo_t *info, void *context)
{
	(void)sig, (void)context;
	/* A child that a tracer stops or lets go is nobody's news but the tracer's. */
	if (info->si_code == CLD_STOPPED || info->si_code == CLD_TRAPPED ||
	    info->si_code == CLD_CONTINUED)
		violation("SIGCHLD with code %d for %d", info->si_code, info->si_pid);
	__atomic_add_fetch(&sigchlds, 1, __ATOMIC_SEQ_CST);
}

static inline void watch_sigchld(void)
{
	struct sigaction act = { .sa_sigaction = on_sigchld, .sa_flags = SA_SIGINFO | SA_RESTART };

	sigemptyset(&act.sa_mask);
	must(sigaction(SIGCHLD, &act, NULL) == 0, "sigaction");
	signal(SIGPIPE, SIG_IGN);
}

/* A nap that nothing may cut short but SIGCHLD. */
static inline void nap(long us)
{
	struct timespec ts = { us / 1000000, us % 1000000 * 1000 };
	uint64_t before = sigchlds;
	int err;

	while ((err = clock_nanosleep(CLOCK_MONOTONIC, 0, &ts, &ts)) != 0) {
		CHECK(err == EINTR && sigchlds != before, "a nap ended with %s", strerror(err));
		before = sigchlds;
	}
}

/* To be called by every process once its place in the tree is what it shall be. */
static inline void know_family(const char *name)
{
	family.pid = getpid();
	family.parent = getppid();
	family.group = getpgrp();
	family.session = getsid(0);
	snprintf(family.name, sizeof(family.name), "%s", name);
	must(prctl(PR_SET_NAME, family.name) == 0, "PR_SET_NAME");
}

/* After fork(), in the child. */
static inline void forget_children(void)
{
	family.children = 0;
	sigchlds = 0;
}

static inline void add_child(pid_t pid)
{
	must(pid > 0, "fork");
	must(family.children < CHILDREN_MAX, "too many children");
	family.child[family.children++] = pid;
}

static inline bool is_child(pid_t pid)
{
	int i;

	for (i = 0; i < family.children; i++)
		if (family.child[i] == pid)
			return true;
	return false;
}

static inline void remove_child(pid_t pid)
{
	int i;

	for (i = 0; i < family.children; i++)
		if (family.child[i] == pid)
			family.child[i--] = family.child[--family.children];
}

/* For any thread of the process. */
static inline void check_place(void)
{
	char name[16];
	pid_t parent;

	CHECK(getpid() == family.pid && syscall(SYS_getpid) == family.pid, "I was %d", family.pid);
	parent = getppid();
	/* Whoever has killed it must answer for that; its own parent will see it. */
	if (parent != family.parent && !is_alive(family.parent))
		_exit(0);
	if (parent != family.parent)
		came_apart("my parent was %d, now it is %d", family.parent, parent);
	CHECK(getpgrp() == family.group, "my process group was %d, now it is %d", family.group,
	      getpgrp());
	CHECK(getsid(0) == family.session, "my session was %d, now it is %d", family.session,
	      getsid(0));
	if (syscall(SYS_gettid) == family.pid) {
		CHECK(prctl(PR_GET_NAME, name) == 0, "PR_GET_NAME: %s", strerror(errno));
		CHECK(!strcmp(name, family.name), "my name was %s, now it is %s", family.name,
		      name);
	}
}

/* How many children /proc lists for all our threads; -1: it could not be read.  An
 * open file of /proc/self is that of a dead process after a restore. */
static inline int listed_children(void)
{
	DIR *tasks = opendir("/proc/self/task");
	struct dirent *task;
	bool failed = false;
	int found = 0;

	if (!tasks)
		return -1;
	while ((task = readdir(tasks))) {
		char path[300];
		FILE *file;
		pid_t pid;

		if (task->d_name[0] == '.')
			continue;
		snprintf(path, sizeof(path), "/proc/self/task/%s/children", task->d_name);
		file = fopen(path, "re");
		if (!file)
			continue; /* a thread that has just ended */
		while (fscanf(file, "%d", &pid) == 1) {
			CHECK(is_child(pid), "%d is not my child, but %s says so", pid, path);
			found++;
		}
		failed |= ferror(file) != 0;
		fclose(file);
	}
	closedir(tasks);
	return failed ? -1 : found;
}

/* /proc/self/task/TID/children of every thread: exactly those that we know of.
 * The process must not fork meanwhile. */
static inline void check_children_file(void)
{
	int tries = 0, found;

	do
		found = listed_children();
	while (found != family.children && tries++ < 5);
	if (found != family.children)
		came_apart("I have %d children, but %d are listed", family.children, found);
}

/* Nobody may be there to be waited for, living children are, and no others. */
static inline void check_nothing_to_wait_for(void)
{
	siginfo_t info = { 0 };
	int status;
	pid_t pid;

	if (waitid(P_ALL, 0, &info, WEXITED | WSTOPPED | WCONTINUED | WNOHANG | WNOWAIT | __WALL) <
	    0) {
		if (family.children || errno != ECHILD)
			came_apart("waitid: %s; I have %d children", strerror(errno),
				   family.children);
	} else {
		CHECK(family.children, "waitid finds children, and I have none");
		CHECK(!info.si_pid || is_child(info.si_pid),
		      "waitid: %d is no child of mine, code %d, status %d", info.si_pid,
		      info.si_code, info.si_status);
		if (info.si_pid)
			came_apart("child %d: code %d, status %d", info.si_pid, info.si_code,
				   info.si_status);
	}
	pid = waitpid(-1, &status, WNOHANG | __WCLONE);
	CHECK(pid == -1 && errno == ECHILD, "wait for clones: %d, status %x", pid, status);
	pid = waitpid(-1, &status, WNOHANG | __WALL | WUNTRACED | WCONTINUED);
	if (pid > 0)
		came_apart("waitpid: child %d, status %x", pid, status);
	if (family.children ? pid != 0 : pid != -1 || errno != ECHILD)
		came_apart("waitpid: %s, and I have %d children",
			   pid ? strerror(errno) : "children", family.children);
	if (sigchlds)
		came_apart("%lu SIGCHLD, and no child has ended", sigchlds);
}

#endif
