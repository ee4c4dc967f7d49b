/* SPDX-License-Identifier: Apache-2.0
 *
 * cells [--forge program|call|other PATH]: children under seccomp filters that the main process has
 * not, and that see that these hold:
 *
 *   apart     two threads, with a filter that both have, and another one each, which forbids
 *             seccomp(2)
 *   together  two threads that share theirs, with memory that is not for forks; when counter 1
 *             is 1, one installs another for both (SECCOMP_FILTER_FLAG_TSYNC), and says in counter
 *             2 that it could: 1, or not: 2
 *   below     one filter, and its own child under two: the first one inherited
 *
 * With --forge there is only one, and when counter 1 is 1 it changes what the parasite keeps of its
 * filter, to be without it after a restore: the program, the call that installs it, or that call
 * into another one, which makes a folder at PATH.  Counter 3: how often it has.  Counter 4: of the
 * five that come under filters, how many have.
 */
#include <pthread.h>

#include "confine.h"
#include "parasite_place.h"

#define MARK 0x5ec0de
#define COUNT(array) (sizeof(array) / sizeof *(array))

enum { NONE, PROGRAM, CALL, OTHER };
static int forges;
static const char *path;
static volatile bool first_is_there, done;

/* Little more than sleeping; `error` for everything else. */
static void confine(bool more_filters, unsigned int flags)
{
	struct sock_filter filter[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_IMM, MARK),
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		ALLOW(SYS_clock_nanosleep),
		ALLOW(SYS_restart_syscall),
		ALLOW(SYS_clock_gettime),
		ALLOW_HOMEWARD,
		ALLOW(SYS_write),
		ALLOW(SYS_gettid),
		ALLOW(SYS_exit_group),
		ALLOW(more_filters ? SYS_seccomp : SYS_write),
		ALLOW(more_filters ? SYS_prctl : SYS_write),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM),
	};

	install_filter(filter, COUNT(filter), flags);
}

static void forbid(long nr, int error)
{
	struct sock_filter filter[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (unsigned int)nr, 0, 1),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | (unsigned int)error),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_seccomp, 0, 1),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EACCES),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
	};

	install_filter(filter, COUNT(filter), 0);
}

static void check(long nr, int error)
{
	CHECK(syscall(nr, 0, 0, 0) < 0 && errno == error, "a filter is gone (call %ld)", nr);
}

static void start(void *(*run)(void *))
{
	pthread_t thread;

	must(!pthread_create(&thread, NULL, run, NULL), "pthread_create");
	while (!done)
		usleep(1000);
}

static void *apart(void *arg)
{
	(void)arg;
	done = true;
	while (!first_is_there)
		usleep(1000);
	forbid(SYS_getpgid, EXDEV);
	count(4, 1);
	for (;;) {
		check(SYS_getppid, EPERM);
		check(SYS_getpgid, EXDEV); /* the newest filter's */
		check(SYS_seccomp, EACCES);
		CHECK(syscall(SYS_gettid) > 0, "this is the other thread's filter");
		nap_us(2000);
	}
	return NULL;
}

static void be_apart(void)
{
	start(apart);
	confine(true, SECCOMP_FILTER_FLAG_TSYNC);
	forbid(SYS_gettid, EDOM);
	count(4, 1);
	first_is_there = true;
	for (;;) {
		check(SYS_getppid, EPERM);
		check(SYS_gettid, EDOM);
		check(SYS_seccomp, EACCES);
		nap_us(2000);
	}
}

static void *together(void *arg)
{
	(void)arg;
	done = true;
	for (;;) {
		if (first_is_there)
			check(SYS_getppid, EPERM);
		nap_us(2000);
	}
	return NULL;
}

static void be_together(void)
{
	struct sock_filter all[] = { BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW) };
	struct sock_fprog program = { 1, all };

	/* For a clone the process has to change that, and change it back. */
	must(!madvise(mmap(NULL, 4096, PROT_READ, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0), 4096,
		      MADV_DONTFORK),
	     "MADV_DONTFORK");
	start(together);
	confine(true, SECCOMP_FILTER_FLAG_TSYNC);
	first_is_there = true;
	count(4, 1);
	for (;;) {
		check(SYS_getppid, EPERM);
		if (board->counter[1] == 1 && !board->counter[2])
			count(2, syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER,
					 SECCOMP_FILTER_FLAG_TSYNC, &program)
					 ? 2
					 : 1);
		nap_us(2000);
	}
}

static void be_below(void)
{
	struct sock_filter all[] = { BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW) };
	const pid_t parent = getpid();

	install_filter(all, 1, SECCOMP_FILTER_FLAG_LOG);
	count(4, 1);
	if (fork() == 0) {
		confine(false, 0);
		count(4, 1);
		for (;;) {
			check(SYS_getppid, EPERM);
			nap_us(2000);
		}
	}
	for (;;) {
		CHECK(getpid() == parent, "another process");
		nap_us(2000);
	}
}

static void forge_all(void)
{
	const struct place parasite = find_parasite();
	const uint64_t start = parasite.start + INJ_CODE_BYTES;
	const struct sock_filter let = BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW);
	const uint64_t end = parasite.start + parasite.bytes - sizeof(struct inj_setup);
	bool forged = false;

	for (uint64_t at = start; at < end; at += 8) {
		struct sock_filter *f = (struct sock_filter *)at;
		struct inj_setup *s = (struct inj_setup *)at;

		if (forges == PROGRAM && f->code == (BPF_LD | BPF_W | BPF_IMM) && f->k == MARK) {
			f[1] = let;
			forged = true;
		}
		if (forges > PROGRAM && s->call.nr == SYS_seccomp && !strcmp(s->name, "seccomp")) {
			s->call.nr = forges == CALL ? SYS_getpid : SYS_mkdirat;
			s->call.arg[0] = (uint64_t)AT_FDCWD;
			s->call.arg[1] = (uint64_t)path;
			s->call.arg[2] = 0700;
			forged = true;
		}
	}
	count(3, forged);
}

static void be_forger(void)
{
	struct sock_filter filter[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_IMM, MARK),
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_getppid, 1, 0),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_mkdirat, 0, 1),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
	};

	install_filter(filter, COUNT(filter), 0);
	for (;;) {
		check(SYS_getppid, EPERM);
		if (board->counter[1])
			forge_all();
		nap_us(1000);
	}
}

static void begin(void (*cell)(void))
{
	const pid_t pid = fork();

	must(pid >= 0, "fork");
	if (pid)
		return;
	cell();
	_exit(1);
}

int main(int argc, char **argv)
{
	static const char *const what[] = { "", "program", "call", "other" };
	int status = 0;

	const bool forge = victim_flag(&argc, argv, "--forge");

	victim_start(&argc, argv, forge ? 2 : 0, "[--forge program|call|other PATH]");
	for (int k = PROGRAM; forge && k <= OTHER; k++)
		forges = !strcmp(argv[1], what[k]) ? k : forges;
	must(!forge || forges, "--forge");
	path = argv[argc - 1];
	if (forges) {
		begin(be_forger);
	} else {
		begin(be_apart);
		begin(be_together);
		begin(be_below);
	}
	victim_ready();
	for (;;) {
		CHECK(waitpid(-1, &status, WNOHANG) == 0, "a child has ended (%x)", status);
		nap_us(1000);
		count(0, 1);
		beat();
	}
}
