/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether this machine supports it: tried on our own child, not deduced from version numbers.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "guard.h"

static int probe_child(pid_t child, struct avc_error *err)
{
	uint64_t rseq[3] = { 0 };

	if (ptrace(PTRACE_SEIZE, child, NULL, (long)TRACE_OPTIONS_APP))
		return fail_errno(err, 0, "probe", "ptrace(SEIZE)",
				  "tracing is not allowed (CAP_SYS_PTRACE)");
	if (ptrace(PTRACE_INTERRUPT, child, NULL, NULL) ||
	    tracee_await(child, NULL, err) != STOP_TRAP)
		return fail_errno(err, 0, "probe", "ptrace(INTERRUPT)",
				  "a child could not be stopped");
	if (ptrace(PTRACE_SETOPTIONS, child, NULL, (long)PTRACE_O_SUSPEND_SECCOMP))
		return fail_errno(
			err, 0, "probe", "ptrace(SUSPEND_SECCOMP)",
			"needs CAP_SYS_ADMIN and no seccomp filter on avckpt itself (--privileged)");
	if (ptrace(PTRACE_GET_RSEQ, child, sizeof rseq, rseq) < 0)
		return fail(err, AVC_UNSUPPORTED, errno, 0, "probe",
			    "ptrace(GET_RSEQ_CONFIGURATION)",
			    "the kernel is too old: Linux 5.13 or newer is needed");
	return 0;
}

int guard_probe(struct avc_error *err)
{
	void *page;
	pid_t child;
	int fd, result, ready[2];
	char byte;

	*err = (struct avc_error){ 0 };
	if (!arch_xstate_bytes())
		return fail(err, AVC_UNSUPPORTED, 0, 0, "probe", "", "this CPU has no XSAVE");
	if (sysconf(_SC_PAGESIZE) != ARCH_PAGE_BYTES)
		return fail(err, AVC_UNSUPPORTED, 0, 0, "probe", "",
			    "the kernel's pages have %ld bytes: avckpt needs pages of %d",
			    sysconf(_SC_PAGESIZE), ARCH_PAGE_BYTES);
	/* Opening it for writing needs root, writing it a capability.  Writing the same value back
	 * changes nothing. */
	fd = open("/proc/sys/kernel/ns_last_pid", O_WRONLY | O_CLOEXEC);
	if (fd < 0)
		return errno == ENOENT
			       ? fail(err, AVC_UNSUPPORTED, errno, 0, "probe", "open(ns_last_pid)",
				      "the kernel lacks CONFIG_CHECKPOINT_RESTORE")
			       : fail_errno(err, 0, "probe", "open(ns_last_pid)",
					    "needs root and a writable /proc/sys (--privileged)");
	close(fd);
	page = mmap(NULL, ARCH_PAGE_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1,
		    0);
	if (pipe2(ready, O_CLOEXEC))
		ready[0] = ready[1] = -1;
	child = fork();
	if (child == 0) {
		/* Like another user's process: one's own child may be traced without
		 * CAP_SYS_PTRACE, unless it is not dumpable. */
		prctl(PR_SET_DUMPABLE, 0);
		close(ready[1]);
		for (;;)
			pause();
	}
	close_fd(&ready[1]);
	while (read(ready[0], &byte, 1) < 0 && errno == EINTR)
		;
	close_fd(&ready[0]);
	if (child < 0 || page == MAP_FAILED)
		return fail_errno(err, 0, "probe", "fork", "no child");
	result = probe_child(child, err);
	if (!result) {
		fd = proc_open_mapped(child, (avc_remote)page, (avc_remote)page + ARCH_PAGE_BYTES,
				      O_RDONLY);
		if (fd < 0)
			result = fail_errno(err, 0, "probe", "open(map_files)",
					    "needs CAP_CHECKPOINT_RESTORE or CAP_SYS_ADMIN");
		else
			close(fd);
	}
	tracee_kill(child);
	munmap(page, ARCH_PAGE_BYTES);
	return result;
}
