/* SPDX-License-Identifier: Apache-2.0
 *
 * Pad and holder are brought into the live app through its main thread; the
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
#include <sys/syscall.h>
#include <unistd.h>

#include "internal.h"

#define CAVE_BYTES 256
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

static void note_old_pad(struct target *target, avc_remote code, avc_remote end)
{
	uint64_t magic;

	if (target->old_pads == OLD_PADS_MAX || code == target->pad.base ||
	    pread(target->mem_fd, &magic, sizeof magic,
		  (off_t)(code + INJ_CODE_BYTES + offsetof(struct inj_control, magic))) !=
		    sizeof magic ||
	    magic != INJ_MAGIC)
		return;
	target->old_pad[target->old_pads].base = code;
	target->old_pad[target->old_pads++].bytes = end - code;
}

/* Finds a cave, and the pads of guards that died.  Fails if the stopped main thread
 * is still in one of those, or in a stub. */
static int survey(struct target *target, avc_remote pc, avc_remote *cave, struct avc_error *err)
{
	char path[64], line[512];
	avc_remote code = 0, code_end = 0;
	bool in_stub = false;
	FILE *maps;

	*cave = 0;
	target->old_pads = 0;
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
			} else if (code && start == code_end) {
				note_old_pad(target, code, end);
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
	if (in_stub || in_old_pad(target, pc))
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
	if (suspend_seccomp(thread, true, err))
		return -1;
	if (arch_regs_set(tid, &regs) || ptrace(PTRACE_SETSIGMASK, tid, sizeof all, &all))
		return fail_errno(err, tid, "infect", "ptrace(SETREGS)", "it has gone");
	thread->borrowed = true;
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

static int make_pad(struct target *target, struct thread *thread, avc_remote cave, uint32_t slots,
		    uint32_t threads_max, struct avc_error *err)
{
	struct pad *pad = &target->pad;
	uint64_t arg[6] = { 0,
			    pad_layout(pad, slots, threads_max),
			    PROT_READ | PROT_WRITE,
			    MAP_SHARED | MAP_ANONYMOUS | MAP_NORESERVE,
			    (uint64_t)-1,
			    0 };
	long base, result;

	if (stub_syscall(thread, cave, SYS_mmap, arg, &base, err))
		return -1;
	if (base < 0 && base > -4096)
		return fail(err, AVC_UNSUPPORTED, (int)-base, target->pid, "infect", "mmap",
			    "it may not map %zu kB more memory", pad->bytes / 1024);
	if (pad_open(pad, target->pid, (avc_remote)base, pad->bytes, target->nonce, err))
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

int infect(struct target *target, uint32_t slots, timer_t timer, uint64_t deadline_ns,
	   struct avc_error *err)
{
	uint8_t stub[ARCH_STUB_BYTES], zero[ARCH_STUB_BYTES] = { 0 };
	uint32_t threads_max = 32, threads = target->thread_count * 2;
	struct thread *thread;
	avc_remote cave;
	size_t bytes;
	int result;

	while (threads_max < threads)
		threads_max *= 2;
	pad_close(&target->pad);
	memory_forget(target->memory);
	if (getrandom(&target->nonce, sizeof target->nonce, 0) < 0)
		return fail_errno(err, 0, "infect", "getrandom", "no random number");
	/* An exec since then has made another address space of it. */
	close_fd(&target->mem_fd);
	target->mem_fd = proc_open(target->pid, "mem", O_RDWR);
	if (target->mem_fd < 0)
		return fail_errno(err, target->pid, "infect", "open(mem)", "it has ended");
	tracee_deadline_set(timer, deadline_ns);
	thread = stop_main(target, err);
	if (!thread) {
		tracee_deadline_clear(timer);
		return -1;
	}
	result = check_task(target, thread, err);
	if (!result)
		result = survey(target, arch_pc(&thread->regs), &cave, err);
	if (!result) {
		struct arch_regs home;

		rseq_fixup(target->mem_fd, thread);
		home = thread->regs;
		arch_resume(&home);
		bytes = arch_stub_build(stub, &home, thread->sigmask);
		if (pwrite(target->mem_fd, stub, bytes, (off_t)cave) != (ssize_t)bytes)
			result = fail_errno(err, target->pid, "infect", "write(mem)",
					    "its code can not be written");
		else
			result = make_pad(target, thread, cave, slots, threads_max, err);
		/* Nobody is in the stub any more: leave no trace. */
		if (thread->stopped && (!thread->borrowed || give_back(thread, err) == 0)) {
			if (pwrite(target->mem_fd, zero, bytes, (off_t)cave) != (ssize_t)bytes)
				err->undo_failures++;
		}
	}
	thread_release(thread);
	tracee_deadline_clear(timer);
	if (result)
		pad_close(&target->pad);
	target->infected = !result;
	target->checkpoints = 0;
	return result;
}

int hold(struct target *target, timer_t timer, uint64_t deadline_ns, struct avc_error *err)
{
	struct inj_call *call = &target->pad.control->runner;
	struct inj_call *own = &target->pad.control->holder;
	struct thread *thread;
	struct arch_regs base;
	pid_t holder = 0;
	int result;

	urgent_begin();
	tracee_deadline_set(timer, deadline_ns);
	thread = stop_main(target, err);
	if (!thread) {
		tracee_deadline_clear(timer);
		urgent_end();
		return -1;
	}
	call_begin(call, INJ_AFTER_HOME);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD, 0, 0, 0, 0);
	result = borrow(target, thread, err);
	if (!result) {
		result = pad_run_clone(thread->tid, call, &holder, err);
		target->lost = target->lost || (result && err->code != AVC_KERNEL);
	}
	if (!result)
		result = tracee_settle(thread->tid, err);
	else if (err->code == AVC_DEADLINE)
		thread->stopped = false; /* on its way through the pad, and home */
	if (!result)
		result = give_back(thread, err);
	thread_release(thread);
	tracee_deadline_clear(timer);
	urgent_end();
	if (!holder)
		return -1;
	/* It must never run on by itself: it has the app's memory for a stack. */
	tracee_deadline_set(timer, NS_PER_S);
	if (tracee_await(holder, NULL, err) != STOP_TRAP)
		result = -1;
	if (ptrace(PTRACE_SETOPTIONS, holder, NULL,
		   (long)(PTRACE_O_EXITKILL | PTRACE_O_TRACESYSGOOD | PTRACE_O_SUSPEND_SECCOMP)) ||
	    arch_regs_get(holder, &base))
		result = fail_errno(err, holder, "make holder", "ptrace(SETOPTIONS)",
				    "it has ended");
	if (!result) {
		memcpy(own->out, "avckpt-hold", 12);
		call_begin(own, INJ_AFTER_PARK);
		/* Out of the app's process group, or the number stays taken. */
		call_add(own, SYS_setpgid, 0, 0, 0, 0, 0);
		call_add(own, SYS_prctl, PR_SET_NAME, pad_remote(&target->pad, own->out), 0, 0, 0);
		result = pad_send(&target->pad, holder, &base, own, err) ||
					 pad_run(holder, own, err)
				 ? -1
				 : 0;
	}
	tracee_deadline_clear(timer);
	target->holder = holder;
	target->holder_pidfd = proc_pidfd_open(holder);
	if (result || target->holder_pidfd < 0) {
		unhold(target);
		return -1;
	}
	return 0;
}

void unhold(struct target *target)
{
	if (!target->holder)
		return;
	tracee_kill(target->holder);
	close_fd(&target->holder_pidfd);
	target->holder = 0;
}
