/* SPDX-License-Identifier: Apache-2.0
 *
 * Opens a userfaultfd where the container's seccomp filter refuses that, as Podman's default profile
 * does.
 *
 * The filter is suspended for this one call. The kernel lets no tracer do that which is under a
 * filter itself. So the guard, before it comes under its own (guard/filter.c), forks a process that
 * is not, and does nothing else. The guard hands it a task of ours in the application (tracker.c).
 * The watcher traces it, has it make this call and no other, takes the descriptor, and kills it. Of
 * all that a container can write it reads a system call's number and first argument.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/capability.h>
#include <poll.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "process.h"

#define ANSWER_NS NS_PER_S
#define CALLS_MAX 16

static int watcher = -1; /* its socket */

/* ---- in the watcher -------------------------------------------------------------------------- */

static bool drop_capabilities(void)
{
	struct __user_cap_header_struct header = { .version = _LINUX_CAPABILITY_VERSION_3 };
	struct __user_cap_data_struct data[2] = { 0 };

	data[0].permitted = 1U << CAP_SYS_PTRACE | 1U << CAP_SYS_ADMIN | 1U << CAP_KILL;
	data[0].effective = data[0].permitted;
	return syscall(SYS_capset, &header, data) == 0;
}

/* At the entry to a call, whose registers only the kernel and its tracer can change now.  True: it
 * is the exit with that argument, and becomes a userfaultfd(2) without a filter; no other call is
 * made at all. */
static bool is_let_through(pid_t tid)
{
	struct arch_regs regs;
	bool is;

	if (arch_regs_get(tid, &regs))
		return false;
	is = arch_syscall_nr(&regs) == SYS_exit_group &&
	     arch_syscall_arg(&regs, 0) == TRACKER_UFFD_FLAGS;
	arch_syscall_nr_set(&regs, is ? SYS_userfaultfd : -1 /* ENOSYS */);
	return arch_regs_set(tid, &regs) == 0 && is &&
	       ptrace(PTRACE_SETOPTIONS, tid, NULL,
		      (long)(TRACE_OPTIONS_OURS | PTRACE_O_SUSPEND_SECCOMP)) == 0;
}

/* The result of that call, after which it does not run again; -1: it was not made. */
static long make_call(pid_t tid)
{
	bool made = false;

	for (int calls = 0; calls < CALLS_MAX;) {
		const struct stop stop = tracee_wait(tid, 0);
		struct arch_regs regs;

		if (stop.kind == STOP_EXIT || stop.kind == STOP_DYING || stop.kind == STOP_DEADLINE)
			return -1;
		if (stop.kind == STOP_SYSCALL && made)
			return arch_regs_get(tid, &regs) ? -1 : arch_syscall_result(&regs);
		if (stop.kind == STOP_SYSCALL && tracee_enters_call(tid)) {
			made = is_let_through(tid);
			calls++;
		}
		if (ptrace(PTRACE_SYSCALL, tid, NULL,
			   stop.kind == STOP_SIGNAL ? (long)stop.signal : 0L))
			return -1;
	}
	return -1;
}

/* `pidfd` tells that the number is still that of the same task, which nobody else can reap from then
 * on. */
static int open_in(pid_t tid, int pidfd)
{
	int fd = -1;
	long number;

	if (pidfd_ended(pidfd) || ptrace(PTRACE_SEIZE, tid, NULL, (long)TRACE_OPTIONS_APP))
		return -1;
	if (pidfd_ended(pidfd))
		_exit(1); /* which lets go of whoever it is */
	if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL) == 0) {
		number = make_call(tid);
		fd = number < 0 ? -1 : proc_borrow_fd(pidfd, (int)number);
	}
	tracee_kill(tid);
	return fd;
}

static void run(int socket)
{
	pid_t tid;

	if (prctl(PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0) || dup2(socket, 0) ||
	    close_range(1, ~0U, 0) || !drop_capabilities())
		_exit(1);
	(void)prctl(PR_SET_NAME, "avckpt-watch", 0, 0, 0);
	while (recv(0, &tid, sizeof tid, 0) == sizeof tid) {
		const uint8_t none = 0;
		int pidfd = fd_receive(0);
		int fd = pidfd < 0 ? -1 : open_in(tid, pidfd);

		if (fd < 0 ? send(0, &none, 1, MSG_NOSIGNAL) < 0 : fd_send(0, fd))
			break;
		close_fd(&fd);
		close_fd(&pidfd);
	}
	_exit(0);
}

/* ---- in the guard -------------------------------------------------------------------------------- */

bool watcher_start(void)
{
	int ends[2];
	pid_t pid;

	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends))
		return false;
	pid = fork();
	if (!pid)
		run(ends[1]);
	close_fd(&ends[1]);
	if (pid < 0)
		close_fd(&ends[0]);
	watcher = ends[0];
	return watcher >= 0;
}

bool watcher_is_there(void)
{
	return watcher >= 0;
}

int watcher_open(pid_t tid, int pidfd)
{
	struct pollfd answer = { .fd = watcher, .events = POLLIN };

	if (send(watcher, &tid, sizeof tid, MSG_NOSIGNAL) == sizeof tid &&
	    fd_send(watcher, pidfd) == 0 && poll_for(&answer, 1, ANSWER_NS) == 1)
		return fd_receive(watcher);
	close_fd(&watcher); /* a late answer would be taken for that to another question */
	return -1;
}
