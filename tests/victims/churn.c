/* SPDX-License-Identifier: Apache-2.0
 *
 * churn N [--threads T] [--vfork] [--life-ms M]: children that come and go.
 *
 * T threads (1) keep N children alive each; a child lives for up to M ms (30) and
 * ends in a way that follows from its number: by a status or a signal.  The parent
 * reaps each once, by one of the calls there are for it, and gets what the number
 * says.  A child writes its number into a pipe of its own, of which the parent
 * reads the end as soon as the child is gone.  Some children have a child
 * themselves.  With --vfork they are made by vfork(2) and exec.
 *
 * A child that somebody else kills with SIGKILL is counted, and replaced.
 * Counter 0: children reaped; 1: longest time from the reaping of a child to the
 * end of its pipe, in ns; 3: children that were killed by SIGKILL.
 */
#include <poll.h>

#include "family.h"

enum { THREADS_MAX = 32, RECENT = 1024, LATE_S = 30, STUCK_TICKS = 5000 };

struct child {
	pid_t pid;
	uint64_t number;
	int fd; /* what it writes */
	uint64_t born_lap;
};

struct parent {
	int index, count;
	uint64_t random;
	struct child child[64];
	volatile uint64_t laps;
};

/* Guards family.child[], the numbers, and that no child inherits another's pipe. */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static uint64_t numbers;
static pid_t recent[RECENT];
static uint64_t recents;

/* What the handler saw; it may be earlier than fork() returns. */
static volatile pid_t signalled[RECENT];
static volatile uint64_t signals_seen;
static uint64_t signals_checked;

static int per_thread, threads = 1;
static long life_ms = 30;
static bool by_vfork;
static const char *board_path;

static void on_child(int sig, siginfo_t *info, void *context)
{
	on_sigchld(sig, info, context);
	signalled[signals_seen++ % RECENT] = info->si_pid;
}

/* ---- a child's life --------------------------------------------------------------- */

static bool dies_by_signal(uint64_t number)
{
	return number % 5 == 3;
}

static int end_of(uint64_t number)
{
	static const int signals[] = { SIGTERM, SIGUSR1, SIGHUP, SIGALRM };

	return dies_by_signal(number) ? signals[number / 5 % 4] : (int)(number % 64);
}

static void have_a_child_for_a_while(long us)
{
	siginfo_t info = { 0 };
	pid_t child = fork();

	must(child >= 0, "fork");
	if (child == 0) {
		forget_children();
		know_family("grandchild");
		nap(us);
		check_place();
		_exit(33);
	}
	add_child(child);
	check_children_file();
	if (waitid(P_ALL, 0, &info, WEXITED) < 0)
		came_apart("waitid: %s", strerror(errno));
	if (info.si_code == CLD_KILLED && info.si_status == SIGKILL)
		came_apart("a grandchild was killed");
	CHECK(info.si_pid == child && info.si_code == CLD_EXITED && info.si_status == 33,
	      "grandchild %d: %d, code %d, status %d", child, info.si_pid, info.si_code,
	      info.si_status);
	remove_child(child);
}

static _Noreturn void live(uint64_t number, int fd)
{
	uint64_t random = mix(number, 3) | 1;
	const long us = (long)(next_random(&random) % (uint64_t)(life_ms * 1000));

	know_family("child");
	if (write(fd, &number, sizeof(number)) != sizeof(number))
		came_apart("child %lu: write: %s", number, strerror(errno));
	nap(us / 2);
	check_place();
	if (number % 7 == 2)
		have_a_child_for_a_while(us / 4);
	nap(us / 2);
	check_place();
	if (!dies_by_signal(number))
		_exit(end_of(number));
	signal(end_of(number), SIG_DFL);
	for (;;)
		raise(end_of(number));
}

/* churn --live NUMBER FD LIFE_MS MAIN [BOARD] */
static _Noreturn void live_execed(char **argv)
{
	if (argv[6])
		board_open(argv[6]);
	life_ms = atol(argv[4]);
	family.main = atoi(argv[5]);
	live(strtoul(argv[2], NULL, 10), atoi(argv[3]));
}

/* ---- the parent ---------------------------------------------------------------------- */

static pid_t start(uint64_t number, int fd, uint64_t *random)
{
	static _Thread_local struct timespec pause;
	char n[4][24];
	char *argv[] = {
		(char *)"churn", (char *)"--live", n[0], n[1], n[2], n[3], (char *)board_path, NULL
	};
	pid_t pid;

	if (!by_vfork) {
		pid = fork();
		if (pid)
			return pid;
		forget_children();
		signal(SIGCHLD, SIG_DFL);
		live(number, fd);
	}
	snprintf(n[0], sizeof(n[0]), "%lu", number);
	snprintf(n[1], sizeof(n[1]), "%d", fd);
	snprintf(n[2], sizeof(n[2]), "%ld", life_ms);
	snprintf(n[3], sizeof(n[3]), "%d", family.main);
	pause.tv_nsec = next_random(random) % 4 == 0 ? 3000000 : 0;
	pid = vfork();
	if (pid == 0) {
		/* With its parent suspended all the while. */
		if (pause.tv_nsec)
			clock_nanosleep(CLOCK_MONOTONIC, 0, &pause, NULL);
		execv("/proc/self/exe", argv);
		_exit(127);
	}
	return pid;
}

static void bear(struct parent *me)
{
	struct child *child = &me->child[me->count++];
	int fds[2];

	must(!pthread_mutex_lock(&lock), "lock");
	must(pipe(fds) == 0, "pipe");
	child->number = ++numbers;
	child->fd = fds[0];
	child->born_lap = me->laps;
	must(fcntl(fds[0], F_SETFL, O_NONBLOCK) == 0, "F_SETFL");
	must(fcntl(fds[0], F_SETFD, FD_CLOEXEC) == 0, "F_SETFD");
	child->pid = start(child->number, fds[1], &me->random);
	must(child->pid > 0, "fork");
	CHECK(!is_child(child->pid), "%d is born twice", child->pid);
	add_child(child->pid);
	close(fds[1]);
	must(!pthread_mutex_unlock(&lock), "unlock");
}

/* Its number, and then the end: nobody else has the other end of the pipe. */
static void read_to_the_end(struct child *child)
{
	struct pollfd fd = { .fd = child->fd, .events = POLLIN };
	const uint64_t start_ns = now_ns();
	uint64_t number = 0, took;
	int tries = 0;
	ssize_t n = read(child->fd, &number, sizeof(number));

	/* Somebody may have killed it before it wrote. */
	if (n > 0 || (n < 0 && errno != EAGAIN))
		CHECK(n == sizeof(number) && number == child->number,
		      "child %lu has written %zd bytes, number %lu", child->number, n, number);
	while (read(child->fd, &number, sizeof(number)) != 0) {
		CHECK(errno == EAGAIN, "child %lu has written too much", child->number);
		CHECK(tries++ < LATE_S * 10, "child %lu has ended, and its pipe has not",
		      child->number);
		poll(&fd, 1, 100);
	}
	took = now_ns() - start_ns;
	if (took > board->counter[1])
		board->counter[1] = took;
	close(child->fd);
}

static int index_of(const struct parent *me, pid_t pid)
{
	int i;

	for (i = 0; i < me->count; i++)
		if (me->child[i].pid == pid)
			return i;
	return -1;
}

/* The one that was reaped just now, with the lock held. */
static struct child bury(struct parent *me, pid_t pid, int code, int status)
{
	const int index = index_of(me, pid);
	struct child child;

	CHECK(index >= 0, "%d is no child of mine: code %d, status %d", pid, code, status);
	child = me->child[index];
	if (code == CLD_KILLED && status == SIGKILL)
		count(3, 1);
	else
		CHECK(code == (dies_by_signal(child.number) ? CLD_KILLED : CLD_EXITED) &&
			      status == end_of(child.number),
		      "child %lu, process %d: code %d, status %d", child.number, child.pid, code,
		      status);
	remove_child(pid);
	recent[recents++ % RECENT] = pid;
	me->child[index] = me->child[--me->count];
	return child;
}

/* With one thread by any of the calls; with several each waits for its own. */
static void reap(struct parent *me)
{
	const bool alone = threads == 1, by_waitpid = alone && next_random(&me->random) % 2;
	const pid_t chosen = me->child[next_random(&me->random) % (uint64_t)me->count].pid;
	struct child child = { 0 };
	siginfo_t info = { 0 };
	int status = 0;
	pid_t pid;

	/* Now and then blocked; without the lock, so nobody is reaped yet. */
	if (next_random(&me->random) % 4 == 0)
		CHECK(waitid(alone ? P_ALL : P_PID, (id_t)chosen, &info, WEXITED | WNOWAIT) == 0,
		      "waitid: %s, and there are %d children", strerror(errno), me->count);
	must(!pthread_mutex_lock(&lock), "lock");
	if (by_waitpid) {
		pid = waitpid(-1, &status, WNOHANG | (next_random(&me->random) % 2 ? __WALL : 0));
		CHECK(pid >= 0, "waitpid: %s, and there are %d children", strerror(errno),
		      me->count);
		if (pid)
			child = bury(me, pid, WIFEXITED(status) ? CLD_EXITED : CLD_KILLED,
				     WIFEXITED(status) ? WEXITSTATUS(status) : WTERMSIG(status));
	} else {
		info = (siginfo_t){ 0 };
		CHECK(waitid(alone ? P_ALL : P_PID, (id_t)chosen, &info, WEXITED | WNOHANG) == 0,
		      "waitid: %s, and there are %d children", strerror(errno), me->count);
		if (info.si_pid)
			child = bury(me, info.si_pid, info.si_code, info.si_status);
	}
	must(!pthread_mutex_unlock(&lock), "unlock");
	if (!child.pid)
		return;
	read_to_the_end(&child);
	count(0, 1);
}

static void *bear_and_bury(void *arg)
{
	struct parent *me = arg;

	for (;; me->laps++) {
		if (me->count < per_thread && next_random(&me->random) % 4)
			bear(me);
		if (me->count)
			reap(me);
		nap((long)(next_random(&me->random) % 1500));
	}
	return NULL;
}

static bool was_child(pid_t pid)
{
	int i;

	for (i = 0; i < RECENT; i++)
		if (recent[i] == pid)
			return true;
	return is_child(pid);
}

/* Nobody else's deaths are told to us. */
static void check_signals(void)
{
	const uint64_t seen = signals_seen;

	if (seen - signals_checked > RECENT / 2)
		signals_checked = seen - RECENT / 2;
	for (; signals_checked < seen; signals_checked++) {
		const pid_t pid = signalled[signals_checked % RECENT];

		CHECK(was_child(pid), "SIGCHLD for %d, which is no child of mine", pid);
	}
	CHECK(sigchlds <= numbers, "%lu SIGCHLD for %lu children", sigchlds, numbers);
}

static void check_all(void)
{
	int status;
	pid_t pid;

	must(!pthread_mutex_lock(&lock), "lock");
	check_children_file();
	check_signals();
	pid = waitpid(-1, &status, WNOHANG | __WCLONE);
	CHECK(pid == -1 && errno == ECHILD, "wait for clones: %d, status %x", pid, status);
	must(!pthread_mutex_unlock(&lock), "unlock");
}

int main(int argc, char **argv)
{
	static struct parent parents[THREADS_MAX];
	static uint64_t seen[THREADS_MAX], ticks[THREADS_MAX];
	struct sigaction act = { .sa_sigaction = on_child, .sa_flags = SA_SIGINFO | SA_RESTART };
	sigset_t chld;
	int i;

	signal(SIGPIPE, SIG_IGN);
	if (argc > 5 && !strcmp(argv[1], "--live"))
		live_execed(argv);
	by_vfork = victim_flag(&argc, argv, "--vfork");
	for (i = 1; i + 1 < argc; i++) {
		if (!strcmp(argv[i], "--threads"))
			threads = atoi(argv[i + 1]);
		else if (!strcmp(argv[i], "--life-ms"))
			life_ms = atol(argv[i + 1]);
		else if (!strcmp(argv[i], "--board"))
			board_path = argv[i + 1];
	}
	victim_start(&argc, argv, 1, "N [--threads T] [--vfork] [--life-ms M]");
	per_thread = atoi(argv[1]);
	must(per_thread > 0 && per_thread <= 64 && threads > 0 && threads <= THREADS_MAX &&
		     per_thread * threads <= CHILDREN_MAX,
	     "too many");
	family.main = getpid();
	know_family("churn");
	sigemptyset(&act.sa_mask);
	must(sigaction(SIGCHLD, &act, NULL) == 0, "sigaction");
	/* One thread takes them, so that the handler is never in two places. */
	sigemptyset(&chld);
	sigaddset(&chld, SIGCHLD);
	pthread_sigmask(SIG_BLOCK, &chld, NULL);
	for (i = 0; i < threads; i++) {
		pthread_t thread;

		parents[i].index = i;
		parents[i].random = (uint64_t)i + 1;
		must(!pthread_create(&thread, NULL, bear_and_bury, &parents[i]), "pthread_create");
	}
	pthread_sigmask(SIG_UNBLOCK, &chld, NULL);
	victim_ready();
	for (;;) {
		check_place();
		check_all();
		for (i = 0; i < threads; i++) {
			/* In ticks of its own, not by the clock: who is stopped is not stuck. */
			ticks[i] = parents[i].laps == seen[i] ? ticks[i] + 1 : 0;
			seen[i] = parents[i].laps;
			CHECK(ticks[i] < STUCK_TICKS, "thread %d is stuck at lap %lu", i, seen[i]);
		}
		beat();
		nap(2000);
	}
}
