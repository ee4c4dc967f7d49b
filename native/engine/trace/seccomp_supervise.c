/* SPDX-License-Identifier: Apache-2.0
 *
 * Injected code under filters that refuse what it calls.
 *
 * Its tracer stops it at the entry to every system call, and suspends the filters
 * (PTRACE_O_SUSPEND_SECCOMP) for that call alone, if it is one that injected code makes, and made by
 * that.  This decision uses nothing that the application can write.  At the entry the registers are
 * fixed in the kernel: whatever the application does to the parasite, its stack or its lists, or maps
 * in its place, leads to calls that its own filter checks, or to some of those in seccomp_calls.c.
 *
 * The suspension ends with the tracer.  Injected code then goes on to the end of its list, and home,
 * under filters that may refuse each of its calls, but must kill for none (also strict mode does),
 * and must allow those that undo and go home (seccomp.c).
 */
#include <linux/seccomp.h>
#include <sched.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>

#include "seccomp.h"

#define SUPERVISED_MAX 512

struct task {
	pid_t tid, inside;
	long options;
	avc_remote code; /* injected code, of so many bytes                          */
	size_t bytes;
};

static __thread struct {
	struct task task[SUPERVISED_MAX];
	uint32_t count;
} supervised;

static int find(pid_t tid)
{
	for (uint32_t i = 0; i < supervised.count; i++)
		if (supervised.task[i].tid == tid)
			return (int)i;
	return -1;
}

int seccomp_supervise(pid_t tid, pid_t inside, long options, avc_remote code, size_t bytes)
{
	int i = find(tid);

	if (i < 0 && supervised.count == SUPERVISED_MAX) {
		/* Makes room by removing those that have exited unnoticed. */
		for (uint32_t k = supervised.count; k-- > 0;)
			if (!tracee_is_ours(supervised.task[k].tid))
				supervised.task[k] = supervised.task[--supervised.count];
	}
	if (i < 0 && supervised.count == SUPERVISED_MAX)
		return -1;
	if (i < 0)
		i = (int)supervised.count++;
	supervised.task[i] = (struct task){ tid, inside, options, code, bytes };
	return 0;
}

void seccomp_end_supervision(pid_t tid)
{
	const int i = find(tid);

	if (i >= 0)
		supervised.task[i] = supervised.task[--supervised.count];
}

bool seccomp_is_supervised(pid_t tid)
{
	return find(tid) >= 0;
}

static bool is_among(const struct kinds *kinds, long nr, uint64_t arg)
{
	for (size_t i = 0; i < kinds->count; i++)
		if (kinds->kind[i].nr == nr &&
		    (kinds->kind[i].arg == ANY || kinds->kind[i].arg == arg))
			return true;
	return false;
}

/* Whether injected code makes such a call, or the kernel for it, when somebody has interrupted its
 * wait; `inside` is its process's own PID. */
static bool is_wanted(const struct arch_regs *regs, pid_t inside)
{
	const long nr = arch_syscall_nr(regs);
	const uint64_t arg = arch_syscall_arg(regs, 0);

	if (!is_among(&seccomp_wanted, nr, arg) && !is_among(&seccomp_wanted_to_restore, nr, arg) &&
	    !is_among(&seccomp_restarts, nr, arg))
		return false;
	switch (nr) {
	case SYS_ioctl:
		return arch_syscall_arg(regs, 1) == TIOCSPGRP ||
		       arch_syscall_arg(regs, 1) == TIOCSCTTY;
	case SYS_mmap:
	case SYS_pkey_mprotect:
	case SYS_mprotect: /* only the porter maps code (porter.c) */
		return !inside || !(arch_syscall_arg(regs, 2) & PROT_EXEC);
	case SYS_userfaultfd: /* in its own descriptor table, for the guard to take (tracker.c) */
		return inside == SECCOMP_WATCHER;
	case SYS_rt_sigqueueinfo:
	case SYS_rt_tgsigqueueinfo:
	case SYS_tgkill: /* to itself, not to others */
		return (pid_t)arg == inside;
	default:
		return true;
	}
}

/* A thread of the app that has returned by itself makes its own calls, under its own filters. */
static void at_call(const struct task *task)
{
	struct arch_regs regs;
	long options = task->options;

	if (tracee_enters_call(task->tid) && arch_regs_get(task->tid, &regs) == 0 &&
	    arch_pc(&regs) - task->code <= task->bytes && is_wanted(&regs, task->inside))
		options |= seccomp_suspend_option();
	ptrace(PTRACE_SETOPTIONS, task->tid, NULL, options); /* fails if it was killed */
}

void seccomp_at_call(pid_t tid, pid_t inside, long options)
{
	at_call(&(struct task){ tid, inside, options, .bytes = SIZE_MAX });
}

/* Its threads; a process would not be a tracee of ours.  And filters, which take something away. */
static bool is_restoring(const struct arch_regs *regs, pid_t inside)
{
	const uint64_t arg = arch_syscall_arg(regs, 0), second = arch_syscall_arg(regs, 1);

	switch (arch_syscall_nr(regs)) {
	case SYS_clone:
		return arg == SPAWN_FLAGS;
	case SYS_seccomp:
		return arg == SECCOMP_SET_MODE_FILTER &&
		       !(second &
			 ~(uint64_t)(SECCOMP_FILTER_FLAG_LOG | SECCOMP_FILTER_FLAG_SPEC_ALLOW));
	default:
		return is_wanted(regs, inside);
	}
}

void seccomp_at_call_only(pid_t tid, pid_t inside, long options)
{
	struct arch_regs regs;

	if (tracee_enters_call(tid)) {
		if (arch_regs_get(tid, &regs))
			return; /* it was killed */
		if (is_restoring(&regs, inside)) {
			options |= seccomp_suspend_option();
		} else {
			arch_syscall_nr_set(&regs, -1); /* ENOSYS */
			if (arch_regs_set(tid, &regs))
				return;
		}
	}
	ptrace(PTRACE_SETOPTIONS, tid, NULL, options); /* fails if it was killed */
}

long seccomp_go_on(pid_t tid, const struct stop *stop)
{
	const long signal = stop && stop->kind == STOP_SIGNAL ? stop->signal : 0;
	const int i = find(tid);

	if (i < 0)
		return ptrace(PTRACE_CONT, tid, NULL, signal);
	if (stop && stop->kind == STOP_SYSCALL)
		at_call(&supervised.task[i]);
	return ptrace(PTRACE_SYSCALL, tid, NULL, signal);
}
