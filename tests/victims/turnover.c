/* SPDX-License-Identifier: Apache-2.0
 *
 * turnover KIND...: children and threads that come and go, of these kinds in turn, each awaited for.
 *
 *   exit     a child that exits              kill     one that is killed
 *   threads  one with threads that exits     slain    one with threads that is killed
 *   exec     one that executes a program     thread   one of whose threads does
 *   spawn    posix_spawn(3)                  again    one that executes itself a few times
 *   pidfd    clone3(2), awaited by a pidfd   polled   waitpid(2) with WNOHANG
 *   handled  SIGCHLD handler with siginfo    queued   sigtimedwait(2)
 *   stopped  stopped, continued, and killed  session  in a session or process group of its own
 *   orphan   a daemon that forks twice       headless its main thread ends first
 *   join     a thread that is joined         detach   one that is detached, and waited for by its TID
 *
 * What each call says of an end is checked.  Counter 0: ends; 1: longest time from an end until that
 * was told, in ns; 2: those above 5 ms; 3: above 10 ms; 4: above 18 ms; 5: the kind of the longest;
 * 6: all of them together, in ns; 7: told by a pidfd before waitid(2) knew; 16 and more: those above
 * 10 ms, by kind; 36 and more: the longest, by kind.
 */
#include <linux/sched.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <spawn.h>
#include <sys/resource.h>

#include "victim.h"

#define TIMES 4

static volatile uint64_t *ended_ns; /* of the child, as it says itself */
static uint64_t randomness;
static volatile sig_atomic_t signals;
static siginfo_t told;
static char *self;
static int kind_now;

static void note(uint64_t since)
{
	const uint64_t now = now_ns(), late = now > since ? now - since : 0;

	if (late > board->counter[1]) {
		board->counter[1] = late;
		board->counter[5] = (uint64_t)kind_now;
	}
	count(0, 1);
	count(2, late > 5000000);
	count(3, late > 10000000);
	count(4, late > 18000000);
	count(6, late);
	count(16 + (unsigned)kind_now, late > 10000000);
	if (late > board->counter[36 + kind_now])
		board->counter[36 + kind_now] = late;
}

static long some_us(void)
{
	return (long)(next_random(&randomness) % 3000);
}

static _Noreturn void leave(int status)
{
	*ended_ns = now_ns();
	_exit(status);
}

static int a_status(void)
{
	return (int)(next_random(&randomness) % 200) + 1;
}

static void *pause_for_ever(void *arg)
{
	(void)arg;
	for (;;)
		pause();
	return NULL;
}

static void make_threads(int n)
{
	pthread_t thread;

	while (n--)
		must(!pthread_create(&thread, NULL, pause_for_ever, NULL), "pthread_create");
}

static pid_t fork_one(void)
{
	const pid_t pid = fork();

	must(pid >= 0, "fork");
	return pid;
}

static void reap(pid_t pid, int status, int signal)
{
	struct rusage usage;
	int got;
	const pid_t done = wait4(pid, &got, 0, &usage);

	CHECK(done == pid, "wait4(%d): %d, %s", pid, done, strerror(errno));
	CHECK(signal ? WIFSIGNALED(got) && WTERMSIG(got) == signal
		     : WIFEXITED(got) && WEXITSTATUS(got) == status,
	      "kind %d: it ended with %#x instead of %d, %d", kind_now, got, status, signal);
	CHECK(usage.ru_utime.tv_sec == 0 && usage.ru_stime.tv_sec == 0, "it worked for seconds");
	CHECK(waitpid(-1, &got, WNOHANG) == -1 && errno == ECHILD, "there is another child");
}

static void exit_one(int threads)
{
	const int status = a_status();
	const pid_t pid = fork_one();

	if (!pid) {
		make_threads(threads);
		nap_us(some_us());
		leave(status);
	}
	reap(pid, status, 0);
	note(*ended_ns);
}

static void kill_one(int threads)
{
	const long us = some_us();
	const pid_t pid = fork_one();
	uint64_t since;

	if (!pid) {
		make_threads(threads);
		pause_for_ever(NULL);
	}
	nap_us(us);
	since = now_ns();
	kill(pid, SIGKILL);
	reap(pid, 0, SIGKILL);
	note(since);
}

static void *execute(void *arg)
{
	execl(self, self, "--leave", (char *)arg, "0", NULL);
	_exit(98);
}

static void exec_one(int times)
{
	const int status = a_status();
	const pid_t pid = fork_one();
	char text[12], left[12];

	if (!pid) {
		snprintf(text, sizeof text, "%d", status);
		snprintf(left, sizeof left, "%d", times);
		execl(self, self, "--leave", text, left, NULL);
		_exit(98);
	}
	reap(pid, status, 0);
	note(*ended_ns);
}

static void thread_one(int threads)
{
	const int status = a_status();
	const pid_t pid = fork_one();
	pthread_t thread;
	char text[12];

	if (!pid) {
		snprintf(text, sizeof text, "%d", status);
		make_threads(threads);
		must(!pthread_create(&thread, NULL, execute, text), "pthread_create");
		pause_for_ever(NULL);
	}
	reap(pid, status, 0);
	note(*ended_ns);
}

static void spawn_one(__attribute__((unused)) int arg)
{
	const int status = a_status();
	char text[12], name[] = "--leave", times[] = "0";
	char *const argv[] = { self, name, text, times, NULL };
	pid_t pid;

	snprintf(text, sizeof text, "%d", status);
	must(!posix_spawn(&pid, self, NULL, NULL, argv, environ), "posix_spawn");
	reap(pid, status, 0);
	note(*ended_ns);
}

static void pidfd_one(__attribute__((unused)) int arg)
{
	int pidfd = -1;
	struct clone_args args = { .flags = CLONE_PIDFD,
				   .pidfd = (uint64_t)&pidfd,
				   .exit_signal = SIGCHLD };
	const int status = a_status();
	const pid_t pid = (pid_t)syscall(SYS_clone3, &args, sizeof args);
	struct pollfd poll_it;
	siginfo_t info = { 0 };

	must(pid >= 0, "clone3");
	if (!pid) {
		nap_us(some_us());
		leave(status);
	}
	poll_it = (struct pollfd){ .fd = pidfd, .events = POLLIN };
	while (poll(&poll_it, 1, -1) != 1)
		CHECK(errno == EINTR, "poll: %s", strerror(errno));
	note(*ended_ns);
	must(!waitid((idtype_t)3 /* P_PIDFD */, (id_t)pidfd, &info, WEXITED | WNOHANG), "waitid");
	if (!info.si_pid) {
		/* It can be told to a pidfd before its tracer has reaped it. */
		count(7, 1);
		must(!waitid((idtype_t)3, (id_t)pidfd, &info, WEXITED), "waitid");
	}
	CHECK(info.si_pid == pid && info.si_code == CLD_EXITED && info.si_status == status &&
		      info.si_signo == SIGCHLD,
	      "waitid: pid %d code %d status %d", info.si_pid, info.si_code, info.si_status);
	close(pidfd);
}

static void polled_one(__attribute__((unused)) int arg)
{
	const int status = a_status();
	const pid_t pid = fork_one();
	pid_t done;
	int got;

	if (!pid) {
		nap_us(some_us());
		leave(status);
	}
	while (!(done = waitpid(pid, &got, WNOHANG)))
		nap_us(50);
	CHECK(done == pid && WIFEXITED(got) && WEXITSTATUS(got) == status, "%d %#x", done, got);
	note(*ended_ns);
}

static void handle(int signal, siginfo_t *info, void *context)
{
	(void)signal;
	(void)context;
	told = *info;
	signals++;
}

static void check_told(const siginfo_t *info, pid_t pid, int status)
{
	CHECK(info->si_pid == pid && info->si_code == CLD_EXITED && info->si_status == status &&
		      info->si_uid == getuid(),
	      "SIGCHLD: pid %d code %d status %d, and not of %d", info->si_pid, info->si_code,
	      info->si_status, pid);
}

static void signalled_one(int handler)
{
	struct sigaction action = { .sa_sigaction = handle, .sa_flags = SA_SIGINFO }, before;
	const struct timespec no_time = { 0 };
	const int status = a_status();
	siginfo_t info;
	sigset_t set, old;
	pid_t pid;
	int got;

	sigemptyset(&set);
	sigaddset(&set, SIGCHLD);
	sigprocmask(SIG_BLOCK, &set, &old);
	sigaction(SIGCHLD, &action, &before);
	signals = 0;
	pid = fork_one();
	if (!pid) {
		nap_us(some_us());
		leave(status);
	}
	if (handler) {
		while (!signals)
			sigsuspend(&old);
		info = told;
	} else {
		got = sigwaitinfo(&set, &info);
		CHECK(got == SIGCHLD, "sigwaitinfo: %d, %s", got, strerror(errno));
	}
	note(*ended_ns);
	check_told(&info, pid, status);
	got = waitpid(pid, &got, WNOHANG);
	CHECK(got == pid, "SIGCHLD came before the end: %d", got);
	CHECK(sigtimedwait(&set, NULL, &no_time) == -1, "another SIGCHLD");
	CHECK(signals == handler, "%d SIGCHLD", signals);
	sigaction(SIGCHLD, &before, NULL);
	sigprocmask(SIG_SETMASK, &old, NULL);
}

static void await_state(pid_t pid, int options, int code, int status)
{
	siginfo_t info = { 0 };

	while (waitid(P_PID, (id_t)pid, &info, options))
		CHECK(errno == EINTR, "waitid: %s", strerror(errno));
	CHECK(info.si_pid == pid && info.si_code == code && info.si_status == status,
	      "waitid: pid %d code %d status %d instead of %d %d %d", info.si_pid, info.si_code,
	      info.si_status, pid, code, status);
}

static void stop_one(__attribute__((unused)) int arg)
{
	const long us = some_us();
	const pid_t pid = fork_one();
	uint64_t since;

	if (!pid)
		pause_for_ever(NULL);
	nap_us(us);
	since = now_ns();
	kill(pid, SIGSTOP);
	await_state(pid, WSTOPPED, CLD_STOPPED, SIGSTOP);
	note(since);
	nap_us(us / 2);
	since = now_ns();
	kill(pid, SIGCONT);
	await_state(pid, WCONTINUED, CLD_CONTINUED, SIGCONT);
	note(since);
	nap_us(us / 3);
	kill(pid, SIGSTOP);
	await_state(pid, WSTOPPED, CLD_STOPPED, SIGSTOP);
	nap_us(us);
	since = now_ns();
	kill(pid, SIGKILL);
	reap(pid, 0, SIGKILL);
	note(since);
}

static void session_one(__attribute__((unused)) int arg)
{
	const bool session = next_random(&randomness) & 1;
	const int status = a_status();
	const pid_t pid = fork_one();

	if (!pid) {
		must(session ? setsid() == getpid() : !setpgid(0, 0), "setsid");
		nap_us(some_us());
		leave(status);
	}
	reap(pid, status, 0);
	note(*ended_ns);
}

static void orphan_one(__attribute__((unused)) int arg)
{
	const int status = a_status();
	const pid_t pid = fork_one();

	if (!pid) {
		setsid();
		if (!fork_one()) {
			nap_us(some_us());
			_exit(0);
		}
		leave(status);
	}
	reap(pid, status, 0);
	note(*ended_ns);
}

static void *leave_later(void *arg)
{
	nap_us(some_us() + 500);
	leave((int)(intptr_t)arg);
	return NULL;
}

static void headless_one(__attribute__((unused)) int arg)
{
	const int status = a_status();
	const pid_t pid = fork_one();
	pthread_t thread;

	if (!pid) {
		must(!pthread_create(&thread, NULL, leave_later, (void *)(intptr_t)status),
		     "pthread_create");
		pthread_exit(NULL);
	}
	reap(pid, status, 0);
	note(*ended_ns);
}

static void *end_thread(void *arg)
{
	nap_us(some_us());
	*ended_ns = now_ns();
	return arg;
}

static pid_t tid_of;

static void join_one(__attribute__((unused)) int arg)
{
	pthread_t thread;
	void *result;

	must(!pthread_create(&thread, NULL, end_thread, &tid_of), "pthread_create");
	must(!pthread_join(thread, &result), "pthread_join");
	CHECK(result == &tid_of, "a thread gave %p", result);
	note(*ended_ns);
}

static void *detached(void *arg)
{
	(void)arg;
	__atomic_store_n(&tid_of, (pid_t)syscall(SYS_gettid), __ATOMIC_RELEASE);
	nap_us(some_us());
	*ended_ns = now_ns();
	return NULL;
}

static void detach_one(__attribute__((unused)) int arg)
{
	pthread_attr_t attr;
	pthread_t thread;
	pid_t tid;

	tid_of = 0;
	*ended_ns = 0;
	pthread_attr_init(&attr);
	pthread_attr_setdetachstate(&attr, PTHREAD_CREATE_DETACHED);
	must(!pthread_create(&thread, &attr, detached, NULL), "pthread_create");
	while (!(tid = __atomic_load_n(&tid_of, __ATOMIC_ACQUIRE)))
		nap_us(50);
	while (syscall(SYS_tgkill, getpid(), tid, 0) == 0)
		nap_us(50);
	note(*ended_ns);
}

static const struct {
	const char *name;
	void (*turn)(int arg);
	int arg;
} kinds[] = {
	{ "exit", exit_one, 0 },         { "kill", kill_one, 0 },
	{ "threads", exit_one, 8 },      { "slain", kill_one, 8 },
	{ "exec", exec_one, 0 },         { "thread", thread_one, 2 },
	{ "spawn", spawn_one, 0 },       { "again", exec_one, 4 },
	{ "pidfd", pidfd_one, 0 },       { "polled", polled_one, 0 },
	{ "handled", signalled_one, 1 }, { "queued", signalled_one, 0 },
	{ "stopped", stop_one, 0 },      { "session", session_one, 0 },
	{ "orphan", orphan_one, 0 },     { "headless", headless_one, 0 },
	{ "join", join_one, 0 },         { "detach", detach_one, 0 },
};
#define KINDS ((int)(sizeof kinds / sizeof *kinds))

/* The page is inherited by descriptor. */
static volatile uint64_t *map_page(int fd)
{
	void *page = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);

	must(page != MAP_FAILED, "mmap");
	return page;
}

int main(int argc, char **argv)
{
	int chosen[KINDS], n = 0, fd;

	self = argv[0];
	if (argc == 4 && !strcmp(argv[1], "--leave")) {
		int times = atoi(argv[3]);
		char text[12];

		ended_ns = map_page(900);
		if (times) {
			snprintf(text, sizeof text, "%d", times - 1);
			execl(self, self, "--leave", argv[2], text, NULL);
			_exit(97);
		}
		leave(atoi(argv[2]));
	}
	victim_start(&argc, argv, 1, "KIND...");
	fd = memfd_create("turnover", 0);
	must(fd >= 0 && ftruncate(fd, 4096) == 0 && dup2(fd, 900) == 900, "memfd_create");
	close(fd);
	ended_ns = map_page(900);
	randomness = (uint64_t)getpid() + 1;
	for (int i = 1; i < argc; i++)
		for (int k = 0; k < KINDS; k++)
			if (!strcmp(argv[i], kinds[k].name) || !strcmp(argv[i], "all"))
				if (n < KINDS)
					chosen[n++] = k;
	must(n > 0, "kinds");
	victim_ready();
	for (int i = 0;; i = (i + 1) % n) {
		kind_now = chosen[i];
		for (int k = 0; k < TIMES; k++)
			kinds[kind_now].turn(kinds[kind_now].arg);
		beat();
	}
}
