/* SPDX-License-Identifier: Apache-2.0
 *
 * A thread of the app: stop, await, release.
 */
#include <errno.h>
#include <sched.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "trace.h"

#define THREADS_BYTES (THREADS_MAX * sizeof(struct thread))
#define ROOM_FIRST 16 /* threads; then twice as many, and so on */

/* They stay where they are, so there is address space for all of them.  Of the limit of our memory
 * (RLIMIT_DATA), which has to do for hundreds of processes, only those take a part that there are:
 * the kernel counts what may be written. */
bool threads_reserve(struct process *process)
{
	void *room = mmap(NULL, THREADS_BYTES, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);

	process->threads = room == MAP_FAILED ? NULL : room;
	return process->threads != NULL;
}

void threads_free(struct process *process)
{
	if (process->threads)
		munmap(process->threads, THREADS_BYTES);
	process->threads = NULL;
	process->thread_room = 0;
}

static int more_room(struct process *process, pid_t tid, struct avc_error *err)
{
	const uint32_t room = process->thread_room ? 2 * process->thread_room : ROOM_FIRST;

	if (process->thread_room == THREADS_MAX)
		return fail(err, AVC_DEADLINE, 0, tid, "freeze", "",
			    "threads appear faster than they can be stopped");
	if (mprotect(process->threads, room * sizeof *process->threads, PROT_READ | PROT_WRITE))
		return fail_memory(err, tid, "walk threads");
	process->thread_room = room;
	return 0;
}

struct thread *thread_find(struct process *process, pid_t tid)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].tid == tid)
			return &process->threads[i];
	return NULL;
}

struct thread *thread_add(struct process *process, pid_t tid, struct avc_error *err)
{
	struct thread *t;

	if (process->thread_count == process->thread_room && more_room(process, tid, err))
		return NULL;
	t = &process->threads[process->thread_count++];
	*t = (struct thread){ .tid = tid, .call.nr = -1, .block = -1 };
	return t;
}

void threads_forget_unseen(struct process *process)
{
	uint32_t kept = 0;

	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].seen || process->threads[i].attached)
			process->threads[kept++] = process->threads[i];
	process->thread_count = kept;
}

bool threads_all_stopped(const struct process *process)
{
	int stopped = 0;

	for (uint32_t i = 0; i < process->thread_count; i++)
		stopped += process->threads[i].seen && process->threads[i].stopped;
	return stopped && proc_thread_count(process->task_dirfd) == stopped;
}

/* 0: it is seized after all. EPERM is also the result for an exiting task (kernel/ptrace.c,
 * ptrace_attach), which has no memory any more, or is a zombie. */
static int seize_failed(pid_t pid, pid_t tid, struct avc_error *err)
{
	const int errnum = errno;
	struct proc_status status;
	char name[16 + 1] = "?"; /* TASK_COMM_LEN, with a line feed at its end */

	if (errnum == EPERM) {
		if (proc_status(tid, &status)) {
			if (!is_shortage(errno))
				errno = ESRCH;
			return fail_errno(err, tid, "stop", "ptrace(SEIZE)", "it has ended");
		}
		if (status.locked_kb < 0)
			return fail(err, AVC_GONE, errnum, tid, "stop", "ptrace(SEIZE)",
				    "it has ended");
		if (status.tracer) {
			/* It may have gone just now. */
			proc_read(status.tracer, "comm", name, sizeof name);
			return fail(err, AVC_BUSY, errnum, pid, "stop", "ptrace(SEIZE)",
				    "it is being traced by process %d (%.*s)", status.tracer,
				    (int)strcspn(name, "\n"), name);
		}
	}
	/* Its tracer may have just exited. */
	if (errnum == EPERM && tracee_seize(tid, (long)TRACE_OPTIONS_APP) == 0)
		return 0;
	if (errnum == EAGAIN)
		return fail(err, AVC_DEADLINE, errnum, tid, "stop", "ptrace(SEIZE)",
			    "its process is executing another program");
	errno = errnum;
	return fail_errno(err, tid, "stop", "ptrace(SEIZE)",
			  "not allowed to trace it (CAP_SYS_PTRACE and CAP_SYS_ADMIN are needed)");
}

/* A process or thread created by a traced thread meanwhile. */
static struct thread *adopt(struct process *process, pid_t tid, struct avc_error *err)
{
	struct thread *born = thread_find(process, tid);

	if (!born)
		born = thread_add(process, tid, err);
	if (born && !born->attached) {
		born->attached = true;
		born->plain = false;
		born->stopped = false;
	}
	return born;
}

/* There is no tracee of that number any more.  execve(2) gives its caller that of the main thread
 * (fs/exec.c, de_thread()): it is our tracee still, but none that anybody would release.  True if it
 * has to be waited for as that. */
static bool follow_exec(struct process *process, pid_t tid)
{
	struct avc_error ignored = { 0 };

	if (!process->leader)
		tracee_expect_strangers(); /* of a process that is not known any more */
	return process->leader && tid != process->leader && tracee_is_ours(process->leader) &&
	       adopt(process, process->leader, &ignored);
}

int thread_stop(struct process *process, struct thread *thread, struct avc_error *err)
{
	int errnum;

	thread->plain = false;
	process->given = 0;
	if (tracee_seize(thread->tid, (long)TRACE_OPTIONS_APP)) {
		errnum = errno;
		if (errnum == ESRCH) {
			(void)follow_exec(process, thread->tid);
			return fail(err, AVC_GONE, ESRCH, thread->tid, "stop", "ptrace(SEIZE)",
				    "it has ended");
		}
		/* A thread just created by a traced one is our tracee already, though it may not
		 * have been reported yet. */
		if (errnum == EPERM && tracee_is_ours(thread->tid)) {
			thread->attached = true; /* and comes with its own stop */
			thread->stopped = false;
			return 0;
		}
		errno = errnum;
		if (seize_failed(process->pid, thread->tid, err))
			return -1;
	}
	thread->attached = true;
	thread->plain = true;
	thread->stopped = false;
	if (ptrace(PTRACE_INTERRUPT, thread->tid, NULL, NULL))
		return fail_errno(err, thread->tid, "stop", "ptrace(INTERRUPT)", "it has ended");
	return 0;
}

/* Whether the call it returns from has created a task that may be our tracee
 * (tracee_release_strangers()). */
static bool has_stranger(const struct process *process, const struct thread *thread)
{
	const long nr = arch_syscall_nr(&thread->regs);
	uint64_t flags = arch_syscall_arg(&thread->regs, 0);

	if ((nr != SYS_clone && nr != SYS_clone3) || arch_syscall_result(&thread->regs) <= 0)
		return false;
	/* They come first in struct clone_args. */
	if (nr == SYS_clone3 &&
	    pread(process->mem_fd, &flags, sizeof flags, (off_t)flags) != sizeof flags)
		return false;
	return flags & CLONE_PTRACE;
}

int thread_await(struct process *process, struct thread *thread, struct avc_error *err)
{
	pid_t child = 0;
	/* It may be waiting for a child unknown to us (vfork(2)). */
	const enum stop_kind kind = tracee_await_while(thread->tid, tracee_release_strangers,
						       &child, err);

	/* In any case, its new threads are found by the next walk, already attached; new processes
	 * are not, which is how freeze_tree() distinguishes them. */
	if (child && !adopt(process, child, err))
		return -1;
	switch (kind) {
	case STOP_TRAP:
		break;
	case STOP_EXIT:
		thread->attached = false; /* reaped */
		(void)follow_exec(process, thread->tid);
		return -1;
	default:
		return -1;
	}
	thread->stopped = true;
	thread->sent_back = false;
	thread->vetted = false;
	thread->umask = -1;
	thread->stop_signal = tracee_group_signal();
	if (arch_regs_get(thread->tid, &thread->regs)) {
		thread->stopped = false;
		return fail_errno(err, thread->tid, "stop", "ptrace(GETREGS)", "it has ended");
	}
	if (has_stranger(process, thread))
		tracee_expect_strangers();
	rewind_call(process, thread);
	return 0;
}

void thread_runs_on(struct thread *thread, const struct avc_error *err)
{
	if (err->code == AVC_DEADLINE || err->code == AVC_RETRY || err->code == AVC_GONE)
		thread->stopped = false;
}

static bool is_waiting(pid_t tid, uint32_t which)
{
	const struct __ptrace_peeksiginfo_args first = { .flags = which, .nr = 1 };
	siginfo_t info;

	return ptrace(PTRACE_PEEKSIGINFO, tid, &first, &info) > 0;
}

/* A signal with a handler that came while we held the thread ends its call.  Where the kernel does not
 * know any more that there was a call, it would have the handler run, and the call made again after
 * it.  So it does with a signal that comes between this look and the thread's way back.  Tracing the
 * thread into its call would be no better: a detach at the entry of a call has it return EINTR
 * (kernel/ptrace.c, __ptrace_unlink(): TIF_SIGPENDING).
 *
 * Whether -ERESTARTSYS becomes EINTR depends on sigaction's flags: those calls are restarted. */
static void end_call_by_signal(struct process *process, struct thread *thread)
{
	const long result = arch_syscall_result(&thread->regs);
	struct arch_regs regs = thread->regs;
	struct proc_status status;
	uint64_t caught;

	if (!ARCH_FORGETS_CALLS || !thread->sent_back || arch_syscall_nr(&regs) < 0 ||
	    (result != -ERESTARTNOHAND && result != -ERESTART_RESTARTBLOCK))
		return;
	if ((!is_waiting(thread->tid, 0) && !is_waiting(thread->tid, PTRACE_PEEKSIGINFO_SHARED)) ||
	    proc_status(thread->tid, &status))
		return;
	caught = status.caught & ~status.blocked;
	if (!(caught & (status.pending | (status.shared_pending & ~process->given))))
		return;
	process->given |= caught & status.shared_pending;
	arch_result_note(&regs, -EINTR);
	(void)arch_regs_set(thread->tid, &regs); /* fails if it was killed */
}

void thread_release(struct process *process, struct thread *thread)
{
	struct avc_error ignored = { 0 };

	if (!thread->attached || !thread->stopped)
		return;
	/* Otherwise it is elsewhere by now. */
	if (!thread->borrowed || thread_give_back(thread, &ignored) == 0)
		rewind_continued(process, thread);
	cut_go_on(process, thread); /* there may have been no parasite when it was stopped */
	end_call_by_signal(process, thread);
	/* If this fails, SIGKILL has ended its stop: it has to be reaped. */
	thread->attached = ptrace(PTRACE_DETACH, thread->tid, NULL, 0L) != 0;
	thread->stopped = false;
}

void thread_let_go(struct process *process, struct thread *thread)
{
	if (thread->attached && thread->stopped)
		rewind_count_stop(process, thread);
	thread_release(process, thread);
}

/* Or its parasite has been replaced, and it returns without us. */
static bool has_made_calls(const struct process *process)
{
	const struct inj_control *control = process->parasite.control;

	return !control || __atomic_load_n(&control->runner.done, __ATOMIC_ACQUIRE);
}

static bool is_in_stub(const struct thread *thread, const struct arch_regs *now)
{
	return thread->borrowed && !thread->borrowed_for &&
	       arch_pc(now) - thread->stub < ARCH_STUB_BYTES;
}

/* The last call of the stub takes the thread's own signal mask back.  From then on a signal that comes
 * again and again has its handler run, instead of the rest of the stub. */
static bool has_own_mask(pid_t tid)
{
	const uint64_t unblockable = SIGNAL_BIT(SIGKILL) | SIGNAL_BIT(SIGSTOP);
	uint64_t mask;

	return ptrace(PTRACE_GETSIGMASK, tid, sizeof mask, &mask) == 0 &&
	       (mask | unblockable) != ~UINT64_C(0);
}

/* From where it can be given back: it has no porter.  Otherwise it still has to reap that. */
static bool has_no_porter(const struct thread *thread, const struct arch_regs *now)
{
	return arch_pc(now) == thread->stub ||
	       (arch_syscall_nr(now) == SYS_clone && arch_syscall_result(now) < 0) ||
	       has_own_mask(thread->tid);
}

/* In the middle of its calls it may still have to restore something (MADV_DONTFORK), or to reap a task
 * that it created for us, which the app would find.  Let go in the stub, it would make them under the
 * app's filters. */
static bool must_go_on(const struct process *process, const struct thread *thread,
		       const struct arch_regs *now)
{
	if (is_in_stub(thread, now))
		return !has_no_porter(thread, now);
	return thread->borrowed && parasite_contains(&process->parasite, arch_pc(now)) &&
	       !has_made_calls(process);
}

/* What a thread has created that was no longer waited for. */
static void take_child(struct process *process, struct thread *thread, pid_t child)
{
	struct avc_error ignored = { 0 };
	struct arch_regs now;
	const bool borrowed = thread->borrowed && arch_regs_get(thread->tid, &now) == 0;
	const bool in_stub = borrowed && is_in_stub(thread, &now);
	const avc_remote stub = thread->stub;
	struct thread *born;

	/* A borrowed thread may have returned by itself, and what it creates then belongs to the
	 * app: killing one thread kills them all. */
	if ((in_stub && !(arch_syscall_arg(&now, 0) & CLONE_THREAD)) ||
	    (borrowed && parasite_contains(&process->parasite, arch_pc(&now)))) {
		tracee_kill(child); /* our clone, too late */
		return;
	}
	born = adopt(process, child, &ignored);
	if (!born || !in_stub)
		return;
	/* A porter that is a thread exits by itself, but not under the app's filters. */
	born->borrowed_for = NULL;
	born->stub = stub;
	born->borrowed = seccomp_supervise(child, 0, (long)TRACE_OPTIONS_APP, stub,
					   ARCH_STUB_BYTES) == 0;
}

/* Registers can only be read of a stopped task.  If no event is pending then, the stop has been consumed
 * already, and it would stay stopped forever. */
static struct stop next_stop(pid_t tid)
{
	struct stop stop = tracee_wait(tid, WNOHANG);
	struct arch_regs now;

	if (stop.kind != STOP_NONE || arch_regs_get(tid, &now))
		return stop;
	stop = tracee_wait(tid, WNOHANG);
	if (stop.kind == STOP_NONE)
		stop.kind = STOP_TRAP;
	return stop;
}

/* It may have returned by itself meanwhile, and would never stop again.  Before that it needs a CPU:
 * interrupted again and again, it would never make its calls. */
static void interrupt_running(const struct process *process, const struct thread *thread)
{
	if (!thread->borrowed || !thread->borrowed_for || has_made_calls(process))
		ptrace(PTRACE_INTERRUPT, thread->tid, NULL, NULL);
}

/* Registers cannot be changed at this stop: lets it reach another one.  A clone that is interrupted
 * where it begins is begun again (ERESTARTNOINTR), and again. */
static void leave_call(const struct process *process, const struct thread *thread,
		       struct stop *stop)
{
	struct arch_regs now;

	if (!tracee_enters_call(thread->tid) &&
	    (arch_regs_get(thread->tid, &now) || !must_go_on(process, thread, &now)))
		ptrace(PTRACE_INTERRUPT, thread->tid, NULL, NULL);
	seccomp_go_on(thread->tid, stop);
}

/* True if another task has to be waited for in its place. */
static bool note_end(struct process *process, struct thread *thread)
{
	const pid_t tid = thread->tid;

	process->lost = process->lost || thread->borrowed;
	seccomp_end_supervision(tid);
	thread->attached = false;
	thread->borrowed = false;
	return follow_exec(process, tid);
}

/* Its registers become the app's, if they are not. */
static void send_home(struct process *process, struct thread *thread, const struct arch_regs *now)
{
	struct avc_error ignored = { 0 };

	if (is_in_stub(thread, now) ||
	    (thread->borrowed && parasite_contains(&process->parasite, arch_pc(now)))) {
		thread_give_back(thread, &ignored);
		return;
	}
	if (thread->borrowed && thread->borrowed_for)
		thread->borrowed_for->left_ns = now_ns();
	thread->borrowed = false;
	thread->regs = *now;
	rewind_call(process, thread);
	rewind_continued(process, thread);
}

/* True while it still has to be waited for. */
static bool straggle(struct process *process, struct thread *thread)
{
	const pid_t tid = thread->tid;
	struct stop stop = next_stop(tid);
	struct arch_regs now;

	switch (stop.kind) {
	case STOP_NONE:
		interrupt_running(process, thread);
		return true;
	case STOP_DYING:
	case STOP_DEADLINE:
		return true;
	case STOP_EXIT:
		return note_end(process, thread);
	case STOP_FORK:
		take_child(process, thread, stop.message);
		/* fall through */
	case STOP_SYSCALL:
		leave_call(process, thread, &stop);
		return true;
	default:
		break;
	}
	if (arch_regs_get(tid, &now) == 0) {
		if (must_go_on(process, thread, &now)) {
			seccomp_go_on(tid, &stop);
			return true;
		}
		send_home(process, thread, &now);
	}
	if (ptrace(PTRACE_DETACH, tid, NULL, (long)(stop.kind == STOP_SIGNAL ? stop.signal : 0)))
		return true; /* killed: to be reaped */
	seccomp_end_supervision(tid);
	thread->attached = false;
	return false;
}

uint32_t threads_tend_stragglers(struct process *process)
{
	uint32_t left = 0;

	for (uint32_t i = 0; i < process->thread_count; i++) /* may grow */
		if (process->threads[i].attached && straggle(process, &process->threads[i]))
			left++;
	return left;
}

struct rseq_cs {
	uint32_t version, flags;
	uint64_t start, length, abort;
};

void thread_fix_rseq(int mem_fd, struct thread *thread)
{
	struct rseq_cs cs;
	uint64_t pointer;

	/* struct rseq: cpu_id_start, cpu_id (4 bytes each), rseq_cs */
	if (!thread->rseq ||
	    pread(mem_fd, &pointer, sizeof pointer, (off_t)(thread->rseq + 8)) != sizeof pointer ||
	    !pointer || pread(mem_fd, &cs, sizeof cs, (off_t)pointer) != sizeof cs)
		return;
	if (arch_pc(&thread->regs) - cs.start < cs.length)
		arch_pc_set(&thread->regs, cs.abort);
}

/* Since Linux 6.4; the headers may be older. */
#define GET_DISPATCH 0x4211 /* PTRACE_GET_SYSCALL_USER_DISPATCH_CONFIG */

/* Checked before a thread runs injected code: depending on its selector, every system call from
 * outside the allowed range raises SIGSYS (Documentation/admin-guide/ syscall-user-dispatch.rst),
 * which kills the app when all signals are blocked. */
int thread_check_dispatch(pid_t tid, struct avc_error *err)
{
	struct {
		uint64_t mode, selector, offset, bytes;
	} dispatch = { 0 };

	if (ptrace(GET_DISPATCH, tid, sizeof dispatch, &dispatch) == 0 && dispatch.mode)
		return fail(err, AVC_UNSUPPORTED, 0, tid, "check", "",
			    "it dispatches system calls by itself (Syscall User Dispatch, as Wine "
			    "does)");
	return 0;
}
