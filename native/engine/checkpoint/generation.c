/* SPDX-License-Identifier: Apache-2.0
 *
 * Finishes a template once the app runs again: it is parked, and prepared so that a restore finds
 * everything ready in its slot of the parasite.
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

/* In template_call.out: what the template inherited by fork(2). */
#define TEMPLATE_NAME 16
#define TEMPLATE_ALTSTACK 32
#define TEMPLATE_ATTRIBUTES 64
#define RSEQ_FLAG_UNREGISTER_ 1 /* linux/rseq.h */

int generation_make_room(struct generation *generation, uint32_t images, struct avc_error *err)
{
	struct image *more = realloc(generation->image, images * sizeof *more);

	if (!more)
		return fail_memory(err, 0, "freeze");
	generation->image = more;
	return 0;
}

int generation_new(struct generation *generation, struct process *main, uint32_t slot,
		   struct avc_error *err)
{
	*generation = (struct generation){ 0 };
	if (generation_make_room(generation, 1, err))
		return -1;
	generation->image[generation->images++] = (struct image){
		.process = main,
		.parent = PARENT_INIT,
		.pidfd = -1,
		.slot = slot,
	};
	return 0;
}

/* A fork of the main thread has its attributes of that instant, except for what fork(2) resets. */
static int hear_template(const struct image *image, struct thread *cloned,
			 const struct inj_call *call, const struct inj_syscall *attributes,
			 struct avc_error *err)
{
	const struct creds was = cloned->creds;

	if (attributes_answer(image->template, attributes, call->out + TEMPLATE_ATTRIBUTES,
			      &cloned->creds, err))
		return -1;
	cloned->creds.death_signal = was.death_signal;
	cloned->creds.subreaper = was.subreaper;
	cloned->creds.slack_ns = was.slack_ns;
	cloned->creds.filters = was.filters;
	cloned->creds.future_lock = was.future_lock;
	memcpy(cloned->altstack, call->out + TEMPLATE_ALTSTACK, sizeof cloned->altstack);
	return thread_ask_others(image->process, cloned, &was, err);
}

/* For a later update instead of another fork. */
static int keep_inherited(struct image *image, struct avc_error *err)
{
	const struct thread *cloned = thread_find(image->process, image->process->pid);
	int64_t ignored;

	image->inherited = calloc(1, sizeof *image->inherited);
	if (!image->inherited)
		return fail_memory(err, 0, "keep template");
	inherited_answer(&image->process->parasite, image->slot, image->inherited, &ignored);
	if (cloned)
		inherited_creds(image->inherited, cloned);
	if (inherited_read(image->inherited, image->template, err))
		return -1;
	/* A descendant's are not its template's (process_attrs_learn()). */
	if (image->process->descendant)
		memset(image->inherited->limit, 0, sizeof image->inherited->limit);
	return 0;
}

static int quieten(struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	struct thread *cloned = process->descendant ? NULL : thread_find(process, process->pid);
	struct inj_slot *slot = parasite_slot(&process->parasite, image->slot);
	struct inj_call *call = &slot->template_call;
	const struct inj_syscall *rseq = NULL, *dumpable, *attributes = NULL;
	const pid_t pid = image->template;

	if (tracee_await(pid, NULL, err) != STOP_TRAP)
		return -1;
	if (parasite_own(&process->parasite, pid) || arch_regs_get(pid, &image->base))
		return fail_errno(err, pid, "keep template", "ptrace(SETOPTIONS)", "it was killed");
	memset(call->out, 0, sizeof call->out);
	memcpy(call->out, "avckpt-tmpl", 12);
	call_begin(call, INJ_AFTER_PARK);
	/* Leaves the app's session or process group; otherwise the number stays taken. */
	if (process->descendant || image->stat.session == process->leader)
		call_add(call, SYS_setsid);
	else
		call_add(call, SYS_setpgid);
	call_add(call, SYS_prctl, PR_GET_NAME,
		 parasite_remote(&process->parasite, call->out + TEMPLATE_NAME));
	call_add(call, SYS_prctl, PR_SET_NAME, parasite_remote(&process->parasite, call->out));
	dumpable = call_add(call, SYS_prctl, PR_GET_DUMPABLE);
	if (cloned) {
		call_add(call, SYS_sigaltstack, 0,
			 parasite_remote(&process->parasite, call->out + TEMPLATE_ALTSTACK));
		attributes = attributes_ask(&process->parasite, call,
					    call->out + TEMPLATE_ATTRIBUTES);
	}
	/* Otherwise the kernel would write to its memory each time it runs, and to its clones'. A
	 * holder's clone is not registered (kernel/rseq.c, CLONE_VM). */
	if (cloned && cloned->rseq)
		rseq = call_add(call, SYS_rseq, cloned->rseq, cloned->rseq_bytes,
				RSEQ_FLAG_UNREGISTER_, cloned->rseq_signature);
	if (process->tracker)
		inherited_ask(&process->parasite, image->slot, 0, call);
	if (parasite_send(&process->parasite, pid, &image->base, call, err) ||
	    parasite_run(pid, call, err))
		return -1;
	if (rseq && rseq->result)
		return fail(err, AVC_KERNEL, (int)-rseq->result, pid, "keep template", "rseq",
			    "refused");
	image->dumpable = dumpable->result;
	if (attributes && hear_template(image, cloned, call, attributes, err))
		return -1;
	return process->tracker ? keep_inherited(image, err) : 0;
}

/* A main thread that has exited while others run: it exists until they do, and exits again. */
static void fill_ended(const struct image *image)
{
	const struct process *process = image->process;
	struct inj_thread *block = parasite_thread(&process->parasite, image->slot, 0);

	*block = (struct inj_thread){
		.stack = parasite_remote(&process->parasite,
					 parasite_stack(&process->parasite, image->slot, 0)) -
			 16,
		.tid = process->inside,
	};
	if (proc_read(process->leader, "comm", block->name, sizeof block->name) > 0)
		block->name[strcspn(block->name, "\n")] = 0;
}

/* A child can have exited since the freeze; its template has what it had. */
static int read_status(const struct image *image, struct proc_status *status, struct avc_error *err)
{
	const struct process *process = image->process;

	if (proc_status_of(process->status_fd, process->pid, status) == 0)
		file_rights_note(&image->files->rights, process->pid, status);
	else if (process->descendant && proc_status(image->template, status) == 0)
		file_rights_note(&image->files->rights, image->template, status);
	else
		return fail_errno(err, process->pid, "keep template", "open(status)",
				  "it has ended");
	if (status->seccomp_filters > process->filters) /* one that has ended has none */
		return fail(err, AVC_RETRY, 0, process->pid, "keep template", "",
			    "its seccomp filters have just changed");
	return 0;
}

/* What the restored thread is made of.  `mem_fd`: the template's memory. */
static struct inj_thread *fill_block(const struct image *image, const struct thread *thread,
				     int mem_fd)
{
	const struct process *process = image->process;
	const struct parasite *parasite = &process->parasite;
	const uint32_t b = (uint32_t)thread->block;
	struct inj_thread *block = parasite_thread(parasite, image->slot, b);
	uint8_t *frame = parasite_frame(parasite, image->slot, b);
	const bool cloned = thread->tid == process->pid;
	struct thread t = *thread;

	/* The borrowed thread's was handled when it was borrowed; its memory has changed since. */
	if (!cloned)
		thread_fix_rseq(mem_fd, &t);
	rewind_original(&t, &t.regs);
	arch_rewind(&t.regs);
	*block = (struct inj_thread){
		.frame = arch_frame_build(frame, parasite_remote(parasite, frame), &t.regs,
					  t.sigmask, t.altstack),
		.stack = parasite_remote(parasite, parasite_stack(parasite, image->slot, b)) - 16,
		.tls = arch_tls(&t.regs),
		.clear_tid = t.clear_tid,
		.robust_list = t.robust_list,
		.robust_bytes = t.robust_bytes,
		.rseq = t.rseq,
		.rseq_bytes = t.rseq_bytes,
		.rseq_signature = t.rseq_signature,
		.other_base = arch_other_base(&t.regs),
		.large_state = arch_frame_needs_room(frame) ? parasite_remote(parasite, frame) : 0,
		.tid = t.inside,
		.affinity_bytes = t.affinity_bytes,
	};
	memcpy(block->affinity, t.affinity, sizeof block->affinity);
	/* Of the thread that was cloned, as of then. */
	memcpy(block->name,
	       cloned && !process->descendant && !image->recycled
		       ? (char *)parasite_slot(parasite, image->slot)->template_call.out +
				 TEMPLATE_NAME
		       : t.name,
	       sizeof block->name);
	return block;
}

static int fill_threads(const struct image *image, const struct thread *main_thread,
			struct setup *setup, struct avc_error *err)
{
	const struct process *process = image->process;
	int mem_fd = -1, result = 0;

	if (process->thread_count > 1) {
		mem_fd = proc_open(image->template, "mem", O_RDONLY);
		if (mem_fd < 0)
			return fail_errno(err, image->template, "keep template", "open(mem)",
					  "it was killed");
	}
	for (uint32_t i = 0; i < process->thread_count && !result; i++) {
		const struct thread *thread = &process->threads[i];

		if (thread->block < 0)
			continue;
		setup_thread(setup, fill_block(image, thread, mem_fd));
		result = attributes_setup_thread(process, main_thread, thread, setup, err);
		pending_setup_thread(process, thread, setup);
		filters_setup_thread(image, thread, setup);
	}
	close_fd(&mem_fd);
	return result;
}

/* What belongs to all of its threads. */
static int fill_process(struct image *image, const struct proc_status *status, struct setup *setup,
			struct avc_error *err)
{
	struct process *process = image->process;

	if (memory_finish(image, status->locked_kb, setup, err))
		return -1;
	pending_setup(process, setup);
	if (attributes_keep(image, err))
		return -1;
	timers_setup(process, status, setup);
	if (process->descendant)
		process_attrs_setup_limits(image, setup);
	/* A change of users clears it for the whole process, whichever thread makes it. */
	if (image->dumpable == 0 || image->dumpable == 1)
		setup_add(setup, INJ_AFTER, "", SYS_prctl, PR_SET_DUMPABLE,
			  (uint64_t)image->dumpable)
			->flags = INJ_MAY_FAIL;
	return 0;
}

/* The slot's own: whose number, group and terminal the restored process takes. */
static void fill_header(const struct image *image)
{
	const struct process *process = image->process;
	const struct proc_stat *stat = &image->stat;
	struct inj_slot *slot = parasite_slot(&process->parasite, image->slot);

	slot->threads = image->threads;
	slot->pid = process->inside;
	/* Only the app's own group, or one whose leader is visible, can be restored. */
	slot->group = !process->descendant && image->group > 0 ? image->group : process->inside;
	slot->session_leader = stat->session == process->leader;
	slot->placed = process->descendant;
	/* Of several processes: restore_tree.c. */
	slot->tty_fd = !process->descendant && stat->tty &&
				       (slot->session_leader || stat->tty_group == stat->group)
			       ? files_find_device(image->files, stat->tty)
			       : -1;
}

/* Fills the slot in from what freeze_tree() has read: one block per thread. */
static int fill_slot(struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	const struct thread *main_thread = thread_find(process, process->pid);
	struct proc_status status;
	struct setup setup;

	if (read_status(image, &status, err))
		return -1;
	image->headless = process->pid != process->leader;
	image->stop_signal = main_thread->stop_signal;
	image->stop_heard = process->stop_heard;
	setup_begin(&setup, &process->parasite, image->slot);
	if (filters_setup(image, main_thread, &setup, err) ||
	    fill_threads(image, main_thread, &setup, err))
		return -1;
	if (image->headless)
		fill_ended(image);
	image->sandboxed = image->installs ||
			   !seccomp_is_containers(&status, process->plain_filters);
	if (fill_process(image, &status, &setup, err))
		return -1;
	if (setup.notice.code)
		image->notice = setup.notice;
	fill_header(image);
	return setup_end(&setup, process->pid, err);
}

static int begin_template(struct image *image, struct avc_error *err)
{
	if (image->recycled)
		return 0;
	/* The holder is parked again. */
	if (image->process->descendant && tracee_settle(image->process->holder, err))
		return -1;
	image->pidfd = proc_pidfd_open(image->template);
	if (image->pidfd < 0)
		return fail_errno(err, image->template, "keep template", "pidfd_open",
				  "it was killed");
	return quieten(image, err);
}

/* What the process that will fork this one has to know.  It may have exited meanwhile: a shell's
 * children live for milliseconds. */
static int finish(struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	int statm_fd;
	long pages;

	statm_fd = proc_open(image->template, "statm", O_RDONLY);
	pages = proc_vm_pages(statm_fd, &image->anon_pages);
	process->anon_pages = image->anon_pages;
	close_fd(&statm_fd);
	if (pages >= 0 && pages != image->vm_pages && !image->recycled)
		return memory_learn(process, image->vm_pages - pages, err);
	if (process->descendant && process_attrs_learn(image, err))
		return -1;
	return fill_slot(image, err);
}

/* Others are forked by the main process, and restored, under its filters. */
static int check_forks(const struct generation *generation, struct avc_error *err)
{
	const struct process *main = generation->image[0].process;

	if (generation->images == 1 || main->filters <= main->plain_filters ||
	    main->parasite.seccomp == SECCOMP_IN_FORCE)
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, main->pid, "keep template", "",
		    "the main process has a seccomp filter that forbids what restoring several "
		    "processes takes");
}

int generation_finish(struct generation *generation, struct avc_error *err)
{
	struct process *main = generation->image[0].process;
	const struct thread *main_thread = thread_find(main, main->pid);
	struct avc_error again = { 0 };

	if (!main_thread)
		return fail(err, AVC_GONE, ESRCH, main->pid, "keep template", "", "it has ended");
	if (check_forks(generation, err))
		return -1;
	for (uint32_t i = 0; i < generation->images; i++) {
		struct image *image = &generation->image[i];
		struct avc_error failed = { 0 };

		if (!image->process)
			continue;
		if (!budget_step())
			return budget_check(main->pid, err);
		if (i)
			image->process->forebear = &main_thread->creds;
		if (begin_template(image, &failed) == 0 && finish(image, &failed) == 0)
			continue;
		/* What was outdated is known now, for all of them. */
		if (failed.code != AVC_RETRY) {
			*err = failed;
			return -1;
		}
		again = failed;
	}
	if (again.code)
		*err = again;
	if (again.code || memory_check_unkept(generation->image, generation->images, err) ||
	    restore_plan_check(generation, err))
		return -1;
	memory_note_left(generation->image, generation->images, &generation->image[0].notice);
	/* Not before its size was compared with the app's. */
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].process)
			files_unmap_areas(&generation->image[i]);
	return 0;
}

void generation_close_files(const struct image *image, bool shared)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_call *call = &parasite_slot(parasite, image->slot)->template_call;
	struct avc_error ignored = { 0 };

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_close_range, 0, ~0u, shared ? CLOSE_RANGE_UNSHARE : 0);
	if (parasite_send(parasite, image->template, &image->base, call, &ignored) ||
	    parasite_run(image->template, call, &ignored))
		return; /* it was killed, and has nothing open any more */
}

static bool start_closing(const struct generation *generation, uint32_t i, bool late)
{
	const struct image *image = &generation->image[i];
	const uint32_t owner = image_table_owner(generation->image, i);
	const struct process *process = image->process;

	/* The main process has its old one again; others have left theirs. */
	if (!process || !process->holder || (late && !process->late) ||
	    (owner != i && (!owner || generation->image[owner].process->holder)))
		return false;
	return process->late && !late ? files_start_closing_claims(process, image->files)
				      : files_start_closing(process);
}

void generation_close_tables(const struct generation *generation, bool late)
{
	bool closing[PROCESSES_MAX] = { false };

	for (uint32_t i = 1; i < generation->images; i++)
		closing[i] = start_closing(generation, i, late);
	for (uint32_t i = 1; i < generation->images; i++) {
		struct process *process = generation->image[i].process;
		struct avc_error gone = { 0 };

		closing[i] = closing[i] &&
			     parasite_halt(process->holder, &process->parasite.control->holder,
					   &gone) == 0;
	}
	for (uint32_t i = 1; i < generation->images; i++) {
		struct avc_error gone = { 0 };

		if (closing[i] &&
		    tracee_await(generation->image[i].process->holder, NULL, &gone) != STOP_TRAP)
			continue; /* it was killed, and has nothing open any more */
	}
}

static void image_drop(struct image *image)
{
	if (image->template)
		tracee_end(image->template, image->pidfd);
	else
		close_fd(&image->pidfd);
	mem_image_free(image->memory);
	free(image->attributes);
	free(image->seal);
	process_attrs_forget(image);
	files_free(image->files);
	files_mapped_free(image->mapped);
	free(image->inherited);
	if (image->stale) {
		if (image->process->tracker)
			tracker_remove(image->process->tracker, image->stale);
		pageset_free(image->stale);
		free(image->stale);
	}
	if (image->process && image->process->descendant)
		image->process->images--;
}

void generation_drop(struct generation *generation)
{
	spare_drop(generation);
	for (uint32_t i = 0; i < generation->images; i++)
		image_drop(&generation->image[i]);
	if (spare_is_unknown(generation))
		tracee_end_now(); /* the kernel has made one by now, or never will */
	restore_plan_free(generation->plan);
	files_ends_free(generation->ends);
	free(generation->image);
	*generation = (struct generation){ 0 };
}

struct image *generation_image(const struct generation *generation, const struct process *process)
{
	return image_find(generation->image, generation->images, process);
}

uint32_t generation_threads(const struct generation *generation)
{
	uint32_t threads = 0;

	for (uint32_t i = 0; i < generation->images; i++)
		threads += generation->image[i].threads;
	return threads;
}

const struct avc_error *generation_notice(const struct generation *generation)
{
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].notice.code)
			return &generation->image[i].notice;
	return &generation->image[0].notice;
}

int generation_files_error(const struct generation *generation, struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].files_error.code) {
			*err = generation->image[i].files_error;
			return -1;
		}
	return 0;
}
