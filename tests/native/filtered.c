/* SPDX-License-Identifier: Apache-2.0
 *
 * filtered: comes under the guard's own seccomp filter and makes calls, of kinds that a guard never
 * makes and of kinds that it does.  Each prints its name and the errno, 0: it was allowed.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/filter.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "guard.h"

static void *in_a_thread(void *arg)
{
	int *errnum = arg;

	errno = 0;
	syscall(SYS_execve, "/nowhere", NULL, NULL);
	*errnum = errno;
	return NULL;
}

static void say(const char *name, long result)
{
	printf("%s %d\n", name, result < 0 ? errno : 0);
}

#define TRY(name, ...) (errno = 0, say(name, syscall(__VA_ARGS__)))

int main(void)
{
	static char page[4096] __attribute__((aligned(4096)));
	pthread_t thread;
	int errnum = 0;

	if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) || guard_filter_enter())
		return 1;
	puts("refused");
	TRY("execve", SYS_execve, "/nowhere", NULL, NULL);
	TRY("execveat", SYS_execveat, AT_FDCWD, "/nowhere", NULL, NULL, 0);
	TRY("fork", SYS_clone, CLONE_NEWUSER | SIGCHLD, 0, 0, 0, 0);
	TRY("clone3", SYS_clone3, NULL, 0);
	TRY("unshare", SYS_unshare, CLONE_NEWNS);
	TRY("setns", SYS_setns, -1, CLONE_NEWNS);
	TRY("mount", SYS_mount, "none", "/nowhere", "tmpfs", 0, NULL);
	TRY("fsopen", SYS_fsopen, "tmpfs", 0);
	TRY("bpf", SYS_bpf, 0, NULL, 0);
	TRY("io_uring_setup", SYS_io_uring_setup, 0, NULL);
	TRY("userfaultfd", SYS_userfaultfd, 0);
	TRY("keyctl", SYS_keyctl, 0, 0, 0, 0, 0);
	TRY("init_module", SYS_init_module, NULL, 0, "");
	TRY("kexec_load", SYS_kexec_load, 0, 0, NULL, 0);
	TRY("reboot", SYS_reboot, 0, 0, 0, NULL);
	TRY("mknodat", SYS_mknodat, AT_FDCWD, "", 0, 0);
	TRY("ptrace(TRACEME)", SYS_ptrace, PTRACE_TRACEME, 0, 0, 0);
	TRY("ptrace(ATTACH)", SYS_ptrace, PTRACE_ATTACH, 0, 0, 0);
	TRY("socket(AF_VSOCK)", SYS_socket, AF_VSOCK, SOCK_STREAM, 0);
	TRY("socket(AF_ALG)", SYS_socket, AF_ALG, SOCK_SEQPACKET, 0);
	TRY("ioctl(TIOCSTI)", SYS_ioctl, -1, TIOCSTI, NULL);
	TRY("prctl(SET_MM)", SYS_prctl, PR_SET_MM, 0, 0, 0, 0);
	TRY("mmap(EXEC)", SYS_mmap, NULL, 4096, PROT_READ | PROT_EXEC, MAP_PRIVATE | MAP_ANONYMOUS,
	    -1, 0);
	TRY("mprotect(EXEC)", SYS_mprotect, page, sizeof page, PROT_READ | PROT_EXEC);
	if (pthread_create(&thread, NULL, in_a_thread, &errnum) || pthread_join(thread, NULL))
		return 1;
	printf("execve-in-a-thread %d\n", errnum);
	puts("allowed");
	TRY("ptrace(SEIZE)", SYS_ptrace, PTRACE_SEIZE, 0, 0, 0); /* of nobody: ESRCH */
	TRY("mmap", SYS_mmap, NULL, 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1,
	    0);
	TRY("mprotect", SYS_mprotect, page, sizeof page, PROT_READ);
	TRY("socket(AF_UNIX)", SYS_socket, AF_UNIX, SOCK_STREAM, 0);
	TRY("unshare(FS)", SYS_unshare, CLONE_FS);
	TRY("openat", SYS_openat, AT_FDCWD, "/", O_RDONLY | O_DIRECTORY);
	return 0;
}
