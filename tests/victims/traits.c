/* SPDX-License-Identifier: Apache-2.0
 *
 * traits KIND: what the kernel knows of a process or thread and tells it in one word or
 * two.  The victim says all the time what it finds, and nothing may ever be other than it
 * was.
 *
 *   exit-signal   a child whose end is told by SIGUSR1, one that had ended so, and one that had
 *                 ended with what is no signal
 *   zombie-group  a process in the group of one that has ended, which nobody waited for
 *   vdso          a child that has unmapped its vDSO
 *   proc          files below its own /proc/PID and its child's are open, in the middle
 *   limits        a child that has more than its parent may have, which has lowered its limits
 *   hard-limits   a child that may give itself more than its parent, which has lowered its own
 *                 hard limits; it has given up the right to raise such (CAP_SYS_RESOURCE)
 *   barriers      membarrier(2), registered
 *   personality   another one than at first (it changes 200 ms after the start)
 *   setup         a thread that sets its alternate stack and its name up a little after it began
 *   disarmed      a thread on an alternate stack that it has given up (SS_AUTODISARM)
 *   rearmed       the same, which has left it when counter 1 of the board is 2
 *   users         threads that change their groups and user, all of them (setuid(3)), each time
 *                 counter 1 of the board does; counter 0 follows
 *   retired       a main process that is another user for the time being (seteuid(2)), with a child
 *                 of a third user and group
 */
#include <fcntl.h>
#include <grp.h>
#include <linux/capability.h>
#include <linux/membarrier.h>
#include <pthread.h>
#include <sched.h>
#include <sys/personality.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/stat.h>

#include "victim.h"

#define SS_AUTODISARM_ (1u << 31) /* linux/signal.h, which does not go with signal.h */
#define STACK_BYTES 65536
#define MUCH (200ul << 20)
#define USERS 4
#define NO_SIGNAL 200

static char was[1024], is[1024], stack[STACK_BYTES];
static pid_t kid, dead, untold;
static volatile int ready;
static stack_t thread_stack;
static char thread_name[16];

static void wait_ended(pid_t pid)
{
	siginfo_t info;

	must(!waitid(P_PID, (id_t)pid, &info, WEXITED | WNOWAIT | __WALL), "waitid");
}

static _Noreturn void rest(void)
{
	for (;;)
		pause();
}

/* ---- exit-signal ---------------------------------------------------------------------- */

static pid_t clone_with(int signal)
{
	return (pid_t)syscall(SYS_clone, (unsigned long)signal, 0, 0, 0, 0);
}

static void setup_exit_signal(void)
{
	signal(SIGUSR1, SIG_IGN);
	signal(SIGUSR2, SIG_IGN);
	untold = clone_with(NO_SIGNAL);
	if (untold < 0 && errno == EINVAL) /* since Linux 7 */
		untold = clone_with(0);
	if (!untold)
		_exit(4);
	must(untold > 0, "clone");
	wait_ended(untold);
	dead = clone_with(SIGUSR2);
	if (!dead)
		_exit(3);
	must(dead > 0, "clone");
	wait_ended(dead);
	kid = clone_with(SIGUSR1);
	must(kid >= 0, "clone");
	if (!kid)
		rest();
}

/* A plain wait(2) is for those with SIGCHLD. */
static void look_at_exit_signal(char *to, size_t size)
{
	siginfo_t info = { 0 };
	const int plain = waitid(P_PID, (id_t)kid, &info, WEXITED | WNOWAIT | WNOHANG),
		  of_clones = waitid(P_PID, (id_t)kid, &info,
				     WEXITED | WNOWAIT | WNOHANG | __WCLONE);

	memset(&info, 0, sizeof(info));
	snprintf(to, size, "child: wait %d, for clones %d; the dead one: wait %d,", plain,
		 of_clones, waitid(P_PID, (id_t)dead, &info, WEXITED | WNOWAIT | WNOHANG));
	waitid(P_PID, (id_t)dead, &info, WEXITED | WNOWAIT | WNOHANG | __WCLONE);
	snprintf(to + strlen(to), size - strlen(to), " status %d", info.si_status);
	waitid(P_PID, (id_t)untold, &info, WEXITED | WNOWAIT | WNOHANG | __WCLONE);
	snprintf(to + strlen(to), size - strlen(to), ", of the other %d", info.si_status);
}

/* ---- zombie-group ------------------------------------------------------------------------- */

static void setup_zombie_group(void)
{
	int gate[2];
	char byte;

	must(!pipe(gate), "pipe");
	dead = fork();
	if (!dead)
		_exit(read(gate[0], &byte, 1) == 1 ? 3 : 4);
	must(!setpgid(dead, dead), "setpgid");
	kid = fork();
	if (!kid)
		rest();
	must(!setpgid(kid, dead), "setpgid");
	must(write(gate[1], "", 1) == 1, "write");
	wait_ended(dead);
	close(gate[0]);
	close(gate[1]);
}

static void look_at_zombie_group(char *to, size_t size)
{
	snprintf(to, size, "group of the dead one %d, of the other one %d", getpgid(dead),
		 getpgid(kid));
}

/* It has what it is to have, and stops itself to tell. */
static void await_kid(void)
{
	must(waitpid(kid, NULL, WUNTRACED) == kid, "waitpid");
	must(!kill(kid, SIGCONT), "kill");
}

/* ---- vdso --------------------------------------------------------------------------------- */

static void setup_vdso(void)
{
	kid = fork();
	if (!kid) {
		(void)victim_vdso(getpid(), true);
		kill(getpid(), SIGSTOP);
		rest();
	}
	await_kid();
}

static void look_at_vdso(char *to, size_t size)
{
	snprintf(to, size, "%d of the kernel's mappings, its child %d",
		 victim_vdso(getpid(), false), victim_vdso(kid, false));
}

/* ---- proc --------------------------------------------------------------------------------- */

static struct {
	int maps, again, status, kids, folder;
} open_files;

static int open_proc(const char *name, pid_t pid)
{
	char path[48];
	int fd;

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	fd = open(path, O_RDONLY | O_CLOEXEC);
	must(fd >= 0, path);
	return fd;
}

static void setup_proc(void)
{
	char some[100];

	kid = fork();
	if (!kid)
		rest();
	open_files.maps = open_proc("maps", getpid());
	must(read(open_files.maps, some, sizeof some) == sizeof some, "read");
	open_files.again = dup(open_files.maps);
	open_files.status = open_proc("status", getpid());
	open_files.kids = open_proc("status", kid);
	open_files.folder = open_proc("", getpid());
}

static void first_line(int fd, char *line)
{
	const ssize_t bytes = pread(fd, line, 31, 0);

	line[bytes < 0 ? 0 : bytes] = 0;
	line[strcspn(line, "\n")] = 0;
}

/* Where the position is, and that the rest of it can be read from there. */
static void look_at_proc(char *to, size_t size)
{
	char own[32], child[32], byte[32];
	struct stat st;

	first_line(open_files.status, own);
	first_line(open_files.kids, child);
	snprintf(to, size,
		 "at %ld and %ld, %zd bytes there, closes at exec: %d %d; %s, its child %s; %d",
		 (long)lseek(open_files.maps, 0, SEEK_CUR),
		 (long)lseek(open_files.again, 0, SEEK_CUR),
		 pread(open_files.again, byte, sizeof byte, 100), fcntl(open_files.maps, F_GETFD),
		 fcntl(open_files.again, F_GETFD), own, child,
		 fstatat(open_files.folder, "task", &st, 0));
}

/* ---- limits ------------------------------------------------------------------------------- */

/* Soft ones: to have more than a hard one takes a right (CAP_SYS_RESOURCE) that not every
 * guard has. */
static void set_limit(int which, rlim_t value)
{
	struct rlimit limit;

	must(!getrlimit(which, &limit), "getrlimit");
	limit.rlim_cur = value;
	must(!setrlimit(which, &limit), "setrlimit");
}

static void setup_limits(void)
{
	kid = fork();
	if (!kid) {
		void *much;

		set_limit(RLIMIT_NOFILE, 300);
		must(dup2(STDOUT_FILENO, 200) == 200, "dup2");
		much = mmap(NULL, MUCH, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
		must(much != MAP_FAILED, "mmap");
		set_limit(RLIMIT_NOFILE, 100);
		set_limit(RLIMIT_FSIZE, 1 << 30);
		raise(SIGSTOP);
		rest();
	}
	await_kid();
	set_limit(RLIMIT_NOFILE, 16);
	set_limit(RLIMIT_AS, MUCH / 2);
	set_limit(RLIMIT_FSIZE, 1 << 20);
}

static void look_at_limits(char *to, size_t size)
{
	static const int which[] = { RLIMIT_NOFILE, RLIMIT_AS, RLIMIT_FSIZE };
	char path[64];

	snprintf(path, sizeof(path), "/proc/%d/fd/200", kid);
	snprintf(to, size, "descriptor 200: %d", access(path, F_OK));
	for (size_t i = 0; i < sizeof(which) / sizeof(*which); i++) {
		struct rlimit own, its;

		must(!getrlimit(which[i], &own) && !prlimit(kid, which[i], NULL, &its), "prlimit");
		snprintf(to + strlen(to), size - strlen(to), "; %d: %lu %lu, mine %lu %lu",
			 which[i], its.rlim_cur, its.rlim_max, own.rlim_cur, own.rlim_max);
	}
}

/* ---- hard-limits -------------------------------------------------------------------------- */

static const int lowered[] = { RLIMIT_NOFILE, RLIMIT_FSIZE };
static bool may_raise;

static void set_hard_limit(int which, rlim_t value)
{
	const struct rlimit limit = { value, value };

	must(!setrlimit(which, &limit), "setrlimit");
}

static bool give_up_raising(void)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	struct __user_cap_data_struct data[2];
	bool had;

	must(!syscall(SYS_capget, &header, data), "capget");
	had = data[0].permitted >> CAP_SYS_RESOURCE & 1;
	data[0].permitted &= ~(1u << CAP_SYS_RESOURCE);
	data[0].effective &= data[0].permitted;
	must(!syscall(SYS_capset, &header, data), "capset");
	return had;
}

static void setup_hard_limits(void)
{
	may_raise = give_up_raising();
	kid = fork();
	if (!kid) {
		set_limit(RLIMIT_NOFILE, 100);
		set_limit(RLIMIT_FSIZE, 1 << 20);
		raise(SIGSTOP);
		rest();
	}
	await_kid();
	set_hard_limit(RLIMIT_NOFILE, 256);
	set_hard_limit(RLIMIT_FSIZE, 1 << 30);
}

/* Hard ones as far as the guard may raise them, which has no more rights than this had. */
static void look_at_hard_limits(char *to, size_t size)
{
	*to = 0;
	for (size_t i = 0; i < sizeof(lowered) / sizeof(*lowered); i++) {
		struct rlimit its;

		must(!prlimit(kid, lowered[i], NULL, &its), "prlimit");
		snprintf(to + strlen(to), size - strlen(to), "%d: %lu %lu; ", lowered[i],
			 its.rlim_cur, may_raise ? its.rlim_max : 0);
	}
}

/* ---- barriers ------------------------------------------------------------------------------ */

static void setup_barriers(void)
{
	must(!syscall(SYS_membarrier, MEMBARRIER_CMD_REGISTER_PRIVATE_EXPEDITED, 0, 0),
	     "membarrier");
	must(!syscall(SYS_membarrier, MEMBARRIER_CMD_REGISTER_GLOBAL_EXPEDITED, 0, 0),
	     "membarrier");
}

static void look_at_barriers(char *to, size_t size)
{
	snprintf(to, size, "barrier %ld, registered %ld",
		 syscall(SYS_membarrier, MEMBARRIER_CMD_PRIVATE_EXPEDITED, 0, 0),
		 syscall(SYS_membarrier, 1 << 9, 0, 0));
}

/* ---- personality ----------------------------------------------------------------------------- */

static uint64_t started_ns;

static void setup_personality(void)
{
	started_ns = now_ns();
}

static void look_at_personality(char *to, size_t size)
{
	static bool changed;

	if (!changed && now_ns() - started_ns > 200000000) {
		changed = true;
		must(personality(ADDR_NO_RANDOMIZE) >= 0, "personality");
		count(0, 1);
	}
	snprintf(to, size, "%s",
		 (personality(0xffffffff) == ADDR_NO_RANDOMIZE) == changed ? "right" : "wrong");
}

/* ---- setup, disarmed, rearmed ------------------------------------------------------------- */

/* What a thread finds of itself. */
static void tell(void)
{
	must(!sigaltstack(NULL, &thread_stack), "sigaltstack");
	must(!prctl(PR_GET_NAME, thread_name), "PR_GET_NAME");
	ready++;
}

static void *set_up_late(void *arg)
{
	const stack_t own = { .ss_sp = stack, .ss_size = STACK_BYTES };

	while (!__atomic_load_n(&board->counter[1], __ATOMIC_ACQUIRE))
		nap_us(1000);
	must(!sigaltstack(&own, NULL), "sigaltstack");
	must(!prctl(PR_SET_NAME, "late"), "PR_SET_NAME");
	count(0, 1);
	for (;; nap_us(1000))
		tell();
	return arg;
}

static void stay(int signal)
{
	(void)signal;
	count(0, 1);
	for (;; nap_us(1000))
		tell();
}

/* A handler, too; what is told of is the thread outside of it. */
static void leave(int signal)
{
	(void)signal;
	count(0, 1);
	while (__atomic_load_n(&board->counter[1], __ATOMIC_ACQUIRE) < 2)
		nap_us(1000);
}

static void *disarm(void *arg)
{
	const stack_t own = { .ss_sp = stack,
			      .ss_flags = (int)SS_AUTODISARM_,
			      .ss_size = STACK_BYTES };

	must(!sigaltstack(&own, NULL), "sigaltstack");
	while (!__atomic_load_n(&board->counter[1], __ATOMIC_ACQUIRE))
		nap_us(1000);
	raise(SIGUSR2);
	count(0, 1);
	for (;; nap_us(1000))
		tell();
	return arg;
}

static void start(void *(*work)(void *), void (*handler)(int))
{
	const struct sigaction action = { .sa_handler = handler, .sa_flags = SA_ONSTACK };
	pthread_t thread;

	sigaction(SIGUSR2, &action, NULL);
	must(!pthread_create(&thread, NULL, work, NULL), "pthread_create");
}

static void setup_late(void)
{
	start(set_up_late, stay);
}

static void setup_disarmed(void)
{
	start(disarm, stay);
}

static void setup_rearmed(void)
{
	start(disarm, leave);
}

/* Nothing, before counter 1 of the board lets the thread go on. */
static void look_at_thread(char *to, size_t size)
{
	static bool seen;
	const int before = ready;

	if (!seen && !ready) {
		snprintf(to, size, "nothing");
		return;
	}
	for (int i = 0; i < 5000 && ready < before + 2; i++)
		nap_us(1000);
	snprintf(to, size, "flags %x of %zu bytes, name %s", (unsigned int)thread_stack.ss_flags,
		 thread_stack.ss_size, thread_name);
	if (!seen)
		strcpy(was, to);
	seen = true;
}

/* ---- users --------------------------------------------------------------------------------- */

static struct {
	volatile uint64_t looks, found;
} user[USERS];
static uint64_t changes;

/* Group and user, as the kernel knows them of this thread. */
static uint64_t who_i_am(void)
{
	gid_t group = 0;

	must(syscall(SYS_getgroups, 1, &group) == 1, "getgroups");
	return (uint64_t)group << 32 | (uint64_t)syscall(SYS_geteuid);
}

static void *be_user(void *arg)
{
	const size_t i = (size_t)arg;

	/* A nap that the change cuts short (nptl(7)). */
	for (;; usleep(1000)) {
		user[i].found = who_i_am();
		user[i].looks++;
	}
	return NULL;
}

/* The user last, who may not change the groups. */
static void change_users(void)
{
	const gid_t group = (gid_t)(3000 + changes);

	must(!seteuid(0) && !setgroups(1, &group) && !seteuid(1000), "setgroups");
}

static void setup_users(void)
{
	pthread_t thread;

	change_users();
	for (size_t i = 0; i < USERS; i++)
		must(!pthread_create(&thread, NULL, be_user, (void *)i), "pthread_create");
}

static void look_at_users(char *to, size_t size)
{
	const uint64_t asked = __atomic_load_n(&board->counter[1], __ATOMIC_ACQUIRE);

	if (asked > changes) {
		changes = asked;
		change_users();
		__atomic_store_n(&board->counter[0], asked, __ATOMIC_RELEASE);
	}
	snprintf(to, size, "all are alike");
	for (size_t i = 0; i < USERS; i++) {
		const uint64_t before = user[i].looks;

		while (user[i].looks < before + 2)
			nap_us(1000);
		if (user[i].found != who_i_am())
			snprintf(to, size, "thread %zu is %lx, the main thread %lx", i,
				 user[i].found, who_i_am());
	}
}

static void add_credentials(pid_t pid, char *to, size_t size)
{
	char name[32], line[256];
	FILE *status;

	snprintf(name, sizeof name, "/proc/%d/status", pid);
	status = fopen(name, "re");
	must(status != NULL, "fopen");
	while (fgets(line, sizeof line, status))
		if (!strncmp(line, "Uid", 3) || !strncmp(line, "Gid", 3) ||
		    !strncmp(line, "Groups", 6) || !strncmp(line, "Cap", 3))
			strncat(to, line, size - strlen(to) - 1);
	fclose(status);
}

static void setup_retired(void)
{
	const gid_t group = 4711;

	kid = fork();
	must(kid >= 0, "fork");
	if (!kid) {
		must(!setgroups(1, &group) && !setresgid(1001, 1001, 1001) &&
			     !setresuid(1001, 1001, 1001),
		     "setresuid");
		kill(getpid(), SIGSTOP);
		rest();
	}
	must(waitpid(kid, NULL, WUNTRACED) == kid && !kill(kid, SIGCONT), "waitpid");
	must(!seteuid(1000), "seteuid");
}

static void look_at_retired(char *to, size_t size)
{
	*to = 0;
	add_credentials(getpid(), to, size);
	add_credentials(kid, to, size);
}

/* ---- all of them ---------------------------------------------------------------------------- */

static const struct {
	const char *name;
	void (*setup)(void);
	void (*look)(char *to, size_t size);
} kinds[] = {
	{ "exit-signal", setup_exit_signal, look_at_exit_signal },
	{ "zombie-group", setup_zombie_group, look_at_zombie_group },
	{ "vdso", setup_vdso, look_at_vdso },
	{ "proc", setup_proc, look_at_proc },
	{ "limits", setup_limits, look_at_limits },
	{ "hard-limits", setup_hard_limits, look_at_hard_limits },
	{ "barriers", setup_barriers, look_at_barriers },
	{ "personality", setup_personality, look_at_personality },
	{ "setup", setup_late, look_at_thread },
	{ "disarmed", setup_disarmed, look_at_thread },
	{ "rearmed", setup_rearmed, look_at_thread },
	{ "users", setup_users, look_at_users },
	{ "retired", setup_retired, look_at_retired },
};

int main(int argc, char **argv)
{
	void (*look)(char *to, size_t size) = NULL;

	victim_start(&argc, argv, 1, "KIND");
	for (size_t i = 0; i < sizeof(kinds) / sizeof(*kinds); i++)
		if (!strcmp(argv[1], kinds[i].name)) {
			look = kinds[i].look;
			kinds[i].setup();
		}
	must(look != NULL, "no such kind");
	look(was, sizeof(was));
	victim_ready();
	for (;; nap_us(2000)) {
		look(is, sizeof(is));
		CHECK(!strcmp(was, is), "was \"%s\", is \"%s\"", was, is);
		beat();
	}
}
