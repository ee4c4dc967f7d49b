/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether a process has executed another program, execve(2).
 *
 * A perf event of the main thread reports that at once: the kernel removes it when any thread calls
 * execve(2), and when the main thread ends (attr.remove_on_exec, since Linux 5.13).  It counts
 * nothing and is never enabled.  poll(2) reports this only with a ring buffer, whose only page is
 * never read.
 */
#include <errno.h>
#include <linux/perf_event.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "process.h"

/* ESRCH: it is exiting.  EFAULT: after execve(2) it has memory, but not the parasite. */
bool process_has_executed(const struct process *process)
{
	uint64_t nonce = 0;
	struct iovec here = { &nonce, sizeof nonce };
	struct iovec there = { (void *)(process->parasite.base + INJ_CODE_BYTES +
					offsetof(struct inj_control, nonce)),
			       sizeof nonce };
	const ssize_t n = process_vm_readv(process->pid, &here, 1, &there, 1, 0);

	return n == sizeof nonce ? nonce != process->nonce : errno == EFAULT;
}

bool process_listen_for_exec(struct process *process)
{
	struct perf_event_attr nothing = {
		.type = PERF_TYPE_SOFTWARE,
		.size = sizeof nothing,
		.config = PERF_COUNT_SW_DUMMY,
		.disabled = 1,
		.remove_on_exec = 1,
	};
	struct exec_sign *sign = &process->exec_sign;

	if (sign->fd >= 0 && !sign->over)
		return true;
	process_listen_no_more(process);
	sign->fd = (int)syscall(SYS_perf_event_open, &nothing, process->leader, -1, -1,
				PERF_FLAG_FD_CLOEXEC);
	if (sign->fd < 0)
		return false;
	sign->page = mmap(NULL, ARCH_PAGE_BYTES, PROT_READ, MAP_SHARED, sign->fd, 0);
	sign->over = false;
	if (sign->page != MAP_FAILED)
		return true;
	close_fd(&sign->fd);
	return false;
}

void process_listen_no_more(struct process *process)
{
	if (process->exec_sign.fd >= 0)
		munmap(process->exec_sign.page, ARCH_PAGE_BYTES);
	close_fd(&process->exec_sign.fd);
}
