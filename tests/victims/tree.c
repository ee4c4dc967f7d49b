/* SPDX-License-Identifier: Apache-2.0
 *
 * tree WORKERS [--threads T] [--lap-us N] [--orphan] [--reaper] [--usual-waits]: processes that
 * hang together.
 *
 * The main process forks WORKERS others that live as long as it does.  Each
 * knows its place (family.h), and what it shares with the others agrees with
 * what it has for itself: numbered records in pipes and sockets from the main
 * process, to it, and round in a ring, of which some are always under way;
 * counters in shared memory behind a lock; the offset of an inherited file; the
 * tokens of an eventfd.  A tree that goes back must go back as a whole, or the
 * next record, counter, token is not the one that follows.
 *
 * What a worker is besides goes by its number: kinds[], below.  With --threads
 * each worker has T threads in all.  --orphan: one process more, whose parent has
 * ended, so that it is a child of init.  --reaper: some adopt orphans themselves.
 * --usual-waits: nobody waits for children without a signal at their exit (__WALL).
 * Counter 0: laps of all in shared memory; 1: records received by the main process; 2, 3:
 * forks (family.h).
 */
#include <sys/resource.h>
#include <sys/socket.h>

#include "channel.h"
#include "common.h"

enum { STUCK_LAPS = 10000 };

enum kind { PLAIN, SESSION, GROUP, MEMBER, EXECED, ZOMBIES, WAITER, REAPER, KINDS };
static const char *const kinds[KINDS] = { "plain",  "session", "group",  "member",
					  "execed", "zombies", "waiter", "reaper" };

/* Numbers of one worker, or of the main process towards it. */
struct ends {
	struct channel in, out;   /* pipes between main and worker */
	struct channel get, give; /* the two directions of a socketpair */
};

static long lap_us, threads = 1;
static int workers;
static bool with_reapers;
static int all = __WALL;
static const char *board_path;

/* ---- kinds of workers --------------------------------------------------------------- */

static _Noreturn void stay(const char *name)
{
	forget_children();
	know_family(name);
	time_forks();
	for (;;) {
		check_place();
		check_nothing_to_wait_for();
		nap(lap_us * 2);
	}
}

static void have_child(const char *name)
{
	const pid_t child = fork();

	if (child == 0)
		stay(name);
	add_child(child);
}

static void have_zombies(void)
{
	int i;

	for (i = 0; i < 2; i++) {
		const pid_t child = fork();
		siginfo_t info;

		if (child == 0) {
			if (i == 0)
				_exit(7);
			for (;;)
				raise(SIGTERM);
		}
		add_child(child);
		must(waitid(P_PID, (id_t)child, &info, WEXITED | WNOWAIT) == 0, "waitid");
	}
}

static void check_zombies(void)
{
	siginfo_t info;
	int i;

	for (i = 0; i < 2; i++) {
		const int code = i ? CLD_KILLED : CLD_EXITED, status = i ? SIGTERM : 7;

		info = (siginfo_t){ 0 };
		if (waitid(P_PID, (id_t)family.child[i], &info, WEXITED | WNOHANG | WNOWAIT) < 0)
			violation("the zombie %d: %s", family.child[i], strerror(errno));
		CHECK(info.si_pid == family.child[i] && info.si_code == code &&
			      info.si_status == status,
		      "the zombie %d: %d, code %d, status %d", family.child[i], info.si_pid,
		      info.si_code, info.si_status);
	}
	info = (siginfo_t){ 0 };
	CHECK(waitid(P_ALL, 0, &info, WEXITED | WNOHANG | WNOWAIT | __WALL) == 0 &&
		      is_child(info.si_pid),
	      "waitid: %d is no zombie of mine", info.si_pid);
}

/* A child's child that becomes our own when its parent ends. */
static void adopt(void)
{
	int fds[2];
	pid_t child, orphan = 0;

	must(prctl(PR_SET_CHILD_SUBREAPER, 1) == 0, "PR_SET_CHILD_SUBREAPER");
	must(pipe(fds) == 0, "pipe");
	child = fork();
	if (child == 0) {
		const pid_t parent = getpid();

		orphan = fork();
		if (orphan == 0) {
			while (getppid() == parent)
				nap(1000);
			close(fds[0]);
			close(fds[1]);
			stay("adopted");
		}
		must(write(fds[1], &orphan, sizeof(orphan)) == sizeof(orphan), "write");
		_exit(0);
	}
	must(read(fds[0], &orphan, sizeof(orphan)) == sizeof(orphan), "read");
	must(waitpid(child, NULL, 0) == child, "waitpid");
	close(fds[0]);
	close(fds[1]);
	while (sigchlds == 0)
		nap(1000);
	sigchlds = 0;
	add_child(orphan);
}

/* ---- workers -------------------------------------------------------------------------- */

struct worker {
	int number;
	enum kind kind;
	struct ends ends;
	struct channel ring_in, ring_out;
};

static struct worker self;

/* More is open than may be opened now. */
enum { HIGH_FD = 300, FEW_FDS = 250 };

static void lower_limit(void)
{
	const struct rlimit few = { FEW_FDS, FEW_FDS };

	must(dup2(self.ends.in.fd, HIGH_FD) == HIGH_FD, "dup2");
	must(setrlimit(RLIMIT_NOFILE, &few) == 0, "setrlimit");
}

static void check_limit(void)
{
	struct rlimit is = { 0, 0 };

	CHECK(fcntl(HIGH_FD, F_GETFD) == 0, "descriptor %d: %s", HIGH_FD, strerror(errno));
	CHECK(getrlimit(RLIMIT_NOFILE, &is) == 0 && is.rlim_cur == FEW_FDS, "RLIMIT_NOFILE is %ld",
	      (long)is.rlim_cur);
}

static void *listen_down(void *unused)
{
	(void)unused;
	for (;;)
		take(&self.ends.in);
	return NULL;
}

static void *wait_for_ever(void *unused)
{
	int status;
	pid_t pid;

	(void)unused;
	for (;;) {
		pid = waitpid(-1, &status, all);
		came_apart("a wait without end: %d, status %x, %s", pid, status,
			   pid < 0 ? strerror(errno) : "");
	}
	return NULL;
}

static void *take_part(void *arg)
{
	const size_t number = (size_t)arg;
	struct party me = { .slot = self.number * (int)threads + (int)number,
			    .random = number + 1 };
	const pid_t tid = gettid();

	for (;;) {
		CHECK(syscall(SYS_gettid) == tid, "I was thread %d", tid);
		check_place();
		if (shared)
			meet(&me);
		nap(lap_us + (long)(next_random(&me.random) % (uint64_t)lap_us));
	}
	return NULL;
}

static _Noreturn void work(void)
{
	struct party me = { .slot = self.number * (int)threads,
			    .random = (uint64_t)self.number + 1 };
	const bool listens = threads > 1;
	pthread_attr_t attr;
	pthread_t thread;
	long i;

	time_forks();
	pthread_attr_init(&attr);
	pthread_attr_setstacksize(&attr, 64 << 10);
	/* One that is blocked in a read, the others meet. */
	for (i = 1; i < threads; i++)
		must(!pthread_create(&thread, &attr, i == 1 ? listen_down : take_part, (void *)i),
		     "pthread_create");
	if (self.kind == WAITER)
		must(!pthread_create(&thread, &attr, wait_for_ever, NULL), "pthread_create");
	for (;;) {
		check_place();
		if (shared)
			meet(&me);
		if (!listens)
			take_some(&self.ends.in);
		send_some(&self.ends.out, &me.random);
		take_some(&self.ends.get);
		send_some(&self.ends.give, &me.random);
		take_some(&self.ring_in);
		send_some(&self.ring_out, &me.random);
		if (next_random(&me.random) % 8 == 0)
			check_children_file();
		if (self.kind == MEMBER)
			check_limit();
		if (self.kind == ZOMBIES)
			check_zombies();
		else if (self.kind != WAITER)
			check_nothing_to_wait_for();
		nap(lap_us / 2 + (long)(next_random(&me.random) % (uint64_t)lap_us));
	}
}

static _Noreturn void exec_again(void)
{
	char n[10][16], *argv[14];
	const long value[10] = { self.number,      family.main,      workers,
				 threads,          lap_us,           self.ends.in.fd,
				 self.ends.out.fd, self.ends.get.fd, self.ring_in.fd,
				 self.ring_out.fd };
	int i;

	argv[0] = (char *)"tree";
	argv[1] = (char *)"--member";
	for (i = 0; i < 10; i++) {
		snprintf(n[i], sizeof(n[i]), "%ld", value[i]);
		argv[i + 2] = n[i];
	}
	argv[12] = (char *)board_path;
	argv[13] = NULL;
	execv("/proc/self/exe", argv);
	must(false, "execv");
	_exit(1);
}

/* Numbers of the channels: the same on both sides, and in an exec'ed worker. */
static void number_channels(void)
{
	const uint64_t n = (uint64_t)self.number * 8;

	self.ends.in.id = n;
	self.ends.out.id = n + 1;
	self.ends.get.id = n + 2;
	self.ends.give.id = n + 3;
	self.ring_out.id = n + 4;
	self.ring_in.id = (uint64_t)(self.number == 1 ? workers : self.number - 1) * 8 + 4;
}

/* tree --member NUMBER MAIN WORKERS THREADS LAP_US IN OUT SOCKET RING_IN RING_OUT [BOARD] */
static _Noreturn void be_execed(char **argv)
{
	int at = 2;

	self.number = atoi(argv[at++]);
	self.kind = EXECED;
	family.main = atoi(argv[at++]);
	workers = atoi(argv[at++]);
	threads = atol(argv[at++]);
	lap_us = atol(argv[at++]);
	self.ends.in.fd = atoi(argv[at++]);
	self.ends.out.fd = atoi(argv[at++]);
	self.ends.get.fd = self.ends.give.fd = atoi(argv[at++]);
	self.ring_in.fd = atoi(argv[at++]);
	self.ring_out.fd = atoi(argv[at++]);
	if (argv[at])
		board_open(argv[at]);
	number_channels();
	know_family(kinds[self.kind]);
	work();
}

/* Between the fork and the work. */
static _Noreturn void be_worker(void)
{
	if (self.kind == SESSION)
		must(setsid() > 0, "setsid");
	else if (self.kind == GROUP)
		must(setpgid(0, 0) == 0, "setpgid");
	else if (self.kind == MEMBER) {
		while (!shared->leader[self.number - 1])
			nap(500);
		must(setpgid(0, shared->leader[self.number - 1]) == 0, "setpgid");
		lower_limit();
	}
	shared->leader[self.number] = getpid();
	if (self.kind == GROUP || self.kind == WAITER)
		have_child("grandchild");
	else if (self.kind == ZOMBIES)
		have_zombies();
	else if (self.kind == REAPER)
		adopt();
	sigchlds = 0;
	know_family(kinds[self.kind]);
	work();
}

static void close_all_but(const int *keep, int n)
{
	int fd, i;

	for (fd = 3; fd < 3 + 6 * (WORKERS_MAX + 2) + 8; fd++) {
		for (i = 0; i < n && keep[i] != fd; i++)
			;
		if (i == n)
			close(fd);
	}
}

/* ---- the main process -------------------------------------------------------------------- */

static struct ends ends[WORKERS_MAX + 1];
static int ring_in[WORKERS_MAX + 1], ring_out[WORKERS_MAX + 1];

static void start_worker(int number)
{
	int down[2], up[2], pair[2], keep[8];
	pid_t pid;

	make_pipe(&down[0], &down[1]);
	make_pipe(&up[0], &up[1]);
	must(socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0, pair) == 0, "socketpair");
	fflush(NULL);
	pid = fork();
	if (pid) {
		const uint64_t n = (uint64_t)number * 8;

		add_child(pid);
		close(down[0]);
		close(up[1]);
		close(pair[1]);
		ends[number] = (struct ends){ .in = { up[0], n + 1, 0 },
					      .out = { down[1], n, 0 },
					      .get = { pair[0], n + 3, 0 },
					      .give = { pair[0], n + 2, 0 } };
		return;
	}
	forget_children();
	self.number = number;
	self.kind = (enum kind)((number - 1) % (with_reapers ? KINDS : REAPER));
	self.ends.in.fd = down[0];
	self.ends.out.fd = up[1];
	self.ends.get.fd = self.ends.give.fd = pair[1];
	self.ring_in.fd = ring_in[number];
	self.ring_out.fd = ring_out[number];
	number_channels();
	memcpy(keep,
	       (int[]){ down[0], up[1], pair[1], ring_in[number], ring_out[number], file_fd,
			event_fd },
	       7 * sizeof(int));
	close_all_but(keep, 7);
	if (self.kind == EXECED)
		exec_again();
	be_worker();
}

static void start_orphan(void)
{
	pid_t child = fork();

	if (child == 0) {
		const pid_t parent = getpid();
		struct party me = { .slot = (workers + 1) * (int)threads, .random = 7 };

		if (fork())
			_exit(0);
		setsid();
		forget_children();
		while (getppid() == parent)
			nap(1000);
		know_family("orphan");
		time_forks();
		for (;;) {
			check_place();
			check_nothing_to_wait_for();
			meet(&me);
			nap(lap_us);
		}
	}
	must(waitpid(child, NULL, 0) == child, "waitpid");
	while (!shared->slot[(workers + 1) * threads])
		nap(1000);
	sigchlds = 0;
}

static void check_child(int number)
{
	const pid_t pid = family.child[number - 1];
	const pid_t group = getpgid(pid), session = getsid(pid);

	if (group < 0 || session < 0)
		came_apart("worker %d, process %d: %s", number, pid, strerror(errno));
	CHECK(group == shared->group[number] && session == shared->session[number],
	      "worker %d, process %d: group %d, session %d; they were %d and %d", number, pid,
	      group, session, shared->group[number], shared->session[number]);
}

/* Everybody goes on, and every lap is counted once. */
static void check_laps(void)
{
	static uint64_t seen[SLOTS_MAX], since[SLOTS_MAX], got[WORKERS_MAX + 1];
	static uint64_t silent[WORKERS_MAX + 1];
	uint64_t sum = 0;
	int i;

	lock_shared();
	for (i = 0; i < SLOTS_MAX; i++)
		sum += shared->slot[i];
	CHECK(sum == shared->laps, "the slots hold %lu laps, and %lu were counted", sum,
	      shared->laps);
	board->counter[0] = sum;
	must(!pthread_mutex_unlock(&shared->lock), "unlock");
	for (i = 0; i < SLOTS_MAX; i++) {
		since[i] = shared->slot[i] && shared->slot[i] == seen[i] ? since[i] + 1 : 0;
		seen[i] = shared->slot[i];
		CHECK(since[i] < STUCK_LAPS, "slot %d is stuck at lap %lu", i, seen[i]);
	}
	for (i = 1; i <= workers; i++) {
		silent[i] = got[i] == ends[i].in.seq ? silent[i] + 1 : 0;
		got[i] = ends[i].in.seq;
		CHECK(silent[i] < STUCK_LAPS, "nothing comes from worker %d after record %lu", i,
		      got[i]);
	}
}

static _Noreturn void be_main(void)
{
	struct party me = { .random = 12345 };
	uint64_t laps;
	int i;

	time_forks();
	for (laps = 0;; laps++) {
		uint64_t received = 0;

		check_place();
		meet(&me);
		for (i = 1; i <= workers; i++) {
			take_some(&ends[i].in);
			send_some(&ends[i].out, &me.random);
			take_some(&ends[i].get);
			send_some(&ends[i].give, &me.random);
			received += ends[i].in.seq + ends[i].get.seq;
			if (laps % 8 == 0)
				check_child(i);
		}
		board->counter[1] = received;
		check_nothing_to_wait_for();
		if (laps % 8 == 0)
			check_children_file();
		check_laps();
		beat();
		nap(lap_us);
	}
}

/* Nobody is checked before everybody is in its place. */
static void wait_for_workers(void)
{
	int i;

	for (i = 1; i <= workers; i++) {
		int bytes = 0;

		while (bytes == 0) {
			must(ioctl(ends[i].in.fd, FIONREAD, &bytes) == 0, "FIONREAD");
			nap(500);
		}
		shared->group[i] = getpgid(family.child[i - 1]);
		shared->session[i] = getsid(family.child[i - 1]);
	}
}

int main(int argc, char **argv)
{
	const bool orphan = victim_flag(&argc, argv, "--orphan");
	int i;

	lap_us = 1000 * (long)slowness();
	with_reapers = victim_flag(&argc, argv, "--reaper");
	if (victim_flag(&argc, argv, "--usual-waits"))
		all = 0;
	watch_sigchld();
	if (argc > 2 && !strcmp(argv[1], "--member"))
		be_execed(argv);
	for (i = 1; i + 1 < argc; i++) {
		if (!strcmp(argv[i], "--threads"))
			threads = atol(argv[i + 1]);
		else if (!strcmp(argv[i], "--lap-us"))
			lap_us = atol(argv[i + 1]);
		else if (!strcmp(argv[i], "--board"))
			board_path = argv[i + 1];
	}
	victim_start(&argc, argv, 1,
		     "WORKERS [--threads T] [--lap-us N] [--orphan] [--reaper] [--usual-waits]");
	workers = atoi(argv[1]);
	must(workers <= WORKERS_MAX && (workers + 2) * threads <= SLOTS_MAX, "too many");
	family.main = getpid();
	know_family("tree");
	make_shared();
	for (i = 1; i <= workers; i++)
		make_pipe(&ring_in[i == workers ? 1 : i + 1], &ring_out[i]);
	for (i = 1; i <= workers; i++)
		start_worker(i);
	for (i = 1; i <= workers; i++) {
		close(ring_in[i]);
		close(ring_out[i]);
	}
	if (orphan)
		start_orphan();
	wait_for_workers();
	victim_ready();
	be_main();
}
