/* SPDX-License-Identifier: Apache-2.0
 *
 * A checkpoint whose cost depends on what was written, not on the size of the process.
 *
 * A template is forked once.  When its generation is replaced, it is not killed but kept, and
 * brought up to date for a later one: pages written since (tracker.c) are copied, in rounds while
 * the application runs, and in a last, small one with it stopped.  Even those are only read then,
 * and written to the template when the application runs again.
 *
 * The pages that may differ between the process and a template are the template's *stale set*.
 * Every scan adds to the sets of all templates, and only a copy removes pages, so that a failed
 * attempt loses nothing.  All else that a fork inherits must be unchanged (inherited.c, layout.c);
 * if not, the checkpoint is taken by a fork.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "dirty.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define ROUNDS 6
#define SCAN_TRIES 3
#define FEW_PAGES 48     /* a round that leaves no more is the last         */
#define READ_PAGE_NS 700 /* in a freeze                                     */
#define AGE_NS (60 * NS_PER_S)
#define PINNED_NS (60 * NS_PER_S)
#define STALE_SHARE 2 /* if more than half of its own pages are stale, a fork is better   */
#define COPIES_SHARE 2
#define OWN_SHARE 8 /* more than this part of the process: it is to share more with the others */
#define OWN_LEAST 1024
#define SLACK_PAGES 64 /* written until the freeze, by one process of many */
#define FORK_NS 100000 /* without any pages */
#define FORK_PAGE_NS 90
#define REST_LEAST 4u /* checkpoints */
#define FAILURES_MAX 4
#define CONFIDENCE 8 /* after so many successes in a row, failures are forgotten */

/* ---- while the application runs -------------------------------------------------------------- */

/* Everything that is mapped now. */
static bool watch_mappings(struct dirty *dirty, struct process *process)
{
	struct avc_error refused = { 0 };

	return layout_read(process->pid, &dirty->layout, &dirty->layout_bytes) &&
	       !tracker_watch(process, dirty->layout, &refused);
}

/* As read by watch_mappings().  If that fails, the template may have some of the mappings, and is
 * dropped. */
static bool follow_layout(struct dirty *dirty, const struct attempt *attempt)
{
	struct template_calls calls = template_calls_begin(&attempt->process->parasite,
							   &dirty->idle, attempt->slot);
	struct avc_error why = { 0 };
	int result;

	tracee_deadline_set(attempt->timer, NS_PER_S);
	result = template_follow_layout(&calls, dirty->layout, &why);
	tracee_deadline_clear(attempt->timer);
	if (result)
		dirty_drop_idle_one(dirty);
	return !result;
}

/* Repeated, because new mappings are not watched yet. */
static bool scan(struct dirty *dirty, const struct attempt *attempt, pid_t template, uint64_t *left)
{
	struct process *process = attempt->process;

	for (int tries = 0; tries < SCAN_TRIES; tries++) {
		if (!tracker_scan(process->tracker, template, left))
			return true;
		if (process->tracker->broken || !watch_mappings(dirty, process) ||
		    !follow_layout(dirty, attempt))
			return false;
	}
	return false;
}

bool dirty_is_stale_one(const struct dirty *dirty)
{
	return dirty->idle.pid &&
	       pageset_count(dirty->idle.stale) > (uint64_t)dirty->own_pages / STALE_SHARE;
}

/* How many pages will have been written since the last scan, at the rate before it. */
static uint64_t expected(uint64_t written, uint64_t before_ns, uint64_t since_ns)
{
	return before_ns ? (uint64_t)((double)written * (double)since_ns / (double)before_ns)
			 : written;
}

/* *reading: how many pages are being read into, and have to be copied again. */
static bool copy_round(struct dirty *dirty, const struct process *process, uint64_t *reading)
{
	struct pageset reads = { 0 };
	bool known = reads_under_way(process, &reads);

	*reading = pageset_count(&reads);
	copy_stale(dirty, process);
	known = pageset_add_all(dirty->idle.stale, &reads) && known;
	process->tracker->broken |= !known;
	pageset_free(&reads);
	return !process->tracker->broken;
}

/* Until a round leaves little, or hardly less than the one before.  *left: how much.  A scan takes
 * time by the size of the process, and is not made if it would find little. */
static bool copy_rounds(struct dirty *dirty, const struct attempt *attempt, uint64_t *left)
{
	const struct process *process = attempt->process;
	uint64_t before = UINT64_MAX;

	for (int i = 0; i < ROUNDS; i++) {
		const uint64_t last_ns = process->tracker->scanned_ns;
		uint64_t scanned_ns, soon, reading;

		if (!scan(dirty, attempt, i ? 0 : dirty->idle.pid, left))
			return false;
		if (!i && dirty_is_stale_one(dirty)) {
			dirty->reason = AVC_FORK_WRITES;
			return false;
		}
		scanned_ns = process->tracker->scanned_ns;
		if (!copy_round(dirty, process, &reading))
			return false;
		soon = expected(*left, scanned_ns - last_ns, now_ns() - scanned_ns) + reading;
		*left += reading;
		if (soon <= FEW_PAGES) {
			*left = soon;
			break;
		}
		if (i && (*left <= FEW_PAGES || *left > before / 4 * 3))
			break;
		before = i ? *left : UINT64_MAX;
	}
	return true;
}

/* ---- decisions ------------------------------------------------------------------------------- */

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

/* A program that opens such files again and again has none open now and then; and what it is reading
 * just then is not always seen (dirty_reads.c): it may be about to sleep. */
static bool may_pin(struct process *process, const struct files *files)
{
	if (files_may_pin(files))
		process->pinned_ns = now_ns();
	return process->pinned_ns && now_ns() - process->pinned_ns < PINNED_NS;
}

static bool has_own_filter(const struct process *process, const struct proc_status *status)
{
	return process->parasite.seccomp == SECCOMP_SUPERVISED ||
	       !seccomp_is_containers(status, process->plain_filters);
}

/* A fork of it takes less than a millisecond, hardly more than the queries that a copy needs. */
static bool is_small(const struct process *process)
{
	long anonymous = 0;

	return proc_vm_pages(process->statm_fd, &anonymous) >= 0 &&
	       anonymous < (process->tracker ? DIRTY_SMALL_PAGES / 2 : DIRTY_SMALL_PAGES);
}

/* Nothing can be read any more of a process that has ended since the tree was read, and all fails
 * that is tried with it. */
static enum avc_fork_reason unless_ended(const struct process *process, enum avc_fork_reason reason)
{
	return proc_is_exiting(process->pid) ? AVC_FORK_PROCESSES : reason;
}

/* Why its memory is not even to be watched. */
static enum avc_fork_reason why_not(struct process *process, const struct attempt *attempt)
{
	const struct avc_config *config = attempt->config;
	struct proc_status status;

	if (config->images == AVC_IMAGES_FORK)
		return AVC_FORK_CONFIG;
	if (!process->infected || process->adopts ||
	    proc_status_of(process->status_fd, process->pid, &status))
		return AVC_FORK_PROCESSES;
	/* Nothing tells whether one that is not dumpable has entered a Landlock domain
	 * (inherited.c). */
	if (has_own_filter(process, &status) || process->undumpable)
		return AVC_FORK_SANDBOX;
	if (config->images == AVC_IMAGES_AUTO && is_small(process))
		return AVC_FORK_SMALL;
	if (attempt->fork)
		return attempt->fork;
	if (memory_needs_fork(process))
		return AVC_FORK_MEMORY;
	/* Those of a table that it shares are not known here. */
	if (process->shared & CLONE_FILES || has_pinned(process->pid) ||
	    may_pin(process, process->files_before))
		return unless_ended(process, AVC_FORK_PINNED);
	return AVC_FORK_NONE;
}

/* A failed attempt costs more than a fork: after each one in a row, twice as many checkpoints are
 * forked before the next attempt. */
static void give_up(struct dirty *dirty, enum avc_fork_reason reason)
{
	dirty->reason = dirty->rest_reason = reason;
	dirty->rest = REST_LEAST << dirty->failures;
	if (dirty->failures < FAILURES_MAX)
		dirty->failures++;
	dirty->successes = 0;
}

static bool rests(struct dirty *dirty, const struct avc_config *config)
{
	if (config->images != AVC_IMAGES_AUTO || !dirty->rest)
		return false;
	dirty->rest--;
	dirty->reason = dirty->rest_reason;
	return true;
}

/* Has all of its memory watched, or returns why not. */
static enum avc_fork_reason watch(struct dirty *dirty, struct process *process, timer_t timer)
{
	struct avc_error refused = { 0 };

	if (process->tracker && (process->tracker->over || process->tracker->broken))
		tracker_end(process);
	if (!process->tracker) {
		if (dirty->refused_nonce == process->nonce)
			return AVC_FORK_KERNEL;
		if (!process->holder)
			return AVC_FORK_PROCESSES;
		if (tracker_begin(process, timer, &refused)) {
			if (refused.code == AVC_UNSUPPORTED)
				dirty->refused_nonce = process->nonce;
			return unless_ended(process, AVC_FORK_KERNEL);
		}
	}
	if (watch_mappings(dirty, process))
		return AVC_FORK_NONE;
	tracker_end(process);
	return unless_ended(process, AVC_FORK_MEMORY);
}

static enum avc_fork_reason why_not_idle(struct dirty *dirty, const struct process *process)
{
	const struct idle_template *idle = &dirty->idle;

	if (idle->pid && (idle->tracker != process->tracker->number || pidfd_ended(idle->pidfd)))
		dirty_drop_idle_one(dirty);
	if (!idle->pid || process->old_parasites)
		return AVC_FORK_FIRST;
	if (now_ns() - idle->forked_ns > AGE_NS)
		return AVC_FORK_AGE;
	/* The main process's is renewed from the newest one (dirty_wants_spare()). */
	if (process->descendant && idle->copied > (uint64_t)dirty->own_pages / COPIES_SHARE)
		return AVC_FORK_COPIES;
	return AVC_FORK_NONE;
}

void dirty_prepare_one(struct dirty *dirty, const struct attempt *attempt)
{
	const struct avc_config *config = attempt->config;
	struct process *process = attempt->process;
	const size_t slack = process->descendant ? SLACK_PAGES : COPY_BATCH_PAGES;
	uint64_t left = 0;

	process->recycling = 0;
	dirty->idle.catching_up = false;
	dirty->copied = 0;
	dirty->reason = why_not(process, attempt);
	if (dirty->reason) {
		dirty_drop_idle_one(dirty);
		tracker_end(process);
		return;
	}
	dirty->reason = watch(dirty, process, attempt->timer);
	if (dirty->reason)
		return;
	if (dirty->fork_next)
		dirty->reason = AVC_FORK_CHANGED;
	else if (!rests(dirty, config))
		dirty->reason = why_not_idle(dirty, process);
	dirty->fork_next = false;
	if (!dirty->reason && !copy_make_room(dirty, COPY_BATCH_PAGES * PAGE))
		dirty->reason = AVC_FORK_FIRST;
	if (!dirty->reason && !follow_layout(dirty, attempt))
		give_up(dirty, AVC_FORK_LAYOUT);
	if (dirty->reason) {
		/* Clears the record: writes before the fork are in the fork. */
		if (tracker_scan(process->tracker, 0, &left))
			tracker_end(process);
		return;
	}
	if (!copy_rounds(dirty, attempt, &left)) {
		give_up(dirty, dirty->reason ? dirty->reason : AVC_FORK_LAYOUT);
		return;
	}
	if (config->images == AVC_IMAGES_AUTO && left * READ_PAGE_NS > dirty->fork_ns)
		give_up(dirty, AVC_FORK_WRITES);
	else
		process->recycling = proc_inside(dirty->idle.pid);
	/* With room for what is written until the freeze. */
	dirty->wanted = (4 * left + slack) * PAGE;
}

/* ---- in the freeze --------------------------------------------------------------------------- */

static int fork_instead(struct dirty *dirty, const struct process *process, const char *what,
			struct avc_error *err)
{
	dirty->fork_next = true;
	give_up(dirty, AVC_FORK_CHANGED);
	return fail(err, AVC_RETRY, 0, process->pid, "freeze", "", "%s", what);
}

/* Twice, if something was mapped since. */
static bool scan_stopped(struct dirty *dirty, struct process *process)
{
	char *before = dirty->layout;
	const size_t bytes = dirty->layout_bytes;
	uint64_t pages;
	bool same, done;

	dirty->layout = dirty->other_layout;
	dirty->layout_bytes = dirty->other_layout_bytes;
	dirty->other_layout = before;
	dirty->other_layout_bytes = bytes;
	if (!layout_read(process->pid, &dirty->layout, &dirty->layout_bytes))
		return false;
	same = before && !strcmp(before, dirty->layout);
	done = same && !tracker_scan(process->tracker, 0, &pages);
	return done || (!process->tracker->broken && watch_mappings(dirty, process) &&
			!tracker_scan(process->tracker, 0, &pages));
}

/* Only the template of the main process has the limits of its process (process_attrs_learn()). */
static int read_inherited(struct inherited *inherited, const struct process *process,
			  struct avc_error *err)
{
	memset(inherited, 0, sizeof *inherited);
	if (inherited_read(inherited, process->pid, err))
		return -1;
	if (process->descendant)
		memset(inherited->limit, 0, sizeof inherited->limit);
	return 0;
}

int dirty_capture_one(struct dirty *dirty, const struct image *image, struct avc_error *err)
{
	struct process *process = image->process;

	if (may_pin(process, image->files))
		return fork_instead(dirty, process, "some of its pages may be pinned", err);
	if (!scan_stopped(dirty, process) || !copy_read(dirty, process))
		return fork_instead(dirty, process, "it has just written too much", err);
	return read_inherited(&dirty->now, process, err);
}

/* ---- when the application runs again --------------------------------------------------------- */

static int bring_up_to_date(struct dirty *dirty, struct template_calls *calls,
			    struct avc_error *err)
{
	if (template_set_break(calls, dirty->now.value[INHERITED_BREAK], err) ||
	    template_follow_layout(calls, dirty->layout, err) || copy_write(dirty, calls, err))
		return -1;
	return dirty->idle.inherited->value[INHERITED_BREAK] == dirty->now.value[INHERITED_BREAK]
		       ? 0
		       : fail(err, AVC_RETRY, 0, dirty->idle.pid, "keep template", "brk",
			      "its heap has moved");
}

static void forget_differences(struct dirty *dirty)
{
	if (dirty->process->tracker)
		tracker_remove(dirty->process->tracker, &dirty->idle.differs);
	pageset_free(&dirty->idle.differs);
	dirty->idle.near = 0;
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
	image->kinds = idle->kinds;
	image->dumpable = dirty->dumpable;
	image->oom_own = proc_oom_score_adj(image->process->pid);
	image->oom_told = IDLE_OOM_SCORE;
	image->oom_known = true;
	image->recycled = true;
	image->stale->count = 0;
	forget_differences(dirty);
	*idle = (struct idle_template){ .pidfd = -1 };
}

int dirty_apply_one(struct dirty *dirty, struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	const struct thread *main_thread = thread_find(process, process->pid);
	struct template_calls calls = template_calls_begin(&process->parasite, &dirty->idle,
							   image->slot);
	struct avc_error why = { 0 };

	inherited_answer(&process->parasite, image->slot, &dirty->now, &dirty->dumpable);
	if (main_thread)
		inherited_creds(&dirty->now, main_thread);
	if (!main_thread || !inherited_equal(&dirty->now, dirty->idle.inherited))
		return fork_instead(dirty, process, "what a fork would inherit has changed", err);
	if (bring_up_to_date(dirty, &calls, &why)) {
		dirty_drop_idle_one(dirty);
		return fork_instead(dirty, process, "a template cannot be brought up to date", err);
	}
	hand_over(dirty, image);
	return 0;
}

int dirty_check_one(struct dirty *dirty, const struct image *image, struct avc_error *err)
{
	if (!image->recycled)
		return 0;
	if (image->kinds != mem_image_kinds(image->memory))
		return fork_instead(dirty, image->process, "it has mapped memory of another kind",
				    err);
	if (++dirty->successes == CONFIDENCE)
		dirty->failures = 0;
	return 0;
}

/* ---- templates ------------------------------------------------------------------------------- */

void dirty_follow_one(struct dirty *dirty, struct image *image)
{
	const struct process *process = image->process;

	if (image->recycled)
		return;
	dirty->own_pages = image->anon_pages;
	dirty->fork_ns = FORK_NS + (uint64_t)image->anon_pages * FORK_PAGE_NS;
	if (!process->tracker || !image->inherited)
		return;
	image->stale = calloc(1, sizeof *image->stale);
	if (!image->stale)
		return;
	image->tracker = process->tracker->number;
	image->forked_ns = image->taken_ns;
	image->kinds = mem_image_kinds(image->memory);
	if (!tracker_add(process->tracker, image->stale)) {
		free(image->stale);
		image->stale = NULL;
	}
}

/* Whether it is known where it differs from the process. */
static bool is_followed(const struct image *image)
{
	const struct tracker *tracker = image->process->tracker;

	return image->stale && image->inherited && image->template && tracker && !tracker->over &&
	       !tracker->broken && tracker->number == image->tracker;
}

/* When memory is short. */
static void be_first_victim(const struct idle_template *idle)
{
	char score[16];

	snprintf(score, sizeof score, "%d", IDLE_OOM_SCORE);
	proc_set_oom_score_adj(idle->pid, score);
}

void dirty_recycle_one(struct dirty *dirty, struct image *image)
{
	struct idle_template *idle = &dirty->idle;

	if (!is_followed(image))
		return;
	if (idle->pid && pageset_count(idle->stale) <= pageset_count(image->stale))
		return;
	dirty_drop_idle_one(dirty);
	*idle = (struct idle_template){
		.pid = image->template,
		.pidfd = image->pidfd,
		.base = image->base,
		.inherited = image->inherited,
		.stale = image->stale,
		.tracker = image->tracker,
		.forked_ns = image->forked_ns,
		.copied = image->copied,
		.kinds = image->kinds,
	};
	image->template = 0;
	image->pidfd = -1;
	image->inherited = NULL;
	image->stale = NULL;
	be_first_victim(idle);
}

/* ---- the idle template shares pages with the others ---------------------------------------------
 *
 * Each template has pages of its own, as copied to it, and if they are updated in turns for long
 * enough, each has all that the process ever writes.  A fork of the newest one shares them with it.
 * It also is the better one if there is more to copy than that fork would take. */

/* Own pages are counted when it may have more than that; where the same ones are copied again and
 * again, it may not have. */
bool dirty_wants_spare_one(struct dirty *dirty, const struct image *image)
{
	struct idle_template *idle = &dirty->idle;
	uint64_t most = (uint64_t)dirty->own_pages / OWN_SHARE, stale;
	long own;

	if (!is_followed(image))
		return false;
	if (most < OWN_LEAST)
		most = OWN_LEAST;
	if (!idle->pid)
		return true;
	stale = pageset_count(idle->stale);
	if (idle->copied + stale <= most)
		return false;
	own = proc_private_pages(idle->pid);
	if (own < 0)
		return true;
	/* The next time not before as much was copied again. */
	idle->copied = (uint64_t)own < most / 2 ? (uint64_t)own : most / 2;
	return (uint64_t)own + stale > most;
}

static struct pageset *copy_set(const struct pageset *set)
{
	struct pageset *copy = calloc(1, sizeof *copy);

	if (copy && pageset_add_all(copy, set))
		return copy;
	if (copy)
		pageset_free(copy);
	free(copy);
	return NULL;
}

void dirty_take_spare_one(struct dirty *dirty, struct generation *generation)
{
	struct image *image = &generation->image[0];
	struct idle_template *idle = &dirty->idle;
	struct inherited *inherited;
	struct pageset *stale;

	if (!is_followed(image) || !spare_becomes_template(generation))
		return;
	dirty_drop_idle_one(dirty);
	inherited = malloc(sizeof *inherited);
	stale = copy_set(image->stale);
	if (!inherited || !stale || !tracker_add(image->process->tracker, stale)) {
		if (stale)
			pageset_free(stale);
		free(stale);
		free(inherited);
		spare_drop(generation);
		return;
	}
	*inherited = *image->inherited;
	*idle = (struct idle_template){
		.pid = generation->spare.pid,
		.pidfd = generation->spare.pidfd,
		.base = generation->spare.base,
		.inherited = inherited,
		.stale = stale,
		.tracker = image->tracker,
		.forked_ns = image->forked_ns,
		.kinds = image->kinds,
	};
	generation->spare.pid = 0;
	generation->spare.pidfd = -1;
	image->copied = 0; /* it shares them with this one */
	be_first_victim(idle);
	/* It equals that template, as long as it is not written to. */
	if (tracker_add(image->process->tracker, &idle->differs))
		idle->near = generation->number;
}

/* Not after a fork: pages written between the scan before it and the fork are found only by the
 * next scan. */
void dirty_compare_one(struct dirty *dirty, const struct image *image, uint64_t number)
{
	struct tracker *tracker = image->process->tracker;
	struct idle_template *idle = &dirty->idle;

	if (!idle->pid)
		return;
	forget_differences(dirty);
	if (!image->recycled || !tracker || idle->tracker != tracker->number ||
	    !pageset_add_all(&idle->differs, idle->stale) || !tracker_add(tracker, &idle->differs))
		return;
	idle->near = number;
	idle->catching_up = true;
	/* Allocated now, not when it is needed. */
	(void)copy_make_room(dirty, 2 * pageset_count(&idle->differs) * PAGE);
}

void dirty_leave_idle_one(struct dirty *dirty)
{
	struct idle_template *idle = &dirty->idle;

	free(idle->inherited);
	forget_differences(dirty);
	if (dirty->process->tracker)
		tracker_remove(dirty->process->tracker, idle->stale);
	pageset_free(idle->stale);
	free(idle->stale);
	*idle = (struct idle_template){ .pidfd = -1 };
}

void dirty_drop_idle_one(struct dirty *dirty)
{
	if (!dirty->idle.pid)
		return;
	tracee_end(dirty->idle.pid, dirty->idle.pidfd);
	dirty_leave_idle_one(dirty);
}

void dirty_free_one(struct dirty *dirty)
{
	dirty_drop_idle_one(dirty);
	free(dirty->run);
	free(dirty->data);
	free(dirty->layout);
	free(dirty->other_layout);
	free(dirty);
}
