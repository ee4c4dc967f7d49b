/* SPDX-License-Identifier: Apache-2.0
 *
 * The app's main process and its threads: stopped, asked, let go.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "internal.h"

#define PIDFD_THREAD_ O_EXCL /* linux/pidfd.h */
#define PIDFS_MAGIC 0xff     /* the same, PIDFS_IOCTL_MAGIC */
#define ASK_AGAIN_AFTER 8    /* checkpoints */
#define ASK_AGAIN_AT_ONCE 2

void target_init(struct target *target)
{
	*target = (struct target){ .pidfd = -1,
				   .leader_pidfd = -1,
				   .task_dirfd = -1,
				   .mem_fd = -1,
				   .timers_fd = -1,
				   .stat_fd = -1,
				   .statm_fd = -1,
				   .holder_pidfd = -1,
				   .due_ns = UINT64_MAX };
}

bool target_make_room(struct target *target)
{
	target->threads = calloc(THREADS_MAX, sizeof *target->threads);
	target->thread_room = THREADS_MAX;
	target->memory = memory_new();
	target->pending = pending_new();
	target->timers = timers_new();
	return target->threads && target->memory && target->pending && target->timers;
}

void target_free_room(struct target *target)
{
	free(target->threads);
	memory_free(target->memory);
	free(target->pending);
	free(target->timers);
	target->threads = NULL;
	target->memory = NULL;
	target->pending = NULL;
	target->timers = NULL;
}

/* A descriptor for its table of descriptors: the main thread has none any more when it
 * has ended, and the others have pidfds of their own since Linux 6.9. */
static int follow(struct target *target, struct avc_error *err)
{
	const pid_t pid = proc_live_thread(target->leader);

	if (!pid)
		return fail(err, AVC_GONE, ESRCH, target->leader, "attach", "", "it has ended");
	close_fd(&target->pidfd);
	close_fd(&target->statm_fd);
	target->pid = pid;
	/* Its number is nobody else's as long as there are others. */
	if (pid != target->leader && target->leader_pidfd < 0)
		target->leader_pidfd = proc_pidfd_open(target->leader);
	target->statm_fd = proc_open(pid, "statm", O_RDONLY);
	target->pidfd = pid == target->leader ? proc_pidfd_open(pid)
					      : (int)syscall(SYS_pidfd_open, pid, PIDFD_THREAD_);
	if (target->pidfd < 0 && errno == EINVAL)
		return fail(err, AVC_UNSUPPORTED, EINVAL, target->leader, "attach",
			    "pidfd_open(PIDFD_THREAD)",
			    "its main thread has ended, which needs Linux 6.9");
	if (target->pidfd < 0)
		return fail_errno(err, target->leader, "attach", "pidfd_open", "it has ended");
	return 0;
}

int target_follow(struct target *target, struct avc_error *err)
{
	return proc_live_thread(target->pid) == target->pid ? 0 : follow(target, err);
}

void target_kill(const struct target *target)
{
	syscall(SYS_pidfd_send_signal,
		target->leader_pidfd < 0 ? target->pidfd : target->leader_pidfd, SIGKILL, NULL, 0);
}

int target_open(struct target *target, pid_t pid, pid_t inside, struct avc_error *err)
{
	target->leader = pid;
	target->inside = inside;
	target->task_dirfd = proc_open(pid, "task", O_RDONLY | O_DIRECTORY);
	target->timers_fd = proc_open(pid, "timers", O_RDONLY);
	target->stat_fd = proc_open(pid, "stat", O_RDONLY);
	if (follow(target, err)) {
		target_close(target);
		return -1;
	}
	target->mem_fd = proc_open(target->pid, "mem", O_RDWR);
	if (target->pidfd < 0 || target->task_dirfd < 0 || target->mem_fd < 0 ||
	    target->timers_fd < 0 || target->stat_fd < 0 || target->statm_fd < 0) {
		fail_errno(err, pid, "attach", "open(/proc)", "its /proc can not be read");
		target_close(target);
		return -1;
	}
	return 0;
}

void target_close(struct target *target)
{
	close_fd(&target->pidfd);
	close_fd(&target->leader_pidfd);
	close_fd(&target->task_dirfd);
	close_fd(&target->mem_fd);
	close_fd(&target->timers_fd);
	close_fd(&target->stat_fd);
	close_fd(&target->statm_fd);
	target->pid = 0;
	target->leader = 0;
	target->infected = false;
	/* Stragglers stay: a tracee that nobody waits for is a zombie for ever. */
	for (uint32_t i = 0; i < target->thread_count; i++) {
		target->threads[i].seen = false;
		target->threads[i].known = false;
	}
	threads_forget_unseen(target);
	files_forget(target);
}

struct thread *thread_find(struct target *target, pid_t tid)
{
	for (uint32_t i = 0; i < target->thread_count; i++)
		if (target->threads[i].tid == tid)
			return &target->threads[i];
	return NULL;
}

struct thread *thread_add(struct target *target, pid_t tid, struct avc_error *err)
{
	struct thread *t;

	if (target->thread_count == target->thread_room) {
		fail(err, AVC_DEADLINE, 0, tid, "freeze", "",
		     "threads appear faster than they can be stopped");
		return NULL;
	}
	t = &target->threads[target->thread_count++];
	*t = (struct thread){ .tid = tid,
			      .call.nr = -1,
			      .block = -1 };
	return t;
}

void threads_forget_unseen(struct target *target)
{
	uint32_t kept = 0;

	for (uint32_t i = 0; i < target->thread_count; i++)
		if (target->threads[i].seen || target->threads[i].attached)
			target->threads[kept++] = target->threads[i];
	target->thread_count = kept;
}

/* EPERM is also what an exiting task answers (kernel/ptrace.c, ptrace_attach); it
 * has no memory any more, or is a zombie. */
static int seize_failed(pid_t pid, pid_t tid, struct avc_error *err)
{
	const int errnum = errno;
	struct proc_status status;

	if (errnum == EPERM) {
		if (proc_status(tid, &status) || status.locked_kb < 0)
			return fail(err, AVC_GONE, errnum, tid, "stop", "ptrace(SEIZE)",
				    "it has ended");
		if (status.tracer)
			return fail(err, AVC_BUSY, errnum, pid, "stop", "ptrace(SEIZE)",
				    "it is being traced by process %d", status.tracer);
	}
	errno = errnum;
	return fail_errno(err, tid, "stop", "ptrace(SEIZE)",
			  "not allowed to trace it (CAP_SYS_PTRACE and CAP_SYS_ADMIN are needed)");
}

int thread_stop(struct target *target, struct thread *thread, struct avc_error *err)
{
	int errnum;

	if (ptrace(PTRACE_SEIZE, thread->tid, NULL, (long)TRACE_OPTIONS_APP)) {
		if (errno == ESRCH)
			return fail(err, AVC_GONE, ESRCH, thread->tid, "stop", "ptrace(SEIZE)",
				    "it has ended");
		errnum = errno;
		/* One that a thread of ours has just brought forth is our tracee already,
		 * though we may not have heard of it yet. */
		if (errnum == EPERM && tracee_is_ours(thread->tid)) {
			thread->attached = true; /* and comes with its own stop */
			thread->stopped = false;
			return 0;
		}
		errno = errnum;
		return seize_failed(target->pid, thread->tid, err);
	}
	thread->attached = true;
	thread->stopped = false;
	if (ptrace(PTRACE_INTERRUPT, thread->tid, NULL, NULL))
		return fail_errno(err, thread->tid, "stop", "ptrace(INTERRUPT)", "it has ended");
	return 0;
}

/* A process or thread that a thread of ours has brought forth meanwhile. */
static struct thread *adopt(struct target *target, pid_t tid, struct avc_error *err)
{
	struct thread *born = thread_find(target, tid);

	if (!born)
		born = thread_add(target, tid, err);
	if (born && !born->attached) {
		born->attached = true;
		born->stopped = false;
	}
	return born;
}

int thread_await(struct target *target, struct thread *thread, struct avc_error *err)
{
	pid_t child = 0;
	const enum stop_kind kind = tracee_await(thread->tid, &child, err);

	/* Whatever came of it: its new threads are found by the next walk, attached
	 * already; new processes are not, which is how freeze() tells them. */
	if (child && !adopt(target, child, err))
		return -1;
	switch (kind) {
	case STOP_TRAP:
		break;
	case STOP_EXIT:
		thread->attached = false; /* reaped */
		return -1;
	default:
		return -1;
	}
	thread->stopped = true;
	thread->vetted = false;
	thread->stop_signal = tracee_group_signal();
	if (arch_regs_get(thread->tid, &thread->regs)) {
		thread->stopped = false;
		return fail_errno(err, thread->tid, "stop", "ptrace(GETREGS)", "it has ended");
	}
	rewind_call(target, thread);
	return 0;
}

void thread_runs_on(struct thread *thread, const struct avc_error *err)
{
	if (err->code == AVC_DEADLINE || err->code == AVC_GONE)
		thread->stopped = false;
}

void thread_release(struct thread *thread)
{
	struct avc_error ignored = { 0 };

	if (!thread->attached || !thread->stopped)
		return;
	if (thread->borrowed)
		give_back(thread, &ignored);
	if (ptrace(PTRACE_DETACH, thread->tid, NULL, 0L) == 0) {
		thread->attached = false;
		thread->stopped = false;
		return;
	}
	/* SIGKILL has taken it out of its stop: it has to be reaped. */
	thread->stopped = false;
}

/* True as long as it still has to be waited for. */
static bool straggle(struct target *target, struct thread *thread)
{
	const pid_t tid = thread->tid;
	struct avc_error ignored = { 0 };
	struct stop stop = tracee_wait(tid, WNOHANG);
	struct arch_regs now;

	/* Registers can be read of what is stopped only.  If that is no news, somebody has
	 * heard of it already, and it would stay so for ever. */
	if (stop.kind == STOP_NONE && arch_regs_get(tid, &now) == 0) {
		stop = tracee_wait(tid, WNOHANG);
		if (stop.kind == STOP_NONE)
			stop.kind = STOP_TRAP;
	}

	switch (stop.kind) {
	case STOP_NONE:
		/* It may have found home by itself meanwhile, and would never stop again. */
		ptrace(PTRACE_INTERRUPT, tid, NULL, NULL);
		return true;
	case STOP_DYING:
	case STOP_DEADLINE:
		return true;
	case STOP_EXIT:
		target->lost = target->lost || thread->borrowed;
		thread->attached = false;
		thread->borrowed = false;
		return false;
	case STOP_FORK:
		/* A borrowed thread may have found home by itself, and what it starts
		 * there is the app's: to kill one thread is to kill them all. */
		if (thread->borrowed && arch_regs_get(tid, &now) == 0 &&
		    parasite_contains(&target->parasite, arch_pc(&now)))
			tracee_kill(stop.message); /* our clone, too late */
		else
			adopt(target, stop.message, &ignored);
		/* fall through */
	case STOP_SYSCALL:
		/* Not a place to change registers: let it come to a better one. */
		ptrace(PTRACE_INTERRUPT, tid, NULL, NULL);
		ptrace(PTRACE_CONT, tid, NULL, 0L);
		return true;
	default:
		break;
	}
	if (arch_regs_get(tid, &now) == 0) {
		/* Not before it has waited for what it brought forth for us: the app would
		 * find that. */
		if (target->waiting && thread->borrowed &&
		    parasite_contains(&target->parasite, arch_pc(&now)) &&
		    !__atomic_load_n(&target->parasite.control->runner.done, __ATOMIC_ACQUIRE)) {
			ptrace(PTRACE_CONT, tid, NULL, 0L);
			return true;
		}
		if (thread->borrowed && parasite_contains(&target->parasite, arch_pc(&now))) {
			give_back(thread, &ignored);
		} else {
			thread->borrowed = false;
			thread->regs = now;
			rewind_call(target, thread);
		}
	}
	if (ptrace(PTRACE_DETACH, tid, NULL, (long)(stop.kind == STOP_SIGNAL ? stop.signal : 0)))
		return true; /* killed: to be reaped */
	thread->attached = false;
	return false;
}

uint32_t stragglers(struct target *target)
{
	uint32_t left = 0;

	for (uint32_t i = 0; i < target->thread_count; i++) /* may grow */
		if (target->threads[i].attached && straggle(target, &target->threads[i]))
			left++;
	return left;
}

struct rseq_cs {
	uint32_t version, flags;
	uint64_t start, length, abort;
};

void rseq_fixup(int mem_fd, struct thread *thread)
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

static int read_signal_state(struct thread *thread, struct avc_error *err)
{
	struct ptrace_rseq_configuration_ {
		uint64_t pointer;
		uint32_t bytes, signature, flags, parasite;
	} rseq = { 0 };

	if (ptrace(PTRACE_GETSIGMASK, thread->tid, sizeof thread->sigmask, &thread->sigmask))
		return fail_errno(err, thread->tid, "read state", "ptrace(GETSIGMASK)",
				  "it has ended");
	/* PTRACE_GET_RSEQ_CONFIGURATION, since Linux 5.13 */
	if (ptrace(PTRACE_GET_RSEQ, thread->tid, sizeof rseq, &rseq) < 0)
		return fail_errno(err, thread->tid, "read state", "ptrace(GET_RSEQ_CONFIGURATION)",
				  "rseq can not be read");
	thread->rseq = rseq.pointer;
	thread->rseq_bytes = rseq.bytes;
	thread->rseq_signature = rseq.signature;
	return 0;
}

int thread_read(struct thread *thread, struct avc_error *err)
{
	long affinity;

	if (read_signal_state(thread, err))
		return -1;
	if (syscall(SYS_get_robust_list, thread->tid, &thread->robust_list, &thread->robust_bytes))
		return fail_errno(err, thread->tid, "read state", "get_robust_list",
				  "it has ended");
	/* As the kernel has it: bytes that were written, 0 on failure. */
	scheduling_read(thread->tid, &thread->scheduling);
	thread->affinity_bytes = 0;
	affinity = syscall(SYS_sched_getaffinity, thread->tid, sizeof thread->affinity,
			   thread->affinity);
	if (affinity > 0)
		thread->affinity_bytes = (uint32_t)affinity;
	return 0;
}

void ask_add(const struct target *target, bool with_locks, struct inj_call *call,
	     struct questions *questions)
{
	const avc_remote out = parasite_remote(&target->parasite, call->out);
	const struct inj_syscall *tid_address, *altstack, *inside, *name, *attributes, *locks;

	memset(call->out, 0, sizeof call->out);
	tid_address = call_add(call, SYS_prctl, PR_GET_TID_ADDRESS, out, 0, 0, 0);
	altstack = call_add(call, SYS_sigaltstack, 0, out + 8, 0, 0, 0);
	/* Not from /proc: whatever is looked at there is remembered, and makes the
	 * thread's end, for which a restore waits, several microseconds longer
	 * (fs/proc/base.c, proc_flush_pid()). */
	inside = call_add(call, SYS_gettid, 0, 0, 0, 0, 0);
	name = call_add(call, SYS_prctl, PR_GET_NAME, out + 32, 0, 0, 0);
	locks = with_locks ? call_add(call, INJ_FUTURE_LOCK, 0, 0, 0, 0, 0) : NULL;
	attributes = attributes_ask(call, call->out + 64, out + 64);
	*questions = (struct questions){ tid_address, altstack, inside, name, locks, attributes };
}

int ask(struct target *target, struct thread *thread, struct avc_error *err)
{
	struct inj_call *call = &target->parasite.control->runner;
	const bool is_main = thread->tid == target->pid, asked_before = thread->inside != 0;
	const struct creds was = thread->creds;
	struct questions questions;

	call_begin(call, INJ_AFTER_HOME);
	ask_add(target, is_main, call, &questions);
	if (read_signal_state(thread, err) || borrow(target, thread, err) ||
	    parasite_run(thread->tid, call, err))
		return -1;
	if (give_back(thread, err) || ask_answer(thread, call, &questions, err))
		return -1;
	return is_main && asked_before ? ask_others(target, thread, &was, err) : 0;
}

int ask_answer(struct thread *thread, const struct inj_call *call,
	       const struct questions *questions, struct avc_error *err)
{
	const struct inj_syscall *altstack = questions->altstack, *inside = questions->inside,
				 *name = questions->name, *locks = questions->locks;
	bool was_disarming;

	if (questions->tid_address->result)
		return fail(err, AVC_UNSUPPORTED, (int)-questions->tid_address->result, thread->tid,
			    "read state", "prctl(PR_GET_TID_ADDRESS)",
			    "the kernel lacks CONFIG_CHECKPOINT_RESTORE");
	if (altstack->result)
		return fail(err, AVC_KERNEL, (int)-altstack->result, thread->tid, "read state",
			    "sigaltstack", "refused");
	memcpy(&thread->clear_tid, call->out, 8);
	was_disarming = thread->disarmed || thread->altstack[1] & SS_AUTODISARM_;
	memcpy(thread->altstack, call->out + 8, 24);
	thread->disarmed = was_disarming && thread->altstack[1] & SS_DISABLE;
	if (inside->result <= 0 || name->result)
		return fail(err, AVC_KERNEL, (int)-name->result, thread->tid, "read state",
			    "prctl(PR_GET_NAME)", "refused");
	thread->inside = (pid_t)inside->result;
	memcpy(thread->name, call->out + 32, sizeof thread->name);
	thread->name[sizeof thread->name - 1] = 0;
	attributes_answer(questions->attributes, call->out + 64, &thread->creds);
	if (locks && locks->result > 0)
		thread->creds.future_lock = (int32_t)locks->result;
	thread->creds.filters = filters_read(thread->tid);
	thread->known_tls = arch_tls(&thread->regs);
	thread->young = !thread->known;
	thread->known = true;
	thread->asked = 0;
	return 0;
}

int ask_others(struct target *target, const struct thread *thread, const struct creds *was,
	       struct avc_error *err)
{
	struct creds is = thread->creds;

	is.future_lock = was->future_lock; /* of the process's memory, no matter of threads */
	if (target->thread_count == 1 || !memcmp(was, &is, sizeof is))
		return 0;
	for (uint32_t i = 0; i < target->thread_count; i++)
		target->threads[i].known &= &target->threads[i] == thread;
	return fail(err, AVC_DEADLINE, EAGAIN, target->pid, "read state", "",
		    "its threads are just changing what they may do");
}

struct walk {
	struct target *target;
	uint32_t count, fresh;
	struct avc_error *err;
};

static int count_task(pid_t tid, void *arg)
{
	struct walk *walk = arg;
	struct thread *t;

	walk->count++;
	if (walk->count > walk->target->thread_room)
		return 0;
	t = thread_find(walk->target, tid);
	if (!t)
		t = thread_add(walk->target, tid, walk->err);
	if (t)
		t->seen = true;
	return 0;
}

int take_stock(struct target *target, struct avc_error *err)
{
	struct walk walk = { .target = target, .err = err };

	for (uint32_t i = 0; i < target->thread_count; i++)
		target->threads[i].seen = false;
	if (proc_tasks(target->task_dirfd, count_task, &walk))
		return fail_errno(err, target->pid, "walk threads", "getdents64", "it has ended");
	if (walk.count > target->thread_room)
		return fail(err, AVC_UNSUPPORTED, 0, target->pid, "walk threads", "",
			    "it has %u threads; %u are supported", walk.count, target->thread_room);
	threads_forget_unseen(target);
	return err->code ? -1 : 0;
}

/* In the order of their numbers they can be made again with the fewest writes to
 * ns_last_pid. */
static int by_inside(const void *a, const void *b)
{
	const struct thread *x = a, *y = b;

	return (x->inside > y->inside) - (x->inside < y->inside);
}

/* A process that one of them has just brought forth stands among them, too, until the next
 * look (adopt()). */
static bool is_thread(const struct target *target, pid_t tid)
{
	char number[16];

	snprintf(number, sizeof number, "%d", tid);
	return faccessat(target->task_dirfd, number, F_OK, 0) == 0;
}

/* unshare(2): those that are restored have the main thread's.  It is stopped. */
static int check_unshared(const struct target *target, const struct thread *t,
			  struct avc_error *err)
{
	const char *what = NULL;

	if (proc_shares(target->pid, t->tid, SHARED_FILES) == 0)
		what = "a descriptor table of its own (CLONE_FILES)";
	else if (proc_shares(target->pid, t->tid, SHARED_FOLDERS) == 0)
		what = "a working directory of its own (CLONE_FS)";
	/* A main thread that is just ending has none. */
	if (!what || proc_is_exiting(target->pid) || proc_is_exiting(t->tid))
		return 0;
	if (!is_thread(target, t->tid))
		return fail(err, AVC_GONE, 0, t->tid, "check", "", "it is no thread");
	return fail(err, AVC_UNSUPPORTED, 0, t->tid, "check", "", "thread %d has %s",
		    proc_inside(t->tid), what);
}

/* 0: the kernel does not tell (it does since Linux 6.11), or the task is ending. */
static uint64_t space_of(int pidfd, unsigned int kind)
{
	struct stat st = { 0 };
	int fd = ioctl(pidfd, _IO(PIDFS_MAGIC, kind), 0);

	if (fd >= 0 && fstat(fd, &st))
		st.st_ino = 0;
	close_fd(&fd);
	return st.st_ino;
}

/* Those that it can have without a working directory of its own.  Not from /proc: see
 * ask_add(). */
static int check_spaces(const struct target *target, const struct thread *t, struct avc_error *err)
{
	static const struct {
		unsigned int kind; /* linux/pidfd.h, PIDFD_GET_..._NAMESPACE */
		const char *name;
	} spaces[] = { { 4, "network" }, { 10, "UTS" }, { 2, "IPC" }, { 1, "cgroup" } };
	int result = 0, pidfd;

	if (t->tid == target->pid)
		return 0;
	pidfd = (int)syscall(SYS_pidfd_open, t->tid, PIDFD_THREAD_);
	for (size_t i = 0; !result && pidfd >= 0 && i < sizeof spaces / sizeof *spaces; i++) {
		const uint64_t own = space_of(pidfd, spaces[i].kind),
			       others = space_of(target->pidfd, spaces[i].kind);

		if (own && others && own != others && is_thread(target, t->tid))
			result = fail(err, AVC_UNSUPPORTED, 0, t->tid, "check", "",
				      "thread %d has a namespace of its own (%s)", t->inside,
				      spaces[i].name);
	}
	close_fd(&pidfd);
	return result;
}

int acquaint(struct target *target, timer_t timer, uint64_t deadline_ns, struct avc_error *err)
{
	uint32_t again = 0;

	/* All of them first: there is one way home in the parasite, and it may still need it. */
	for (uint32_t i = 0; i < target->thread_count; i++)
		if (target->threads[i].attached)
			return fail(err, AVC_DEADLINE, 0, target->threads[i].tid, "stop", "",
				    "a thread has not come back from an earlier attempt yet");
	for (uint32_t i = 0; i < target->thread_count; i++) {
		struct thread *t = &target->threads[i];
		struct avc_error gone = { 0 };

		if (t->known) {
			t->asked++;
			if (!t->young && (t->asked < ASK_AGAIN_AFTER || again == ASK_AGAIN_AT_ONCE))
				continue;
			again += !t->young;
		}
		tracee_deadline_set(timer, deadline_ns);
		rewind_prepare(t);
		if (thread_stop(target, t, &gone) || thread_await(target, t, &gone) ||
		    check_unshared(target, t, &gone) || ask(target, t, &gone))
			t->known = false;
		thread_release(t);
		tracee_deadline_clear(timer);
		if (!gone.code && check_spaces(target, t, &gone))
			t->known = false;
		if (gone.code && gone.code != AVC_GONE) {
			*err = gone;
			return -1;
		}
		t->seen |= t->known; /* or it is no thread */
	}
	threads_forget_unseen(target);
	qsort(target->threads, target->thread_count, sizeof *target->threads, by_inside);
	return 0;
}
