/* SPDX-License-Identifier: Apache-2.0
 *
 * The porter: a task with the memory of the app, which maps the parasite there.
 *
 * The main thread clones it, from a stub.  The porter unshares the app's descriptor table, so that it
 * never uses a number there; in its own table it receives the memory over a socket, maps it, and
 * exits.  It makes one system call at a time, with every register set by the guard.
 */
#include <fcntl.h>
#include <linux/close_range.h>
#include <sched.h>
#include <signal.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "infect.h"

#define PADS_START UINT64_C(0x200000000000)
#define PADS (UINT64_C(1) << 19)
#define PARASITE_DISTANCE (UINT64_C(64) << 20)
#define PARASITE_SHARE 16 /* the parasite may be at most a 16th of what may still be mapped */

/* ---- its calls ------------------------------------------------------------------------------- */

static int step_failed(const struct stop *stop, pid_t tid, struct avc_error *err)
{
	if (stop->kind == STOP_DEADLINE)
		return fail(err, AVC_DEADLINE, 0, tid, "infect", "",
			    "it did not get to run in time");
	return fail(err, AVC_GONE, 0, tid, "infect", "", "it has ended");
}

/* To the next entry into a system call, exit from one, or new task.  Other stops may come in
 * between: job control, or SIGSTOP, which cannot be blocked. */
static int step(pid_t tid, struct stop *stop, struct avc_error *err)
{
	do {
		if (seccomp_go_on(tid, stop))
			return fail_errno(err, tid, "infect", "ptrace(SYSCALL)", "it has gone");
		*stop = tracee_wait(tid, 0);
		if (stop->kind == STOP_EXIT || stop->kind == STOP_DYING ||
		    stop->kind == STOP_DEADLINE)
			return step_failed(stop, tid, err);
	} while (stop->kind != STOP_SYSCALL && stop->kind != STOP_FORK);
	return 0;
}

/* From stop to stop, to the exit from a call `nr` that will not be restarted. 1: on the way it has
 * created *child. */
static int step_over(pid_t tid, long nr, long *result, pid_t *child, struct avc_error *err)
{
	struct stop stop = { .kind = STOP_OTHER };
	struct arch_regs regs;

	for (;;) {
		if (step(tid, &stop, err))
			return -1;
		if (stop.kind == STOP_FORK && child) {
			*child = stop.message;
			return 1;
		}
		if (stop.kind == STOP_FORK || tracee_enters_call(tid))
			continue;
		if (arch_regs_get(tid, &regs))
			return fail_errno(err, tid, "infect", "ptrace(GETREGS)", "it has gone");
		*result = arch_syscall_result(&regs);
		/* -ERESTARTSYS and its like (include/linux/errno.h): for a SIGSTOP. */
		if (arch_syscall_nr(&regs) == nr && (*result > -512 || *result < -516))
			return 0;
	}
}

/* The task that injects the parasite.  For the main process it is a child of init.  A child of
 * another process could be reaped by that process's own threads (__WALL), even before the stub
 * does: there it is a thread, which needs no wait, and which exits by itself, because killing it
 * would kill the process. */
struct porter {
	pid_t tid; /* 0: there is none                                     */
	bool is_thread;
	avc_remote cave;
	const struct arch_regs *base;
};

static int porter_call(const struct porter *porter, long nr, const uint64_t arg[6], long *result,
		       struct avc_error *err)
{
	struct arch_regs regs;

	arch_stub_call(&regs, porter->base, porter->cave, true, nr, arg);
	if (arch_regs_set(porter->tid, &regs))
		return fail_errno(err, porter->tid, "infect", "ptrace(SETREGS)", "it has gone");
	return step_over(porter->tid, nr, result, NULL, err);
}

/* One that must not fail. */
static int porter_must(const struct porter *porter, const char *name, const char *problem, long nr,
		       const uint64_t arg[6], struct avc_error *err)
{
	long result;

	if (porter_call(porter, nr, arg, &result, err))
		return -1;
	if (result < 0 && result > -4096)
		return fail(err, AVC_UNSUPPORTED, (int)-result, porter->tid, "infect", name, "%s",
			    problem);
	return 0;
}

/* ---- its life -------------------------------------------------------------------------------- */

static int open_pidfd(pid_t tid, bool is_thread)
{
	return (int)syscall(SYS_pidfd_open, tid, is_thread ? PIDFD_THREAD_ : 0);
}

bool porter_can_be_thread(void)
{
	int pidfd = open_pidfd((pid_t)syscall(SYS_gettid), true);
	const bool can = pidfd >= 0;

	close_fd(&pidfd);
	return can;
}

/* A process that is killed right then tells of no new thread, which is our tracee all the same: it has
 * to be waited for, or the process would not end. */
static int adopt_unseen(int tid, void *arg)
{
	struct process *process = arg;
	struct avc_error ignored = { 0 };
	struct thread *unseen;

	if (thread_find(process, tid) || !tracee_is_ours(tid))
		return 0;
	unseen = thread_add(process, tid, &ignored);
	if (unseen)
		unseen->attached = true;
	return 0;
}

/* The main thread clones it, and stays in the event's stop. */
static int make_porter(struct process *process, struct thread *thread, struct porter *porter,
		       struct avc_error *err)
{
	const uint64_t all = ~UINT64_C(0);
	/* Not CLONE_SYSVSEM: the kernel would give the process a list of semaphores to be undone, which
	 * stays, and which kcmp(2) can tell from that of its parent: none. */
	const uint64_t shared = porter->is_thread     ? CLONE_THREAD | CLONE_SIGHAND | CLONE_FS
				: process->descendant ? 0
						      : CLONE_PARENT | SIGCHLD;
	const uint64_t arg[6] = { CLONE_VM | CLONE_FILES | shared };
	const long options = (long)(porter->is_thread ? TRACE_OPTIONS_APP : TRACE_OPTIONS_OURS);
	struct arch_regs homeward, regs;
	long refused;
	int born;

	/* If we die before its signals are blocked, it must not clone a porter, which would handle
	 * the app's signals on its stack: it makes a call that fails (a mask of 0 bytes) and
	 * returns.  But it is never in the app with every signal blocked. */
	thread->borrowed_for = NULL;
	thread->stub = porter->cave;
	thread_head_home(thread, &homeward);
	arch_stub_call(&regs, &thread->regs, porter->cave, false, SYS_clone, arg);
	if (seccomp_supervise(thread->tid, process->inside, (long)TRACE_OPTIONS_APP, porter->cave,
			      ARCH_STUB_BYTES) ||
	    arch_regs_set(thread->tid, &homeward) ||
	    ptrace(PTRACE_SETSIGMASK, thread->tid, sizeof all, &all) ||
	    arch_regs_set(thread->tid, &regs))
		return fail_errno(err, thread->tid, "infect", "ptrace(SETREGS)", "it has gone");
	thread->borrowed = true;
	born = step_over(thread->tid, SYS_clone, &refused, &porter->tid, err);
	if (born < 0) {
		process->lost = true;
		thread->stopped = false; /* it runs: in the stub, which must stay, and back */
		if (porter->is_thread && err->code == AVC_GONE)
			(void)proc_numbers(process->task_dirfd, adopt_unseen, process);
		return -1;
	}
	if (!born) {
		if (tracee_settle(thread->tid, err)) {
			thread->stopped = false;
			return -1;
		}
		return fail(err, AVC_KERNEL, (int)-refused, process->pid, "infect", "clone",
			    "it may not have another process: %s", strerror((int)-refused));
	}
	if (tracee_await(porter->tid, NULL, err) != STOP_TRAP)
		return -1;
	if (ptrace(PTRACE_SETOPTIONS, porter->tid, NULL, options) ||
	    seccomp_supervise(porter->tid, 0, options, porter->cave, ARCH_STUB_BYTES))
		return fail_errno(err, porter->tid, "infect", "ptrace(SETOPTIONS)", "it has ended");
	/* The main thread waits for it, and each of its calls takes two wake-ups.  Best effort. */
	(void)rt_priority_give(porter->tid);
	return 0;
}

/* Supervised, until its exit, or the deadline. */
static enum stop_kind see_off(pid_t tid)
{
	struct stop stop = { .kind = STOP_NONE };

	while (seccomp_go_on(tid, &stop) == 0 && stop.kind != STOP_EXIT &&
	       stop.kind != STOP_DYING && stop.kind != STOP_DEADLINE)
		stop = tracee_wait(tid, 0);
	return stop.kind;
}

/* False: it is still exiting, through the stub. */
static bool kill_porter(struct process *process, const struct porter *porter)
{
	const uint64_t arg[6] = { 0 };
	struct stop stop = { .kind = STOP_NONE };
	struct avc_error ignored = { 0 };
	struct arch_regs regs;
	struct thread *left;

	if (!porter->is_thread)
		tracee_kill(porter->tid);
	arch_stub_call(&regs, porter->base, porter->cave, true, SYS_exit, arg);
	if (porter->is_thread && arch_regs_set(porter->tid, &regs) == 0)
		stop.kind = see_off(porter->tid);
	/* It has exited, and can be reaped. */
	while (stop.kind == STOP_DYING)
		stop = tracee_wait(porter->tid, 0);
	seccomp_end_supervision(porter->tid);
	if (!porter->is_thread || stop.kind == STOP_EXIT)
		return true;
	left = thread_add(process, porter->tid, &ignored);
	if (left)
		left->attached = true; /* it still has to be waited for */
	return false;
}

/* The porter is gone: leads the main thread out of the stub's calls, to where it can be
 * released. */
static int leave_stub(struct thread *thread, struct avc_error *err)
{
	long result;

	/* It is inside of clone(2) still. */
	if (step_over(thread->tid, SYS_clone, &result, NULL, err) == 0 &&
	    step_over(thread->tid, ARCH_STUB_WAIT, &result, NULL, err) == 0 &&
	    tracee_settle(thread->tid, err) == 0)
		return 0;
	thread->stopped = false;
	return -1;
}

/* ---- what it does ---------------------------------------------------------------------------- */

/* A child has its parent's parasite mapped, and at a restore briefly has both: each has its own
 * address, in a part of the address space that programs do not use otherwise.  The kernel chooses
 * another one if this is taken. */
static uint64_t where_to_map(const struct process *process)
{
	return PADS_START + process->nonce % PADS * PARASITE_DISTANCE;
}

bool porter_is_place(avc_remote base)
{
	return base >= PADS_START && base - PADS_START < PADS * PARASITE_DISTANCE &&
	       base % PARASITE_DISTANCE == 0;
}

/* RLIMIT_AS counts the parasite, too, but must not make the app's own mappings fail.  So only where
 * the parasite is a small part of what is left. */
static int check_room(const struct process *process, size_t bytes, struct avc_error *err)
{
	const long pages = proc_vm_pages(process->statm_fd, NULL);
	uint64_t limit[LIMITS][2];

	if (pages < 0 || proc_limits(process->pid, limit))
		return fail_errno(err, process->pid, "infect", "open(limits)", "it has ended");
	if (limit[RLIMIT_AS][0] == ~UINT64_C(0) ||
	    (uint64_t)pages * ARCH_PAGE_BYTES + PARASITE_SHARE * bytes <= limit[RLIMIT_AS][0])
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
		    "it may map so little more memory (RLIMIT_AS, ulimit -v) that it would miss "
		    "the %zu kB which protection takes",
		    bytes / 1024);
}

/* The other end of the porter's socket, whose own is descriptor 0: the first of an unshared
 * table. */
static int open_channel(const struct porter *porter, avc_remote scratch, struct avc_error *err)
{
	const uint64_t leave[6] = { 0, ~0u, CLOSE_RANGE_UNSHARE };
	const uint64_t pair[6] = { AF_UNIX, SOCK_STREAM, 0, scratch };
	const uint64_t ours[6] = { 1 };
	int pidfd, channel;

	if (porter_must(porter, "close_range", "it needs a table of descriptors of its own",
			SYS_close_range, leave, err) ||
	    porter_must(porter, "socketpair", "it may not have a socket", SYS_socketpair, pair,
			err))
		return -1;
	pidfd = open_pidfd(porter->tid, porter->is_thread);
	channel = pidfd < 0 ? -1 : proc_borrow_fd(pidfd, 1);
	close_fd(&pidfd);
	if (channel < 0)
		return fail_errno(err, porter->tid, "infect", "pidfd_getfd", "it was killed");
	if (porter_must(porter, "close", "its end of a socket cannot be closed", SYS_close, ours,
			err))
		close_fd(&channel);
	return channel;
}

/* One part of the parasite; it arrives as descriptor 1. If the app changes the message header
 * meanwhile, it does not arrive, or cannot be mapped. */
static int bring(const struct process *process, const struct porter *porter, int channel, int fd,
		 const uint64_t map[6], struct avc_error *err)
{
	const avc_remote scratch = process->parasite.base;
	const uint64_t receive[6] = { 0, scratch, MSG_CMSG_CLOEXEC | MSG_DONTWAIT };
	const uint64_t received[6] = { 1 };
	struct fd_letter letter;

	fd_letter_write(&letter, scratch);
	if (pwrite(process->mem_fd, &letter, sizeof letter, (off_t)scratch) != sizeof letter)
		return fail_errno(err, process->pid, "infect", "write(mem)", "it has ended");
	if (fd_send(channel, fd))
		return fail_errno(err, process->pid, "infect", "sendmsg",
				  "the parasite cannot be handed over");
	return porter_must(porter, "recvmsg", "the parasite cannot be handed over", SYS_recvmsg,
			   receive, err) ||
			       porter_must(porter, "mmap",
					   map[2] & PROT_EXEC
						   ? "it may not have new executable memory"
						   : "it may not map the parasite",
					   SYS_mmap, map, err) ||
			       porter_must(porter, "close", "a descriptor cannot be closed",
					   SYS_close, received, err)
		       ? -1
		       : 0;
}

/* Reserves the whole range first, so that the parts replace no other mapping.  Its first page holds
 * the message headers until the code is mapped there. */
static int bring_parasite(struct process *process, const struct porter *porter,
			  struct avc_error *err)
{
	struct parasite *parasite = &process->parasite;
	const size_t data_bytes = parasite->bytes - INJ_CODE_BYTES;
	const uint64_t place[6] = { where_to_map(process), parasite->bytes, PROT_NONE,
				    MAP_SHARED | MAP_ANONYMOUS | MAP_NORESERVE, (uint64_t)-1 };
	uint64_t scratch[6] = { 0, ARCH_PAGE_BYTES, PROT_READ | PROT_WRITE };
	uint64_t code[6] = { 0, INJ_CODE_BYTES, PARASITE_CODE_PROT, PARASITE_FLAGS_OVER, 1 };
	uint64_t data[6] = { 0, data_bytes, PARASITE_DATA_PROT, PARASITE_FLAGS_OVER, 1 };
	int channel, result;
	long base;

	if (porter_call(porter, SYS_mmap, place, &base, err))
		return -1;
	if (base < 0 && base > -4096)
		return fail(err, AVC_UNSUPPORTED, (int)-base, process->pid, "infect", "mmap",
			    "it may not map %zu kB more memory", parasite->bytes / 1024);
	parasite->base = scratch[0] = code[0] = (uint64_t)base;
	data[0] = (uint64_t)base + INJ_CODE_BYTES;
	if (porter_must(porter, "mprotect", "it may not have new memory", SYS_mprotect, scratch,
			err))
		return -1;
	channel = open_channel(porter, scratch[0], err);
	if (channel < 0)
		return -1;
	result = bring(process, porter, channel, parasite->data_fd, data, err) ||
				 bring(process, porter, channel, parasite->code_fd, code, err)
			 ? -1
			 : 0;
	close_fd(&channel);
	return result;
}

int porter_bring(struct process *process, struct thread *thread, avc_remote cave, size_t bytes,
		 bool *stub_is_free, struct avc_error *err)
{
	struct porter porter = { .cave = cave,
				 .base = &thread->regs,
				 .is_thread = process->descendant && porter_can_be_thread() };
	int result;

	if (check_room(process, bytes, err) ||
	    parasite_make(&process->parasite, process->nonce, err))
		return -1;
	result = make_porter(process, thread, &porter, err);
	if (!result)
		result = bring_parasite(process, &porter, err);
	if (porter.tid) {
		*stub_is_free = kill_porter(process, &porter);
		if (leave_stub(thread, err))
			result = -1;
	}
	return result;
}
