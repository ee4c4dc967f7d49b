/* SPDX-License-Identifier: Apache-2.0
 *
 * The holder: a task that shares the memory, the descriptors and the signal handlers of a process, so
 * that they outlive it; made by its main thread, from the parasite.  It never runs by itself.
 */
#include <sched.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "infect.h"

/* Turns a new task into the holder: stopped, named, and outside of the app's process groups. */
static int make_holder(struct process *process, pid_t holder, struct avc_error *err)
{
	struct inj_call *own = &process->parasite.control->holder;

	/* It clones while the whole app is stopped.  Best effort; not for its clones. */
	if (process->descendant)
		(void)rt_priority_give(holder);
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

/* A new task of ours, in its first stop.  *base: its registers there; or NULL. */
static int take_over(const struct process *process, pid_t task, struct arch_regs *base,
		     struct avc_error *err)
{
	if (tracee_await(task, NULL, err) != STOP_TRAP)
		return -1;
	return parasite_own(&process->parasite, task) || (base && arch_regs_get(task, base))
		       ? fail_errno(err, task, "make holder", "ptrace(SETOPTIONS)", "it has ended")
		       : 0;
}

/* The main process's is a child of init. */
static int clone_sibling(struct process *process, struct thread *thread, pid_t *holder,
			 struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	int result;

	call_begin(call, INJ_AFTER_HOME);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD);
	result = thread_borrow(process, thread, err);
	if (!result) {
		result = parasite_run_clone(thread->tid, call, holder, err);
		process->lost = process->lost || (result && err->code != AVC_LIMIT);
	}
	if (!result)
		result = tracee_settle(thread->tid, err);
	else if (err->code == AVC_DEADLINE && thread->borrowed)
		thread->stopped = false; /* on its way through the parasite, and back */
	return result ? result : thread_give_back(thread, err);
}

int process_hold(struct process *process, timer_t timer, uint64_t deadline_ns,
		 struct avc_error *err)
{
	struct thread *thread = infect_stop_all(process, timer, deadline_ns, err);
	pid_t holder = 0;
	int result;

	if (!thread)
		return -1;
	result = process->descendant ? process_hold_stopped(process, process->init, err)
				     : clone_sibling(process, thread, &holder, err);
	process_go_on(process, timer);
	if (!holder)
		return result;
	tracee_deadline_set(timer, NS_PER_S);
	if (take_over(process, holder, &process->holder_base, err))
		result = -1;
	if (!result)
		result = make_holder(process, holder, err);
	tracee_deadline_clear(timer);
	return keep_holder(process, holder, result, err);
}

/* What cannot be found out is 0.  umask -1: not known yet. */
static struct folders folders_of(struct process *process, int32_t umask)
{
	static const char *const name[] = { "root", "cwd" };
	struct folders folders = { .umask = (uint64_t)umask };
	struct seccomp_counts counts;
	struct statx st;

	if (umask < 0)
		folders.umask = seccomp_counts(process, &counts) == 0 ? counts.umask : 0;
	for (size_t i = 0; i < sizeof name / sizeof *name; i++)
		if (proc_look(process->pid, name[i], STATX_INO | STATX_MNT_ID, &st)) {
			folders.device[i] = device_of(&st);
			folders.inode[i] = st.stx_ino;
			folders.mount[i] = st.stx_mnt_id;
		}
	return folders;
}

bool process_has_moved(struct process *process, int32_t umask)
{
	struct folders now;

	if (!process->descendant || !process->holder)
		return false;
	now = folders_of(process, umask);
	return memcmp(&now, &process->folders, sizeof now) != 0;
}

/* The stopped intermediate task clones the holder, which is then in its first stop. */
static int clone_by(struct process *process, pid_t between, pid_t *holder, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->holder;

	if (take_over(process, between, &process->holder_base, err))
		return -1;
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND | SIGCHLD);
	if (parasite_send(&process->parasite, between, &process->holder_base, call, err) ||
	    parasite_run_clone(between, call, holder, err))
		return -1;
	return take_over(process, *holder, NULL, err);
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

static int check_parent(const struct process *process, pid_t holder, pid_t init,
			struct avc_error *err)
{
	struct proc_stat stat;

	if (proc_stat(holder, &stat))
		return fail_errno(err, holder, "make holder", "open(stat)", "it was killed");
	return stat.parent == init
		       ? 0
		       : fail(err, AVC_RETRY, 0, process->pid, "make holder", "",
			      "a process above it adopts orphans now (PR_SET_CHILD_SUBREAPER)");
}

/* One that adopts orphans leaves the holder to init meanwhile. */
static void list_intermediate(const struct process *process, const struct thread *thread,
			      struct inj_call *call)
{
	call_begin(call, INJ_AFTER_HOME);
	if (thread->creds.subreaper)
		call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER);
	for (uint32_t i = 0; i < process->old_parasites && i < INJ_CALLS_MAX / 2; i++)
		reap_left_child(process, process->old_parasite[i].base, call);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND);
	call_add(call, INJ_WAIT);
	if (thread->creds.subreaper)
		call_add(call, SYS_prctl, PR_SET_CHILD_SUBREAPER, 1);
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
	pid_t between = 0, holder = 0;
	int result;

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "make holder", "",
			    "its main thread has ended");
	if (thread->creds.subreaper && check_adoption(process, err))
		return -1;
	process->folders = folders_of(process, -1);
	list_intermediate(process, thread, call);
	if (thread_borrow(process, thread, err))
		return -1;
	result = parasite_run_clone(thread->tid, call, &between, err);
	if (result) {
		process->lost = process->lost || err->code != AVC_LIMIT;
		thread_runs_on(thread, err);
		return -1;
	}
	result = clone_by(process, between, &holder, err);
	tracee_kill(between);
	if (!result)
		result = make_holder(process, holder, err);
	if (!result)
		result = check_parent(process, holder, init, err);
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
