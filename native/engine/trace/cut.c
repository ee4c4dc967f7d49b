/* SPDX-License-Identifier: Apache-2.0
 *
 * System calls that a stop has cut short.
 *
 * A blocking write(2) of more than fits waits for its reader, recv(2) with MSG_WAITALL until all is
 * there.  A ptrace stop ends such a call, and it returns how much it has done so far, as after a
 * signal.  A program without signal handlers need not expect that, and many do not: what Python
 * prints with PYTHONUNBUFFERED=1 would be cut, and a message received by its half.
 *
 * So the thread itself goes on, in the kernel, with what is left.  It makes that call from a place in
 * the parasite, where what was done before is added to its result and its registers become what they
 * were (inj_cut()).  All of that is in its registers, and they are set at once: it needs no guard any
 * more, a signal with a handler ends the call as it would have ended it, and so do further stops.  An
 * image has the thread in the same call.
 *
 * A place belongs to the instruction of the app's that made the call, and is never used for another.
 */
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "trace.h"

#define CALL_MAX UINT64_C(0x7ffff000) /* MAX_RW_COUNT of the kernel */
#define SEND_FLAGS (MSG_NOSIGNAL | MSG_MORE)
#define RECEIVE_FLAGS (MSG_NOSIGNAL | MSG_WAITALL)

/* Not those that name an address; nor those for which a flag means that less may be done. */
static bool may_be_cut(const struct arch_regs *regs)
{
	const uint64_t flags = arch_syscall_arg(regs, 3), address = arch_syscall_arg(regs, 4);

	switch (arch_syscall_nr(regs)) {
	case SYS_write:
		return true;
	case SYS_sendto:
		return !address && !(flags & ~(uint64_t)SEND_FLAGS);
	case SYS_recvfrom:
		return !address && flags & MSG_WAITALL && !(flags & ~(uint64_t)RECEIVE_FLAGS);
	default:
		return false;
	}
}

static bool is_part(const struct arch_regs *regs)
{
	const long result = arch_syscall_result(regs);

	return result > 0 && (uint64_t)result < arch_syscall_arg(regs, 2) &&
	       (uint64_t)result + arch_call_done(regs) < CALL_MAX;
}

/* What is received from several senders is never joined with SO_PASSCRED. */
static bool is_stream(int fd)
{
	const int domain = fd_option(fd, SOL_SOCKET, SO_DOMAIN),
		  protocol = fd_option(fd, SOL_SOCKET, SO_PROTOCOL);

	if (fd_option(fd, SOL_SOCKET, SO_TYPE) != SOCK_STREAM)
		return false;
	if (domain == AF_UNIX)
		return !fd_option(fd, SOL_SOCKET, SO_PASSCRED);
	return (domain == AF_INET || domain == AF_INET6) &&
	       (protocol == IPPROTO_TCP || protocol == IPPROTO_MPTCP);
}

/* Whether nothing but a stop, or a signal, ends such a call of it early: it has no error to tell, and
 * is a pipe that somebody reads or a connection.  What was sent before an end can still be received. */
static bool is_blocking(int fd, bool receives)
{
	const short end = receives ? POLLERR : POLLERR | POLLHUP;
	struct pollfd state = { .fd = fd };

	return !(fcntl(fd, F_GETFL) & O_NONBLOCK) && poll(&state, 1, 0) >= 0 &&
	       !(state.revents & end);
}

static bool waits_for_all(const struct process *process, const struct thread *thread)
{
	const int number = (int)arch_syscall_arg(&thread->regs, 0);
	const bool receives = arch_syscall_nr(&thread->regs) == SYS_recvfrom;
	char name[32];
	struct statx st;
	bool waits;
	int fd;

	/* To close a duplicate of a file would be a request to its server, which may be stopped. */
	snprintf(name, sizeof name, "fd/%d", number);
	if (!proc_look(thread->tid, name, STATX_TYPE, &st) ||
	    (!S_ISFIFO(st.stx_mode) && !S_ISSOCK(st.stx_mode)))
		return false;
	fd = proc_borrow_fd(process->pidfd, number);
	waits = fd >= 0 && (S_ISFIFO(st.stx_mode) || is_stream(fd)) && is_blocking(fd, receives);
	close_fd(&fd);
	return waits;
}

bool cut_contains(avc_remote parasite, avc_remote address)
{
	return address >= parasite + INJ_CUT_OFFSET && address < parasite + INJ_CODE_BYTES;
}

bool cut_is_place(const struct process *process, avc_remote pc)
{
	for (uint32_t i = 0; i < process->old_parasites; i++)
		if (cut_contains(process->old_parasite[i].base, pc))
			return true;
	return process->parasite.base && cut_contains(process->parasite.base, pc);
}

/* It may have executed another program, or mapped something else there. */
static bool is_there(const struct parasite *parasite, pid_t tid, const void *what, size_t bytes)
{
	uint8_t there[INJ_CUT_BYTES];
	const struct iovec to = { there, bytes };
	const struct iovec from = { (void *)parasite_remote(parasite, what), bytes };

	return process_vm_readv(tid, &to, 1, &from, 1, 0) == (ssize_t)bytes &&
	       memcmp(there, what, bytes) == 0;
}

/* 0: there is none. */
static avc_remote place_for(const struct process *process, const struct thread *thread)
{
	const struct parasite *parasite = &process->parasite;
	const avc_remote back = arch_pc(&thread->regs);

	if (!parasite->base || !parasite->control)
		return 0;
	for (size_t i = 0; i < INJ_CUT_PLACES; i++) {
		uint64_t *use = &parasite->control->cut[i];
		const uint8_t *code = parasite->map + INJ_CUT_OFFSET + i * INJ_CUT_BYTES;

		if (!__atomic_load_n(use, __ATOMIC_RELAXED))
			__atomic_store_n(use, back, __ATOMIC_RELAXED);
		if (__atomic_load_n(use, __ATOMIC_RELAXED) == back)
			return is_there(parasite, thread->tid, use, sizeof *use) &&
					       is_there(parasite, thread->tid, code, INJ_CUT_BYTES)
				       ? parasite_remote(parasite, code)
				       : 0;
	}
	return 0;
}

void cut_go_on(struct process *process, struct thread *thread)
{
	struct arch_regs regs = thread->regs;
	const bool again = cut_is_place(process, arch_pc(&regs));
	avc_remote place;

	if (ARCH_FORGETS_CALLS || thread->borrowed || thread->stop_signal || !may_be_cut(&regs) ||
	    !is_part(&regs) || rewind_is_before(process, &regs, arch_syscall_nr(&regs)) ||
	    !arch_is_native(&regs) || (!again && arch_call_done(&regs)) ||
	    seccomp_bars_rest(process, thread->tid) || !waits_for_all(process, thread))
		return;
	place = again ? arch_pc(&regs) - ARCH_SYSCALL_BYTES : place_for(process, thread);
	if (!place)
		return;
	arch_call_rest(&regs, place);
	if (arch_regs_set(thread->tid, &regs))
		return; /* it was killed */
	thread->regs = regs;
	thread->rewound = (struct rewound){ 0 };
	thread->sent_back = true;
}
