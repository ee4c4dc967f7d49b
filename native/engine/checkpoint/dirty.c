/* SPDX-License-Identifier: Apache-2.0
 *
 * A checkpoint that costs what was written, and not what there is.
 *
 * A template is forked once.  When its generation gives way it is not killed but kept, and brought up
 * to date for a later one: what was written since (tracker.c) is copied, in rounds while the
 * application runs, and the last, small one with it stopped.  Even that is only read then, and
 * written to the template when the application runs again.
 *
 * What may differ between the process and a template is the template's *stale set*.  Every scan adds
 * to the sets of all templates, and only a copy takes away, so that an attempt that comes to nothing
 * costs nothing.  What else a fork inherits must be what it was (inherited.c, layout.c); if not, the
 * checkpoint is taken by a fork.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "checkpoint.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define ROUNDS 6
#define FEW_PAGES 48       /* a round that finds no more is the last          */
#define BATCH_PAGES 1024   /* copied at a time                                */
#define FREEZE_PAGES 16384 /* read in a freeze, at most                       */
#define READ_PAGE_NS 700   /* in a freeze                                     */
#define AGE_NS (60 * NS_PER_S)
#define STALE_SHARE 2 /* of its pages of its own: more than a half is for a fork to bring */
#define COPIES_SHARE 2
#define VECTORS 1024
#define IDLE_OOM_SCORE 1000
#define LISTED_MAX (INJ_FILES_BYTES / 2 / sizeof(struct inj_syscall))

enum run_kind { RUN_DATA, RUN_EMPTY, RUN_GUARD };

struct run {
	avc_remote start, end;
	enum run_kind kind;
	size_t at; /* of its contents                                           */
};

/* ---- what there is to copy ------------------------------------------------------------------ */

static enum run_kind kind_of(uint64_t entry)
{
	return page_is_guard(entry) ? RUN_GUARD : page_is_own(entry) ? RUN_DATA : RUN_EMPTY;
}

static bool add_run(struct dirty *dirty, avc_remote start, avc_remote end, enum run_kind kind)
{
	if (!make_room(&dirty->run, dirty->runs, &dirty->run_room, sizeof *dirty->run))
		return false;
	dirty->run[dirty->runs++] = (struct run){ start, end, kind, dirty->used };
	if (kind == RUN_DATA)
		dirty->used += end - start;
	return true;
}

/* A stretch of a chunk, as the process has it. */
static bool sort_stretch(struct dirty *dirty, int pagemap, avc_remote start, avc_remote end)
{
	uint64_t entry[PAGESET_PAGES];
	const size_t pages = (end - start) / PAGE;

	if (pread(pagemap, entry, pages * sizeof *entry, (off_t)(start / PAGE * sizeof *entry)) !=
	    (ssize_t)(pages * sizeof *entry))
		return false;
	for (size_t i = 0, k; i < pages; i = k) {
		const enum run_kind kind = kind_of(entry[i]);

		for (k = i + 1; k < pages && kind_of(entry[k]) == kind; k++)
			;
		if (!add_run(dirty, start + i * PAGE, start + k * PAGE, kind))
			return false;
	}
	return true;
}

static bool make_data_room(struct dirty *dirty, size_t bytes)
{
	uint8_t *more;

	if (dirty->data_bytes >= bytes)
		return true;
	free(dirty->data);
	more = malloc(bytes);
	dirty->data = more;
	dirty->data_bytes = more ? bytes : 0;
	if (more)
		memset(more, 0, bytes); /* page faults now, and not in a freeze */
	return more != NULL;
}

/* process_vm_readv(2) or its counterpart for some of the runs, all of which have contents; `mem` is
 * for those that the process itself could not read or write. */
typedef ssize_t transfer(pid_t pid, const struct iovec *here, unsigned long heres,
			 const struct iovec *there, unsigned long theres, unsigned long flags);

static bool move_one(const struct dirty *dirty, const struct run *run, int mem, bool reading)
{
	uint8_t *data = dirty->data + run->at;
	const size_t bytes = run->end - run->start;
	const ssize_t n = reading ? pread(mem, data, bytes, (off_t)run->start)
				  : pwrite(mem, data, bytes, (off_t)run->start);

	return n == (ssize_t)bytes;
}

static bool move(const struct dirty *dirty, pid_t pid, int mem, bool reading)
{
	transfer *const step = reading ? process_vm_readv : process_vm_writev;
	struct iovec there[VECTORS];

	for (uint32_t i = 0; i < dirty->runs;) {
		struct iovec here = { NULL, 0 };
		uint32_t first = i, count = 0;

		for (; i < dirty->runs && count < VECTORS; i++) {
			const struct run *run = &dirty->run[i];

			if (run->kind != RUN_DATA)
				continue;
			if (!count)
				here.iov_base = dirty->data + run->at;
			there[count++] = (struct iovec){ (void *)run->start,
							 run->end - run->start };
			here.iov_len += run->end - run->start;
		}
		if (!count || step(pid, &here, 1, there, count, 0) == (ssize_t)here.iov_len)
			continue;
		for (; first < i; first++)
			if (dirty->run[first].kind == RUN_DATA &&
			    !move_one(dirty, &dirty->run[first], mem, reading))
				return false;
	}
	return true;
}

/* ---- while the application runs -------------------------------------------------------------- */

/* What cannot be copied yet stays in the set; what is empty does in any case. */
static void copy_batch(struct dirty *dirty, const struct process *process, int mem)
{
	struct idle_template *idle = &dirty->idle;
	const bool copied = move(dirty, process->pid, process->mem_fd, true) &&
			    move(dirty, idle->pid, mem, false);

	for (uint32_t i = 0; i < dirty->runs; i++) {
		const struct run *run = &dirty->run[i];

		if (copied && run->kind == RUN_DATA)
			dirty->copied += (run->end - run->start) / PAGE;
		else
			process->tracker->broken |= !pageset_add(idle->stale, run->start, run->end);
	}
	dirty->runs = 0;
	dirty->used = 0;
}

static void copy_stale(struct dirty *dirty, const struct process *process)
{
	struct pageset todo = *dirty->idle.stale;
	struct page_cursor at = { 0 };
	avc_remote start, end;
	int mem = proc_open(dirty->idle.pid, "mem", O_RDWR);

	if (mem < 0)
		return;
	*dirty->idle.stale = (struct pageset){ 0 };
	dirty->runs = 0;
	dirty->used = 0;
	while (pageset_next(&todo, &at, &start, &end)) {
		heartbeat();
		if (!sort_stretch(dirty, process->tracker->pagemap, start, end))
			process->tracker->broken |= !pageset_add(dirty->idle.stale, start, end);
		if (dirty->used >= BATCH_PAGES / 2 * PAGE)
			copy_batch(dirty, process, mem);
	}
	copy_batch(dirty, process, mem);
	pageset_free(&todo);
	close(mem);
}

/* Until a round finds little, or no less than the one before.  What is left. */
static bool copy_rounds(struct dirty *dirty, const struct process *process, uint64_t *left)
{
	uint64_t before = UINT64_MAX;

	for (int i = 0; i < ROUNDS; i++) {
		const pid_t template = i ? 0 : dirty->idle.pid;

		if (tracker_scan(process->tracker, template, left))
			return false;
		if (!i &&
		    pageset_count(dirty->idle.stale) > (uint64_t)dirty->own_pages / STALE_SHARE) {
			dirty->reason = AVC_FORK_WRITES;
			return false;
		}
		copy_stale(dirty, process);
		if (process->tracker->broken)
			return false;
		if (i && (*left <= FEW_PAGES || *left > before / 4 * 3))
			break;
		before = i ? *left : UINT64_MAX;
	}
	return true;
}

/* ---- whether --------------------------------------------------------------------------------- */

/* By RDMA and the like (mm_struct.pinned_vm). */
static bool has_pinned(pid_t pid)
{
	char buf[4096];
	const char *line;

	if (proc_read(pid, "status", buf, sizeof buf) <= 0)
		return true;
	line = strstr(buf, "\nVmPin:");
	return line && strtoul(line + 7, NULL, 10) != 0;
}

static bool has_own_filter(const struct process *process)
{
	struct proc_status status;

	return process->parasite.seccomp == SECCOMP_SUPERVISED ||
	       proc_status(process->pid, &status) || status.seccomp == 1 ||
	       status.seccomp_filters > process->plain_filters;
}

/* Zombies that init is just about to wait for do not count; ours are among them. */
static bool has_others(const struct tree *tree)
{
	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->entry[i].process ||
		    (tree->entry[i].pid && tree->entry[i].parent != PARENT_INIT))
			return true;
	return false;
}

/* Why its memory is not even to be watched. */
static enum avc_fork_reason why_not(const struct tree *tree, const struct avc_config *config)
{
	const struct process *process = tree_main(tree);

	if (config->images == AVC_IMAGES_FORK)
		return AVC_FORK_CONFIG;
	if (has_others(tree))
		return AVC_FORK_PROCESSES;
	if (has_own_filter(process))
		return AVC_FORK_SANDBOX;
	if (memory_needs_fork(process))
		return AVC_FORK_MEMORY;
	if (has_pinned(process->pid) || files_may_pin(process->files_before))
		return AVC_FORK_PINNED;
	return AVC_FORK_NONE;
}

/* It is watched, all of it. */
static enum avc_fork_reason watch(struct dirty *dirty, struct process *process, timer_t timer)
{
	struct avc_error refused = { 0 };

	if (process->tracker && (process->tracker->over || process->tracker->broken))
		tracker_end(process);
	if (!process->tracker) {
		if (dirty->refused_nonce == process->nonce || !process->holder)
			return AVC_FORK_KERNEL;
		if (tracker_begin(process, timer, &refused)) {
			if (refused.code == AVC_UNSUPPORTED)
				dirty->refused_nonce = process->nonce;
			return AVC_FORK_KERNEL;
		}
	}
	if (!layout_read(process->pid, &dirty->layout, &dirty->layout_bytes))
		return AVC_FORK_LAYOUT;
	if (tracker_watch(process, dirty->layout, &refused)) {
		tracker_end(process);
		return AVC_FORK_MEMORY;
	}
	return AVC_FORK_NONE;
}

/* As of when it was watched: of what is mapped in between, nothing is known. */
static bool has_same_layout(struct dirty *dirty)
{
	char *theirs = NULL;
	size_t bytes = 0;
	const bool same = layout_read(dirty->idle.pid, &theirs, &bytes) &&
			  layout_equal(dirty->layout, theirs);

	free(theirs);
	return same;
}

static enum avc_fork_reason why_not_idle(struct dirty *dirty, const struct process *process)
{
	const struct idle_template *idle = &dirty->idle;

	if (idle->pid && (idle->tracker != process->tracker->number || pidfd_ended(idle->pidfd)))
		dirty_drop_idle(dirty);
	if (!idle->pid || process->old_parasites)
		return AVC_FORK_FIRST;
	if (now_ns() - idle->forked_ns > AGE_NS)
		return AVC_FORK_AGE;
	if (idle->copied > (uint64_t)dirty->own_pages / COPIES_SHARE)
		return AVC_FORK_COPIES;
	if (!has_same_layout(dirty))
		return AVC_FORK_LAYOUT;
	return AVC_FORK_NONE;
}

void dirty_prepare(struct dirty *dirty, const struct tree *tree, const struct avc_config *config,
		   timer_t timer)
{
	struct process *process = tree_main(tree);
	uint64_t left = 0;

	process->recycling = false;
	dirty->copied = 0;
	dirty->reason = why_not(tree, config);
	if (dirty->reason) {
		dirty_drop_idle(dirty);
		tracker_end(process);
		return;
	}
	dirty->reason = watch(dirty, process, timer);
	if (dirty->reason)
		return;
	dirty->reason = dirty->fork_next ? AVC_FORK_CHANGED : why_not_idle(dirty, process);
	dirty->fork_next = false;
	if (!dirty->reason && !make_data_room(dirty, BATCH_PAGES * PAGE))
		dirty->reason = AVC_FORK_FIRST;
	if (dirty->reason) {
		/* What is written before the fork is not written since. */
		if (tracker_scan(process->tracker, 0, &left))
			tracker_end(process);
		return;
	}
	if (!copy_rounds(dirty, process, &left)) {
		if (!dirty->reason)
			dirty->reason = AVC_FORK_LAYOUT;
		return;
	}
	/* Room for what is written until the freeze. */
	if (config->images == AVC_IMAGES_AUTO && left * READ_PAGE_NS > dirty->fork_ns)
		dirty->reason = AVC_FORK_WRITES;
	else if (make_data_room(dirty, (4 * left + BATCH_PAGES) * PAGE))
		process->recycling = true;
}

/* ---- in the freeze --------------------------------------------------------------------------- */

static int fork_instead(struct dirty *dirty, const struct process *process, const char *what,
			struct avc_error *err)
{
	dirty->fork_next = true;
	return fail(err, AVC_RETRY, 0, process->pid, "freeze", "", "%s", what);
}

static bool read_stale(struct dirty *dirty, const struct process *process)
{
	struct page_cursor at = { 0 };
	avc_remote start, end;

	dirty->runs = 0;
	dirty->used = 0;
	while (pageset_next(dirty->idle.stale, &at, &start, &end))
		if (!sort_stretch(dirty, process->tracker->pagemap, start, end) ||
		    dirty->used > dirty->data_bytes || dirty->used > FREEZE_PAGES * PAGE)
			return false;
	return move(dirty, process->pid, process->mem_fd, true);
}

int dirty_capture(struct dirty *dirty, const struct generation *generation, struct avc_error *err)
{
	const struct image *image = &generation->image[0];
	struct process *process = image->process;
	uint64_t pages;

	if (generation->images > 1)
		return fork_instead(dirty, process, "it has just started another process", err);
	if (files_may_pin(image->files))
		return fork_instead(dirty, process, "pages of its may be pinned", err);
	if (!layout_read(process->pid, &dirty->layout, &dirty->layout_bytes) ||
	    tracker_scan(process->tracker, 0, &pages) || !read_stale(dirty, process))
		return fork_instead(dirty, process, "too much of it has changed just now", err);
	memset(&dirty->now, 0, sizeof dirty->now);
	return inherited_read(&dirty->now, process->pid, err);
}

/* ---- when the application runs again --------------------------------------------------------- */

/* Calls that the template makes. */
struct calls {
	const struct parasite *parasite;
	const struct idle_template *idle;
	uint32_t slot, count;
	struct inj_syscall *list;
};

static int flush(struct calls *calls, struct avc_error *err)
{
	struct inj_call *call = &parasite_slot(calls->parasite, calls->slot)->template_call;
	const uint32_t count = calls->count;

	calls->count = 0;
	if (!count)
		return 0;
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, INJ_LIST, parasite_remote(calls->parasite, calls->list), count);
	if (parasite_send(calls->parasite, calls->idle->pid, &calls->idle->base, call, err) ||
	    parasite_run(calls->idle->pid, call, err))
		return -1;
	for (uint32_t i = 0; i < count; i++)
		if (calls->list[i].result)
			return fail(err, AVC_RETRY, (int)-calls->list[i].result, calls->idle->pid,
				    "keep template", "madvise", "refused");
	return 0;
}

static int advise(struct calls *calls, avc_remote start, avc_remote end, int advice,
		  struct avc_error *err)
{
	if (calls->count == LISTED_MAX && flush(calls, err))
		return -1;
	calls->list[calls->count++] = (struct inj_syscall){
		.nr = SYS_madvise, .arg = { start, end - start, (uint64_t)advice }
	};
	return 0;
}

/* Of one run, what the template has there that the process has not. */
static int prepare_run(struct calls *calls, const struct run *run, int pagemap,
		       struct avc_error *err)
{
	uint64_t entry[PAGESET_PAGES];
	const size_t pages = (run->end - run->start) / PAGE;
	bool own = false, guard = false;

	if (run->kind == RUN_GUARD)
		return advise(calls, run->start, run->end, GUARD_INSTALL, err);
	if (pread(pagemap, entry, pages * sizeof *entry,
		  (off_t)(run->start / PAGE * sizeof *entry)) != (ssize_t)(pages * sizeof *entry))
		return fail_errno(err, calls->idle->pid, "keep template", "read(pagemap)",
				  "it was killed");
	for (size_t i = 0; i < pages; i++) {
		own |= page_is_own(entry[i]);
		guard |= page_is_guard(entry[i]);
	}
	if (guard && advise(calls, run->start, run->end, GUARD_REMOVE, err))
		return -1;
	return own && run->kind == RUN_EMPTY
		       ? advise(calls, run->start, run->end, MADV_DONTNEED, err)
		       : 0;
}

static int write_stale(struct dirty *dirty, const struct image *image, struct avc_error *err)
{
	const struct idle_template *idle = &dirty->idle;
	const struct parasite *parasite = &image->process->parasite;
	struct calls calls = {
		.parasite = parasite,
		.idle = idle,
		.slot = image->slot,
		.list = (struct inj_syscall *)(parasite_files(parasite, image->slot) +
					       INJ_FILES_BYTES / 2),
	};
	int mem = proc_open(idle->pid, "mem", O_RDWR);
	int pagemap = proc_open(idle->pid, "pagemap", O_RDONLY);
	int result = 0;

	for (uint32_t i = 0; !result && i < dirty->runs; i++)
		result = prepare_run(&calls, &dirty->run[i], pagemap, err);
	if (!result)
		result = flush(&calls, err);
	if (!result && (mem < 0 || !move(dirty, idle->pid, mem, false)))
		result = fail_errno(err, idle->pid, "keep template", "process_vm_writev",
				    "its memory cannot be written");
	close_fd(&mem);
	close_fd(&pagemap);
	for (uint32_t i = 0; i < dirty->runs; i++)
		if (dirty->run[i].kind == RUN_DATA)
			dirty->copied += (dirty->run[i].end - dirty->run[i].start) / PAGE;
	return result;
}

static void hand_over(struct dirty *dirty, struct image *image)
{
	struct idle_template *idle = &dirty->idle;

	image->template = idle->pid;
	image->pidfd = idle->pidfd;
	image->base = idle->base;
	image->inherited = idle->inherited;
	image->stale = idle->stale;
	image->tracker = idle->tracker;
	image->forked_ns = idle->forked_ns;
	image->copied = idle->copied + dirty->copied;
	image->dumpable = dirty->dumpable;
	image->oom_own = proc_oom_score_adj(image->process->pid);
	image->oom_told = IDLE_OOM_SCORE;
	image->oom_known = true;
	image->recycled = true;
	image->stale->count = 0;
	*idle = (struct idle_template){ .pidfd = -1 };
}

int dirty_apply(struct dirty *dirty, struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	const struct thread *main_thread = thread_find(process, process->pid);
	char *theirs = NULL;
	size_t bytes = 0;
	bool same;

	inherited_answer(&process->parasite, image->slot, &dirty->now, &dirty->dumpable);
	if (main_thread)
		inherited_creds(&dirty->now, main_thread);
	if (!main_thread || !inherited_equal(&dirty->now, dirty->idle.inherited))
		return fork_instead(dirty, process, "what a fork of it inherits has changed", err);
	same = layout_read(dirty->idle.pid, &theirs, &bytes) && layout_equal(dirty->layout, theirs);
	free(theirs);
	if (!same)
		return fork_instead(dirty, process, "its mappings have just changed", err);
	if (write_stale(dirty, image, err)) {
		dirty_drop_idle(dirty);
		return fork_instead(dirty, process, "a template cannot be brought up to date", err);
	}
	hand_over(dirty, image);
	return 0;
}

/* ---- templates ------------------------------------------------------------------------------- */

void dirty_follow(struct dirty *dirty, struct image *image)
{
	const struct process *process = image->process;

	if (image->recycled)
		return;
	dirty->own_pages = image->anon_pages;
	if (!process->tracker || !image->inherited)
		return;
	image->stale = calloc(1, sizeof *image->stale);
	if (!image->stale)
		return;
	image->tracker = process->tracker->number;
	image->forked_ns = image->taken_ns;
	if (!tracker_add(process->tracker, image->stale)) {
		free(image->stale);
		image->stale = NULL;
	}
}

void dirty_recycle(struct dirty *dirty, struct generation *generation)
{
	struct image *image = &generation->image[0];
	const struct tracker *tracker = image->process->tracker;
	struct idle_template *idle = &dirty->idle;
	char score[16];

	if (generation->images > 1 || generation->spare.work || !image->stale ||
	    !image->inherited || !image->template || !tracker || tracker->over ||
	    tracker->number != image->tracker)
		return;
	dirty_drop_idle(dirty); /* one that could not be used is older */
	*idle = (struct idle_template){
		.pid = image->template,
		.pidfd = image->pidfd,
		.base = image->base,
		.inherited = image->inherited,
		.stale = image->stale,
		.tracker = image->tracker,
		.forked_ns = image->forked_ns,
		.copied = image->copied,
	};
	image->template = 0;
	image->pidfd = -1;
	image->inherited = NULL;
	image->stale = NULL;
	/* The first to go when memory is short. */
	snprintf(score, sizeof score, "%d", IDLE_OOM_SCORE);
	proc_set_oom_score_adj(idle->pid, score);
}

void dirty_drop_idle(struct dirty *dirty)
{
	struct idle_template *idle = &dirty->idle;

	if (!idle->pid)
		return;
	tracee_end(idle->pid, idle->pidfd);
	free(idle->inherited);
	if (dirty->process->tracker)
		tracker_remove(dirty->process->tracker, idle->stale);
	pageset_free(idle->stale);
	free(idle->stale);
	*idle = (struct idle_template){ .pidfd = -1 };
}

void dirty_free(struct dirty *dirty)
{
	dirty_drop_idle(dirty);
	free(dirty->run);
	free(dirty->data);
	free(dirty->layout);
	*dirty = (struct dirty){ .idle.pidfd = -1 };
}
