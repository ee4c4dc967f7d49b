/* SPDX-License-Identifier: Apache-2.0
 *
 * attributes [--inherited]: threads that differ from each other in all that the kernel
 * knows of a thread, in a process that has changed what a process can change.  Each
 * looks at itself all the time: nothing may ever be other than it was.
 *
 * Needs root.  With --inherited only the process is changed, and all threads are alike.
 */
#include <linux/capability.h>
#include <linux/mempolicy.h>
#include <linux/securebits.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <sys/personality.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/stat.h>

#include "victim.h"

enum { TEXT = 16384, NICE = 7, ROUND_ROBIN = 3 };

struct look {
	char text[TEXT];
	size_t used;
};

__attribute__((format(printf, 2, 3))) static void add(struct look *look, const char *format, ...)
{
	va_list args;

	va_start(args, format);
	look->used += (size_t)vsnprintf(look->text + look->used, TEXT - look->used, format, args);
	va_end(args);
	must(look->used < TEXT, "room");
}

/* A file of /proc; of status only what does not change by itself. */
static void add_file(struct look *look, const char *name, bool status)
{
	static const char *const lines[] = {
		"Name:", "Umask:",      "Uid:",    "Gid:",          "Groups:",
		"Cap",   "NoNewPrivs:", "Seccomp", "Cpus_allowed:", "THP_enabled:"
	};
	char buf[8192], *line, *save = NULL;
	ssize_t n = -1;
	size_t i;
	int tries;

	/* An open file of /proc/self is of the process that opened it: of one that died,
	 * if that was before a restore.  Then once more. */
	for (tries = 0; n <= 0 && tries < 5; tries++) {
		int fd = open(name, O_RDONLY | O_CLOEXEC);

		CHECK(fd >= 0, "%s: %s", name, strerror(errno));
		n = read(fd, buf, sizeof(buf) - 1);
		close(fd);
	}
	CHECK(n > 0, "%s cannot be read: %s", name, strerror(errno));
	buf[n] = 0;
	for (line = strtok_r(buf, "\n", &save); line; line = strtok_r(NULL, "\n", &save)) {
		bool wanted = !status;

		for (i = 0; status && i < sizeof(lines) / sizeof(*lines); i++)
			wanted = wanted || !strncmp(line, lines[i], strlen(lines[i]));
		if (wanted)
			add(look, "%s\n", line);
	}
}

static void add_prctl(struct look *look, const char *name, int option)
{
	add(look, "%s %d\n", name, prctl(option, 0, 0, 0, 0));
}

static void add_caps(struct look *look, const char *name, int option, int second)
{
	unsigned long set = 0;
	int i;

	for (i = 0; i < 64; i++)
		if (prctl(option, second >= 0 ? second : i, second >= 0 ? i : 0, 0, 0) == 1)
			set |= 1ul << i;
	add(look, "%s %lx\n", name, set);
}

static void add_prctl_to(struct look *look, const char *name, int option)
{
	int value = 0;

	add(look, "%s %d", name, prctl(option, &value, 0, 0, 0));
	add(look, " %d\n", value);
}

static void look_at_me(struct look *look)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	uint32_t attr[12] = { 0 }, caps[6], id[3], groups[8];
	unsigned long nodes[16];
	char path[1024];
	int i;

	look->used = 0;
	must(!syscall(SYS_capget, &header, caps), "capget");
	for (i = 0; i < 6; i++)
		add(look, "caps %d: %x\n", i, caps[i]);
	add_caps(look, "bounding", PR_CAPBSET_READ, -1);
	add_caps(look, "ambient", PR_CAP_AMBIENT, PR_CAP_AMBIENT_IS_SET);
	must(!syscall(SYS_getresuid, &id[0], &id[1], &id[2]), "getresuid");
	add(look, "uid %u %u %u\n", id[0], id[1], id[2]);
	must(!syscall(SYS_getresgid, &id[0], &id[1], &id[2]), "getresgid");
	add(look, "gid %u %u %u\n", id[0], id[1], id[2]);
	add_prctl(look, "no new privileges", PR_GET_NO_NEW_PRIVS);
	add_prctl(look, "seccomp", PR_GET_SECCOMP);
	must(!syscall(SYS_sched_getattr, 0, attr, sizeof(attr), 0), "sched_getattr");
	for (i = 0; i < 12; i++)
		add(look, "sched %d: %u\n", i, attr[i]);
	i = (int)syscall(SYS_getgroups, 8, groups);
	add(look, "groups %d: %u %u\n", i, i > 0 ? groups[0] : 0, i > 1 ? groups[1] : 0);
	if (!syscall(SYS_get_mempolicy, &i, nodes, 64 * 16, 0, 0))
		add(look, "memory policy %d of %lx\n", i, nodes[0]);
	add(look, "ioprio %ld\n", syscall(SYS_ioprio_get, 1, 0));
	add(look, "fsuid %ld fsgid %ld\n", syscall(SYS_setfsuid, -1), syscall(SYS_setfsgid, -1));
	add_prctl(look, "slack", PR_GET_TIMERSLACK);
	add_prctl(look, "securebits", PR_GET_SECUREBITS);
	add_prctl(look, "thp", PR_GET_THP_DISABLE);
	add_prctl(look, "mce", PR_MCE_KILL_GET);
	add_prctl_to(look, "pdeathsig", PR_GET_PDEATHSIG);
	add_prctl_to(look, "subreaper", PR_GET_CHILD_SUBREAPER);
	add(look, "personality %x\n", (unsigned int)personality(0xffffffff));
	add(look, "cwd %s\n", getcwd(path, sizeof(path)));
	add(look, "session %d group %d\n", getsid(0), getpgrp());
	for (i = 0; i < RLIM_NLIMITS; i++) {
		struct rlimit limit;

		must(!getrlimit(i, &limit), "getrlimit");
		add(look, "limit %d: %lu %lu\n", i, limit.rlim_cur, limit.rlim_max);
	}
	/* One thread only: others might get their hands on its descriptors. */
	if (syscall(SYS_gettid) != getpid())
		return;
	/* Whoever changes its user changes that of all. */
	add_prctl(look, "dumpable", PR_GET_DUMPABLE);
	add_file(look, "/proc/self/status", true);
	add_file(look, "/proc/self/oom_score_adj", false);
	add_file(look, "/proc/self/coredump_filter", false);
}

static void compare(const struct look *was, const struct look *is)
{
	const char *a = was->text, *b = is->text;

	while (*a && *b) {
		const size_t n = strcspn(a, "\n"), m = strcspn(b, "\n");

		CHECK(n == m && !memcmp(a, b, n), "was \"%.*s\", is \"%.*s\"", (int)n, a, (int)m,
		      b);
		a += n + (a[n] == '\n');
		b += m + (b[m] == '\n');
	}
	CHECK(*a == *b, "there is more or less of it");
}

static void set_nice(void)
{
	must(!setpriority(PRIO_PROCESS, 0, NICE), "setpriority");
}

static void set_round_robin(void)
{
	const struct sched_param param = { .sched_priority = ROUND_ROBIN };

	if (sched_setscheduler(0, SCHED_RR | SCHED_RESET_ON_FORK, &param))
		must(!sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){ 0 }),
		     "sched_setscheduler");
}

static void set_batch(void)
{
	must(!sched_setscheduler(0, SCHED_BATCH, &(struct sched_param){ 0 }), "sched_setscheduler");
	must(!setpriority(PRIO_PROCESS, 0, -5), "setpriority");
}

static void set_io_priority(void)
{
	must(!syscall(SYS_ioprio_set, 1, 0, 2 << 13 | 6), "ioprio_set");
}

static void set_slack(void)
{
	must(!prctl(PR_SET_TIMERSLACK, 1234567), "PR_SET_TIMERSLACK");
}

static void set_user(void)
{
	must(!syscall(SYS_setresgid, 1001, 1002, 1003), "setresgid");
	must(!syscall(SYS_setresuid, 1001, 1002, 1003), "setresuid");
}

static void set_death_signal(void)
{
	must(!prctl(PR_SET_PDEATHSIG, SIGUSR1), "PR_SET_PDEATHSIG");
}

/* The signal last: a change of users takes it away. */
static void set_user_with_signal(void)
{
	set_user();
	set_death_signal();
}

static void set_bounds(void)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	struct __user_cap_data_struct data[2];

	must(!syscall(SYS_capget, &header, data), "capget");
	data[0].inheritable |= 1u << CAP_KILL | 1u << CAP_CHOWN;
	must(!syscall(SYS_capset, &header, data), "capset");
	must(!prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, CAP_KILL, 0, 0), "PR_CAP_AMBIENT");
	must(!prctl(PR_CAPBSET_DROP, CAP_KILL, 0, 0, 0), "PR_CAPBSET_DROP");
	must(!prctl(PR_CAPBSET_DROP, CAP_SYS_TIME, 0, 0, 0), "PR_CAPBSET_DROP");
	must(!prctl(PR_SET_SECUREBITS,
		    SECBIT_NOROOT | SECBIT_NOROOT_LOCKED | SECBIT_NO_CAP_AMBIENT_RAISE, 0, 0, 0),
	     "PR_SET_SECUREBITS");
}

static void set_bounds_and_user(void)
{
	set_bounds();
	must(!prctl(PR_SET_KEEPCAPS, 1), "PR_SET_KEEPCAPS");
	set_user();
}

static void set_personality(void)
{
	must(personality(ADDR_NO_RANDOMIZE | STICKY_TIMEOUTS) >= 0, "personality");
}

static void set_user_with_caps(void)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	struct __user_cap_data_struct data[2] = { { 0 } };

	must(!prctl(PR_SET_KEEPCAPS, 1), "PR_SET_KEEPCAPS");
	must(!syscall(SYS_setresuid, 1001, 1001, 0), "setresuid");
	data[0].permitted = 1u << CAP_NET_BIND_SERVICE | 1u << CAP_KILL;
	data[0].effective = 1u << CAP_KILL;
	must(!syscall(SYS_capset, &header, data), "capset");
}

static void set_fs_user(void)
{
	syscall(SYS_setfsuid, 1234);
	syscall(SYS_setfsgid, 1235);
}

static void set_no_new_privs(void)
{
	must(!prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "PR_SET_NO_NEW_PRIVS");
}

static void set_groups(void)
{
	const gid_t groups[] = { 2001, 2002 };

	must(!syscall(SYS_setgroups, 2, groups), "setgroups");
}

static void set_memory_policy(void)
{
	const unsigned long node = 1;

	if (syscall(SYS_set_mempolicy, MPOL_BIND, &node, 64))
		must(errno == ENOSYS, "set_mempolicy");
}

static void set_nothing(void)
{
}

static void (*const kinds[])(void) = {
	set_nice,
	set_round_robin,
	set_batch,
	set_io_priority,
	set_slack,
	set_user,
	set_user_with_signal,
	set_fs_user,
	set_no_new_privs,
	set_death_signal,
	set_user_with_caps,
	set_bounds,
	set_bounds_and_user,
	set_personality,
	set_groups,
	set_memory_policy,
	set_nothing,
};

static void *work(void *arg)
{
	struct look *was = malloc(sizeof(*was)), *is = malloc(sizeof(*is));

	must(was && is, "malloc");
	kinds[(size_t)arg]();
	look_at_me(was);
	count(1, 1);
	for (;;) {
		nap_us(2000);
		look_at_me(is);
		compare(was, is);
		count(0, 1);
	}
	return NULL;
}

static void write_file(const char *name, const char *text)
{
	int fd = open(name, O_WRONLY | O_CLOEXEC);

	must(fd >= 0 && write(fd, text, strlen(text)) > 0, name);
	close(fd);
}

static void change_process(void)
{
	const struct rlimit cores = { 0, 4096 }, files = { 200, 300 };

	umask(0137);
	must(!chdir("/usr/share"), "chdir");
	must(!setrlimit(RLIMIT_CORE, &cores) && !setrlimit(RLIMIT_NOFILE, &files), "setrlimit");
	write_file("/proc/self/oom_score_adj", "321");
	write_file("/proc/self/coredump_filter", "0x17");
	must(personality(ADDR_NO_RANDOMIZE) >= 0, "personality");
	must(!prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0), "PR_SET_CHILD_SUBREAPER");
	must(!prctl(PR_SET_PDEATHSIG, SIGUSR2), "PR_SET_PDEATHSIG");
	must(!prctl(PR_SET_THP_DISABLE, 1, 0, 0, 0), "PR_SET_THP_DISABLE");
	must(!prctl(PR_SET_TIMERSLACK, 77777), "PR_SET_TIMERSLACK");
	must(!prctl(PR_SET_DUMPABLE, 0), "PR_SET_DUMPABLE");
}

int main(int argc, char **argv)
{
	const bool inherited = victim_flag(&argc, argv, "--inherited");
	const size_t n = inherited ? 1 : sizeof(kinds) / sizeof(*kinds);
	struct look *was = malloc(sizeof(*was)), *is = malloc(sizeof(*is));
	size_t i;

	victim_start(&argc, argv, 0, "[--inherited]");
	signal(SIGUSR1, SIG_IGN);
	signal(SIGUSR2, SIG_IGN);
	board->counter[1] = 0;
	change_process();
	for (i = 0; i < n; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, work,
				     (void *)(inherited ? sizeof(kinds) / sizeof(*kinds) - 1 : i)),
		     "pthread_create");
	}
	while (__atomic_load_n(&board->counter[1], __ATOMIC_RELAXED) < n)
		nap_us(1000);
	if (!inherited)
		must(!prctl(PR_SET_DUMPABLE, 1), "PR_SET_DUMPABLE");
	look_at_me(was);
	victim_ready();
	for (;;) {
		nap_us(2000);
		look_at_me(is);
		compare(was, is);
		beat();
	}
}
