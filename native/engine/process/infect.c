/* SPDX-License-Identifier: Apache-2.0
 *
 * Parasite and holder are brought into the live app through its main thread; the
 * other threads run on meanwhile.
 *
 * To get the first mapping, the thread makes two system calls (mmap, mprotect)
 * from a stub in the zero padding behind some executable mapping, the vDSO's as
 * a rule.  The stub ends by loading the thread's own registers, so it gets home
 * without us.
 */
#include <errno.h>
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/random.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <sys/wait.h>
#include <unistd.h>

#include "internal.h"

#define CAVE_BYTES 256
#define PADS_START UINT64_C(0x200000000000)
#define PADS (UINT64_C(1) << 19)
#define PARASITE_DISTANCE (UINT64_C(64) << 20)
#define PARASITE_SHARE 16 /* of what may be mapped, the parasite is a 16th at most */
_Static_assert(CAVE_BYTES >= ARCH_STUB_BYTES, "the stub must fit");

/* True if the last bytes of the mapping are a stub that a guard which died could not
 * take away. */
static bool has_stub(int mem_fd, avc_remote end)
{
	uint8_t bytes[CAVE_BYTES];

	return pread(mem_fd, bytes, sizeof bytes, (off_t)(end - sizeof bytes)) == sizeof bytes &&
	       arch_is_stub(bytes);
}

/* True if the last bytes of the mapping are zero padding. */
static bool has_cave(int mem_fd, avc_remote end)
{
	uint8_t bytes[CAVE_BYTES];

	if (pread(mem_fd, bytes, sizeof bytes, (off_t)(end - sizeof bytes)) != sizeof bytes)
		return false;
	for (size_t i = 0; i < sizeof bytes; i++)
		if (bytes[i])
			return false;
	return true;
}

/* True if a parasite may be mapped here (where_to_map). */
static bool is_place_of_pads(avc_remote base)
{
	return base >= PADS_START && base - PADS_START < PADS * PARASITE_DISTANCE &&
	       base % PARASITE_DISTANCE == 0;
}

/* The mapping of a guard that died before it wrote anything is told by its place. */
static void note_old_pad(struct target *target, avc_remote base, avc_remote end)
{
	uint64_t magic;

	if (target->old_parasites == OLD_PARASITES_MAX || base == target->parasite.base ||
	    end - base < INJ_CODE_BYTES + sizeof(struct inj_control) ||
	    pread(target->mem_fd, &magic, sizeof magic,
		  (off_t)(base + INJ_CODE_BYTES + offsetof(struct inj_control, magic))) !=
		    sizeof magic ||
	    (magic != INJ_MAGIC && (magic || !is_place_of_pads(base))))
		return;
	target->old_parasite[target->old_parasites].base = base;
	target->old_parasite[target->old_parasites++].bytes = end - base;
}

/* Finds a cave, and the parasites of guards that died.  Fails if the stopped main thread
 * is still in one of those, or in a stub. */
static int survey(struct target *target, avc_remote pc, avc_remote *cave, struct avc_error *err)
{
	char path[64], line[512];
	avc_remote code = 0, code_end = 0;
	bool in_stub = false;
	FILE *maps;

	*cave = 0;
	target->old_parasites = 0;
	snprintf(path, sizeof path, "/proc/%d/maps", target->pid);
	maps = fopen(path, "re");
	if (!maps)
		return fail_errno(err, target->pid, "infect", "open(maps)", "it has ended");
	while (fgets(line, sizeof line, maps)) {
		unsigned long start, end;
		char mode[5];

		if (sscanf(line, "%lx-%lx %4s", &start, &end, mode) != 3)
			continue;
		if (strstr(line, "/dev/zero (deleted)")) {
			if (!strcmp(mode, "r-xs") && end - start == INJ_CODE_BYTES) {
				code = start;
				code_end = end;
			} else {
				/* In one piece until its first pages are made executable. */
				note_old_pad(target, code && start == code_end ? code : start, end);
				code = 0;
			}
		}
		if (mode[2] == 'x' && mode[3] == 'p' && pc < end && pc >= end - CAVE_BYTES)
			in_stub = has_stub(target->mem_fd, end);
		if (mode[0] == 'r' && mode[2] == 'x' && mode[3] == 'p' &&
		    (!*cave || strstr(line, "[vdso]")) &&
		    (has_cave(target->mem_fd, end) || has_stub(target->mem_fd, end)))
			*cave = end - CAVE_BYTES;
	}
	fclose(maps);
	if (in_stub || in_old_parasite(target, pc))
		return fail(err, AVC_DEADLINE, 0, target->pid, "infect", "",
			    "still on its way home from a guard that died");
	if (!*cave)
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "infect", "",
			    "there is no room for the first injected instructions");
	return 0;
}

/* One system call from the stub.  The thread is in a plain trap stop before and
 * after; its own registers are put back by the caller. */
static int stub_syscall(struct thread *thread, avc_remote cave, long nr, const uint64_t arg[6],
			long *result, struct avc_error *err)
{
	const uint64_t all = ~UINT64_C(0);
	const pid_t tid = thread->tid;
	struct arch_regs regs;

	arch_stub_call(&regs, &thread->regs, cave, nr, arg);
	if (suspend_seccomp(thread, err))
		return -1;
	if (arch_regs_set(tid, &regs) || ptrace(PTRACE_SETSIGMASK, tid, sizeof all, &all))
		return fail_errno(err, tid, "infect", "ptrace(SETREGS)", "it has gone");
	thread->borrowed = true;
	thread->borrowed_for = NULL;
	/* Entry and exit.  Other stops may come in between: job control, or SIGSTOP,
	 * which can not be blocked. */
	for (int stops = 0, signal = 0; stops < 2;) {
		struct stop stop;

		if (ptrace(PTRACE_SYSCALL, tid, NULL, (long)signal))
			return fail_errno(err, tid, "infect", "ptrace(SYSCALL)", "it has gone");
		stop = tracee_wait(tid, 0);
		signal = stop.kind == STOP_SIGNAL ? stop.signal : 0;
		if (stop.kind == STOP_EXIT || stop.kind == STOP_DYING)
			return fail(err, AVC_GONE, 0, tid, "infect", "", "it has ended");
		if (stop.kind == STOP_DEADLINE) {
			thread->stopped = false;
			return fail(err, AVC_DEADLINE, 0, tid, "infect", "",
				    "it did not get to run in time");
		}
		stops += stop.kind == STOP_SYSCALL;
	}
	if (arch_regs_get(tid, &regs))
		return fail_errno(err, tid, "infect", "ptrace(GETREGS)", "it has gone");
	*result = arch_syscall_result(&regs);
	if (tracee_settle(tid, err)) {
		/* It runs: in the stub, which must stay, and home. */
		thread->stopped = false;
		return -1;
	}
	return 0;
}

/* A child has its parent's parasite mapped, and at a restore is there together with it for
 * a moment: each has a place of its own, in a part of the address space that programs
 * do not use by themselves.  The kernel takes another place if this one is taken. */
static uint64_t where_to_map(const struct target *target)
{
	return PADS_START + target->nonce % PADS * PARASITE_DISTANCE;
}

/* RLIMIT_AS counts the parasite, too: what the app could still map before it has to be able to map
 * with it, as far as one can tell.  So only where the parasite is next to nothing of that. */
static int check_room(const struct target *target, size_t bytes, struct avc_error *err)
{
	const long pages = proc_vm_pages(target->statm_fd, NULL);
	uint64_t limit[LIMITS][2];

	if (pages < 0 || proc_limits(target->pid, limit))
		return fail_errno(err, target->pid, "infect", "open(limits)", "it has ended");
	if (limit[RLIMIT_AS][0] == ~UINT64_C(0) ||
	    (uint64_t)pages * ARCH_PAGE_BYTES + PARASITE_SHARE * bytes <= limit[RLIMIT_AS][0])
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, target->pid, "infect", "",
		    "it may map so little more memory (RLIMIT_AS, ulimit -v) that it would miss "
		    "the %zu kB which protection takes",
		    bytes / 1024);
}

static int make_pad(struct target *target, struct thread *thread, avc_remote cave, uint32_t slots,
		    uint32_t threads_max, struct avc_error *err)
{
	struct parasite *parasite = &target->parasite;
	uint64_t arg[6] = { where_to_map(target),   parasite_layout(parasite, slots, threads_max),
			    PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS | MAP_NORESERVE,
			    (uint64_t)-1,           0 };
	long base, result;

	if (check_room(target, parasite->bytes, err))
		return -1;
	if (stub_syscall(thread, cave, SYS_mmap, arg, &base, err))
		return -1;
	if (base < 0 && base > -4096)
		return fail(err, AVC_UNSUPPORTED, (int)-base, target->pid, "infect", "mmap",
			    "it may not map %zu kB more memory", parasite->bytes / 1024);
	if (parasite_open(parasite, target->pid, (avc_remote)base, parasite->bytes, target->nonce,
			  err))
		return -1;
	arg[0] = (uint64_t)base;
	arg[1] = INJ_CODE_BYTES;
	arg[2] = PROT_READ | PROT_EXEC;
	if (stub_syscall(thread, cave, SYS_mprotect, arg, &result, err))
		return -1;
	if (result < 0)
		return fail(err, AVC_UNSUPPORTED, (int)-result, target->pid, "infect", "mprotect",
			    "it may not have new executable memory");
	return 0;
}

/* The main thread, stopped, with everything read that borrowing it needs. */
static struct thread *stop_main(struct target *target, struct avc_error *err)
{
	struct thread *t = thread_find(target, target->pid);

	if (!t)
		t = thread_add(target, target->pid, err);
	if (!t || t->attached) {
		fail(err, AVC_DEADLINE, 0, target->pid, "stop", "",
		     "not back from an earlier attempt yet");
		return NULL;
	}
	t->seen = true;
	rewind_prepare(t);
	if (thread_stop(target, t, err) || thread_await(target, t, err) || thread_read(t, err)) {
		thread_release(t);
		return NULL;
	}
	return t;
}

static int check_task(struct target *target, const struct thread *t, struct avc_error *err)
{
	if (!arch_is_native(&t->regs))
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "infect", "",
			    "it is a 32-bit program");
	return 0;
}

static int infect_thread(struct target *target, struct thread *thread, uint32_t slots,
			 struct avc_error *err)
{
	uint8_t stub[ARCH_STUB_BYTES], zero[ARCH_STUB_BYTES] = { 0 };
	uint32_t threads_max = 32, threads = target->thread_count * 2;
	struct arch_regs home;
	avc_remote cave;
	size_t bytes;
	int result;

	while (threads_max < threads)
		threads_max *= 2;
	parasite_close(&target->parasite);
	memory_forget(target->memory);
	if (getrandom(&target->nonce, sizeof target->nonce, 0) < 0)
		return fail_errno(err, 0, "infect", "getrandom", "no random number");
	/* An exec since then has made another address space of it. */
	close_fd(&target->mem_fd);
	target->mem_fd = proc_open(target->pid, "mem", O_RDWR);
	if (target->mem_fd < 0)
		return fail_errno(err, target->pid, "infect", "open(mem)", "it has ended");
	if (support_check_thread(thread->tid, err) || check_task(target, thread, err) ||
	    survey(target, arch_pc(&thread->regs), &cave, err))
		return -1;
	rseq_fixup(target->mem_fd, thread);
	home = thread->regs;
	arch_resume(&home);
	bytes = arch_stub_build(stub, &home, thread->sigmask);
	if (pwrite(target->mem_fd, stub, bytes, (off_t)cave) != (ssize_t)bytes)
		return fail_errno(err, target->pid, "infect", "write(mem)",
				  "its code can not be written");
	result = make_pad(target, thread, cave, slots, threads_max, err);
	/* Nobody is in the stub any more: leave no trace. */
	if (thread->stopped && (!thread->borrowed || give_back(thread, err) == 0)) {
		if (pwrite(target->mem_fd, zero, bytes, (off_t)cave) != (ssize_t)bytes)
			err->undo_failures++;
	}
	if (result)
		parasite_close(&target->parasite);
	target->infected = !result;
	target->checkpoints = 0;
	return result;
}

int infect(struct target *target, uint32_t slots, timer_t timer, uint64_t deadline_ns,
	   struct avc_error *err)
{
	struct thread *thread;
	int result;

	tracee_deadline_set(timer, deadline_ns);
	thread = stop_main(target, err);
	if (!thread) {
		tracee_deadline_clear(timer);
		return -1;
	}
	result = infect_thread(target, thread, slots, err);
	thread_release(thread);
	tracee_deadline_clear(timer);
	return result;
}

int infect_stopped(struct target *target, uint32_t slots, struct avc_error *err)
{
	struct thread *thread = thread_find(target, target->pid);

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "infect", "",
			    "its main thread has ended");
	if (thread_read(thread, err))
		return -1;
	return infect_thread(target, thread, slots, err);
}

/* ESRCH is of one that is ending: exec(2) has memory, but not this. */
bool has_executed(const struct target *target)
{
	uint64_t nonce = 0;
	struct iovec here = { &nonce, sizeof nonce };
	struct iovec there = { (void *)(target->parasite.base + INJ_CODE_BYTES +
					offsetof(struct inj_control, nonce)),
			       sizeof nonce };
	const ssize_t n = process_vm_readv(target->pid, &here, 1, &there, 1, 0);

	return n == sizeof nonce ? nonce != target->nonce : errno == EFAULT;
}

/* What makes a new task the holder: it lies still, is known as such, and has none of
 * the app's numbers. */
static int make_holder(struct target *target, pid_t holder, const struct arch_regs *base,
		       struct avc_error *err)
{
	struct inj_call *own = &target->parasite.control->holder;
	const struct sched_param first = { .sched_priority = 1 };

	/* It clones while all of the app stands still.  Best effort; not for its clones. */
	if (target->descendant)
		(void)sched_setscheduler(holder, SCHED_FIFO | SCHED_RESET_ON_FORK, &first);
	memcpy(own->out, "avckpt-hold", 12);
	call_begin(own, INJ_AFTER_PARK);
	/* Out of the app's process group, or the number stays taken; and of its session,
	 * which another process of the app may lead. */
	call_add(own, target->descendant ? SYS_setsid : SYS_setpgid, 0, 0, 0, 0, 0);
	call_add(own, SYS_prctl, PR_SET_NAME, parasite_remote(&target->parasite, own->out), 0, 0,
		 0);
	return parasite_send(&target->parasite, holder, base, own, err) ||
			       parasite_run(holder, own, err)
		       ? -1
		       : 0;
}

int adopt_no_more(struct target *target, struct avc_error *err)
{
	struct inj_call *call = &target->parasite.control->runner;
	struct thread *thread = thread_find(target, target->pid);

	if (target->paused)
		return 0;
	call_begin(call, INJ_AFTER_HOME);
	call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0);
	call_add(call, INJ_PAUSE, 0, 0, 0, 0, 0);
	call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0);
	if (borrow(target, thread, err))
		return -1;
	target->paused = true;
	if (parasite_run_to_pause(thread->tid, call, err)) {
		thread->stopped = false; /* on its way through the parasite, and home */
		target->paused = false;
		return -1;
	}
	return 0;
}

int adopt_again(struct target *target, struct avc_error *err)
{
	struct thread *thread = thread_find(target, target->pid);

	if (!target->paused)
		return 0;
	target->paused = false;
	if (parasite_run_on(thread->tid, &target->parasite.control->runner, err)) {
		thread->stopped = false;
		return -1;
	}
	return give_back(thread, err);
}

static int keep_holder(struct target *target, pid_t holder, int result, struct avc_error *err)
{
	target->holder = holder;
	target->held_ns = now_ns();
	target->exec_check_ns = 0;
	target->holder_pidfd = proc_pidfd_open(holder);
	if (!result && target->holder_pidfd >= 0)
		return 0;
	if (!err->code)
		fail_errno(err, holder, "make holder", "pidfd_open", "it was killed");
	unhold(target);
	return -1;
}

static int hold_descendant(struct target *target, timer_t timer, uint64_t deadline_ns,
			   struct avc_error *err)
{
	struct thread *thread;
	int result;

	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	/* All of it: another thread may be waiting for children, of any kind (__WALL). */
	result = stop_process(target, err);
	thread = thread_find(target, target->pid);
	if (!result && (!thread || !thread->stopped))
		result = fail(err, AVC_GONE, 0, target->pid, "make holder", "", "it has ended");
	if (!result)
		result = thread_read(thread, err) || hold_stopped(target, target->init, err);
	let_go_process(target);
	tracee_deadline_clear(timer);
	rt_priority_end();
	return result;
}

int hold(struct target *target, timer_t timer, uint64_t deadline_ns, struct avc_error *err)
{
	struct inj_call *call = &target->parasite.control->runner;
	struct thread *thread;
	struct arch_regs base;
	pid_t holder = 0;
	int result;

	if (target->descendant)
		return hold_descendant(target, timer, deadline_ns, err);
	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	thread = stop_main(target, err);
	if (!thread) {
		tracee_deadline_clear(timer);
		rt_priority_end();
		return -1;
	}
	call_begin(call, INJ_AFTER_HOME);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD, 0, 0, 0, 0);
	result = borrow(target, thread, err);
	if (!result) {
		result = parasite_run_clone(thread->tid, call, &holder, err);
		target->lost = target->lost || (result && err->code != AVC_KERNEL);
	}
	if (!result)
		result = tracee_settle(thread->tid, err);
	else if (err->code == AVC_DEADLINE && thread->borrowed)
		thread->stopped = false; /* on its way through the parasite, and home */
	if (!result)
		result = give_back(thread, err);
	thread_release(thread);
	tracee_deadline_clear(timer);
	rt_priority_end();
	if (!holder)
		return -1;
	/* It must never run on by itself: it has the app's memory for a stack. */
	tracee_deadline_set(timer, NS_PER_S);
	if (tracee_await(holder, NULL, err) != STOP_TRAP)
		result = -1;
	if (ptrace(PTRACE_SETOPTIONS, holder, NULL, (long)TRACE_OPTIONS_OURS) ||
	    arch_regs_get(holder, &base))
		result = fail_errno(err, holder, "make holder", "ptrace(SETOPTIONS)",
				    "it has ended");
	if (!result)
		result = make_holder(target, holder, &base, err);
	tracee_deadline_clear(timer);
	return keep_holder(target, holder, result, err);
}

/* A stopped task in the parasite makes one clone; *child is in its first stop. */
static int clone_by(struct target *target, pid_t tid, const struct arch_regs *base,
		    struct inj_call *call, uint64_t flags, pid_t *child, struct avc_error *err)
{
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, flags, 0, 0, 0, 0);
	if (parasite_send(&target->parasite, tid, base, call, err) ||
	    parasite_run_clone(tid, call, child, err))
		return -1;
	if (tracee_await(*child, NULL, err) != STOP_TRAP)
		return -1;
	if (ptrace(PTRACE_SETOPTIONS, *child, NULL, (long)TRACE_OPTIONS_OURS))
		return fail_errno(err, *child, "make holder", "ptrace(SETOPTIONS)", "it has ended");
	return 0;
}

/* The holder of a process that is not the main one must not be a child of anybody in the
 * app: wait(2) would find it.  So a task in between makes it, and ends, whereupon it is
 * init's; and the one in between is waited for by its parent, which does so in any case
 * before it goes home, whether we are still there or not.  It has no exit signal, so that
 * nobody is told.
 *
 * This holder also makes the templates.  They have its signal handlers and working
 * directory, which are therefore shared with the app (CLONE_SIGHAND, CLONE_FS). */
int hold_stopped(struct target *target, pid_t init, struct avc_error *err)
{
	struct inj_call *call = &target->parasite.control->runner;
	struct thread *thread = thread_find(target, target->pid);
	struct proc_stat stat = { 0 };
	pid_t between = 0, holder = 0;
	int result;

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "make holder", "",
			    "its main thread has ended");
	call_begin(call, INJ_AFTER_HOME);
	if (thread->creds.subreaper)
		call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_FS | CLONE_SIGHAND, 0, 0, 0, 0);
	call_add(call, INJ_WAIT, 0, 0, 0, 0, 0);
	if (thread->creds.subreaper)
		call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0);
	if (borrow(target, thread, err))
		return -1;
	target->waiting = true;
	result = parasite_run_clone(thread->tid, call, &between, err);
	if (result) {
		target->lost = target->lost || err->code != AVC_KERNEL;
		thread_runs_on(thread, err);
		return -1;
	}
	if (tracee_await(between, NULL, err) != STOP_TRAP ||
	    ptrace(PTRACE_SETOPTIONS, between, NULL, (long)TRACE_OPTIONS_OURS) ||
	    arch_regs_get(between, &target->holder_base))
		result = fail_errno(err, between, "make holder", "ptrace(SETOPTIONS)",
				    "it has ended");
	if (!result)
		result = clone_by(target, between, &target->holder_base,
				  &target->parasite.control->holder,
				  CLONE_VM | CLONE_FILES | CLONE_FS | CLONE_SIGHAND | SIGCHLD,
				  &holder, err);
	tracee_kill(between);
	if (!result)
		result = make_holder(target, holder, &target->holder_base, err);
	if (!result && proc_stat(holder, &stat))
		result = fail_errno(err, holder, "make holder", "open(stat)", "it was killed");
	if (!result && stat.parent != init)
		result = fail(err, AVC_DEADLINE, EAGAIN, target->pid, "make holder", "",
			      "a process above it adopts orphans now (PR_SET_CHILD_SUBREAPER)");
	if (holder && keep_holder(target, holder, result, err))
		result = -1;
	if (parasite_run(thread->tid, call, err)) {
		thread->stopped = false;
		return -1;
	}
	target->waiting = false;
	return give_back(thread, err) || result ? -1 : 0;
}

static void forget_holder(struct target *target)
{
	target->doubtful = false;
	target->holder = 0;
	target->holder_pidfd = -1;
}

void unhold(struct target *target)
{
	if (target->holder)
		tracee_kill(target->holder);
	close_fd(&target->holder_pidfd);
	forget_holder(target);
}

void unhold_soon(struct target *target)
{
	if (target->holder)
		tracee_end(target->holder, target->holder_pidfd);
	forget_holder(target);
}
