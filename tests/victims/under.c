/* SPDX-License-Identifier: Apache-2.0
 *
 * under FILTER PROGRAM [ARGUMENT...]: executes a program of this folder under a seccomp filter, which
 * its processes inherit.
 *
 *   harmless       refuses acct(2), which nobody calls
 *   hindering      refuses, too, calls that only checkpoints and restores make
 *   barren         refuses all that only checkpoints call and that one can be protected without
 *   no-sigprocmask refuses rt_sigprocmask(2)
 *   no-sigreturn   refuses rt_sigreturn(2)
 *   kill-sigprocmask, kill-sigreturn: kill the process that calls it
 *   killing        kills a process that makes the call by which the kernel continues a sleep,
 *                  restart_syscall(2), which few programs know of
 *   exacting       kills a process that calls write, sendto or recvfrom with a first argument of more
 *                  than 32 bits
 */
#include <errno.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#define CALLS_MAX 12
#define EPERM_IT (SECCOMP_RET_ERRNO | EPERM)

static const struct kind {
	const char *name;
	unsigned int action;
	unsigned int call[CALLS_MAX]; /* 0: no more */
} kinds[] = {
	{ "harmless", EPERM_IT, { SYS_acct } },
	{ "hindering",
	  EPERM_IT,
	  { SYS_acct, SYS_capget, SYS_capset, SYS_setfsuid, SYS_getresgid, SYS_get_mempolicy,
	    SYS_personality, SYS_setresuid, SYS_timer_create } },
	{ "barren",
	  EPERM_IT,
	  { SYS_futex, SYS_ppoll, SYS_clone, SYS_wait4, SYS_waitid, SYS_prctl, SYS_mincore,
	    SYS_socketpair, SYS_recvmsg, SYS_close_range, SYS_capget, SYS_getitimer } },
	{ "no-sigprocmask", EPERM_IT, { SYS_rt_sigprocmask } },
	{ "no-sigreturn", EPERM_IT, { SYS_rt_sigreturn } },
	{ "kill-sigprocmask", SECCOMP_RET_KILL_PROCESS, { SYS_rt_sigprocmask } },
	{ "kill-sigreturn", SECCOMP_RET_KILL_PROCESS, { SYS_rt_sigreturn } },
	{ "killing", SECCOMP_RET_KILL_PROCESS, { SYS_restart_syscall } },
	{ "exacting", SECCOMP_RET_KILL_PROCESS, { SYS_write, SYS_sendto, SYS_recvfrom } },
};

static const struct kind *find(const char *name)
{
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++)
		if (!strcmp(name, kinds[i].name))
			return &kinds[i];
	return NULL;
}

static int come_under(const struct kind *kind)
{
	struct sock_filter filter[4 * CALLS_MAX + 2], *end = filter;
	const bool exacting = !strcmp(kind->name, "exacting");
	struct sock_fprog program = { .filter = filter };

	*end++ = (struct sock_filter)BPF_STMT(BPF_LD | BPF_W | BPF_ABS,
					      offsetof(struct seccomp_data, nr));
	for (int i = 0; i < CALLS_MAX && kind->call[i]; i++) {
		*end++ = (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, kind->call[i], 0,
						      exacting ? 4 : 1);
		if (exacting) {
			*end++ = (struct sock_filter)BPF_STMT(
				BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, args) + 4);
			*end++ = (struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, 0, 0, 1);
			*end++ = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW);
		}
		*end++ = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, kind->action);
	}
	*end++ = (struct sock_filter)BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW);
	program.len = (unsigned short)(end - filter);
	return prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) ||
	       prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program);
}

int main(int argc, char **argv)
{
	const struct kind *kind = argc > 2 ? find(argv[1]) : NULL;
	char path[4096];
	ssize_t n;

	if (!kind) {
		fprintf(stderr, "usage: %s FILTER PROGRAM [ARGUMENT...]\n", argv[0]);
		return 2;
	}
	n = readlink("/proc/self/exe", path, sizeof path - strlen(argv[2]) - 1);
	if (n > 0) {
		path[n] = 0;
		strcpy(strrchr(path, '/') + 1, argv[2]);
	}
	if (n <= 0 || come_under(kind)) {
		perror("under");
		return 1;
	}
	execv(path, argv + 2);
	perror(path);
	return 1;
}
