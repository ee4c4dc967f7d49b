/* SPDX-License-Identifier: Apache-2.0
 *
 * under FILTER PROGRAM [ARGUMENT...]: executes a program of this folder under a seccomp filter, which
 * its processes inherit.
 *
 *   harmless  refuses acct(2), which nobody calls
 *   hindering refuses, too, calls that only checkpoints and restores make
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

int main(int argc, char **argv)
{
	const int hinders = argc > 2 && !strcmp(argv[1], "hindering");
	struct sock_fprog program = {
		hinders ? sizeof hindering / sizeof *hindering : sizeof harmless / sizeof *harmless,
		hinders ? hindering : harmless,
	};
	char path[4096];
	ssize_t n;

	if (argc < 3) {
		fprintf(stderr, "usage: %s harmless|hindering PROGRAM [ARGUMENT...]\n", argv[0]);
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
