/* SPDX-License-Identifier: Apache-2.0
 *
 * Seccomp filters stay in force over injected code. The container's allow what it calls; so do most
 * that applications install. Where they refuse it, injected code is *supervised*: its tracer stops
 * it at the entry to every system call, and suspends the filters (PTRACE_O_SUSPEND_SECCOMP) for that
 * call alone, if it is one that injected code makes, and made by that. This decision uses nothing
 * that the application can write. At the entry the registers are fixed in the kernel: whatever the
 * application does to the parasite, its stack or its lists, or maps in its place, leads to calls
 * that its own filter checks, or to some of those below.
 *
 * The suspension ends with the tracer.  Injected code then goes on to the end of its list, and home,
 * under filters that may refuse each of its calls, but must kill for none (also strict mode does),
 * and must allow those that undo and go home.  Others are not protected.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "trace.h"

#define ANY (~UINT64_C(0))
#define SUPERVISED_MAX 512
/* Threads of a process being restored (parasite.c, spawn()). */
#define SPAWN_FLAGS                                                                         \
	(CLONE_VM | CLONE_FS | CLONE_FILES | CLONE_SIGHAND | CLONE_THREAD | CLONE_SYSVSEM | \
	 CLONE_SETTLS)

/* A system call, with the first argument where a filter is likely to check it. */
struct kind {
	long nr;
	uint64_t arg; /* ANY: it varies */
};

/* The calls of injected code. */
static const struct kind wanted[] = {
	/* control */
	{ SYS_futex, ANY },
	{ SYS_ppoll, ANY },
	{ SYS_nanosleep, ANY },
	{ SYS_rt_sigprocmask, SIG_SETMASK },
	{ SYS_exit, ANY },
	{ SYS_exit_group, ANY },
	{ SYS_wait4, ANY },
	{ SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD },
	{ SYS_clone, CLONE_VM | CLONE_FILES },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_THREAD | CLONE_SIGHAND | CLONE_FS },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND | SIGCHLD },
	{ SYS_clone, SPAWN_FLAGS },
	{ SYS_setpgid, ANY },
	{ SYS_setsid, ANY },
	/* queries of a template */
	{ SYS_brk, 0 },
	{ SYS_prctl, PR_GET_THP_DISABLE },
	{ SYS_prctl, 68 /* PR_GET_MEMORY_MERGE */ },
	{ SYS_pkey_alloc, ANY },
	{ SYS_get_robust_list, ANY },
	/* queries */
	{ SYS_prctl, PR_GET_TID_ADDRESS },
	{ SYS_prctl, PR_GET_NAME },
	{ SYS_prctl, PR_GET_DUMPABLE },
	{ SYS_prctl, PR_GET_SECUREBITS },
	{ SYS_prctl, PR_GET_NO_NEW_PRIVS },
	{ SYS_prctl, PR_GET_TIMERSLACK },
	{ SYS_prctl, PR_GET_PDEATHSIG },
	{ SYS_prctl, PR_GET_CHILD_SUBREAPER },
	{ SYS_prctl, PR_CAPBSET_READ },
	{ SYS_gettid, ANY },
	{ SYS_getpid, ANY },
	{ SYS_sigaltstack, ANY },
	{ SYS_getgroups, ANY },
	{ SYS_getresuid, ANY },
	{ SYS_getresgid, ANY },
	{ SYS_setfsuid, ANY },
	{ SYS_setfsgid, ANY },
	{ SYS_capget, ANY },
	{ SYS_get_mempolicy, ANY },
	{ SYS_personality, 0xffffffff },
	{ ARCH_STATE_CALL, ARCH_STATE_PERMITTED },
	{ SYS_getitimer, ANY },
	{ SYS_timer_gettime, ANY },
	{ SYS_clock_gettime, ANY },
	{ SYS_waitid, ANY },
	{ SYS_mincore, ANY },
	{ SYS_rseq, ANY },
	{ SYS_prctl, PR_SET_NAME },
	{ SYS_prctl, PR_SET_CHILD_SUBREAPER },
	{ SYS_rt_sigaction, ANY },
	/* memory and descriptors */
	{ SYS_mmap, ANY },
	{ SYS_munmap, ANY },
	{ SYS_mprotect, ANY },
	{ SYS_mremap, ANY },
	{ SYS_madvise, ANY },
	{ SYS_membarrier, ANY },
	{ SYS_mlockall, ANY },
	{ SYS_close, ANY },
	{ SYS_close_range, ANY },
	{ SYS_dup3, ANY },
	{ SYS_fcntl, ANY },
	{ SYS_epoll_ctl, ANY },
	{ SYS_pidfd_open, ANY },
	{ SYS_socketpair, ANY },
	{ SYS_recvmsg, ANY },
	{ SYS_setsockopt, ANY },
};

/* And those of a process being restored: one with its own filters is then supervised in any case
 * (sandbox.c). */
static const struct kind wanted_to_restore[] = {
	{ SYS_prctl, PR_SET_DUMPABLE },
	{ SYS_prctl, PR_SET_KEEPCAPS },
	{ SYS_prctl, PR_SET_SECUREBITS },
	{ SYS_prctl, PR_SET_NO_NEW_PRIVS },
	{ SYS_prctl, PR_SET_TIMERSLACK },
	{ SYS_prctl, PR_SET_PDEATHSIG },
	{ SYS_prctl, PR_CAPBSET_DROP },
	{ SYS_prctl, PR_CAP_AMBIENT },
	{ SYS_prctl, 77 /* PR_TIMER_CREATE_RESTORE_IDS */ },
	{ SYS_set_tid_address, ANY },
	{ SYS_set_robust_list, ANY },
	{ SYS_rt_sigqueueinfo, ANY },
	{ SYS_rt_tgsigqueueinfo, ANY },
	{ SYS_tgkill, ANY },
	{ SYS_sched_setaffinity, ANY },
	{ SYS_set_mempolicy, ANY },
	{ SYS_setgroups, ANY },
	{ SYS_setresuid, ANY },
	{ SYS_setresgid, ANY },
	{ SYS_capset, ANY },
	{ SYS_prlimit64, ANY },
	{ SYS_setitimer, ANY },
	{ SYS_timer_create, ANY },
	{ SYS_timer_settime, ANY },
	{ SYS_timer_delete, ANY },
	{ SYS_mlock2, ANY },
	{ SYS_listen, ANY },
	{ SYS_userfaultfd, ANY },
	{ SYS_ioctl, ANY }, /* TIOCSPGRP, TIOCSCTTY                            */
	{ SYS_umask, ANY },
	{ SYS_fchdir, ANY },
	{ SYS_rt_sigtimedwait, ANY },
	{ SYS_pkey_free, ANY },
	{ SYS_pkey_mprotect, ANY },
	ARCH_ROOM_CALLS
};

/* Of processes below the main one, which are made as forks of it.  They are not supervised for all
 * of these: the application's own filters must allow them, and those above. */
static const struct kind wanted_for_trees[] = {
	{ SYS_clone, CLONE_FILES | SIGCHLD },
	{ SYS_clone, SIGCHLD },
	{ SYS_personality, ANY },
	{ SYS_brk, ANY },
	{ SYS_shmat, ANY },
	{ SYS_chroot, ANY },
	{ SYS_fcntl, ANY },
	{ SYS_write, ANY },
	{ SYS_read, ANY },
	{ SYS_kill, ANY },
	{ SYS_prctl, 41 /* PR_SET_THP_DISABLE */ },
	{ SYS_prctl, 67 /* PR_SET_MEMORY_MERGE */ },
	{ SYS_prctl, PR_SET_MM },
};

/* What the container's own filters must allow, too, if none can be suspended: an application need not
 * make such calls. */
static const struct kind needed[] = {
	/* of the porter, and the stub that clones it (porter.c) */
	{ SYS_rt_sigprocmask, SIG_SETMASK },
	{ SYS_clone, CLONE_VM | CLONE_FILES },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_THREAD | CLONE_SIGHAND | CLONE_FS },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD },
	{ SYS_wait4, ANY },
	{ SYS_waitid, ANY },
	{ SYS_mmap, ANY },
	{ SYS_mprotect, ANY },
	{ SYS_close_range, ANY },
	{ SYS_socketpair, AF_UNIX },
	{ SYS_recvmsg, ANY },
	{ SYS_close, ANY },
	{ SYS_exit, ANY },
};
static const struct kind needed_to_watch = { SYS_userfaultfd, ANY };
/* INJ_CLOSE_CLAIMS */
static const struct kind needed_to_ask[] = {
	{ SYS_getsockopt, ANY },
	{ SYS_getsockname, ANY },
	{ SYS_getpeername, ANY },
	{ SYS_fstat, ANY },
};

/* What must not be refused when the guard has died in the middle: the thread's signals would stay
 * blocked, its memory would stay as it is for a clone, a porter would call exit(2) for ever.  And
 * nothing could be restored without rt_sigreturn(2). */
static const struct homeward {
	struct kind call;
	const char *name;
} homeward[] = {
	{ { SYS_rt_sigprocmask, SIG_SETMASK }, "rt_sigprocmask" },
	{ { SYS_rt_sigreturn, ANY }, "rt_sigreturn" },
	{ { SYS_munmap, ANY }, "munmap" },
	{ { SYS_madvise, ANY }, "madvise" },
	{ { SYS_exit, ANY }, "exit" },
};

#define COUNT(array) (sizeof(array) / sizeof *(array))

/* ---- what a filter says --------------------------------------------------------------------- */

struct program {
	struct sock_filter insn[BPF_MAXINSNS];
	long count;
};

/* The classic BPF of seccomp(2), with only the number, the architecture and, if it is not ANY, the
 * first argument known. A filter that reads anything else may return anything that is in it. */
#define DEPENDS 0xffff0000U /* no action                                            */

static bool load(uint32_t at, long nr, uint64_t arg, uint32_t *value)
{
	if (at == offsetof(struct seccomp_data, nr))
		*value = (uint32_t)nr;
	else if (at == offsetof(struct seccomp_data, arch))
		*value = ARCH_AUDIT;
	else if (arg != ANY && at == offsetof(struct seccomp_data, args))
		*value = (uint32_t)arg;
	else if (arg != ANY && at == offsetof(struct seccomp_data, args) + 4)
		*value = (uint32_t)(arg >> 32);
	else
		return false;
	return true;
}

static bool compute(uint16_t op, uint32_t operand, uint32_t *a)
{
	switch (op) {
	case BPF_ADD:
		*a += operand;
		return true;
	case BPF_SUB:
		*a -= operand;
		return true;
	case BPF_AND:
		*a &= operand;
		return true;
	case BPF_OR:
		*a |= operand;
		return true;
	case BPF_XOR:
		*a ^= operand;
		return true;
	case BPF_LSH:
		*a = operand < 32 ? *a << operand : 0;
		return true;
	case BPF_RSH:
		*a = operand < 32 ? *a >> operand : 0;
		return true;
	case BPF_NEG:
		*a = -*a;
		return true;
	default:
		return false;
	}
}

static bool compare(uint16_t op, uint32_t a, uint32_t operand)
{
	switch (op) {
	case BPF_JEQ:
		return a == operand;
	case BPF_JGT:
		return a > operand;
	case BPF_JGE:
		return a >= operand;
	default:
		return a & operand; /* BPF_JSET */
	}
}

static uint32_t run(const struct program *p, long nr, uint64_t arg)
{
	uint32_t a = 0, x = 0, mem[BPF_MEMWORDS] = { 0 };

	/* All jumps go forward. */
	for (long pc = 0; pc < p->count; pc++) {
		const struct sock_filter *f = &p->insn[pc];
		const uint32_t operand = BPF_SRC(f->code) == BPF_X ? x : f->k;
		uint32_t *to = BPF_CLASS(f->code) == BPF_LDX ? &x : &a;

		switch (BPF_CLASS(f->code)) {
		case BPF_LD:
		case BPF_LDX:
			if (BPF_MODE(f->code) == BPF_IMM)
				*to = f->k;
			else if (BPF_MODE(f->code) == BPF_MEM && f->k < BPF_MEMWORDS)
				*to = mem[f->k];
			else if (BPF_MODE(f->code) != BPF_ABS || !load(f->k, nr, arg, to))
				return DEPENDS;
			break;
		case BPF_ST:
		case BPF_STX:
			if (f->k >= BPF_MEMWORDS)
				return DEPENDS;
			mem[f->k] = BPF_CLASS(f->code) == BPF_ST ? a : x;
			break;
		case BPF_ALU:
			if (!compute(BPF_OP(f->code), operand, &a))
				return DEPENDS;
			break;
		case BPF_JMP:
			if (BPF_OP(f->code) == BPF_JA)
				pc += f->k;
			else
				pc += compare(BPF_OP(f->code), a, operand) ? f->jt : f->jf;
			break;
		case BPF_RET:
			return BPF_RVAL(f->code) == BPF_A ? a : f->k;
		default: /* BPF_MISC */
			if (BPF_MISCOP(f->code) == BPF_TAX)
				x = a;
			else
				a = x;
		}
	}
	return DEPENDS;
}

/* Whether it prevents a call, and how. The most severe of several filters counts. */
enum verdict {
	PASSES,
	REFUSES,
	MAY_REFUSE,
	ENDS /* the task, or the call is not what it seems: it asks another process, or lies   */
};

static enum verdict verdict_of(uint32_t result)
{
	switch (result & SECCOMP_RET_ACTION_FULL) {
	case SECCOMP_RET_ALLOW:
	case SECCOMP_RET_LOG:
		return PASSES;
	case SECCOMP_RET_ERRNO:
		return result & SECCOMP_RET_DATA ? REFUSES : ENDS;
	default:
		return ENDS;
	}
}

static bool may_end(const struct program *p)
{
	for (long i = 0; i < p->count; i++)
		if (BPF_CLASS(p->insn[i].code) == BPF_RET &&
		    (BPF_RVAL(p->insn[i].code) == BPF_A || verdict_of(p->insn[i].k) == ENDS))
			return true;
	return false;
}

static enum verdict verdict(const struct program *p, long nr, uint64_t arg)
{
	const uint32_t result = run(p, nr, arg);

	if (result == DEPENDS)
		return may_end(p) ? ENDS : MAY_REFUSE;
	return verdict_of(result);
}

/* Whether it prevents a call of injected code.  Fails if such code would do harm under it without a
 * tracer.  The app cannot have made a call that the container's own filters refuse, so that is not
 * needed. */
static int judge(const struct program *p, bool containers, pid_t tid, bool *barred,
		 struct avc_error *err)
{
	for (size_t i = 0; i < COUNT(wanted); i++) {
		const enum verdict v = verdict(p, wanted[i].nr, wanted[i].arg);

		if (v == ENDS)
			return fail(
				err, AVC_UNSUPPORTED, 0, tid, "check", "",
				"it has a seccomp filter that may kill it, if the guard dies in "
				"a checkpoint, for what that calls (system call %ld)",
				wanted[i].nr);
		*barred |= v == MAY_REFUSE || (v == REFUSES && !containers);
	}
	for (size_t i = 0; i < COUNT(homeward); i++)
		if (verdict(p, homeward[i].call.nr, homeward[i].call.arg) != PASSES)
			return fail(err, AVC_UNSUPPORTED, 0, tid, "check", "",
				    "it has a seccomp filter that may refuse %s, without which it "
				    "would not go on as before if the guard died in a checkpoint",
				    homeward[i].name);
	return 0;
}

static bool refuses_any(const struct program *p, const struct kind *kinds, size_t count)
{
	for (size_t i = 0; i < count; i++)
		if (verdict(p, kinds[i].nr, kinds[i].arg) != PASSES)
			return true;
	return false;
}

static bool hinders_trees(const struct program *p)
{
	return refuses_any(p, wanted_to_restore, COUNT(wanted_to_restore)) ||
	       refuses_any(p, wanted_for_trees, COUNT(wanted_for_trees));
}

/* Where the kernel would continue an interrupted call. */
static const struct kind restarts[] = { { SYS_restart_syscall, ANY } };
/* ... and we (cut.c): with another first argument, and from elsewhere. */
static const struct kind rests[] = {
	{ SYS_write, ANY },
	{ SYS_sendto, ANY },
	{ SYS_recvfrom, ANY },
};

/* The container's filters, as of the first thread that was looked at. */
static struct {
	bool known, hinder, refuse_watching, refuse_asking, bar_restart, bar_rest;
} containers_filters;

static void note_containers(const struct program *p, bool barred)
{
	containers_filters.hinder |= refuses_any(p, needed, COUNT(needed)) || barred;
	containers_filters.refuse_asking |= refuses_any(p, needed_to_ask, COUNT(needed_to_ask));
	containers_filters.bar_restart |= refuses_any(p, restarts, COUNT(restarts));
	containers_filters.bar_rest |= refuses_any(p, rests, COUNT(rests));
	containers_filters.refuse_watching |= verdict(p, needed_to_watch.nr, needed_to_watch.arg) !=
					      PASSES;
}

/* ---- a guard that has a filter of its own ----------------------------------------------------- */

/* The kernel lets it neither read the filters of others nor suspend them (kernel/seccomp.c,
 * seccomp_get_filter(); kernel/ptrace.c, check_ptrace_options()). So it can only go on as long as no
 * task has more filters than the container, whose filters it has read before. */
static struct {
	bool is, met;
} confined;

bool seccomp_can_be_confined(void)
{
	return containers_filters.known && !containers_filters.hinder;
}

bool seccomp_refuses_watching(void)
{
	return containers_filters.refuse_watching;
}

bool seccomp_refuses_asking(void)
{
	return containers_filters.refuse_asking;
}

void seccomp_confined(void)
{
	confined.is = true;
}

bool seccomp_is_confined(void)
{
	return confined.is;
}

bool seccomp_must_suspend(void)
{
	return confined.met;
}

static long suspend_option(void)
{
	return confined.is ? 0 : PTRACE_O_SUSPEND_SECCOMP;
}

bool seccomp_is_containers(const struct proc_status *status, uint32_t containers)
{
	const bool is = status->seccomp != SECCOMP_MODE_STRICT &&
			status->seccomp_filters <= containers;

	confined.met |= confined.is && !is;
	return is;
}

static bool parse_counts(const char *text, struct proc_status *status)
{
	const char *mode = strstr(text, "\nSeccomp:"), *count = strstr(text, "\nSeccomp_filters:"),
		   *umask = strstr(text, "\nUmask:");

	if (!mode || !count || !umask)
		return false;
	status->umask = (uint32_t)strtoul(umask + strlen("\nUmask:"), NULL, 8);
	status->seccomp = (uint32_t)atoi(mode + strlen("\nSeccomp:"));
	status->seccomp_filters = (uint32_t)atoi(count + strlen("\nSeccomp_filters:"));
	return true;
}

/* Only these lines, and from an open file where there is one, because all of this is done while
 * the application is stopped. */
static int read_counts(pid_t tid, int status_fd, struct proc_status *status)
{
	char text[8192];
	const ssize_t n = status_fd < 0 ? -1 : pread(status_fd, text, sizeof text - 1, 0);

	if (n > 0) {
		text[n] = 0;
		if (parse_counts(text, status))
			return 0;
	}
	return proc_status(tid, status);
}

/* It is stopped: nothing but another thread of its process could give it a filter. */
static int read_confined(const struct process *process, struct thread *thread, int status_fd,
			 struct avc_error *err)
{
	struct proc_status status;

	if (read_counts(thread->tid, status_fd, &status))
		return fail_errno(err, thread->tid, "run injected code", "open(status)",
				  "it has ended");
	thread->umask = (int32_t)status.umask;
	thread->seccomp = process->plain_filters ? SECCOMP_IN_FORCE : SECCOMP_NONE;
	return seccomp_is_containers(&status, process->plain_filters)
		       ? 0
		       : fail(err, AVC_DEADLINE, 0, thread->tid, "run injected code", "",
			      "it has a seccomp filter of its own now, which takes another guard");
}

static long filter_get(pid_t tid, uint32_t index, void *insn)
{
	return ptrace(PTRACE_SECCOMP_GET_FILTER, tid, (long)index, insn);
}

/* A task without any filter may be in strict mode. */
static int read_none(struct thread *thread, int status_fd, struct avc_error *err)
{
	struct proc_status status;

	if (read_counts(thread->tid, status_fd, &status))
		return fail_errno(err, thread->tid, "run injected code", "open(status)",
				  "it has ended");
	thread->umask = (int32_t)status.umask;
	thread->seccomp = SECCOMP_NONE;
	return status.seccomp == SECCOMP_MODE_STRICT
		       ? fail(err, AVC_UNSUPPORTED, 0, thread->tid, "check", "",
			      "it is in seccomp's strict mode, which would kill it if the guard "
			      "died in a checkpoint")
		       : 0;
}

int seccomp_read(const struct process *process, struct thread *thread, struct avc_error *err)
{
	const int status_fd = thread->tid == process->pid ? process->status_fd : -1;
	const uint32_t containers = process->plain_filters;
	bool barred = false, less = false;
	struct program p;
	uint32_t i;

	if (confined.is)
		return read_confined(process, thread, status_fd, err);
	/* Filters are only ever added. */
	if (thread->filters_known && filter_get(thread->tid, thread->filters_known, NULL) < 0 &&
	    errno == ENOENT)
		return 0;
	for (i = 0; (p.count = filter_get(thread->tid, i, p.insn)) > 0; i++) {
		if (judge(&p, i < containers, thread->tid, &barred, err))
			return -1;
		if (i < containers && !containers_filters.known)
			note_containers(&p, barred);
		less = less || (i >= containers && hinders_trees(&p));
	}
	if (errno == EMEDIUMTYPE)
		return fail(err, AVC_UNSUPPORTED, 0, thread->tid, "check", "",
			    "it has a seccomp filter that cannot be read");
	if (errno != ENOENT && errno != EINVAL)
		return fail_errno(err, thread->tid, "run injected code",
				  "ptrace(SECCOMP_GET_FILTER)", "its filters cannot be read");
	containers_filters.known |= i >= containers;
	if (!i)
		return read_none(thread, status_fd, err);
	thread->filters_known = i;
	thread->seccomp = barred ? SECCOMP_SUPERVISED : less ? SECCOMP_LESS : SECCOMP_IN_FORCE;
	return 0;
}

/* A guard that cannot read them assumes it of all that are not the container's. */
static bool has_own(struct process *process)
{
	struct proc_status status;

	if (!process->filters_seen)
		process->filters_own = read_counts(process->pid, process->status_fd, &status) ==
					       0 &&
				       !seccomp_is_containers(&status, process->plain_filters);
	process->filters_seen = true;
	return process->filters_own;
}

static bool own_refuse(struct process *process, pid_t tid, const struct kind *kinds, size_t count)
{
	struct program p;

	if (confined.is)
		return has_own(process);
	for (uint32_t i = process->plain_filters; (p.count = filter_get(tid, i, p.insn)) > 0; i++)
		if (refuses_any(&p, kinds, count))
			return true;
	return errno == EMEDIUMTYPE; /* it cannot be read */
}

bool seccomp_bars_restart(struct process *process, pid_t tid)
{
	return containers_filters.bar_restart ||
	       own_refuse(process, tid, restarts, COUNT(restarts));
}

bool seccomp_bars_rest(struct process *process, pid_t tid)
{
	return !containers_filters.known || containers_filters.bar_rest ||
	       own_refuse(process, tid, rests, COUNT(rests));
}

/* ---- supervision ---------------------------------------------------------------------------- */

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

static bool is_among(const struct kind *kinds, size_t count, long nr, uint64_t arg)
{
	for (size_t i = 0; i < count; i++)
		if (kinds[i].nr == nr && (kinds[i].arg == ANY || kinds[i].arg == arg))
			return true;
	return false;
}

/* Whether injected code makes such a call; `inside` is its process's own PID. */
static bool is_wanted(const struct arch_regs *regs, pid_t inside)
{
	const long nr = arch_syscall_nr(regs);
	const uint64_t arg = arch_syscall_arg(regs, 0);

	if (!is_among(wanted, COUNT(wanted), nr, arg) &&
	    !is_among(wanted_to_restore, COUNT(wanted_to_restore), nr, arg))
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
		options |= suspend_option();
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
			options |= suspend_option();
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
