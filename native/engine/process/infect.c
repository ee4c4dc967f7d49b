/* SPDX-License-Identifier: Apache-2.0
 *
 * Injects parasite and holder into the live app through its main thread.
 *
 * The parasite is memory that the guard makes (parasite.c), so that what the app does to its own
 * mapping affects only the app.  To inject it, the main thread clones a *porter*, a task with the
 * same memory, from a stub in the zero padding behind an executable mapping, usually the vDSO. The
 * porter unshares the app's descriptor table, so that it never uses a number there; in its own
 * table it receives the memory over a socket, maps it, and exits.  It makes one system call at a
 * time, with every register set by the guard.
 *
 * The stub ends by loading the thread's own registers, so the thread returns without us, and a
 * porter without a guard exits by itself.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/close_range.h>
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
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <sys/wait.h>
#include <unistd.h>

#include "process.h"

/* At the end of a page: what is in it is aligned. */
#define CAVE_BYTES ((ARCH_STUB_BYTES + 255) & ~255)
#define CAVES 4 /* so many stubs of guards that died are left as they are      */
#define PADS_START UINT64_C(0x200000000000)
#define PADS (UINT64_C(1) << 19)
#define PARASITE_DISTANCE (UINT64_C(64) << 20)
#define PARASITE_SHARE 16 /* the parasite may be at most a 16th of what may still be mapped */

/* True if the last bytes of the mapping are a stub that a dead guard has left. */
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

/* The mapping of a guard that died before it wrote anything is recognized by its address. */
static void note_old_parasite(struct process *process, avc_remote base, avc_remote end)
{
	uint64_t magic;

	if (process->old_parasites == OLD_PARASITES_MAX || base == process->parasite.base ||
	    end - base < INJ_CODE_BYTES + sizeof(struct inj_control) ||
	    pread(process->mem_fd, &magic, sizeof magic,
		  (off_t)(base + INJ_CODE_BYTES + offsetof(struct inj_control, magic))) !=
		    sizeof magic ||
	    (magic != INJ_MAGIC && (magic || !is_place_of_pads(base))))
		return;
	process->old_parasite[process->old_parasites].base = base;
	process->old_parasite[process->old_parasites++].bytes = end - base;
}

struct survey {
	struct process *process;
	avc_remote pc, cave, start, end; /* start, end: of the parasite being scanned */
	bool in_stub, is_vdso;           /* is_vdso: the cave                             */
};

/* Of an existing parasite, or one that was being injected (bring_parasite). */
static bool is_of_parasite(const struct mapping *m)
{
	return !strcmp(m->name, PARASITE_MAPPED) || !strcmp(m->name, "/dev/zero (deleted)");
}

/* In a stub that is there already a task may still be, or a handler may return to it: a thread that
 * leaves it without us has its own signal mask there.  So it stays as it is, until process_drop_stubs(). */
static void survey_caves(struct survey *survey, const struct mapping *m)
{
	struct process *process = survey->process;
	const bool is_vdso = !strcmp(m->name, "[vdso]");
	avc_remote end = m->end;

	for (int i = 0; i < CAVES && end - m->start > CAVE_BYTES; i++, end -= CAVE_BYTES) {
		if (has_stub(process->mem_fd, end)) {
			survey->in_stub |= survey->pc < end && survey->pc >= end - CAVE_BYTES;
			process->stubs_start = end - CAVE_BYTES;
			process->stubs_end = m->end;
			continue;
		}
		if ((!survey->cave || (is_vdso && !survey->is_vdso)) &&
		    has_cave(process->mem_fd, end)) {
			survey->cave = end - CAVE_BYTES;
			survey->is_vdso = is_vdso;
		}
		return;
	}
}

static int survey_mapping(const struct mapping *m, void *arg)
{
	struct survey *survey = arg;
	struct process *process = survey->process;

	/* In adjacent pieces. */
	if (is_of_parasite(m)) {
		if (m->start != survey->end || is_place_of_pads(m->start)) {
			note_old_parasite(process, survey->start, survey->end);
			survey->start = m->start;
		}
		survey->end = m->end;
	}
	if (m->mode[0] == 'r' && m->mode[2] == 'x' && !m->shared)
		survey_caves(survey, m);
	return 0;
}

/* Finds a cave, and the parasites of guards that died.  Fails if the stopped main thread
 * is still in one of those, or in a stub. */
static int survey(struct process *process, avc_remote pc, avc_remote *cave, struct avc_error *err)
{
	struct survey survey = { .process = process, .pc = pc };

	*cave = 0;
	process->stubs_start = process->stubs_end = 0;
	process->old_parasites = 0;
	if (proc_mappings(process->pid, "maps", survey_mapping, &survey))
		return fail_errno(err, process->pid, "infect", "read(maps)", "it has ended");
	note_old_parasite(process, survey.start, survey.end);
	*cave = survey.cave;
	if (!*cave && process->stubs_end) /* all are full: the one that has been so the longest */
		*cave = process->stubs_end - CAVE_BYTES;
	if (survey.in_stub || parasite_is_old(process, pc))
		return fail(err, AVC_DEADLINE, 0, process->pid, "infect", "",
			    "still on its way home from a guard that died");
	/* It has no memory any more. */
	if (!*cave && proc_is_exiting(process->pid))
		return fail(err, AVC_GONE, ESRCH, process->pid, "infect", "read(maps)",
			    "it has ended");
	if (!*cave)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
			    "there is no room for the first injected instructions");
	return 0;
}

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

static int open_pidfd(pid_t tid, bool is_thread)
{
	return (int)syscall(SYS_pidfd_open, tid, is_thread ? PIDFD_THREAD_ : 0);
}

/* A thread has its own descriptor table, reachable only through its own pidfd (since Linux 6.9). */
static bool can_be_thread(void)
{
	int pidfd = open_pidfd((pid_t)syscall(SYS_gettid), true);
	const bool can = pidfd >= 0;

	close_fd(&pidfd);
	return can;
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
	const struct sched_param first = { .sched_priority = 1 };
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
	(void)sched_setscheduler(porter->tid, SCHED_FIFO, &first);
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

/* A child has its parent's parasite mapped, and at a restore briefly has both: each has its own
 * address, in a part of the address space that programs do not use otherwise.  The kernel chooses
 * another one if this is taken. */
static uint64_t where_to_map(const struct process *process)
{
	return PADS_START + process->nonce % PADS * PARASITE_DISTANCE;
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

/* Of `bytes`, as parasite_layout() has them. */
static int make_parasite(struct process *process, struct thread *thread, avc_remote cave,
			 size_t bytes, bool *stub_is_free, struct avc_error *err)
{
	struct porter porter = { .cave = cave,
				 .base = &thread->regs,
				 .is_thread = process->descendant && can_be_thread() };
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

/* The main thread, stopped, with all that borrowing it needs read. */
static struct thread *stop_main(struct process *process, struct avc_error *err)
{
	struct thread *t = thread_find(process, process->pid);

	if (!t)
		t = thread_add(process, process->pid, err);
	if (!t || t->attached) {
		fail(err, AVC_DEADLINE, 0, process->pid, "stop", "",
		     "not back from an earlier attempt yet");
		return NULL;
	}
	t->seen = true;
	rewind_prepare(t);
	if (thread_stop(process, t, err) || thread_await(process, t, err) || thread_read(t, err)) {
		thread_release(process, t);
		return NULL;
	}
	return t;
}

/* The same, and all others stopped, too, until process_let_go(). */
static struct thread *stop_all(struct process *process, struct avc_error *err)
{
	struct thread *t;

	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].attached) {
			fail(err, AVC_DEADLINE, 0, process->threads[i].tid, "stop", "",
			     "not back from an earlier attempt yet");
			return NULL;
		}
	waits_prepare(process);
	if (process_stop(process, err))
		return NULL;
	t = thread_find(process, process->pid);
	if (!t || !t->stopped) {
		fail(err, AVC_GONE, 0, process->pid, "stop", "", "it has ended");
		return NULL;
	}
	return thread_read(t, err) ? NULL : t;
}

static int check_task(struct process *process, const struct thread *t, struct avc_error *err)
{
	if (!arch_is_native(&t->regs))
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
			    "it is a 32-bit program");
	if (arch_is_delicate(t->tid))
		return fail(err, AVC_DEADLINE, 0, t->tid, "infect", "",
			    "it is in the middle of vector code");
	return 0;
}

static void keep_stub(struct process *process, avc_remote stub)
{
	if (!process->stubs_end || stub < process->stubs_start)
		process->stubs_start = stub;
	if (stub + CAVE_BYTES > process->stubs_end)
		process->stubs_end = stub + CAVE_BYTES;
}

void process_drop_stubs(struct process *process)
{
	const uint8_t zero[CAVES * CAVE_BYTES] = { 0 };
	const size_t bytes = process->stubs_end - process->stubs_start;

	if (bytes <= sizeof zero)
		(void)pwrite(process->mem_fd, zero, bytes, (off_t)process->stubs_start);
	process->stubs_start = process->stubs_end = 0;
}

static int infect_thread(struct process *process, struct thread *thread, uint32_t slots,
			 struct avc_error *err)
{
	uint8_t stub[ARCH_STUB_BYTES], zero[ARCH_STUB_BYTES] = { 0 };
	uint32_t threads_max = 32, threads = process->thread_count * 2;
	struct arch_regs home;
	bool stub_is_free = true;
	avc_remote cave;
	size_t bytes;
	int result;

	while (threads_max < threads)
		threads_max *= 2;
	tracker_end(process);
	parasite_close(&process->parasite);
	process->parasite.inside = process->inside;
	memory_forget(process->memory);
	if (getrandom(&process->nonce, sizeof process->nonce, 0) < 0)
		return fail_errno(err, 0, "infect", "getrandom", "no random number");
	/* An exec since then has made another address space of it. */
	close_fd(&process->mem_fd);
	process->mem_fd = proc_open(process->pid, "mem", O_RDWR);
	if (process->mem_fd < 0)
		return fail_errno(err, process->pid, "infect", "open(mem)", "it has ended");
	if (thread_check_dispatch(thread->tid, err) || check_task(process, thread, err) ||
	    seccomp_read(process, thread, err) ||
	    survey(process, arch_pc(&thread->regs), &cave, err))
		return -1;
	thread_fix_rseq(process->mem_fd, thread);
	rewind_home(thread, &home);
	bytes = arch_stub_build(stub, &home, thread->sigmask);
	if (arch_stub_read_xstate(thread->tid, stub))
		return fail_errno(err, thread->tid, "infect", "ptrace(GETREGSET)", "it has ended");
	if (pwrite(process->mem_fd, stub, bytes, (off_t)cave) != (ssize_t)bytes)
		return fail_errno(err, process->pid, "infect", "write(mem)",
				  "its code cannot be written");
	result = make_parasite(process, thread, cave,
			       parasite_layout(&process->parasite, slots, threads_max),
			       &stub_is_free, err);
	if (!thread->stopped || (thread->borrowed && thread_give_back(thread, err)))
		stub_is_free = false;
	/* No thread is in the stub any more: erase it. */
	if (stub_is_free && !parasite_is_old(process, cave)) {
		if (pwrite(process->mem_fd, zero, bytes, (off_t)cave) != (ssize_t)bytes)
			err->undo_failures++;
	} else {
		keep_stub(process, cave);
	}
	if (result)
		parasite_close(&process->parasite);
	process->infected = !result;
	process->checkpoints = 0;
	return result;
}

/* While all of it is stopped: injects the holder, or a parasite with `slots`. */
static int do_stopped(struct process *process, uint32_t slots, timer_t timer, uint64_t deadline_ns,
		      struct avc_error *err)
{
	struct thread *thread;
	int result;

	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	thread = stop_all(process, err);
	result = thread ? 0 : -1;
	if (thread)
		result = slots ? infect_thread(process, thread, slots, err)
			       : process_hold_stopped(process, process->init, err);
	process_go_on(process, timer);
	return result;
}

int process_infect(struct process *process, uint32_t slots, timer_t timer, uint64_t deadline_ns,
		   struct avc_error *err)
{
	struct thread *thread = NULL;
	int result;

	/* Another thread may be waiting for children of any kind (__WALL).  Or install a filter for all
	 * that kills the one that makes our calls, which a guard with a filter could not suspend. */
	if ((process->descendant && !can_be_thread()) || seccomp_is_confined())
		return do_stopped(process, slots, timer, deadline_ns, err);
	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	if (process_check_dying(process, err) == 0)
		thread = stop_main(process, err);
	result = thread ? infect_thread(process, thread, slots, err) : -1;
	if (thread)
		thread_let_go(process, thread);
	tracee_deadline_clear(timer);
	rt_priority_end();
	return result;
}

int process_infect_stopped(struct process *process, uint32_t slots, struct avc_error *err)
{
	struct thread *thread = thread_find(process, process->pid);

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
			    "its main thread has ended");
	if (thread_read(thread, err))
		return -1;
	return infect_thread(process, thread, slots, err);
}

/* Turns a new task into the holder: stopped, named, and outside of the app's process groups. */
static int make_holder(struct process *process, pid_t holder, struct avc_error *err)
{
	struct inj_call *own = &process->parasite.control->holder;
	const struct sched_param first = { .sched_priority = 1 };

	/* It clones while the whole app is stopped.  Best effort; not for its clones. */
	if (process->descendant)
		(void)sched_setscheduler(holder, SCHED_FIFO | SCHED_RESET_ON_FORK, &first);
	memcpy(own->out, "avckpt-hold", 12);
	call_begin(own, INJ_AFTER_PARK);
	/* Leaves the app's session and process group, which a process of the app may lead: their
	 * numbers would stay taken. */
	call_add(own, SYS_setsid);
	call_add(own, SYS_prctl, PR_SET_NAME, parasite_remote(&process->parasite, own->out));
	return parasite_send(&process->parasite, holder, &process->holder_base, own, err) ||
			       parasite_run(holder, own, err)
		       ? -1
		       : 0;
}

/* Without a tracer its filters might refuse to set that attribute again. */
static int check_adoption(const struct process *process, struct avc_error *err)
{
	return process->parasite.seccomp == SECCOMP_SUPERVISED
		       ? fail(err, AVC_UNSUPPORTED, 0, process->pid, "make holder", "",
			      "it adopts orphans (PR_SET_CHILD_SUBREAPER) under a seccomp filter "
			      "that forbids what checkpoints call")
		       : 0;
}

int process_pause_adoption(struct process *process, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);

	if (process->paused)
		return 0;
	if (check_adoption(process, err))
		return -1;
	call_begin(call, INJ_AFTER_HOME);
	call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER);
	call_add(call, INJ_PAUSE);
	call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 1);
	if (thread_borrow(process, thread, err))
		return -1;
	process->paused = true;
	if (parasite_run_to_pause(thread->tid, call, err)) {
		thread->stopped = false; /* on its way through the parasite, and back */
		process->paused = false;
		return -1;
	}
	return 0;
}

int process_resume_adoption(struct process *process, struct avc_error *err)
{
	struct thread *thread = thread_find(process, process->pid);

	if (!process->paused)
		return 0;
	process->paused = false;
	if (parasite_run_on(thread->tid, &process->parasite.control->runner, err)) {
		thread->stopped = false;
		return -1;
	}
	return thread_give_back(thread, err);
}

static int keep_holder(struct process *process, pid_t holder, int result, struct avc_error *err)
{
	process->holder = holder;
	process->holder_inside = proc_inside(holder);
	process->held_ns = now_ns();
	process->exec_check_ns = 0;
	process->holder_pidfd = proc_pidfd_open(holder);
	if (!result && process->holder_pidfd >= 0)
		return 0;
	if (!err->code)
		fail_errno(err, holder, "make holder", "pidfd_open", "it was killed");
	process_unhold(process);
	return -1;
}

int process_hold(struct process *process, timer_t timer, uint64_t deadline_ns,
		 struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread;
	pid_t holder = 0;
	int result;

	if (process->descendant)
		return do_stopped(process, 0, timer, deadline_ns, err);
	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	thread = stop_all(process, err);
	if (!thread) {
		process_go_on(process, timer);
		return -1;
	}
	call_begin(call, INJ_AFTER_HOME);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD);
	result = thread_borrow(process, thread, err);
	if (!result) {
		result = parasite_run_clone(thread->tid, call, &holder, err);
		process->lost = process->lost || (result && err->code != AVC_LIMIT);
	}
	if (!result)
		result = tracee_settle(thread->tid, err);
	else if (err->code == AVC_DEADLINE && thread->borrowed)
		thread->stopped = false; /* on its way through the parasite, and back */
	if (!result)
		result = thread_give_back(thread, err);
	process_go_on(process, timer);
	if (!holder)
		return -1;
	/* It must never run by itself: its stack is the app's memory. */
	tracee_deadline_set(timer, NS_PER_S);
	if (tracee_await(holder, NULL, err) != STOP_TRAP)
		result = -1;
	if (parasite_own(&process->parasite, holder) ||
	    arch_regs_get(holder, &process->holder_base))
		result = fail_errno(err, holder, "make holder", "ptrace(SETOPTIONS)",
				    "it has ended");
	if (!result)
		result = make_holder(process, holder, err);
	tracee_deadline_clear(timer);
	return keep_holder(process, holder, result, err);
}

/* What cannot be found out is 0.  umask -1: not known yet. */
static struct folders folders_of(const struct process *process, int32_t umask)
{
	static const char *const name[] = { "root", "cwd" };
	struct folders folders = { .umask = (uint64_t)umask };
	struct proc_status status;
	struct statx st;

	if (umask < 0)
		folders.umask = proc_status_of(process->status_fd, process->pid, &status) == 0
					? status.umask
					: 0;
	for (size_t i = 0; i < sizeof name / sizeof *name; i++)
		if (proc_look(process->pid, name[i], STATX_INO | STATX_MNT_ID, &st)) {
			folders.device[i] = device_of(&st);
			folders.inode[i] = st.stx_ino;
			folders.mount[i] = st.stx_mnt_id;
		}
	return folders;
}

bool process_has_moved(const struct process *process, int32_t umask)
{
	struct folders now;

	if (!process->descendant || !process->holder)
		return false;
	now = folders_of(process, umask);
	return memcmp(&now, &process->folders, sizeof now) != 0;
}

/* The stopped intermediate task clones the holder, which is then in its first stop. */
static int clone_holder(struct process *process, pid_t between, pid_t *holder,
			struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->holder;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND | SIGCHLD);
	if (parasite_send(&process->parasite, between, &process->holder_base, call, err) ||
	    parasite_run_clone(between, call, holder, err))
		return -1;
	if (tracee_await(*holder, NULL, err) != STOP_TRAP)
		return -1;
	if (parasite_own(&process->parasite, *holder))
		return fail_errno(err, *holder, "make holder", "ptrace(SETOPTIONS)",
				  "it has ended");
	return 0;
}

/* A child without exit signal that has ended. */
static bool is_left_child(const struct process *process, pid_t inside)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(process->pid, children, CHILDREN_MAX);
	struct proc_stat stat;

	for (int i = 0; i < count; i++)
		if (proc_inside(children[i]) == inside)
			return proc_stat(children[i], &stat) == 0 && stat.state == 'Z' &&
			       !stat.exit_signal;
	return false;
}

/* A filter of the thread's own may have refused the wait for a dead guard's intermediate task (see
 * below), which has been a zombie since. */
static void reap_left_child(const struct process *process, avc_remote parasite,
			    struct inj_call *call)
{
	struct inj_syscall list[4];
	const off_t at =
		(off_t)(parasite + INJ_CODE_BYTES + offsetof(struct inj_control, runner.call));

	if (pread(process->mem_fd, list, sizeof list, at) != sizeof list)
		return;
	for (size_t i = 1; i < sizeof list / sizeof *list; i++)
		if (list[i].nr == INJ_WAIT && list[i].result != list[i - 1].result &&
		    is_left_child(process, (pid_t)list[i - 1].result))
			call_add(call, SYS_wait4, (uint64_t)list[i - 1].result, 0,
				 WNOHANG | __WALL);
}

/* The holder of a process other than the main one must not be a child of any process of the app:
 * wait(2) would find it.  So an intermediate task clones it, and exits, whereupon it is init's
 * child; the intermediate task is reaped by its parent, which does so in any case before it
 * returns, whether we are alive or not.  It has no exit signal, so that the app does not notice.
 *
 * This holder also clones the templates.  They get its signal handlers, which are therefore shared
 * with the app (CLONE_SIGHAND), and its directories and umask.  To share those (CLONE_FS) would take
 * the privileges from a set-user-ID program that the app executes (fs/exec.c, check_unsafe_exec()).
 * So there is another holder when the app has changed them (process_has_moved()). */
int process_hold_stopped(struct process *process, pid_t init, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);
	struct proc_stat stat = { 0 };
	pid_t between = 0, holder = 0;
	int result;

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "make holder", "",
			    "its main thread has ended");
	if (thread->creds.subreaper && check_adoption(process, err))
		return -1;
	process->folders = folders_of(process, -1);
	call_begin(call, INJ_AFTER_HOME);
	if (thread->creds.subreaper)
		call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER);
	for (uint32_t i = 0; i < process->old_parasites && i < INJ_CALLS_MAX / 2; i++)
		reap_left_child(process, process->old_parasite[i].base, call);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND);
	call_add(call, INJ_WAIT);
	if (thread->creds.subreaper)
		call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 1);
	if (thread_borrow(process, thread, err))
		return -1;
	result = parasite_run_clone(thread->tid, call, &between, err);
	if (result) {
		process->lost = process->lost || err->code != AVC_LIMIT;
		thread_runs_on(thread, err);
		return -1;
	}
	if (tracee_await(between, NULL, err) != STOP_TRAP ||
	    parasite_own(&process->parasite, between) ||
	    arch_regs_get(between, &process->holder_base))
		result = fail_errno(err, between, "make holder", "ptrace(SETOPTIONS)",
				    "it has ended");
	if (!result)
		result = clone_holder(process, between, &holder, err);
	tracee_kill(between);
	if (!result)
		result = make_holder(process, holder, err);
	if (!result && proc_stat(holder, &stat))
		result = fail_errno(err, holder, "make holder", "open(stat)", "it was killed");
	if (!result && stat.parent != init)
		result = fail(err, AVC_RETRY, 0, process->pid, "make holder", "",
			      "a process above it adopts orphans now (PR_SET_CHILD_SUBREAPER)");
	if (holder && keep_holder(process, holder, result, err))
		result = -1;
	if (parasite_run(thread->tid, call, err)) {
		thread->stopped = false;
		return -1;
	}
	return thread_give_back(thread, err) || result ? -1 : 0;
}

static void forget_holder(struct process *process)
{
	process->doubtful = false;
	process->holder = 0;
	process->holder_inside = 0;
	process->late = false;
	process->holder_pidfd = -1;
}

void process_unhold(struct process *process)
{
	if (process->holder)
		tracee_kill(process->holder);
	close_fd(&process->holder_pidfd);
	forget_holder(process);
}

pid_t process_detach_holder(struct process *process, int *pidfd)
{
	const pid_t holder = process->holder;

	*pidfd = process->holder_pidfd;
	forget_holder(process);
	return holder;
}

void process_unhold_soon(struct process *process)
{
	int pidfd;
	const pid_t holder = process_detach_holder(process, &pidfd);

	if (holder)
		tracee_end(holder, pidfd);
}
