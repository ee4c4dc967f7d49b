/* SPDX-License-Identifier: Apache-2.0
 *
 * Reading and cloning: begins with a process as soon as it is stopped, continues while others are
 * searched, and is completed at the end.
 *
 * A process's own memory is read before its clone begins: the kernel blocks access while it clones
 * (mmap_lock).
 */
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "freeze.h"

/* Holders have real-time priority, and processes not found yet need a CPU to reach their stops:
 * clones up to this size may run before that. */
#define CLONES_AHEAD_NS (5 * NS_PER_MS)
#define CLONE_PROCESS_NS 100000
#define CLONE_PAGE_NS 90
#define CLONES_MAX_NS NS_PER_S
#define FILE_NS 10000
/* The factor by which they may exceed that. */
#define PATIENCE 4

/* ---- what is read ----------------------------------------------------------------------- */

/* In a handler, on an alternate stack that is disarmed meanwhile (sigaltstack(2), SS_AUTODISARM),
 * or was at the last query.  Any other cannot be changed while in use. */
static bool may_be_disarmed(const struct thread *t)
{
	return t->disarmed || (t->altstack[1] & SS_AUTODISARM_ &&
			       arch_sp(&t->regs) - t->altstack[0] < t->altstack[2]);
}

static int read_all(struct process *process, uint32_t slot, struct avc_error *err)
{
	uint32_t next = 1;

	dying_begin(process);
	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread *t = &process->threads[i];

		if (t->attached && !t->seen)
			return fail(err, AVC_RETRY, 0, t->tid, "freeze", "",
				    "it is just starting a process");
		if (!t->stopped)
			continue;
		if (next >= process->parasite.threads_max && t->tid != process->leader)
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "more threads than prepared for");
		if (!arch_is_native(&t->regs))
			return fail(err, AVC_UNSUPPORTED, 0, t->tid, "freeze", "",
				    "it is a 32-bit program");
		/* A thread that a dead guard sent into a parasite leaves it in microseconds: such
		 * an image would be of the parasite. */
		if (parasite_contains(&process->parasite, arch_pc(&t->regs)))
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "a thread is in the parasite");
		if (parasite_is_old(process, arch_pc(&t->regs)))
			return fail(err, AVC_DEADLINE, 0, t->tid, "freeze", "",
				    "a thread is in an old parasite");
		t->block = t->tid == process->leader ? 0 : (int)next++;
		if (thread_read(t, err) || dying_check(process, t, err))
			return -1;
		if (arch_frame_read_xstate(t->tid, parasite_frame(&process->parasite, slot,
								  (uint32_t)t->block)))
			return fail_errno(err, t->tid, "freeze", "ptrace(GETREGSET)",
					  "its state cannot be read");
		if ((!t->known || t->due || t->known_tls != arch_tls(&t->regs) ||
		     may_be_disarmed(t) || filters_are_more(t)) &&
		    thread_ask(process, t, err))
			return -1;
	}
	dying_end(process);
	process->blocks = next;
	return 0;
}

/* ECHILD if it has none: the only query that needs no walk of all threads. */
static const struct inj_syscall *ask_for_children(struct inj_call *call)
{
	return call_add(call, SYS_waitid, P_ALL, 0, 0, WEXITED | WNOHANG | WNOWAIT | __WALL);
}

/* A process that had none at the last checkpoint was not searched. */
static int hear_of_children(struct process *process, struct avc_error *err)
{
	const bool was_childless = process->childless;

	process->childless = process->children->result == -ECHILD;
	return was_childless && !process->childless
		       ? fail(err, AVC_RETRY, 0, process->pid, "freeze", "",
			      "it has just started another process")
		       : 0;
}

/* Those of dead guards, and of the process that forked this one.  Its clone is smaller by their
 * size. */
static void drop_old_parasites(struct process *process, struct inj_call *call)
{
	if (!process->checkpoints || (!process->old_parasites && !process->stubs_end) ||
	    process_needs_old(process))
		return;
	process_drop_stubs(process);
	for (; process->old_parasites && call->count < INJ_CALLS_MAX - 2;
	     process->old_parasites--) {
		const avc_remote base = process->old_parasite[process->old_parasites - 1].base;
		const size_t bytes = process->old_parasite[process->old_parasites - 1].bytes;

		call_add(call, SYS_munmap, base, bytes);
		process->clone_pages -= (long)(bytes / ARCH_PAGE_BYTES);
	}
}

/* ---- clones ----------------------------------------------------------------------------- */

static int start_own_clone(struct process *process, uint32_t slot, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);

	call_begin(call, INJ_AFTER_HOME);
	timers_ask(process, call);
	drop_old_parasites(process, call);
	process->children = ask_for_children(call);
	memory_advise(process, slot, MADV_DOFORK, call);
	/* The descriptor table is shared, not copied: what the app closes is closed. */
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD);
	memory_advise(process, slot, MADV_DONTFORK, call);
	process->asked_ns = now_ns();
	return thread_borrow(process, thread, err) || parasite_start(thread->tid, err) ? -1 : 0;
}

static int await_own_clone(struct process *process, pid_t *template, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);

	if (parasite_await_clone(thread->tid, call, template, err)) {
		process->lost |= err->code != AVC_LIMIT;
		parasite_cut_short(call, err);
		thread_runs_on(thread, err);
		return -1;
	}
	/* After the timers were queried: one that has just expired is found here. */
	if (pending_read(process, err))
		return -1;
	timers_answer(process, call, now_ns() - process->asked_ns);
	return hear_of_children(process, err);
}

int freeze_park_main(const struct process *main, struct thread *main_thread, struct avc_error *err)
{
	const int result = memory_is_unforked(main->memory)
				   ? parasite_run(main_thread->tid, &main->parasite.control->runner,
						  err)
				   : tracee_settle(main_thread->tid, err);

	if (result == 0 && thread_give_back(main_thread, err) == 0)
		return 0;
	main_thread->stopped = false;
	return -1;
}

static int start_holders_clone(struct process *process, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->holder;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, INJ_FUTURE_LOCK);
	drop_old_parasites(process, call);
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD);
	if (parasite_send(&process->parasite, process->holder, &process->holder_base, call, err) ||
	    parasite_start(process->holder, err))
		return -1;
	process->lost = true; /* until the clone has been reported */
	return 0;
}

/* After the query of its main thread, which reports everything else. */
static void note_future_lock(struct process *process)
{
	const struct inj_call *call = &process->parasite.control->holder;
	struct thread *thread = thread_find(process, process->pid);

	if (thread && call->call[0].result > 0)
		thread->creds.future_lock = (int32_t)call->call[0].result;
}

static int await_holders_clone(struct process *process, pid_t *template, struct avc_error *err)
{
	const struct inj_call *call = &process->parasite.control->holder;

	if (parasite_await_clone(process->holder, call, template, err))
		return -1;
	process->lost = false;
	return 0;
}

/* Only the process itself may change its memory temporarily: a holder would be killed with us in
 * the middle of it.  Its main thread waits in the parasite until that is over, and then restores
 * it, with or without us. */
static int clone_unforked(struct process *process, uint32_t slot, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);
	struct avc_error failed = { 0 };
	int result;

	call_begin(call, INJ_AFTER_HOME);
	call->park_ms += (uint32_t)(CLONES_MAX_NS / NS_PER_MS);
	memory_advise(process, slot, MADV_DOFORK, call);
	call_add(call, INJ_PAUSE);
	memory_advise(process, slot, MADV_DONTFORK, call);
	if (thread_borrow(process, thread, err))
		return -1;
	if (parasite_run_to_pause(thread->tid, call, err)) {
		thread->stopped = false; /* on its way through the parasite, and home */
		return -1;
	}
	result = start_holders_clone(process, err) ||
				 await_holders_clone(process, &process->cloned, err)
			 ? -1
			 : 0;
	if (parasite_run_on(thread->tid, call, result ? &failed : err)) {
		thread->stopped = false;
		return -1;
	}
	return thread_give_back(thread, result ? &failed : err) || result ? -1 : 0;
}

static int start_clone(struct process *process, uint32_t slot, struct avc_error *err)
{
	if (!process->descendant)
		return start_own_clone(process, slot, err);
	return memory_is_unforked(process->memory) ? clone_unforked(process, slot, err)
						   : start_holders_clone(process, err);
}

int freeze_start_clone(struct process *process, uint32_t slot, struct avc_error *err)
{
	int result;

	/* Before a holder runs, which maps something for a moment. */
	process->clone_pages = proc_vm_pages(process->statm_fd, NULL);
	process->cloned = 0;
	result = start_clone(process, slot, err);
	process->cloning = !result || process->cloned;
	return result;
}

int freeze_await_clone(struct process *process, pid_t *template, struct avc_error *err)
{
	process->cloning = false;
	if (!process->descendant)
		return await_own_clone(process, template, err);
	if (!process->cloned && await_holders_clone(process, &process->cloned, err))
		return -1;
	*template = process->cloned;
	process->cloned = 0;
	note_future_lock(process);
	return 0;
}

/* ---- questions --------------------------------------------------------------------------- */

/* Timers can only be read by the process itself.  And young processes often change attributes: a
 * name, a user.  All are queried at the same time. */
static int ask_begin(struct process *process, uint32_t slot, uint64_t takes_ns,
		     struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);

	call_begin(call, INJ_AFTER_HOME);
	/* It is awaited only when the main process is cloned, and the holders take the CPUs from us
	 * meanwhile; if it returned before, the image would be of two instants. */
	call->park_ms += (uint32_t)(PATIENCE *
				    (takes_ns < CLONES_MAX_NS ? takes_ns : CLONES_MAX_NS) /
				    NS_PER_MS);
	timers_ask(process, call);
	process->children = ask_for_children(call);
	thread_ask_add(process, false, call, &process->questions);
	if (process->recycling)
		inherited_ask(&process->parasite, slot, process->recycling, call);
	process->asked_ns = now_ns();
	if (thread_borrow(process, thread, err) || parasite_start(thread->tid, err))
		return -1;
	process->asked = true;
	return 0;
}

/* All are interrupted before the first is waited for: it takes each some time to get there. */
static int ask_halt(struct process *process, struct avc_error *err)
{
	struct thread *thread = thread_find(process, process->pid);

	if (parasite_halt(thread->tid, &process->parasite.control->runner, err) == 0)
		return 0;
	process->asked = false;
	parasite_cut_short(&process->parasite.control->runner, err);
	thread_runs_on(thread, err);
	return -1;
}

static int ask_end(struct process *process, struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct thread *thread = thread_find(process, process->pid);
	const struct creds was = thread->creds;

	process->asked = false;
	if (tracee_await(thread->tid, NULL, err) != STOP_TRAP) {
		thread_runs_on(thread, err);
		return -1;
	}
	if (thread_give_back(thread, err) || pending_read(process, err))
		return -1;
	timers_answer(process, call, now_ns() - process->asked_ns);
	if (thread_ask_answer(process, thread, call, &process->questions, err))
		return -1;
	return thread_ask_others(process, thread, &was, err) || hear_of_children(process, err) ? -1
											       : 0;
}

int freeze_await_answers(struct tree *tree, struct avc_error *err)
{
	int (*const step[])(struct process *, struct avc_error *) = { ask_halt, ask_end };
	int result = 0;

	for (size_t k = 0; k < sizeof step / sizeof *step; k++)
		for (uint32_t i = 0; i < tree->processes; i++) {
			struct avc_error failed = { 0 };

			if (tree->process[i]->asked && step[k](tree->process[i], &failed) &&
			    !result) {
				*err = failed;
				result = -1;
			}
		}
	return result;
}

/* It is stopped: its clone begins, if it has a holder, while it answers queries, which does not
 * change its memory.  The main process is queried by the calls that clone it. */
static int begin(struct process *process, uint32_t slot, uint64_t takes_ns, struct avc_error *err)
{
	struct thread *thread = thread_find(process, process->pid);

	if (!thread || !thread->stopped)
		return fail(err, process->descendant ? AVC_UNSUPPORTED : AVC_DEADLINE, 0,
			    process->pid, "freeze", "", "its main thread has ended");
	process->stage = FREEZE_BEGUN;
	if (read_all(process, slot, err) || memory_find_unforked(process, err))
		return -1;
	if (!process->descendant && !process->recycling)
		return freeze_start_clone(process, slot, err);
	if (thread_vet(process, thread, err))
		return -1;
	if (!process->recycling && process_has_moved(process, thread->umask))
		process_unhold(process); /* gets another one (clone_missing()) */
	return (!process->recycling && process->holder && freeze_start_clone(process, slot, err)) ||
			       ask_begin(process, slot, takes_ns, err)
		       ? -1
		       : 0;
}

/* A task that it has just created was mistaken for its thread; check. */
static bool has_strangers(const struct process *process)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].attached && !process->threads[i].seen)
			return true;
	return false;
}

/* An estimate, for a process with this many pages of its own. */
static uint64_t clone_time_ns(long anon_pages)
{
	return CLONE_PROCESS_NS + (uint64_t)anon_pages * CLONE_PAGE_NS;
}

/* The same for reading the descriptors of all of them, as many as there were right before. */
static uint64_t read_time_ns(const struct tree *tree)
{
	uint64_t takes_ns = 0;

	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->entry[i].process)
			takes_ns += (uint64_t)tree->entry[i].process->files_seen * FILE_NS;
	return takes_ns;
}

uint64_t freeze_clones_time_ns(const struct tree *tree)
{
	uint64_t takes_ns = 0;

	for (uint32_t i = 0; i < tree->count; i++) {
		const struct process *process = tree->entry[i].process;
		long pages = process ? process->anon_pages : 0;

		if (process && !pages)
			proc_vm_pages(process->statm_fd, &pages);
		takes_ns += clone_time_ns(pages);
	}
	return takes_ns;
}

/* How long one that has been asked may have to wait for the others. */
static uint64_t others_time_ns(const struct tree *tree)
{
	return tree->count > 1 ? freeze_clones_time_ns(tree) + read_time_ns(tree) : 0;
}

/* One that can be cloned at once, and whose clone time is known. */
static bool is_ready(const struct process *process)
{
	return process->stage == FREEZE_STOPPED && !has_strangers(process) &&
	       (!process->descendant ||
		(process->holder && process->anon_pages && process->pid == process->leader));
}

int freeze_begin_known(struct freeze *freeze, struct avc_error *err)
{
	const struct tree *tree = freeze->tree;
	const struct image *main = &freeze->generation->image[0];
	const uint64_t others_ns = others_time_ns(tree);
	uint64_t takes_ns = 0;

	/* Not while it is being cloned. */
	memory_copy_own(main->process, main->memory);
	for (uint32_t i = 0; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;

		if (!process || !is_ready(process))
			continue;
		if (process->descendant && !process->recycling)
			takes_ns += clone_time_ns(process->anon_pages);
		if (takes_ns > CLONES_AHEAD_NS)
			break;
		if (begin(process, main->slot, others_ns, err))
			return -1;
	}
	return 0;
}

int freeze_begin_others(struct freeze *freeze, struct avc_error *err)
{
	const struct generation *generation = freeze->generation;
	const uint64_t others_ns = others_time_ns(freeze->tree);

	for (uint32_t i = 0; i < generation->images; i++) {
		struct process *process = generation->image[i].process;

		if (process && process->stage < FREEZE_BEGUN &&
		    begin(process, generation->image[i].slot, others_ns, err))
			return -1;
	}
	return 0;
}

void freeze_drop_clones(struct tree *tree)
{
	for (uint32_t i = 0; i < tree->processes; i++) {
		struct process *process = tree->process[i];
		struct avc_error ignored = { 0 };
		pid_t template;

		if (!process->cloning || freeze_await_clone(process, &template, &ignored))
			continue;
		tracee_kill(template);
		process->lost = tracee_settle(process->holder, &ignored) != 0;
	}
}
