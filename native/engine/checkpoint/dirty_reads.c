/* SPDX-License-Identifier: Apache-2.0
 *
 * Reads that are under way while the application runs.  Where a file system or a device fills the
 * pages itself (O_DIRECT, FUSE, 9p), they are looked up, and so marked as written, when the call
 * begins.  What arrives after a scan and a copy is not noticed any more: such pages stay stale.
 */
#include <stdio.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>

#include "dirty.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define BYTES_MAX ((size_t)INT32_MAX) /* more is not read by one call              */
#define VECTORS_MAX 1024

struct reads {
	const struct process *process;
	struct pageset *pages;
};

/* Or may be one: another thread can close what is being read. */
static bool is_file(pid_t pid, uint64_t number)
{
	char name[24];
	struct statx st;

	snprintf(name, sizeof name, "fd/%u", (unsigned int)number);
	return !proc_look(pid, name, STATX_TYPE, &st) || S_ISREG(st.stx_mode) ||
	       S_ISBLK(st.stx_mode);
}

static bool add(struct reads *reads, avc_remote start, size_t bytes)
{
	avc_remote end;

	if (!bytes || start >= ARCH_USER_END)
		return true;
	end = start + (bytes < BYTES_MAX ? bytes : BYTES_MAX);
	if (end > ARCH_USER_END)
		end = ARCH_USER_END;
	return pageset_add(reads->pages, start & ~(PAGE - 1), (end + PAGE - 1) & ~(PAGE - 1));
}

static bool add_vectors(struct reads *reads, avc_remote at, size_t count)
{
	struct iovec vector[VECTORS_MAX];
	const size_t bytes = (count < VECTORS_MAX ? count : VECTORS_MAX) * sizeof *vector;
	const ssize_t n = process_vm_readv(reads->process->pid, &(struct iovec){ vector, bytes }, 1,
					   &(struct iovec){ (void *)at, bytes }, 1, 0);

	for (ssize_t i = 0; i < n / (ssize_t)sizeof *vector; i++)
		if (!add(reads, (avc_remote)vector[i].iov_base, vector[i].iov_len))
			return false;
	return true;
}

static int look_at_thread(pid_t tid, void *arg)
{
	struct reads *reads = arg;
	const pid_t pid = reads->process->pid;
	char name[48], text[256];
	unsigned long file, at, count;
	long number;

	snprintf(name, sizeof name, "task/%d/syscall", tid);
	/* Or "running". */
	if (proc_read(pid, name, text, sizeof text) <= 0 ||
	    sscanf(text, "%ld %lx %lx %lx", &number, &file, &at, &count) != 4)
		return 0;
	switch (number) {
	case SYS_read:
	case SYS_pread64:
		return !is_file(pid, file) || add(reads, at, count) ? 0 : -1;
	case SYS_readv:
	case SYS_preadv:
	case SYS_preadv2:
		return !is_file(pid, file) || add_vectors(reads, at, count) ? 0 : -1;
	default:
		return 0;
	}
}

bool reads_under_way(const struct process *process, struct pageset *pages)
{
	struct reads reads = { process, pages };

	return proc_numbers(process->task_dirfd, look_at_thread, &reads) == 0;
}
