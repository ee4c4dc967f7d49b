/* SPDX-License-Identifier: Apache-2.0
 *
 * Writes into pipes that a stop has cut short.
 *
 * A blocking write(2) of more than fits into a pipe waits for its reader.  A ptrace stop ends it, and
 * it returns how much it has written so far, as after a signal.  A program without signal handlers
 * need not expect that, and many do not: what Python prints with PYTHONUNBUFFERED=1 would be cut.
 *
 * So the guard writes the rest, while only this thread is still stopped, which otherwise would wait
 * for the reader itself.  The result in its registers is at all times what has been written: a thread
 * that loses its guard returns that.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "process.h"

/* For all of them together, and for a reader that reads nothing: the guard does nothing else meanwhile. */
#define WRITES_NS NS_PER_S
#define STALLED_NS (100 * NS_PER_MS)
#define CHUNK_BYTES 65536
#define WRITE_MAX UINT64_C(0x7ffff000) /* MAX_RW_COUNT of the kernel */

/* Its registers still say what it was called with: not where the result replaces an argument. */
static bool is_cut(const struct thread *thread)
{
	const struct arch_regs *regs = &thread->regs;
	const long result = arch_syscall_result(regs);

	return !ARCH_FORGETS_CALLS && thread->attached && thread->stopped && !thread->borrowed &&
	       !thread->signalled && !thread->stop_signal && arch_syscall_nr(regs) == SYS_write &&
	       result > 0 && (uint64_t)result < arch_syscall_arg(regs, 2) &&
	       (uint64_t)result < WRITE_MAX;
}

void thread_let_go_uncut(struct process *process, struct thread *thread)
{
	if (!is_cut(thread))
		thread_let_go(process, thread);
}

static bool is_blocking_pipe(int fd)
{
	struct stat st;

	return fstat(fd, &st) == 0 && S_ISFIFO(st.st_mode) && !(fcntl(fd, F_GETFL) & O_NONBLOCK);
}

/* A signal would have ended the call, and a death must not wait.  Some do nothing without a handler, but
 * are pending for as long as a thread has a tracer. */
static bool is_wanted(const struct process *process, pid_t tid)
{
	const struct process *main = process->main ? process->main : process;
	const uint64_t harmless = SIGNAL_BIT(SIGCHLD) | SIGNAL_BIT(SIGCONT) | SIGNAL_BIT(SIGURG) |
				  SIGNAL_BIT(SIGWINCH);
	struct proc_status status;

	return proc_is_dying(main->stat_fd) || proc_status(tid, &status) ||
	       ((status.pending | status.shared_pending) &
		~(status.blocked | status.ignored | (harmless & ~status.caught)));
}

/* How much the pipe took of what is there; 0: nothing for now; -1: it takes nothing any more, or the
 * kernel does not write into a pipe without waiting (before Linux 6.4). */
static ssize_t write_some(const struct process *process, int fd, uint64_t from, uint64_t bytes)
{
	static uint8_t chunk[CHUNK_BYTES];
	struct iovec io = { chunk, bytes < CHUNK_BYTES ? bytes : CHUNK_BYTES };
	const struct iovec there = { (void *)from, io.iov_len };
	ssize_t n = process_vm_readv(process->pid, &io, 1, &there, 1,
				     0); /* what it can read itself */

	if (n <= 0)
		return -1;
	io.iov_len = (size_t)n;
	n = pwritev2(fd, &io, 1, -1, RWF_NOWAIT);
	return n < 0 && errno == EAGAIN ? 0 : n;
}

static void write_rest(const struct process *process, struct thread *thread, int fd, uint64_t end)
{
	const uint64_t from = arch_syscall_arg(&thread->regs, 1),
		       count = arch_syscall_arg(&thread->regs, 2),
		       bytes = count < WRITE_MAX ? count : WRITE_MAX;
	uint64_t done = (uint64_t)arch_syscall_result(&thread->regs), wrote_ns = now_ns(), now;

	while (done < bytes && (now = now_ns()) < end && now - wrote_ns < STALLED_NS &&
	       !is_wanted(process, thread->tid)) {
		struct pollfd room = { .fd = fd, .events = POLLOUT };
		const ssize_t n = write_some(process, fd, from + done, bytes - done);

		if (n < 0)
			return;
		if (n)
			wrote_ns = now;
		done += (uint64_t)n;
		/* Not in thread->regs: an image has the pipe as it was in the freeze. */
		if (n && arch_result_set(thread->tid, (long)done))
			return; /* it was killed */
		heartbeat();
		if (!n)
			(void)poll_for(&room, 1, NS_PER_MS);
	}
}

static void finish(struct process *process, struct thread *thread, uint64_t end)
{
	int fd = -1;

	if (is_cut(thread))
		fd = (int)syscall(SYS_pidfd_getfd, process->pidfd,
				  (int)arch_syscall_arg(&thread->regs, 0), 0);
	if (fd >= 0 && is_blocking_pipe(fd))
		write_rest(process, thread, fd, end);
	close_fd(&fd);
	thread_let_go(process, thread);
}

uint64_t writes_end(void)
{
	return now_ns() + WRITES_NS;
}

void writes_finish_until(struct process *process, uint64_t end)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		finish(process, &process->threads[i], end);
}

void writes_finish(struct process *process)
{
	writes_finish_until(process, writes_end());
}
