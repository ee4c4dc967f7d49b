/* SPDX-License-Identifier: Apache-2.0
 *
 * The engine's side of the parasite (see parasite/parasite.h), and running its code in a stopped
 * task.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "parasite_blob.h"
#include "trace.h"

#define HOMEWARD_NS (INJ_PARK_MS / 2 * NS_PER_MS)
#define PARKED_NS NS_PER_S
#define MFD_NOEXEC_SEAL_ 8U /* linux/memfd.h, since Linux 6.3: not to be executed by a path */

static size_t page_up(size_t n)
{
	return (n + ARCH_PAGE_BYTES - 1) & ~(size_t)(ARCH_PAGE_BYTES - 1);
}

/* A block: struct inj_thread, stack (growing down), signal frame.  With AVX-512
 * it all fits one page, with AMX three. */
static size_t block_stack_top(void)
{
	return 896;
}
_Static_assert(sizeof(struct inj_thread) <= 320, "leave most of it to the stack");

size_t parasite_layout(struct parasite *parasite, uint32_t slots, uint32_t threads_max)
{
	parasite->slots = slots;
	parasite->threads_max = threads_max;
	parasite->block_bytes = page_up(block_stack_top() + arch_frame_bytes());
	parasite->slot_bytes = page_up(sizeof(struct inj_slot)) + INJ_SETUP_BYTES +
			       INJ_FILES_BYTES + threads_max * parasite->block_bytes;
	parasite->bytes = INJ_SLOTS_OFFSET + slots * parasite->slot_bytes;
	return parasite->bytes;
}

/* Private memory until we pass it on, which can neither be truncated under us (SIGBUS) nor grow. */
static int make_memory(size_t bytes)
{
	int fd = memfd_create(PARASITE_NAME, MFD_CLOEXEC | MFD_ALLOW_SEALING | MFD_NOEXEC_SEAL_);

	if (fd < 0 && errno == EINVAL) /* before Linux 6.3 */
		fd = memfd_create(PARASITE_NAME, MFD_CLOEXEC | MFD_ALLOW_SEALING);
	if (fd >= 0 &&
	    (ftruncate(fd, (off_t)bytes) || fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW)))
		close_fd(&fd);
	return fd;
}

/* The code is the same in every process, and sealed: one memfd for all. */
static int code_fd = -1;

static void make_code(void)
{
	int fd = make_memory(INJ_CODE_BYTES);

	if (fd >= 0 &&
	    pwrite(fd, parasite_blob, sizeof parasite_blob, 0) == (ssize_t)sizeof parasite_blob &&
	    fcntl(fd, F_ADD_SEALS, F_SEAL_WRITE | F_SEAL_SEAL) == 0)
		/* Read-only: this descriptor cannot be mapped for writing; and kernels before 6.7
		 * refuse shared mappings of a write-sealed memfd by any other descriptor. */
		code_fd = open_again(fd, O_RDONLY);
	close_fd(&fd);
}

int parasite_make(struct parasite *parasite, uint64_t nonce, struct avc_error *err)
{
	int fd;
	uint8_t *map;

	if (code_fd < 0)
		make_code();
	fd = code_fd < 0 ? -1 : make_memory(parasite->bytes - INJ_CODE_BYTES);
	if (fd < 0 || fcntl(fd, F_ADD_SEALS, F_SEAL_SEAL)) {
		close_fd(&fd);
		return fail_errno(err, 0, "infect", "memfd_create", "no memory for the parasite");
	}
	map = mmap(NULL, parasite->bytes, PROT_READ, MAP_SHARED, code_fd, 0);
	if (map == MAP_FAILED ||
	    mmap(map + INJ_CODE_BYTES, parasite->bytes - INJ_CODE_BYTES, PROT_READ | PROT_WRITE,
		 MAP_SHARED | MAP_FIXED, fd, 0) == MAP_FAILED) {
		if (map != MAP_FAILED)
			munmap(map, parasite->bytes);
		close(fd);
		return fail_errno(err, 0, "infect", "mmap", "the parasite cannot be mapped");
	}
	parasite->code_fd = code_fd;
	parasite->data_fd = fd;
	parasite->map = map;
	parasite->control = (struct inj_control *)(parasite->map + INJ_CODE_BYTES);
	parasite->control->nonce = nonce;
	parasite->control->magic = INJ_MAGIC;
	return 0;
}

void parasite_close(struct parasite *parasite)
{
	if (parasite->map) {
		munmap(parasite->map, parasite->bytes);
		close(parasite->data_fd);
	}
	*parasite = (struct parasite){ 0 };
}

struct inj_slot *parasite_slot(const struct parasite *parasite, uint32_t slot)
{
	return (struct inj_slot *)(parasite->map + INJ_SLOTS_OFFSET + slot * parasite->slot_bytes);
}

avc_remote parasite_remote(const struct parasite *parasite, const void *local)
{
	return parasite->base + (avc_remote)((const uint8_t *)local - parasite->map);
}

bool parasite_contains(const struct parasite *parasite, avc_remote address)
{
	return parasite->base && address >= parasite->base &&
	       address < parasite->base + parasite->bytes && !cut_contains(parasite->base, address);
}

uint8_t *parasite_setup(const struct parasite *parasite, uint32_t slot)
{
	return (uint8_t *)parasite_slot(parasite, slot) + page_up(sizeof(struct inj_slot));
}

uint8_t *parasite_files(const struct parasite *parasite, uint32_t slot)
{
	return parasite_setup(parasite, slot) + INJ_SETUP_BYTES;
}

static uint8_t *block(const struct parasite *parasite, uint32_t slot, uint32_t i)
{
	return parasite_files(parasite, slot) + INJ_FILES_BYTES + i * parasite->block_bytes;
}

struct inj_thread *parasite_thread(const struct parasite *parasite, uint32_t slot, uint32_t i)
{
	return (struct inj_thread *)block(parasite, slot, i);
}

void *parasite_stack(const struct parasite *parasite, uint32_t slot, uint32_t i)
{
	return block(parasite, slot, i) + block_stack_top();
}

void *parasite_frame(const struct parasite *parasite, uint32_t slot, uint32_t i)
{
	return block(parasite, slot, i) + block_stack_top();
}

void call_begin(struct inj_call *call, enum inj_after after)
{
	call->done = 0;
	call->pause = INJ_PAUSE_NONE;
	call->count = 0;
	call->wills = 0;
	call->after = after;
	call->park_ms = INJ_PARK_MS;
}

struct inj_syscall *call_append(struct inj_call *call, long nr, const uint64_t arg[6])
{
	/* The app can overwrite the parasite, and its other threads run while one is queried: not
	 * even a value just written is trusted. */
	const uint32_t count = __atomic_load_n(&call->count, __ATOMIC_RELAXED);
	const uint32_t i = count < INJ_CALLS_MAX ? count : INJ_CALLS_MAX - 1;
	struct inj_syscall *s = &call->call[i];

	call->count = i + 1;
	*s = (struct inj_syscall){ .nr = nr, .result = -ENOSYS };
	memcpy(s->arg, arg, sizeof s->arg);
	return s;
}

void parasite_cut_short(struct inj_call *call, const struct avc_error *err)
{
	if (err->code != AVC_DEADLINE)
		return;
	for (uint32_t i = 0; i < call->count && i < INJ_CALLS_MAX; i++)
		if (call->call[i].nr == SYS_madvise || call->call[i].nr == SYS_munmap)
			return;
	__atomic_store_n(&call->park_ms, 0, __ATOMIC_RELAXED);
	__atomic_store_n(&call->count, 0, __ATOMIC_RELEASE);
}

int parasite_set_undo(struct process *process, long nr, const uint64_t arg[6])
{
	struct inj_call *call = &process->parasite.control->runner;
	const struct thread *thread = thread_find(process, process->pid);
	const uint32_t i = __atomic_load_n(&call->wills, __ATOMIC_RELAXED);

	/* If supervised, its filters would apply to what it does without us. */
	if (!thread || !thread->borrowed || i >= INJ_WILLS_MAX ||
	    process->parasite.seccomp == SECCOMP_SUPERVISED)
		return -1;
	call->will_data[i] = arg[3];
	call->will[i] = (struct inj_syscall){ .nr = nr };
	memcpy(call->will[i].arg, arg, sizeof call->will[i].arg);
	call->will[i].arg[3] = parasite_remote(&process->parasite, &call->will_data[i]);
	__atomic_store_n(&call->wills, i + 1, __ATOMIC_RELEASE);
	return 0;
}

void parasite_clear_undo(struct process *process)
{
	struct inj_call *call = &process->parasite.control->runner;
	const uint32_t i = __atomic_load_n(&call->wills, __ATOMIC_RELAXED);

	if (i && i <= INJ_WILLS_MAX)
		__atomic_store_n(&call->wills, i - 1, __ATOMIC_RELEASE);
}

/* Other threads wait for a thread of the app, and it returns after INJ_PARK_MS. Templates and
 * holders stay, and a template that waits for a CPU is no reason to restore an older one.
 *
 * A task that is killed never completes: this must be noticed at once, because its process cannot
 * be reaped before we have. */
static int wait_word(struct inj_call *call, uint32_t *word, pid_t tid, struct avc_error *err)
{
	const struct timespec slice = { .tv_nsec = 500000 };
	const uint64_t end = call->after == INJ_AFTER_PARK ? tracee_deadline(PARKED_NS)
							   : now_ns() + HOMEWARD_NS;

	while (!__atomic_load_n(word, __ATOMIC_ACQUIRE)) {
		const bool supervised = seccomp_is_supervised(tid);
		struct stop stop;

		/* A supervised task stops at every call. */
		if (!supervised)
			syscall(SYS_futex, word, FUTEX_WAIT, 0, &slice, NULL, 0);
		if (__atomic_load_n(word, __ATOMIC_ACQUIRE))
			break;
		tracee_watch(supervised ? word : NULL);
		stop = tracee_wait(tid, supervised ? 0 : WNOHANG);
		tracee_watch(NULL);
		if (stop.kind == STOP_EXIT || stop.kind == STOP_DYING)
			return fail(err, AVC_GONE, 0, tid, "run injected code", "", "it has ended");
		/* STOP_TRAP: SIGCONT for a process that was stopped (kernel/signal.c,
		 * ptrace_trap_notify()). */
		if (stop.kind == STOP_SIGNAL || stop.kind == STOP_GROUP || stop.kind == STOP_TRAP ||
		    stop.kind == STOP_SYSCALL)
			seccomp_go_on(tid, &stop);
		if (!tracee_has_time(end))
			return fail(err, AVC_DEADLINE, 0, tid, "run injected code", "",
				    "the task did not get to run in time");
	}
	return 0;
}

static long options_of(const struct parasite *parasite, bool ours);

static int send_in(const struct parasite *parasite, pid_t tid, bool ours,
		   const struct arch_regs *base, struct inj_call *call, struct avc_error *err)
{
	const avc_remote stack = parasite_remote(parasite, call->stack + sizeof call->stack);
	struct arch_regs regs;

	if (parasite->seccomp != SECCOMP_SUPERVISED)
		seccomp_end_supervision(tid);
	else if (seccomp_supervise(tid, parasite->inside, options_of(parasite, ours),
				   parasite->base, INJ_CODE_BYTES))
		return fail(err, AVC_UNSUPPORTED, 0, tid, "run injected code", "",
			    "it has too many processes under seccomp filters of its own");
	if (ours)
		arch_call(&regs, base, parasite->base + INJ_RUN_OFFSET, stack,
			  parasite_remote(parasite, call));
	else
		arch_enter(&regs, base, parasite->base + INJ_ENTER_OFFSET,
			   parasite_remote(parasite, call), stack);
	if (arch_regs_set(tid, &regs))
		return fail_errno(err, tid, "run injected code", "ptrace(SETREGS)", "it has gone");
	return 0;
}

int parasite_send(const struct parasite *parasite, pid_t tid, const struct arch_regs *base,
		  struct inj_call *call, struct avc_error *err)
{
	return send_in(parasite, tid, true, base, call, err);
}

int parasite_start(pid_t tid, struct avc_error *err)
{
	if (seccomp_go_on(tid, NULL))
		return fail_errno(err, tid, "run injected code", "ptrace(CONT)", "it has gone");
	return 0;
}

int parasite_run_to_pause(pid_t tid, struct inj_call *call, struct avc_error *err)
{
	return parasite_start(tid, err) ? -1 : wait_word(call, &call->pause, tid, err);
}

int parasite_halt(pid_t tid, struct inj_call *call, struct avc_error *err)
{
	if (wait_word(call, &call->done, tid, err)) {
		/* Without a stop of its own it would return and stay a tracee forever; now it stops
		 * as soon as it gets to run, and straggle() releases it. */
		ptrace(PTRACE_INTERRUPT, tid, NULL, NULL);
		return -1;
	}
	if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL))
		return fail_errno(err, tid, "run injected code", "ptrace(INTERRUPT)",
				  "it has gone");
	return 0;
}

int parasite_finish(pid_t tid, struct inj_call *call, struct avc_error *err)
{
	if (parasite_halt(tid, call, err))
		return -1;
	return tracee_await(tid, NULL, err) == STOP_TRAP ? 0 : -1;
}

int parasite_run_on(pid_t tid, struct inj_call *call, struct avc_error *err)
{
	__atomic_store_n(&call->pause, INJ_PAUSE_OVER, __ATOMIC_RELEASE);
	return parasite_finish(tid, call, err);
}

int parasite_run(pid_t tid, struct inj_call *call, struct avc_error *err)
{
	return parasite_start(tid, err) ? -1 : parasite_finish(tid, call, err);
}

/* It has made all its calls without a clone event: a limit on processes or memory. */
static int clone_refused(pid_t tid, const struct inj_call *call, struct avc_error *err)
{
	int64_t result = 0;

	for (uint32_t i = 0; i < call->count && i < INJ_CALLS_MAX; i++)
		if (call->call[i].nr == SYS_clone)
			result = call->call[i].result;
	if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL))
		return fail_errno(err, tid, "clone", "ptrace(INTERRUPT)", "it has gone");
	if (tracee_await(tid, NULL, err) != STOP_TRAP)
		return -1;
	return fail(err, AVC_LIMIT, (int)-result, tid, "clone", "clone",
		    "it may not have another process: %s", strerror((int)-result));
}

int parasite_await_clone(pid_t tid, const struct inj_call *call, pid_t *child,
			 struct avc_error *err)
{
	for (;;) {
		struct stop stop;

		tracee_watch(&call->done);
		stop = tracee_wait(tid, 0);
		tracee_watch(NULL);
		switch (stop.kind) {
		case STOP_FORK:
			*child = stop.message;
			return 0;
		case STOP_EXIT:
		case STOP_DYING:
			return fail(err, AVC_GONE, 0, tid, "clone", "", "it has ended");
		case STOP_DEADLINE:
			if (!__atomic_load_n(&call->done, __ATOMIC_ACQUIRE))
				return fail(err, AVC_DEADLINE, 0, tid, "clone", "clone",
					    "not done in time");
			return clone_refused(tid, call, err);
		default:
			/* SIGSTOP, SIGCONT and job control cause stops of their own (ptrace(2),
			 * PTRACE_EVENT_STOP). */
			if (seccomp_go_on(tid, &stop))
				return fail_errno(err, tid, "clone", "ptrace(CONT)", "it has gone");
		}
	}
}

int parasite_run_clone(pid_t tid, const struct inj_call *call, pid_t *child, struct avc_error *err)
{
	return parasite_run_clone_while(tid, call, NULL, NULL, child, err);
}

int parasite_run_clone_while(pid_t tid, const struct inj_call *call, void (*meanwhile)(void *arg),
			     void *arg, pid_t *child, struct avc_error *err)
{
	if (parasite_start(tid, err))
		return -1;
	if (meanwhile)
		meanwhile(arg);
	return parasite_await_clone(tid, call, child, err);
}

bool parasite_is_old(const struct process *process, avc_remote address)
{
	return parasite_is_needed(process, address) && !cut_is_place(process, address);
}

bool parasite_is_needed(const struct process *process, avc_remote address)
{
	for (uint32_t i = 0; i < process->old_parasites; i++)
		if (address - process->old_parasite[i].base < process->old_parasite[i].bytes)
			return true;
	return address >= process->stubs_start && address < process->stubs_end;
}

/* One without filters may get some from another thread meanwhile (SECCOMP_FILTER_FLAG_TSYNC). */
static long options_of(const struct parasite *parasite, bool ours)
{
	return (long)((ours ? TRACE_OPTIONS_OURS : TRACE_OPTIONS_APP) |
		      (parasite->seccomp == SECCOMP_NONE && !seccomp_is_confined()
			       ? PTRACE_O_SUSPEND_SECCOMP
			       : 0));
}

int parasite_own(const struct parasite *parasite, pid_t tid)
{
	return ptrace(PTRACE_SETOPTIONS, tid, NULL, options_of(parasite, true)) ? -1 : 0;
}

/* Decides how the thread will be resumed: it is borrowed next. */
static int look_at_seccomp(struct process *process, struct thread *thread, struct avc_error *err)
{
	struct parasite *parasite = &process->parasite;
	long options;
	bool plain;

	if (seccomp_read(process, thread, err))
		return -1;
	if (parasite->seccomp == SECCOMP_SUPERVISED) /* for another thread */
		thread->seccomp = SECCOMP_SUPERVISED;
	parasite->seccomp = thread->seccomp;
	options = options_of(parasite, false);
	plain = options == (long)TRACE_OPTIONS_APP;
	/* A supervised one changes them at each call (seccomp_at_call()). */
	if (plain && thread->plain && thread->seccomp != SECCOMP_SUPERVISED)
		return 0;
	if (ptrace(PTRACE_SETOPTIONS, thread->tid, NULL, options))
		return fail_errno(err, thread->tid, "run injected code", "ptrace(SETOPTIONS)",
				  "it has gone");
	thread->plain = plain;
	return 0;
}

/* execve(2) can replace the program at any moment, and the parasite with it: checks, in a stopped
 * thread, that it is there.  If not, the process is not infected any more. */
static int check_there(struct process *process, pid_t tid, struct avc_error *err)
{
	const avc_remote at = process->parasite.base + INJ_CODE_BYTES +
			      offsetof(struct inj_control, nonce);
	long nonce;

	errno = 0;
	nonce = ptrace(PTRACE_PEEKDATA, tid, (void *)at, NULL);
	if (errno == ESRCH)
		return fail_errno(err, tid, "stop", "ptrace(PEEKDATA)", "it has ended");
	if (errno || (uint64_t)nonce != process->nonce) {
		process->infected = false;
		/* Where children are started all the time, it is one of them in many freezes. */
		return fail(err, AVC_RETRY, 0, tid, "stop", "", "it has executed another program");
	}
	return 0;
}

/* A holder has the memory of the program in which it was made. */
static bool has_memory_of_holder(const struct process *process)
{
	return process->holder && proc_same_memory(process->pid, process->holder);
}

int thread_vet(struct process *process, struct thread *thread, struct avc_error *err)
{
	if (thread_check_dispatch(thread->tid, err))
		return -1;
	/* Or in 32-bit code at the moment, as Wine's threads: ours would be taken for that. */
	if (!arch_is_native(&thread->regs))
		return fail(err, AVC_UNSUPPORTED, 0, thread->tid, "check", "",
			    "it is a 32-bit program");
	if (!has_memory_of_holder(process) && check_there(process, thread->tid, err))
		return -1;
	/* A thread must return into the app, never into a parasite that will be unmapped. */
	if (parasite_is_old(process, arch_pc(&thread->regs)))
		return fail(err, AVC_DEADLINE, 0, thread->tid, "stop", "",
			    "still on its way home from a guard that died");
	/* The kernel forgets a restartable sequence as soon as the thread is outside of it: it has
	 * to continue where the kernel would send it. There are no system calls in one. */
	if (thread->call.nr < 0)
		thread_fix_rseq(process->mem_fd, thread);
	thread->vetted = true;
	return 0;
}

bool parasite_says_home(const struct parasite *parasite)
{
	return __atomic_load_n(&parasite->control->arrived, __ATOMIC_ACQUIRE);
}

int thread_borrow(struct process *process, struct thread *thread, struct avc_error *err)
{
	const uint64_t all = ~UINT64_C(0);
	struct inj_control *control = process->parasite.control;
	struct arch_regs home;

	if (!thread->vetted && thread_vet(process, thread, err))
		return -1;
	if (arch_is_delicate(thread->tid))
		return fail(err, AVC_RETRY, 0, thread->tid, "run injected code", "",
			    "it is in the middle of vector code");
	if (process->parasite.left_ns)
		return fail(err, AVC_DEADLINE, 0, thread->tid, "run injected code", "",
			    "a thread is still on its way home");
	rewind_home(thread, &home);
	arch_home_set(&control->home, &home, thread->sigmask);
	control->arrived = 0;
	/* Registers first: if we die between the two, the thread enters the parasite with its own
	 * mask, and blocks signals by itself (inj_enter()). In the other order it would be in the
	 * app with every signal blocked, forever. */
	if (look_at_seccomp(process, thread, err) ||
	    send_in(&process->parasite, thread->tid, false, &thread->regs, &control->runner, err))
		return -1;
	thread->borrowed = true;
	thread->borrowed_for = &process->parasite;
	if (ptrace(PTRACE_SETSIGMASK, thread->tid, sizeof all, &all))
		return fail_errno(err, thread->tid, "run injected code", "ptrace(SETSIGMASK)",
				  "it has gone");
	return 0;
}

void thread_head_home(const struct thread *thread, struct arch_regs *regs)
{
	const uint64_t nothing[6] = { SIG_SETMASK };

	if (thread->borrowed_for)
		arch_enter(regs, &thread->regs, thread->borrowed_for->base + INJ_GO_HOME_OFFSET, 0,
			   0);
	else
		arch_stub_call(regs, &thread->regs, thread->stub, false, SYS_rt_sigprocmask,
			       nothing);
}

int thread_give_back(struct thread *thread, struct avc_error *err)
{
	struct arch_regs now;

	if (arch_regs_get(thread->tid, &now))
		return fail_errno(err, thread->tid, "give back", "ptrace(GETREGS)", "it has gone");
	/* If the guard gets no CPU for this long (park_ms), the thread takes it for dead: it has
	 * returned by itself, and its registers are newer than ours. */
	if (thread->borrowed_for && !parasite_contains(thread->borrowed_for, arch_pc(&now))) {
		thread->borrowed = false;
		thread->borrowed_for->left_ns = now_ns();
		return fail(err, AVC_RETRY, 0, thread->tid, "give back", "",
			    "it has gone on by itself, for the guard came too late");
	}
	/* The mask before the registers, for the same reason. But not while it is on the parasite's
	 * stack, where a handler would run if we died, or about to clone a porter: it is sent to
	 * where it goes home from first, which it would reach with any mask. */
	thread_head_home(thread, &now);
	if (arch_regs_set(thread->tid, &now) ||
	    ptrace(PTRACE_SETSIGMASK, thread->tid, sizeof thread->sigmask, &thread->sigmask) ||
	    arch_regs_set(thread->tid, &thread->regs))
		return fail_errno(err, thread->tid, "give back", "ptrace(SETREGS)", "it has gone");
	seccomp_end_supervision(thread->tid);
	thread->borrowed = false;
	thread->sent_back = true;
	return 0;
}
