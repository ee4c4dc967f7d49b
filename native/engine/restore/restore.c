/* SPDX-License-Identifier: Apache-2.0
 *
 * A template becomes the app again: it forks a process with the app's own PID, or its spare
 * gives its memory to one (spare.c), which puts itself together (parasite.c, inj_restore) and waits
 * until everything is there; then all its threads go at once.  The new process is not traced.
 */
#include <errno.h>
#include <linux/futex.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "parasite_blob.h"
#include "restore.h"

#define TRIES 8 /* at once */
#define TRY_NS NS_PER_S
#define TRY_AGAIN_NS (NS_PER_MS / 2)
#define READY_NS (2 * NS_PER_S)
#define FORK_NS (5 * NS_PER_S)

static const char *const step_names[] = {
	[INJ_STEP_SESSION] = "setsid",
	[INJ_STEP_GROUP] = "setpgid",
	[INJ_STEP_TTY] = "ioctl(TIOCSPGRP)",
	[INJ_STEP_ROBUST] = "set_robust_list",
	[INJ_STEP_RSEQ] = "rseq",
	[INJ_STEP_THREAD] = "clone",
	[INJ_STEP_TID] = "clone",
	[INJ_STEP_BASE] = "arch_prctl",
};

/* Waits while *word == value; false after `end`. */
static bool wait_word(uint32_t *word, uint32_t value, uint64_t end)
{
	const struct timespec slice = { .tv_nsec = 20 * (long)NS_PER_MS };

	while (__atomic_load_n(word, __ATOMIC_ACQUIRE) == value) {
		if (now_ns() > end)
			return false;
		syscall(SYS_futex, word, FUTEX_WAIT, value, &slice, NULL, 0);
	}
	return true;
}

/* Until the new process has put itself together, or has failed to. */
static bool await_state(struct inj_slot *slot, struct sandbox *sandbox)
{
	const uint64_t end = now_ns() + READY_NS;

	return sandbox ? sandbox_wait(sandbox, &slot->state, end)
		       : wait_word(&slot->state, INJ_IDLE, end);
}

static void reset(const struct parasite *parasite, uint32_t slot_number)
{
	struct inj_slot *slot = parasite_slot(parasite, slot_number);

	slot->state = INJ_IDLE;
	slot->go = INJ_GO_NOT;
	slot->ready = 0;
	slot->running = 0;
	slot->error = 0;
	slot->error_at = INJ_STEP_NONE;
	slot->error_tid = 0;
	slot->error_setup = 0;
	slot->block_bytes = (uint32_t)parasite->block_bytes;
	slot->blocks = parasite_remote(parasite, parasite_thread(parasite, slot_number, 0));
}

/* A stopped process is sent to inj_restore() and let go. */
static int send_off(struct process *process, struct generation *generation, pid_t child,
		    struct sandbox **sandbox, struct avc_error *err)
{
	const struct parasite *parasite = &process->parasite;
	struct arch_regs regs;

	/* Its stack is the first thread's, in the slot. */
	arch_call(&regs, &generation->base, parasite->base + INJ_RESTORE_OFFSET,
		  parasite_remote(parasite, parasite_stack(parasite, generation->slot, 0)),
		  parasite_remote(parasite, parasite_slot(parasite, generation->slot)));
	/* A holder, of which the template is a clone, has that of the time when it was made. */
	if (!generation->headless)
		arch_tls_set(&regs, parasite_thread(parasite, generation->slot, 0)->tls);
	if ((generation->sandboxed || generation->stop_signal) &&
	    arch_regs_set(child, &regs) == 0) {
		*sandbox = sandbox_begin(child, process->inside, err);
		if (*sandbox)
			return 0;
		tracee_kill(child);
		return -1;
	}
	if (arch_regs_set(child, &regs) || ptrace(PTRACE_DETACH, child, NULL, 0L)) {
		fail_errno(err, child, "restore", "ptrace(DETACH)", "the new process was killed");
		tracee_kill(child);
		return -1;
	}
	return 0;
}

/* One fork of the template, or what is to have the memory of its spare.  If it is to have
 * children, it stays stopped. */
static int fork_template(struct process *process, struct generation *generation, pid_t *pid,
			 int *pidfd, bool again, struct sandbox **sandbox, struct avc_error *err)
{
	const struct parasite *parasite = &process->parasite;
	struct inj_slot *slot = parasite_slot(parasite, generation->slot);
	struct inj_call *call = &slot->template_call;
	const bool spare = spare_is_there(generation);
	const pid_t from = spare ? generation->spare.pid : generation->template;
	pid_t child = 0;

	/* The first time there are calls of files_restore() before it. */
	if (again)
		call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, (spare ? CLONE_VM : 0) | CLONE_FILES | CLONE_PARENT | SIGCHLD, 0,
		 0, 0, 0);
	if (parasite_send(parasite, from, &generation->base, call, err) ||
	    parasite_run_clone(from, call, &child, err))
		return -1;
	if (tracee_await(child, NULL, err) != STOP_TRAP)
		return -1;
	close_fd(pidfd);
	*pidfd = proc_pidfd_open(child);
	if (*pidfd < 0) {
		fail_errno(err, child, "restore", "pidfd_open", "the new process was killed");
		tracee_kill(child);
		return -1;
	}
	files_lift_limit(generation->files, child);
	if (generation->branches) {
		if (proc_inside(child) == slot->pid) {
			*pid = child;
		} else {
			tracee_kill(child);
			slot->state = INJ_WRONG_PID;
		}
		return tracee_settle(from, err);
	}
	if (send_off(process, generation, child, sandbox, err))
		return -1;
	*pid = child;
	/* The template can come to rest meanwhile. */
	return tracee_settle(from, err);
}

static int describe_failure(const struct parasite *parasite, const struct inj_slot *slot,
			    struct avc_error *err)
{
	const uint32_t at = __atomic_load_n(&slot->error_at, __ATOMIC_RELAXED);
	const char *name = at < sizeof step_names / sizeof *step_names ? step_names[at] : NULL;

	if (at == INJ_STEP_TID)
		return fail(err, AVC_KERNEL, slot->error, slot->pid, "restore", "clone",
			    "thread number %d is taken by somebody else", slot->error_tid);
	if (at == INJ_STEP_SETUP)
		return fail(err, AVC_KERNEL, slot->error, slot->pid, "restore",
			    setup_name(parasite, slot->error_setup),
			    "thread %d could not be put back", slot->error_tid);
	return fail(err, AVC_KERNEL, slot->error, slot->pid, "restore", name,
		    "thread %d could not be put back", slot->error_tid);
}

/* Forks until the number that comes out is the app's; in a PID namespace that is
 * shared somebody else may fork in between. */
static int rebuild(struct process *process, struct generation *generation, struct last_pid *helper,
		   struct restore_tree *others, pid_t *pid, int *pidfd, struct sandbox **sandbox,
		   struct restore_times *times, struct avc_error *notes, struct avc_error *err)
{
	struct inj_slot *slot = parasite_slot(&process->parasite, generation->slot);

	const uint64_t end = now_ns() + TRY_NS;

	for (int i = 0; i < TRIES || now_ns() < end; i++) {
		uint64_t start;

		/* The dead app's number may be free only some time after it was
		 * reaped; see spawn() in parasite.c. */
		if (i >= TRIES)
			usleep(TRY_AGAIN_NS / 1000);
		start = now_ns();
		reset(&process->parasite, generation->slot);
		if (last_pid_set(helper, slot->pid - 1, err) ||
		    fork_template(process, generation, pid, pidfd, i > 0, sandbox, err))
			return -1;
		times->fork_ns = now_ns() - start;
		if (others && slot->state == INJ_IDLE) {
			if (restore_tree_make(others, *pid, notes, err) ||
			    send_off(process, generation, *pid, sandbox, err))
				return -1;
			times->fork_ns = now_ns() - start;
		}
		start = now_ns();
		if (!await_state(slot, *sandbox))
			return fail(err, AVC_KERNEL, ETIMEDOUT, *pid, "restore", "",
				    "the new process does not answer");
		times->threads_ns = now_ns() - start;
		if (slot->state == INJ_READY)
			return 0;
		if (*sandbox)
			sandbox_end(*sandbox);
		*sandbox = NULL;
		if (slot->state == INJ_FAILED)
			return describe_failure(&process->parasite, slot, err);
	}
	return fail(err, AVC_KERNEL, EEXIST, slot->pid, "restore", "clone",
		    "the PID is taken by somebody else");
}

/* ---- one of several ---------------------------------------------------------------- */

int restore_start(struct process *process, struct generation *image, struct last_pid *helper,
		  pid_t pid, struct sandbox **sandbox, struct avc_error *err)
{
	reset(&process->parasite, image->slot);
	last_pid_serve(helper, parasite_slot(&process->parasite, image->slot));
	return send_off(process, image, pid, sandbox, err);
}

int restore_await(struct process *process, struct generation *image, pid_t pid,
		  struct sandbox *sandbox, struct avc_error *err)
{
	struct inj_slot *slot = parasite_slot(&process->parasite, image->slot);

	if (!await_state(slot, sandbox))
		return fail(err, AVC_KERNEL, ETIMEDOUT, pid, "restore", "",
			    "the new process does not answer");
	return slot->state == INJ_READY ? 0 : describe_failure(&process->parasite, slot, err);
}

/* What was allowed to fail, and did: to be told. */
static void note_failed(const struct parasite *parasite, uint32_t slot, pid_t pid,
			struct avc_error *notice)
{
	const struct inj_setup *s = setup_failed(parasite, slot);

	if (s)
		fail(notice, AVC_KERNEL, (int)-s->call.result, pid, "restore",
		     setup_name(parasite, parasite_remote(parasite, s)),
		     "not everything could be put back");
}

static void let_go(struct inj_slot *slot, enum inj_go stage)
{
	__atomic_store_n(&slot->go, stage, __ATOMIC_RELEASE);
	syscall(SYS_futex, &slot->go, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0);
}

/* As the others knew it: its main thread has ended, it is stopped. */
void restore_go(struct process *process, struct generation *image, struct sandbox *sandbox)
{
	struct inj_slot *slot = parasite_slot(&process->parasite, image->slot);

	if (sandbox)
		sandbox_go(sandbox, &process->parasite, image->slot, image->stop_signal);
	let_go(slot, INJ_GO_ALL);
}

void restore_note(struct process *process, struct generation *image, pid_t pid,
		  struct avc_error *notes)
{
	note_failed(&process->parasite, image->slot, pid, notes);
	files_check_calls(&process->parasite, image->slot,
			  parasite_slot(&process->parasite, image->slot)->pid, notes);
	attributes_put_back(image->attributes, pid, notes);
}

/* It serves all processes that ask for numbers: those that are no zombies. */
static struct last_pid *start_helper(const struct process *process,
				     const struct generation *generation,
				     const struct init_channel *channel, struct avc_error *err)
{
	struct last_pid_slot *slot = calloc(generation->branches + 1, sizeof *slot);
	struct last_pid *helper = NULL;
	uint32_t count = 0;

	if (!slot) {
		fail_errno(err, 0, "restore", "calloc", "out of memory");
		return NULL;
	}
	slot[count++] = (struct last_pid_slot){ &process->parasite, generation->slot };
	for (uint32_t i = 0; i < generation->branches; i++) {
		const struct branch *branch = &generation->branch[i];

		if (branch->process)
			slot[count++] = (struct last_pid_slot){ &branch->process->parasite,
								branch->image->slot };
	}
	helper = last_pid_start(channel->init_pidfd, slot, count, err);
	free(slot);
	return helper;
}

int restore_app(struct process *process, struct generation *generation,
		struct init_channel *channel, const struct avc_config *config, timer_t timer,
		uint64_t died_ns, int (*ready)(void *arg, struct avc_error *err), void *arg,
		pid_t *pid, struct restore_times *times, struct avc_error *notes,
		struct avc_error *err)
{
	struct inj_slot *slot = parasite_slot(&process->parasite, generation->slot);
	struct last_pid *helper = start_helper(process, generation, channel, err);
	struct sandbox *sandbox = NULL;
	struct restore_tree *others = NULL;
	struct fd_table *tables = calloc(generation->branches + 1, sizeof *tables);
	int result, pidfd = -1;
	uint64_t start, spare_ns;

	*pid = 0;
	*times = (struct restore_times){ 0 };
	if (!helper || !tables) {
		last_pid_stop(helper);
		free(tables);
		return fail_errno(err, 0, "restore", "calloc", "out of memory");
	}
	tracee_deadline_set(timer, FORK_NS);
	start = now_ns();
	result = spare_await(process, generation, err);
	/* To fork takes so long that the number would be somebody else's in the end. */
	if (!result && generation->anon_pages >= COPIED_PAGES && !generation->spare.unwanted &&
	    !spare_is_there(generation))
		result = spare_make_now(process, generation, err);
	spare_ns = now_ns() - start;
	if (!result)
		result = files_restore(process, generation, config, channel->init, tables, notes,
				       err);
	if (!result && generation->branches) {
		others = restore_tree_new(process, generation, helper, channel, timer, tables, err);
		result = others ? 0 : -1;
	}
	init_channel_working(channel);
	if (!result)
		result = rebuild(process, generation, helper, others, pid, &pidfd, &sandbox, times,
				 notes, err);
	if (!result && others)
		result = restore_tree_start(others, notes, err);
	if (!result)
		generation_close_tables(generation);
	tracee_deadline_clear(timer);
	last_pid_stop(helper);
	for (uint32_t i = 0; i < generation->branches; i++)
		fd_table_free(&tables[i]);
	free(tables);
	if (!result)
		restore_note(process, generation, *pid, notes);
	if (!result)
		result = memory_put_back(process, generation, *pid, notes, err);
	if (!result)
		result = ready(arg, err);
	if (result) {
		/* It waits for `go`: nothing of the app's has run.  The numbers it
		 * holds must be free before another generation is tried. */
		if (sandbox)
			sandbox_end(sandbox);
		if (pidfd >= 0) {
			struct pollfd gone = { .fd = pidfd, .events = POLLIN };

			syscall(SYS_pidfd_send_signal, pidfd, SIGKILL, NULL, 0);
			poll(&gone, 1, 1000);
			close_fd(&pidfd);
		}
		if (others)
			restore_tree_kill(others);
		restore_tree_free(others);
		*pid = 0;
		return -1;
	}
	if (others)
		restore_tree_go(others);
	if (!sandbox && generation->headless) {
		let_go(slot, INJ_GO_ENDED);
		proc_await_end(*pid);
	}
	restore_go(process, generation, sandbox);
	spare_drop(generation); /* it has the memory of what runs now */
	for (uint64_t end = now_ns() + READY_NS;;) {
		const uint32_t running = __atomic_load_n(&slot->running, __ATOMIC_ACQUIRE);

		if (running == slot->threads || now_ns() > end || pidfd_ended(pidfd))
			break; /* or it has died again already */
		wait_word(&slot->running, running, now_ns() + NS_PER_MS);
	}
	times->fork_ns += spare_ns;
	times->restore_ns = now_ns() - died_ns;
	for (uint32_t i = 0; i < generation->branches; i++)
		generation->branch[i].pid = restore_tree_pid(others, i);
	restore_tree_free(others);
	close_fd(&pidfd);
	return 0;
}
