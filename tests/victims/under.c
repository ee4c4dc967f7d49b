/* SPDX-License-Identifier: Apache-2.0
 *
 * under FILTER PROGRAM [ARGUMENT...]: executes a program of this folder under a seccomp filter, which
 * its processes inherit.
 *
 *   harmless  refuses acct(2), which nobody calls
 *   hindering refuses, too, calls that only checkpoints and restores make
 *   killing   kills a process that makes the call by which the kernel continues a sleep,
 *             restart_syscall(2), which few programs know of
 */
#include <errno.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#define REFUSE(nr)                                       \
	BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (nr), 0, 1), \
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM)
#define ALLOW BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW)

static struct sock_filter harmless[] = {
	BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
	REFUSE(SYS_acct),
	ALLOW,
};
static struct sock_filter hindering[] = {
	BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
	REFUSE(SYS_acct),
	REFUSE(SYS_capget),
	REFUSE(SYS_capset),
	REFUSE(SYS_setfsuid),
	REFUSE(SYS_getresgid),
	REFUSE(SYS_get_mempolicy),
	REFUSE(SYS_personality),
	REFUSE(SYS_setresuid),
	REFUSE(SYS_timer_create),
	ALLOW,
};
static struct sock_filter killing[] = {
	BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
	BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_restart_syscall, 0, 1),
	BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
	ALLOW,
};

#define PROGRAM(filter)                                   \
	{                                                 \
		sizeof(filter) / sizeof *(filter), filter \
	}
static const struct {
	const char *name;
	struct sock_fprog program;
} filters[] = {
	{ "harmless", PROGRAM(harmless) },
	{ "hindering", PROGRAM(hindering) },
	{ "killing", PROGRAM(killing) },
};

int main(int argc, char **argv)
{
	struct sock_fprog program = { 0 };
	char path[4096];
	ssize_t n;

	for (size_t i = 0; argc > 2 && i < sizeof filters / sizeof *filters; i++)
		if (!strcmp(argv[1], filters[i].name))
			program = filters[i].program;
	if (!program.len) {
		fprintf(stderr, "usage: %s harmless|hindering|killing PROGRAM [ARGUMENT...]\n",
			argv[0]);
		return 2;
	}
	n = readlink("/proc/self/exe", path, sizeof path - strlen(argv[2]) - 1);
	if (n > 0) {
		path[n] = 0;
		strcpy(strrchr(path, '/') + 1, argv[2]);
	}
	if (n <= 0 || prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) ||
	    prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program)) {
		perror("under");
		return 1;
	}
	execv(path, argv + 2);
	perror(path);
	return 1;
}
