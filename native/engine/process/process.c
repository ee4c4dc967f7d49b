/* SPDX-License-Identifier: Apache-2.0
 *
 * A process of the app and its threads: opened, listed, queried.
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

#include "process.h"

#define PIDFS_MAGIC 0xff  /* the same, PIDFS_IOCTL_MAGIC */
#define ASK_AGAIN_AFTER 8 /* checkpoints */
#define ASK_AGAIN_AT_ONCE 2
#define ASK_NS (2 * NS_PER_MS)

void process_init(struct process *process)
{
	*process = (struct process){ .pidfd = -1,
				     .leader_pidfd = -1,
				     .task_dirfd = -1,
				     .mem_fd = -1,
				     .timers_fd = -1,
				     .stat_fd = -1,
				     .statm_fd = -1,
				     .status_fd = -1,
				     .holder_pidfd = -1,
				     .exec_sign.fd = -1,
				     .due_ns = UINT64_MAX };
}

bool process_make_room(struct process *process)
{
	process->memory = memory_new();
	process->pending = pending_new();
	process->timers = timers_new();
	return threads_reserve(process) && process->memory && process->pending && process->timers;
}

void process_free_room(struct process *process)
{
	process_listen_no_more(process);
	threads_free(process);
	memory_free(process->memory);
	filters_forget(process);
	free(process->pending);
	free(process->timers);
	process->memory = NULL;
	process->pending = NULL;
	process->timers = NULL;
}

/* pidfd_getfd(2) needs a thread that still has descriptors: a main thread that has ended has none,
 * and other threads have pidfds since Linux 6.9. */
static int follow(struct process *process, struct avc_error *err)
{
	const pid_t pid = proc_live_thread(process->leader);

	if (!pid)
		return fail_errno(err, process->leader, "attach", "open(stat)", "it has ended");
	close_fd(&process->pidfd);
	close_fd(&process->statm_fd);
	close_fd(&process->status_fd);
	process->pid = pid;
	/* Its PID is not reused while other threads exist. */
	if (pid != process->leader && process->leader_pidfd < 0)
		process->leader_pidfd = proc_pidfd_open(process->leader);
	process->statm_fd = proc_open(pid, "statm", O_RDONLY);
	process->status_fd = proc_open(pid, "status", O_RDONLY);
	process->pidfd = pid == process->leader ? proc_pidfd_open(pid)
						: (int)syscall(SYS_pidfd_open, pid, PIDFD_THREAD_);
	if (process->pidfd < 0 && errno == EINVAL)
		return fail(err, AVC_UNSUPPORTED, EINVAL, process->leader, "attach",
			    "pidfd_open(PIDFD_THREAD)",
			    "its main thread has ended, which needs Linux 6.9");
	if (process->pidfd < 0)
		return fail_errno(err, process->leader, "attach", "pidfd_open", "it has ended");
	return 0;
}

/* As proc_live_thread() has it. */
static bool is_live(const struct process *process)
{
	struct proc_stat stat;

	if (process->pid != process->leader)
		return proc_live_thread(process->pid) == process->pid;
	return proc_stat_of(process->stat_fd, &stat) == 0 && stat.state != 'Z' &&
	       stat.state != 'X' && proc_vm_pages(process->statm_fd, NULL) > 0;
}

int process_follow(struct process *process, struct avc_error *err)
{
	return is_live(process) ? 0 : follow(process, err);
}

void process_kill(const struct process *process)
{
	syscall(SYS_pidfd_send_signal,
		process->leader_pidfd < 0 ? process->pidfd : process->leader_pidfd, SIGKILL, NULL,
		0);
}

static void each_thread(const struct process *process, void (*fn)(pid_t tid))
{
	char name[16];

	for (uint32_t i = 0; i < process->thread_count; i++) {
		snprintf(name, sizeof name, "%d", process->threads[i].tid);
		if (faccessat(process->task_dirfd, name, F_OK, 0) == 0)
			fn(process->threads[i].tid);
	}
}

void process_hasten(const struct process *process)
{
	each_thread(process, rt_priority_share);
}

void process_hasten_no_more(const struct process *process)
{
	each_thread(process, rt_priority_unshare);
}

int process_open(struct process *process, pid_t pid, pid_t inside, struct avc_error *err)
{
	if (inside < 0)
		return fail_errno(err, pid, "attach", "open(status)", "it has ended");
	process->leader = pid;
	process->inside = inside;
	process->parasite.left_ns = 0; /* by a thread of the process before */
	process->task_dirfd = proc_open(pid, "task", O_RDONLY | O_DIRECTORY);
	process->timers_fd = proc_open(pid, "timers", O_RDONLY);
	process->stat_fd = proc_open(pid, "stat", O_RDONLY);
	if (process->task_dirfd >= 0 && process->timers_fd >= 0 && process->stat_fd >= 0) {
		if (follow(process, err)) {
			process_close(process);
			return -1;
		}
		process->mem_fd = proc_open(process->pid, "mem", O_RDWR);
	}
	if (process->task_dirfd < 0 || process->mem_fd < 0 || process->timers_fd < 0 ||
	    process->stat_fd < 0 || process->statm_fd < 0 || process->status_fd < 0) {
		fail_errno(err, pid, "attach", "open(/proc)", "its /proc cannot be read");
		process_close(process);
		return -1;
	}
	return 0;
}

void process_close(struct process *process)
{
	close_fd(&process->pidfd);
	close_fd(&process->leader_pidfd);
	close_fd(&process->task_dirfd);
	close_fd(&process->mem_fd);
	close_fd(&process->timers_fd);
	close_fd(&process->stat_fd);
	close_fd(&process->statm_fd);
	close_fd(&process->status_fd);
	process->exec_sign.over = true; /* a restore must not wait for it, either */
	process->pid = 0;
	process->leader = 0;
	process->infected = false;
	/* Closed later: while the memory exists, that takes some 10 ms for each GB, for which a
	 * restore must not wait. */
	if (process->tracker)
		process->tracker->over = true;
	/* Stragglers stay: a tracee that is not reaped remains a zombie forever. */
	for (uint32_t i = 0; i < process->thread_count; i++) {
		process->threads[i].seen = false;
		process->threads[i].known = false;
	}
	threads_forget_unseen(process);
	files_forget(process);
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
				  "rseq cannot be read");
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
	/* affinity_bytes: as returned by the kernel, 0 on failure. */
	attributes_read_scheduling(thread->tid, &thread->scheduling);
	thread->affinity_bytes = 0;
	affinity = syscall(SYS_sched_getaffinity, thread->tid, sizeof thread->affinity,
			   thread->affinity);
	if (affinity > 0)
		thread->affinity_bytes = (uint32_t)affinity;
	return 0;
}

void thread_ask_add(const struct process *process, bool with_locks, struct inj_call *call,
		    struct questions *questions)
{
	const avc_remote out = parasite_remote(&process->parasite, call->out);
	const struct inj_syscall *tid_address, *altstack, *inside, *name, *attributes, *locks;

	memset(call->out, 0, sizeof call->out);
	tid_address = call_add(call, SYS_prctl, PR_GET_TID_ADDRESS, out);
	altstack = call_add(call, SYS_sigaltstack, 0, out + 8);
	/* Not from /proc: reading there leaves cached entries, which prolong the thread's end, for
	 * which a restore waits, by several microseconds (fs/proc/base.c, proc_flush_pid()). */
	inside = call_add(call, SYS_gettid);
	name = call_add(call, SYS_prctl, PR_GET_NAME, out + 32);
	locks = with_locks ? call_add(call, INJ_FUTURE_LOCK) : NULL;
	attributes = attributes_ask(&process->parasite, call, call->out + 64);
	*questions = (struct questions){ tid_address, altstack,   inside, name,
					 locks,       attributes, NULL,   NULL };
	_Static_assert(64 + ATTRIBUTES_ASK_BYTES + 16 <= sizeof call->out, "room for the answers");
	fence_ask(process, call, out + 64 + ATTRIBUTES_ASK_BYTES, questions);
}

int thread_ask(struct process *process, struct thread *thread, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	const bool is_main = thread->tid == process->pid, asked_before = thread->inside != 0;
	const struct creds was = thread->creds;
	struct questions questions;

	call_begin(call, INJ_AFTER_HOME);
	thread_ask_add(process, is_main, call, &questions);
	if (read_signal_state(thread, err) || thread_borrow(process, thread, err))
		return -1;
	if (parasite_run(thread->tid, call, err)) {
		parasite_cut_short(call, err);
		thread_runs_on(thread, err); /* not to be given back in the middle of it */
		return -1;
	}
	if (thread_give_back(thread, err) ||
	    thread_ask_answer(process, thread, call, &questions, err))
		return -1;
	return is_main && asked_before ? thread_ask_others(process, thread, &was, err) : 0;
}

int thread_ask_answer(struct process *process, struct thread *thread, const struct inj_call *call,
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
	if (attributes_answer(thread->tid, questions->attributes, call->out + 64, &thread->creds,
			      err))
		return -1;
	if (locks && locks->result > 0)
		thread->creds.future_lock = (int32_t)locks->result;
	if (fence_answer(process, thread, questions, err))
		return -1;
	filters_read(process, thread);
	thread->known_tls = arch_tls(&thread->regs);
	thread->young = !thread->known;
	thread->known = true;
	thread->due = false;
	thread->asked = 0;
	return 0;
}

int thread_ask_others(struct process *process, const struct thread *thread, const struct creds *was,
		      struct avc_error *err)
{
	struct creds is = thread->creds;

	is.future_lock = was->future_lock; /* of the process's memory, not of threads */
	if (process->thread_count == 1 || !memcmp(was, &is, sizeof is))
		return 0;
	for (uint32_t i = 0; i < process->thread_count; i++)
		process->threads[i].known &= &process->threads[i] == thread;
	return fail(err, AVC_RETRY, 0, process->pid, "read state", "",
		    "its threads are just changing their credentials");
}

struct walk {
	struct process *process;
	uint32_t count, fresh;
	struct avc_error *err;
};

static int count_task(pid_t tid, void *arg)
{
	struct walk *walk = arg;
	struct thread *t;

	walk->count++;
	if (walk->count > THREADS_MAX)
		return 0;
	t = thread_find(walk->process, tid);
	if (!t)
		t = thread_add(walk->process, tid, walk->err);
	if (t)
		t->seen = true;
	return 0;
}

int process_list_threads(struct process *process, struct avc_error *err)
{
	struct walk walk = { .process = process, .err = err };

	for (uint32_t i = 0; i < process->thread_count; i++)
		process->threads[i].seen = false;
	if (process->thread_count == 1 && process->threads[0].tid == process->leader &&
	    proc_thread_count(process->task_dirfd) == 1) {
		process->threads[0].seen = true;
		return 0;
	}
	if (proc_numbers(process->task_dirfd, count_task, &walk))
		return fail_errno(err, process->pid, "walk threads", "getdents64", "it has ended");
	if (walk.count > THREADS_MAX)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "walk threads", "",
			    "it has %u threads; %d are supported", walk.count, THREADS_MAX);
	threads_forget_unseen(process);
	return err->code ? -1 : 0;
}

/* In the order of their TIDs they can be created again with the fewest writes to ns_last_pid. */
static int by_inside(const void *a, const void *b)
{
	const struct thread *x = a, *y = b;

	return (x->inside > y->inside) - (x->inside < y->inside);
}

/* Until the next look, the list may contain a process that a thread has just created (adopt()). */
static bool is_thread(const struct process *process, pid_t tid)
{
	char number[16];

	snprintf(number, sizeof number, "%d", tid);
	return faccessat(process->task_dirfd, number, F_OK, 0) == 0;
}

/* unshare(2): restored threads share the main thread's.  `t` is stopped. */
static int check_unshared(const struct process *process, const struct thread *t,
			  struct avc_error *err)
{
	const char *what = NULL;

	if (proc_shares(process->pid, t->tid, SHARED_FILES) == 0)
		what = "a descriptor table of its own (CLONE_FILES)";
	else if (proc_shares(process->pid, t->tid, SHARED_FOLDERS) == 0)
		what = "a working directory of its own (CLONE_FS)";
	/* A main thread that is just ending has neither. */
	if (!what || proc_is_exiting(process->pid) || proc_is_exiting(t->tid))
		return 0;
	if (!is_thread(process, t->tid))
		return fail(err, AVC_GONE, 0, t->tid, "check", "", "it is no thread");
	return fail(err, AVC_UNSUPPORTED, 0, t->tid, "check", "", "thread %d has %s",
		    proc_inside(t->tid), what);
}

/* 0: the kernel does not support it (it does since Linux 6.11), or the task is ending. */
static uint64_t space_of(int pidfd, unsigned int kind)
{
	struct stat st = { 0 };
	int fd = ioctl(pidfd, _IO(PIDFS_MAGIC, kind), 0);

	if (fd >= 0 && fstat(fd, &st))
		st.st_ino = 0;
	close_fd(&fd);
	return st.st_ino;
}

/* Namespaces that a thread can have without a working directory of its own.  Not from /proc: see
 * thread_ask_add(). */
static int check_spaces(const struct process *process, const struct thread *t,
			struct avc_error *err)
{
	static const struct {
		unsigned int kind; /* linux/pidfd.h, PIDFD_GET_..._NAMESPACE */
		const char *name;
	} spaces[] = { { 4, "network" }, { 10, "UTS" }, { 2, "IPC" }, { 1, "cgroup" } };
	int result = 0, pidfd;

	if (t->tid == process->pid)
		return 0;
	pidfd = (int)syscall(SYS_pidfd_open, t->tid, PIDFD_THREAD_);
	for (size_t i = 0; !result && pidfd >= 0 && i < sizeof spaces / sizeof *spaces; i++) {
		const uint64_t own = space_of(pidfd, spaces[i].kind),
			       others = space_of(process->pidfd, spaces[i].kind);

		if (own && others && own != others && is_thread(process, t->tid))
			result = fail(err, AVC_UNSUPPORTED, 0, t->tid, "check", "",
				      "thread %d has a namespace of its own (%s)",
				      proc_inside(t->tid), spaces[i].name);
	}
	close_fd(&pidfd);
	return result;
}

/* Whether it is new, or was asked long ago; of those, few at a time. */
static bool has_to_be_asked(struct thread *t, uint32_t *again)
{
	if (!t->known)
		return true;
	t->asked++;
	if (!t->young && (t->asked < ASK_AGAIN_AFTER || *again == ASK_AGAIN_AT_ONCE))
		return false;
	*again += !t->young;
	return true;
}

/* While the process runs, as nothing of it is changed.  1: it is no thread, or has just ended. */
static int check_thread(const struct process *process, const struct thread *t,
			struct avc_error *err)
{
	struct avc_error failed = { 0 };

	if (!check_unshared(process, t, &failed) && !check_spaces(process, t, &failed))
		return 0;
	if (failed.code == AVC_GONE)
		return 1;
	*err = failed;
	return -1;
}

static int mark_threads(struct process *process, uint32_t *due, struct avc_error *err)
{
	uint32_t again = 0;

	*due = 0;
	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread *t = &process->threads[i];
		int left;

		/* The parasite's way back is for one thread, and may be in use. */
		if (t->attached)
			return fail(err, AVC_DEADLINE, 0, t->tid, "stop", "",
				    "a thread has not come back from an earlier attempt yet");
		t->due = has_to_be_asked(t, &again);
		left = t->due ? check_thread(process, t, err) : 0;
		if (left < 0)
			return -1;
		t->seen &= !left;
		*due += t->due && !left;
	}
	threads_forget_unseen(process);
	return 0;
}

/* As long as that takes no longer than to stop them did, or ASK_NS. */
static int ask_due(struct process *process, uint64_t stopping_ns, uint32_t *due,
		   struct avc_error *err)
{
	const uint64_t end = now_ns() + (stopping_ns > ASK_NS ? stopping_ns : ASK_NS);

	*due = 0;
	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread *t = &process->threads[i];
		struct avc_error failed = { 0 };

		if (!t->seen || !t->stopped || (t->known && !t->due))
			continue;
		if (now_ns() > end) {
			++*due;
			continue;
		}
		if (thread_ask(process, t, &failed) == 0)
			continue;
		t->known = false;
		if (failed.code != AVC_GONE) {
			*err = failed;
			return -1;
		}
	}
	return 0;
}

int process_query_new_threads(struct process *process, timer_t timer, uint64_t deadline_ns,
			      uint32_t *later, struct avc_error *err)
{
	uint64_t stopped_ns = 0;
	uint32_t due;
	int result = mark_threads(process, &due, err);

	if (!result && process->thread_count > 1 && due <= *later) {
		*later -= due;
		due = 0;
	}
	/* While all stand still: a filter that one of them installs for all (SECCOMP_FILTER_FLAG_TSYNC)
	 * could kill the one that makes calls of ours. */
	while (!result && due) {
		uint64_t start;

		/* Between two stops it runs for as long: to be stopped for short times only would be of
		 * no use to it otherwise. */
		if (stopped_ns)
			usleep((useconds_t)(stopped_ns / 1000));
		waits_prepare(process);
		rt_priority_begin();
		tracee_deadline_set(timer, deadline_ns);
		start = now_ns();
		result = process_stop(process, err);
		if (!result)
			result = ask_due(process, now_ns() - start, &due, err);
		process_go_on(process, timer);
		stopped_ns = now_ns() - start;
	}
	threads_forget_unseen(process);
	qsort(process->threads, process->thread_count, sizeof *process->threads, by_inside);
	return result;
}
