/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt-exec: runs one command in a container, as the container's own
 * processes run, for a limited time.
 *
 *   avckpt-exec PIDFD PID TIMEOUT_MS ERROR_FD ENV_FD CREDENTIALS NGROUPS GROUP...
 *                 NCGROUPS FILE... COMMAND [ARG...]
 *
 * PIDFD and PID name a process of the container (avckpt-init) whose namespaces, working directory,
 * resource limits and seccomp filters the command gets. CREDENTIALS is
 * UID:GID:INH:PRM:EFF:BND:AMB:NNP, the capability sets in hex. ENV_FD holds the environment,
 * NUL-terminated strings. Each FILE is a cgroup.procs. For the sidecar only, which starts it from a
 * sealed memfd: processes of a container must not be able to write to our program through
 * /proc/PID/exe.
 *
 * Exits with the command's status, 128+N if signal N killed it. An error is a line on ERROR_FD;
 * "timeout" there means that the command, with its process group, was killed at the timeout.
 */
#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <linux/capability.h>
#include <linux/close_range.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <sched.h>
#include <signal.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "program.h"

#define FILTERS_MAX 32
#define CGROUPS_MAX 32
#define GROUPS_MAX 256
#define EXIT_OURS 125
#define EXIT_CANNOT_RUN 126
#define EXIT_NOT_FOUND 127
#define ENVIRONMENT_MAX (4 << 20)

static int error_fd = 2;

static _Noreturn void give_up(const char *what)
{
	dprintf(error_fd, "%s: %s\n", what, strerror(errno));
	_exit(EXIT_OURS);
}

static void must(bool worked, const char *what)
{
	if (!worked)
		give_up(what);
}

static struct {
	int pidfd;
	pid_t pid;
	int64_t timeout_ms;
	uid_t uid;
	gid_t gid;
	unsigned long long inheritable, permitted, effective, bounding, ambient;
	bool no_new_privs;
	gid_t groups[GROUPS_MAX];
	size_t group_count;
	int cgroup_fds[CGROUPS_MAX];
	int cgroup_count;
	int cwd_fd;
	char **env;
	char **command;
	struct sock_fprog filters[FILTERS_MAX]; /* oldest first */
	int filter_count;
	struct rlimit limits[RLIM_NLIMITS];
} job;

/* ---- what it is to be like ------------------------------------------------------ */

static long number(const char *text, const char *what)
{
	char *end;
	long value = strtol(text, &end, 10);

	errno = EINVAL;
	must(end != text && !*end && value >= 0, what);
	return value;
}

static char **take(char **argv, const char *what)
{
	errno = EINVAL;
	must(*argv != NULL, what);
	return argv + 1;
}

/* NGROUPS GROUP...; returns what follows. */
static char **read_groups(char **argv)
{
	long count = number(*argv++, "NGROUPS");

	for (; count > 0; count--) {
		char **next = take(argv, "GROUP");

		errno = E2BIG;
		must(job.group_count < GROUPS_MAX, "GROUP");
		job.groups[job.group_count++] = (gid_t)number(*argv, "GROUP");
		argv = next;
	}
	return argv;
}

/* NCGROUPS FILE...; returns what follows. */
static char **read_cgroups(char **argv)
{
	char **next = take(argv, "NCGROUPS");
	long count = number(*argv, "NCGROUPS");

	for (argv = next; count > 0; count--) {
		next = take(argv, "FILE");
		errno = E2BIG;
		must(job.cgroup_count < CGROUPS_MAX, "FILE");
		job.cgroup_fds[job.cgroup_count] = open(*argv, O_WRONLY | O_CLOEXEC);
		must(job.cgroup_fds[job.cgroup_count++] >= 0, *argv);
		argv = next;
	}
	return argv;
}

/* The environment is for the command, not for us: it can hold variables that affect our own C
 * library. */
static void read_environment(int fd)
{
	struct stat st;
	char *text;
	size_t n = 0, i = 0;

	must(fstat(fd, &st) == 0, "ENV_FD");
	errno = E2BIG;
	must(st.st_size <= ENVIRONMENT_MAX, "ENV_FD");
	text = calloc(1, (size_t)st.st_size + 1);
	must(text != NULL, "calloc");
	must(pread(fd, text, (size_t)st.st_size, 0) == st.st_size, "ENV_FD");
	for (off_t at = 0; at < st.st_size; at++)
		n += text[at] == '\0';
	job.env = calloc(n + 2, sizeof *job.env);
	must(job.env != NULL, "calloc");
	for (char *at = text; at < text + st.st_size && i <= n; at += strlen(at) + 1)
		job.env[i++] = at;
}

static void read_arguments(char **argv)
{
	unsigned int nnp;

	for (int i = 0; i < 7; i++) {
		errno = EINVAL;
		must(argv[i] != NULL, "arguments");
	}
	job.pidfd = (int)number(argv[0], "PIDFD");
	job.pid = (pid_t)number(argv[1], "PID");
	job.timeout_ms = number(argv[2], "TIMEOUT_MS");
	error_fd = (int)number(argv[3], "ERROR_FD");
	read_environment((int)number(argv[4], "ENV_FD"));
	errno = EINVAL;
	must(sscanf(argv[5], "%u:%u:%llx:%llx:%llx:%llx:%llx:%u", &job.uid, &job.gid,
		    &job.inheritable, &job.permitted, &job.effective, &job.bounding, &job.ambient,
		    &nnp) == 8,
	     "CREDENTIALS");
	job.no_new_privs = nnp;
	argv = read_cgroups(read_groups(argv + 6));
	take(argv, "COMMAND");
	job.command = argv;
}

/* The filters of the container's main process. The kernel shows them only to a tracer, so it is
 * stopped briefly; our exit, however it comes about, releases it. */
static void read_filters(void)
{
	int status;

	must(ptrace(PTRACE_SEIZE, job.pid, NULL, NULL) == 0, "ptrace(SEIZE)");
	must(ptrace(PTRACE_INTERRUPT, job.pid, NULL, NULL) == 0, "ptrace(INTERRUPT)");
	must(waitpid(job.pid, &status, __WALL) == job.pid, "waitpid");
	errno = ESRCH;
	must(WIFSTOPPED(status), "waitpid");
	for (;;) {
		struct sock_fprog *filter = &job.filters[job.filter_count];
		long n = ptrace(PTRACE_SECCOMP_GET_FILTER, job.pid, job.filter_count, NULL);

		if (n < 0 && errno == ENOENT)
			break;
		must(n >= 0, "ptrace(SECCOMP_GET_FILTER)");
		errno = E2BIG;
		must(job.filter_count < FILTERS_MAX, "seccomp filters");
		filter->len = (unsigned short)n;
		filter->filter = calloc((size_t)n, sizeof *filter->filter);
		must(filter->filter != NULL, "calloc");
		must(ptrace(PTRACE_SECCOMP_GET_FILTER, job.pid, job.filter_count, filter->filter) ==
			     n,
		     "ptrace(SECCOMP_GET_FILTER)");
		job.filter_count++;
	}
	must(ptrace(PTRACE_DETACH, job.pid, NULL,
		    status >> 16 == PTRACE_EVENT_STOP ? 0 : (long)WSTOPSIG(status)) == 0,
	     "ptrace(DETACH)");
}

static bool has_filters(void)
{
	char path[64], line[256];
	int mode = 0;
	FILE *status;

	snprintf(path, sizeof path, "/proc/%d/status", job.pid);
	status = fopen(path, "re");
	must(status != NULL, path);
	while (fgets(line, sizeof line, status))
		if (sscanf(line, "Seccomp: %d", &mode) == 1)
			break;
	fclose(status);
	return mode == SECCOMP_MODE_FILTER;
}

static bool other_user_namespace(void)
{
	struct stat ours, its;
	char path[64];

	snprintf(path, sizeof path, "/proc/%d/ns/user", job.pid);
	must(stat("/proc/self/ns/user", &ours) == 0 && stat(path, &its) == 0, path);
	return ours.st_ino != its.st_ino;
}

static void read_model(void)
{
	char path[64];

	snprintf(path, sizeof path, "/proc/%d/cwd", job.pid);
	job.cwd_fd = open(path, O_PATH | O_DIRECTORY | O_CLOEXEC);
	must(job.cwd_fd >= 0, path);
	for (int i = 0; i < RLIM_NLIMITS; i++)
		if (prlimit(job.pid, (__rlimit_resource_t)i, NULL, &job.limits[i]))
			/* Another user's process needs CAP_SYS_RESOURCE. */
			must(getrlimit((__rlimit_resource_t)i, &job.limits[i]) == 0, "getrlimit");
	if (has_filters())
		read_filters();
}

/* Only our original user namespace may raise a hard limit; the command, in the container's, can
 * only lower it. */
static void raise_limits(void)
{
	for (int i = 0; i < RLIM_NLIMITS; i++) {
		struct rlimit own;

		must(getrlimit((__rlimit_resource_t)i, &own) == 0, "getrlimit");
		if (own.rlim_max >= job.limits[i].rlim_max)
			continue;
		own.rlim_max = job.limits[i].rlim_max;
		if (setrlimit((__rlimit_resource_t)i, &own))
			errno = 0; /* not permitted: ours stays */
	}
}

/* ---- the command ------------------------------------------------------------------ */

static void set_capabilities(unsigned long long inheritable, unsigned long long permitted,
			     unsigned long long effective)
{
	struct __user_cap_header_struct header = { .version = _LINUX_CAPABILITY_VERSION_3 };
	struct __user_cap_data_struct data[2] = {
		{ (uint32_t)effective, (uint32_t)permitted, (uint32_t)inheritable },
		{ (uint32_t)(effective >> 32), (uint32_t)(permitted >> 32),
		  (uint32_t)(inheritable >> 32) },
	};

	must(syscall(SYS_capset, &header, data) == 0, "capset");
}

static void install_filters(void)
{
	for (int i = 0; i < job.filter_count; i++)
		must(syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, 0, &job.filters[i]) == 0,
		     "seccomp");
}

static void drop_privileges(void)
{
	/* Needed to install a filter without no_new_privs. */
	const unsigned long long admin = UINT64_C(1) << CAP_SYS_ADMIN | UINT64_C(1) << CAP_SETUID |
					 UINT64_C(1) << CAP_SETGID;

	for (int cap = 0; cap < 64; cap++) {
		if (prctl(PR_CAPBSET_READ, cap, 0, 0, 0) < 0)
			break;
		if (!(job.bounding >> cap & 1))
			must(prctl(PR_CAPBSET_DROP, cap, 0, 0, 0) == 0, "prctl(CAPBSET_DROP)");
	}
	must(prctl(PR_SET_KEEPCAPS, 1, 0, 0, 0) == 0, "prctl(SET_KEEPCAPS)");
	must(setgroups(job.group_count, job.groups) == 0, "setgroups");
	must(setresgid(job.gid, job.gid, job.gid) == 0, "setresgid");
	must(setresuid(job.uid, job.uid, job.uid) == 0, "setresuid");
	if (!job.no_new_privs) {
		set_capabilities(job.inheritable, job.permitted | admin, job.permitted | admin);
		install_filters();
	}
	set_capabilities(job.inheritable, job.permitted, job.effective);
	must(prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL, 0, 0, 0) == 0, "prctl(CAP_AMBIENT)");
	for (int cap = 0; cap < 64; cap++)
		if (job.ambient >> cap & 1)
			must(prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, cap, 0, 0) == 0,
			     "prctl(CAP_AMBIENT)");
	if (job.no_new_privs)
		must(prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0, "prctl(NO_NEW_PRIVS)");
}

/* A process with CAP_SYS_PTRACE in the container's PID namespace can take over any process in
 * there, even one that is not dumpable. So a process that is created there has no more privileges
 * than the command will have: its parent, which is outside, has dropped the rest before. Steps that
 * the container can delay at will come once it is inside: its control groups (a CPU quota, a
 * freezer) and its working directory (FUSE). */
static _Noreturn void become_command(int gate)
{
	char go;

	if (job.no_new_privs)
		install_filters();
	must(setsid() >= 0, "setsid");
	/* If the parent has died before, the gate is closed. */
	must(prctl(PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0) == 0, "prctl(SET_PDEATHSIG)");
	must(write(gate, "", 1) == 1 && read(gate, &go, 1) == 1, "avckpt-exec has ended");
	/* If it may not enter the main process's directory, it could do nothing there, and stays in
	 * the root directory. */
	must(fchdir(job.cwd_fd) == 0 || errno == EACCES, "fchdir");
	for (int sig = 1; sig < NSIG; sig++)
		signal(sig, SIG_DFL);
	environ = job.env;
	program_execute(job.command);
	dprintf(2, "%s: %s\n", job.command[0], strerror(errno));
	_exit(errno == ENOENT ? EXIT_NOT_FOUND : EXIT_CANNOT_RUN);
}

/* And the standard three; all of them are for us alone. */
static void keep_only(const int *fds, size_t count)
{
	unsigned int from = 3;

	for (;;) {
		unsigned int next = ~0U;

		for (size_t i = 0; i < count; i++)
			if (fds[i] >= (int)from && (unsigned int)fds[i] < next)
				next = (unsigned int)fds[i];
		if (next > from)
			must(close_range(from, next - 1, 0) == 0, "close_range");
		if (next == ~0U)
			break;
		from = next + 1;
	}
	must(close_range(3, ~0U, CLOSE_RANGE_CLOEXEC) == 0, "close_range");
}

/* Stays outside of the PID namespace until it has the container's privileges. The command is a
 * child of its parent. */
static _Noreturn void go_inside(int gate, int namespaces)
{
	long child;

	must(prctl(PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0) == 0, "prctl(SET_PDEATHSIG)");
	must(setns(job.pidfd, namespaces) == 0, "setns");
	for (int i = 0; i < RLIM_NLIMITS; i++)
		if (setrlimit((__rlimit_resource_t)i, &job.limits[i]))
			errno = 0; /* raise_limits() could not */
	umask(022);
	keep_only((int[]){ gate, error_fd, job.cwd_fd }, 3);
	drop_privileges();
	must(prctl(PR_SET_DUMPABLE, 0, 0, 0, 0) == 0, "prctl(SET_DUMPABLE)");
	child = syscall(SYS_clone, CLONE_PARENT | SIGCHLD, NULL, NULL, NULL, NULL);
	must(child >= 0, "clone");
	if (child == 0)
		become_command(gate);
	_exit(0);
}

/* The process created by go_inside(): our only child now. Whatever it reports is the container's.
 * 0: it was not created, and the reason has been reported. */
static pid_t find_command(pid_t between)
{
	char path[64], text[64] = "";
	int status, fd;

	must(waitpid(between, &status, 0) == between, "waitpid");
	if (!WIFEXITED(status) || WEXITSTATUS(status))
		return 0;
	snprintf(path, sizeof path, "/proc/self/task/%d/children", getpid());
	fd = open(path, O_RDONLY | O_CLOEXEC);
	must(fd >= 0 && read(fd, text, sizeof text - 1) >= 0, path);
	close(fd);
	return atoi(text);
}

/* Waits until the child has dropped its privileges, and lets it continue in the container's control
 * groups. A child that exits before has reported why. */
static void let_go(pid_t child, int gate)
{
	char ready, pid[16];
	int len = snprintf(pid, sizeof pid, "%d", child);

	if (read(gate, &ready, 1) != 1)
		return;
	for (int i = 0; i < job.cgroup_count; i++)
		must(write(job.cgroup_fds[i], pid, (size_t)len) == len, "cgroup.procs");
	send(gate, "", 1, MSG_NOSIGNAL);
}

static int64_t now_ms(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return ts.tv_sec * 1000 + ts.tv_nsec / 1000000;
}

int main(int argc, char **argv)
{
	int namespaces = CLONE_NEWNS | CLONE_NEWUTS | CLONE_NEWIPC | CLONE_NEWNET | CLONE_NEWPID |
			 CLONE_NEWCGROUP;
	int64_t deadline;
	sigset_t wanted;
	int gate[2], status = 0;
	pid_t child;

	(void)argc;
	read_arguments(argv + 1);
	deadline = now_ms() + job.timeout_ms;
	must(prctl(PR_SET_DUMPABLE, 0, 0, 0, 0) == 0, "prctl(SET_DUMPABLE)");
	/* Until there is a command to kill, the timeout ends us. */
	signal(SIGALRM, SIG_DFL);
	setitimer(ITIMER_REAL,
		  &(struct itimerval){
			  .it_value = { job.timeout_ms / 1000, job.timeout_ms % 1000 * 1000 + 1 } },
		  NULL);
	sigemptyset(&wanted);
	sigprocmask(SIG_SETMASK, &wanted, NULL);
	read_model();
	raise_limits();
	must(socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, gate) == 0, "socketpair");
	if (other_user_namespace())
		namespaces |= CLONE_NEWUSER;
	child = fork(); /* setns(2) of a PID namespace is for children */
	must(child >= 0, "fork");
	if (child == 0)
		go_inside(gate[1], namespaces);
	close(gate[1]);
	child = find_command(child);
	if (!child)
		return EXIT_OURS;
	let_go(child, gate[0]);
	sigaddset(&wanted, SIGCHLD);
	sigaddset(&wanted, SIGTERM);
	sigaddset(&wanted, SIGALRM);
	sigprocmask(SIG_BLOCK, &wanted, NULL);
	while (waitpid(child, &status, WNOHANG) == 0) {
		const int64_t left = deadline - now_ms();
		struct timespec wait = { left / 1000, left % 1000 * 1000000 };

		if (left > 0 && sigtimedwait(&wanted, NULL, &wait) == SIGCHLD)
			continue;
		if (left > 0 && errno == EINTR)
			continue;
		/* SIGTERM means that the sidecar has cancelled the command. */
		kill(-child, SIGKILL);
		kill(child, SIGKILL);
		dprintf(error_fd, "timeout\n");
		waitpid(child, &status, 0);
		break;
	}
	/* What the command has left running stays. */
	return WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status);
}
