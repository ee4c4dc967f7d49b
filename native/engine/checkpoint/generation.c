/* SPDX-License-Identifier: Apache-2.0
 *
 * A template once the app runs again: made to lie still, and prepared so that a
 * restore finds everything ready in its slot of the parasite.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "checkpoint.h"

/* In template_call.out: what the template had got by fork(2). */
#define TEMPLATE_NAME 16
#define TEMPLATE_ALTSTACK 32
#define TEMPLATE_ATTRIBUTES 64
#define RSEQ_FLAG_UNREGISTER_ 1 /* linux/rseq.h */

/* A fork of the main thread has what that had at that instant, but for what fork(2) resets. */
static int hear_template(struct process *process, struct thread *cloned,
			 const struct inj_call *call, const struct inj_syscall *attributes,
			 struct avc_error *err)
{
	const struct creds was = cloned->creds;

	attributes_answer(attributes, call->out + TEMPLATE_ATTRIBUTES, &cloned->creds);
	cloned->creds.death_signal = was.death_signal;
	cloned->creds.subreaper = was.subreaper;
	cloned->creds.slack_ns = was.slack_ns;
	cloned->creds.filters = was.filters;
	cloned->creds.future_lock = was.future_lock;
	memcpy(cloned->altstack, call->out + TEMPLATE_ALTSTACK, sizeof cloned->altstack);
	return thread_ask_others(process, cloned, &was, err);
}

static int quieten(struct process *process, struct generation *generation,
		   const struct branch *branch, struct avc_error *err)
{
	struct thread *cloned = branch ? NULL : thread_find(process, process->pid);
	struct inj_slot *slot = parasite_slot(&process->parasite, generation->slot);
	struct inj_call *call = &slot->template_call;
	const struct inj_syscall *rseq = NULL, *dumpable, *attributes = NULL;
	const pid_t pid = generation->template;

	if (tracee_await(pid, NULL, err) != STOP_TRAP)
		return -1;
	if (parasite_own(&process->parasite, pid) || arch_regs_get(pid, &generation->base))
		return fail_errno(err, pid, "keep template", "ptrace(SETOPTIONS)", "it was killed");
	memset(call->out, 0, sizeof call->out);
	memcpy(call->out, "avckpt-tmpl", 12);
	call_begin(call, INJ_AFTER_PARK);
	/* Out of the app's session or process group, or the number stays taken. */
	if (branch || generation->stat.session == process->leader)
		call_add(call, SYS_setsid, 0, 0, 0, 0, 0);
	else
		call_add(call, SYS_setpgid, 0, 0, 0, 0, 0);
	call_add(call, SYS_prctl, PR_GET_NAME,
		 parasite_remote(&process->parasite, call->out + TEMPLATE_NAME), 0, 0, 0);
	call_add(call, SYS_prctl, PR_SET_NAME, parasite_remote(&process->parasite, call->out), 0, 0,
		 0);
	dumpable = call_add(call, SYS_prctl, PR_GET_DUMPABLE, 0, 0, 0, 0);
	if (cloned) {
		call_add(call, SYS_sigaltstack, 0,
			 parasite_remote(&process->parasite, call->out + TEMPLATE_ALTSTACK), 0, 0,
			 0);
		attributes = attributes_ask(call, call->out + TEMPLATE_ATTRIBUTES,
					    parasite_remote(&process->parasite,
							    call->out + TEMPLATE_ATTRIBUTES));
	}
	/* Or the kernel would write to its memory each time it runs, and to what is made of
	 * that.  A holder's clone is not registered (kernel/rseq.c, CLONE_VM). */
	if (cloned && cloned->rseq)
		rseq = call_add(call, SYS_rseq, cloned->rseq, cloned->rseq_bytes,
				RSEQ_FLAG_UNREGISTER_, cloned->rseq_signature, 0);
	if (parasite_send(&process->parasite, pid, &generation->base, call, err) ||
	    parasite_run(pid, call, err))
		return -1;
	if (rseq && rseq->result)
		return fail(err, AVC_KERNEL, (int)-rseq->result, pid, "keep template", "rseq",
			    "refused");
	generation->dumpable = dumpable->result;
	proc_set_oom_score_adj(pid, "1000");
	return attributes ? hear_template(process, cloned, call, attributes, err) : 0;
}

/* A main thread that has ended while others go on: it is there again until they are,
 * and ends again. */
static void fill_ended(struct process *process, struct generation *generation)
{
	struct inj_thread *block = parasite_thread(&process->parasite, generation->slot, 0);

	*block = (struct inj_thread){
		.stack = parasite_remote(&process->parasite,
					 parasite_stack(&process->parasite, generation->slot, 0)) -
			 16,
		.tid = process->inside,
	};
	if (proc_read(process->leader, "comm", block->name, sizeof block->name) > 0)
		block->name[strcspn(block->name, "\n")] = 0;
}

/* Fills the slot in from what freeze_tree() has read: one block per thread. */
static int fill_slot(struct process *process, struct generation *generation,
		     const struct branch *branch, struct avc_error *err)
{
	const struct parasite *parasite = &process->parasite;
	struct inj_slot *slot = parasite_slot(parasite, generation->slot);
	const struct thread *main_thread = thread_find(process, process->pid);
	const struct proc_stat *stat = &generation->stat;
	struct proc_status status;
	struct setup setup;
	int mem_fd = proc_open(generation->template, "mem", O_RDONLY);

	if (mem_fd < 0)
		return fail_errno(err, generation->template, "keep template", "open(mem)",
				  "it was killed");
	if (proc_status(process->pid, &status) &&
	    (!branch || proc_status(generation->template, &status))) {
		close(mem_fd);
		return fail_errno(err, process->pid, "keep template", "open(status)",
				  "it has ended");
	}
	generation->headless = process->pid != process->leader;
	generation->stop_signal = main_thread->stop_signal;
	setup_begin(&setup, parasite, generation->slot);
	for (uint32_t i = 0; i < process->thread_count; i++) {
		struct thread t = process->threads[i];
		const uint32_t b = (uint32_t)t.block;
		struct inj_thread *block;
		uint8_t *frame;

		if (t.block < 0)
			continue;
		block = parasite_thread(parasite, generation->slot, b);
		frame = parasite_frame(parasite, generation->slot, b);

		/* The borrowed thread's was seen to when it was borrowed; its own
		 * memory has been run on since. */
		if (t.tid != process->pid)
			thread_fix_rseq(mem_fd, &t);
		rewind_original(&t, &t.regs);
		arch_rewind(&t.regs);
		*block = (struct inj_thread){
			.frame = arch_frame_build(frame, parasite_remote(parasite, frame), &t.regs,
						  t.sigmask, t.altstack),
			.stack = parasite_remote(parasite,
						 parasite_stack(parasite, generation->slot, b)) -
				 16,
			.tls = arch_tls(&t.regs),
			.clear_tid = t.clear_tid,
			.robust_list = t.robust_list,
			.robust_bytes = t.robust_bytes,
			.rseq = t.rseq,
			.rseq_bytes = t.rseq_bytes,
			.rseq_signature = t.rseq_signature,
			.other_base = arch_other_base(&t.regs),
			.large_state =
				arch_frame_needs_room(frame) ? parasite_remote(parasite, frame) : 0,
			.tid = t.inside,
			.affinity_bytes = t.affinity_bytes,
		};
		memcpy(block->affinity, t.affinity, sizeof block->affinity);
		/* Of the one that was cloned, as it was then. */
		memcpy(block->name,
		       !branch && t.tid == process->pid
			       ? (char *)slot->template_call.out + TEMPLATE_NAME
			       : t.name,
		       sizeof block->name);
		setup_thread(&setup, block);
		if (attributes_setup_thread(process, main_thread, &process->threads[i], &setup,
					    err)) {
			close(mem_fd);
			return -1;
		}
		pending_setup_thread(process, &t, &setup);
	}
	close(mem_fd);
	if (generation->headless)
		fill_ended(process, generation);
	generation->sandboxed = status.seccomp == 1 ||
				status.seccomp_filters > process->plain_filters;
	if (status.seccomp == 1)
		process->parasite.seccomp = SECCOMP_SUPERVISED;
	if (memory_finish(process, generation, status.locked_kb, &setup, err))
		return -1;
	pending_setup(process, &setup);
	if (attributes_keep(process, generation, err))
		return -1;
	timers_setup(process, &setup);
	if (branch)
		process_attrs_setup_limits(branch, &setup);
	/* A change of users takes it from the whole process, whichever thread it is. */
	if (generation->dumpable == 0 || generation->dumpable == 1)
		setup_add(&setup, INJ_AFTER, "", SYS_prctl, PR_SET_DUMPABLE,
			  (uint64_t)generation->dumpable, 0, 0, 0)
			->flags = INJ_MAY_FAIL;
	if (setup.notice.code)
		generation->notice = setup.notice;
	slot->threads = generation->threads;
	slot->pid = process->inside;
	/* Nothing but the app's own group, or one whose leader is visible, can be
	 * put back. */
	slot->group = generation->group > 0 ? generation->group : process->inside;
	slot->session_leader = stat->session == process->leader;
	slot->placed = process->descendant;
	/* Of several processes: restore_tree.c. */
	slot->tty_fd = !branch && stat->tty && stat->tty_group == stat->group
			       ? files_find_device(generation->files, stat->tty)
			       : -1;
	return setup_end(&setup, process->pid, err);
}

/* What has to be known before anything is filled in: what the others are made from. */
static int begin_template(struct process *process, struct generation *generation,
			  const struct branch *branch, struct avc_error *err)
{
	generation->pidfd = proc_pidfd_open(generation->template);
	if (generation->pidfd < 0)
		return fail_errno(err, generation->template, "keep template", "pidfd_open",
				  "it was killed");
	return quieten(process, generation, branch, err);
}

static int finish(struct process *process, struct generation *generation, struct branch *branch,
		  struct avc_error *err)
{
	int statm_fd;
	long pages;

	statm_fd = proc_open(generation->template, "statm", O_RDONLY);
	pages = proc_vm_pages(statm_fd, &generation->anon_pages);
	process->anon_pages = generation->anon_pages;
	close_fd(&statm_fd);
	if (pages >= 0 && pages != generation->vm_pages)
		return memory_learn(process, generation->vm_pages - pages, err);
	if (branch && process_attrs_learn(branch, err))
		return -1;
	return fill_slot(process, generation, branch, err);
}

/* What only a process that makes another one its child has to know.  This one may have
 * ended meanwhile: a shell's children live for milliseconds. */
static int finish_branch(struct branch *branch, struct avc_error *err)
{
	struct process *process = branch->process;

	/* The holder rests again. */
	return tracee_settle(process->holder, err) ||
			       begin_template(process, branch->image, branch, err) ||
			       finish(process, branch->image, branch, err)
		       ? -1
		       : 0;
}

int generation_finish(struct process *process, struct generation *generation, struct avc_error *err)
{
	const struct thread *main_thread = thread_find(process, process->pid);
	struct avc_error again = { 0 };

	if (generation->branches && !main_thread)
		return fail(err, AVC_GONE, ESRCH, process->pid, "keep template", "",
			    "it has ended");
	if (begin_template(process, generation, NULL, err))
		return -1;
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct branch *branch = &generation->branch[i];
		struct avc_error failed = { 0 };

		if (!branch->process)
			continue;
		branch->process->forebear = &main_thread->creds;
		if (finish_branch(branch, &failed)) {
			/* What was not as it was known is known now: of all of them. */
			if (failed.code != AVC_RETRY) {
				*err = failed;
				return -1;
			}
			again = failed;
			continue;
		}
		if (branch->image->notice.code && !generation->notice.code)
			generation->notice = branch->image->notice;
	}
	if (finish(process, generation, NULL, err))
		return -1;
	if (again.code)
		*err = again;
	if (again.code || restore_plan_check(generation, err))
		return -1;
	/* Not before its size was compared with the app's. */
	files_unmap_areas(process, generation);
	for (uint32_t i = 0; i < generation->branches; i++)
		if (generation->branch[i].process)
			files_unmap_areas(generation->branch[i].process,
					  generation->branch[i].image);
	return 0;
}

void generation_close_files(struct process *process, struct generation *image)
{
	struct inj_call *call = &parasite_slot(&process->parasite, image->slot)->template_call;
	struct avc_error ignored = { 0 };

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_close_range, 0, ~0u, 0, 0, 0);
	if (parasite_send(&process->parasite, image->template, &image->base, call, &ignored) ||
	    parasite_run(image->template, call, &ignored))
		return; /* it was killed, and has nothing open any more */
}

static bool start_closing(struct process *process)
{
	struct inj_call *call = &process->parasite.control->holder;
	struct avc_error gone = { 0 };

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_close_range, 0, ~0u, 0, 0, 0);
	return parasite_send(&process->parasite, process->holder, &process->holder_base, call,
			     &gone) == 0 &&
	       parasite_start(process->holder, &gone) == 0;
}

void generation_close_tables(const struct generation *generation)
{
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct process *process = generation->branch[i].process;

		if (process)
			process->closing = process->holder && start_closing(process);
	}
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct process *process = generation->branch[i].process;
		struct avc_error gone = { 0 };

		if (process && process->closing &&
		    parasite_finish(process->holder, &process->parasite.control->holder, &gone))
			continue; /* it was killed, and has nothing open any more */
	}
}

static void image_drop(struct generation *image)
{
	spare_drop(image);
	if (image->template)
		tracee_end(image->template, image->pidfd);
	else
		close_fd(&image->pidfd);
	if (spare_is_unknown(image))
		tracee_end_now(); /* the kernel has made one by now, or makes none */
	mem_image_free(image->image);
	free(image->attributes);
	files_free(image->files);
	files_mapped_free(image->mapped);
}

void generation_drop(struct generation *generation)
{
	for (uint32_t i = 0; i < generation->branches; i++) {
		struct branch *branch = &generation->branch[i];

		process_attrs_forget(branch);
		if (!branch->image)
			continue;
		image_drop(branch->image);
		free(branch->image);
		if (branch->process)
			branch->process->images--;
	}
	restore_plan_free(generation->plan);
	free(generation->branch);
	image_drop(generation);
	*generation = (struct generation){ .pidfd = -1 };
}

uint32_t generation_threads(const struct generation *generation)
{
	uint32_t threads = generation->threads;

	for (uint32_t i = 0; i < generation->branches; i++)
		threads += generation->branch[i].image ? generation->branch[i].image->threads : 0;
	return threads;
}
