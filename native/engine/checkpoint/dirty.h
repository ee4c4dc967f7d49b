/* SPDX-License-Identifier: Apache-2.0
 *
 * Shared by the files that bring an idle template up to date:
 *
 *   dirty_tree.c      all processes
 *   dirty.c           one of them: whether, when, and which pages
 *   dirty_copy.c      copies them
 *   dirty_reads.c     which may still be written unseen
 *   dirty_template.c  calls made by the template, so that its mappings become the process's
 *   stand_in.c        replaces a template whose memory a restore takes
 */
#ifndef AVCKPT_DIRTY_H
#define AVCKPT_DIRTY_H

#include "checkpoint.h"

#define IDLE_OOM_SCORE 1000

/* ---- dirty.c ----------------------------------------------------------------------------------- */

/* One attempt. */
struct attempt {
	const struct avc_config *config;
	struct process *process;
	enum avc_fork_reason fork; /* why none is to be copied now, or NONE */
	uint32_t slot;
	timer_t timer;
};

/* Like those in checkpoint.h, for one process. */
void dirty_prepare_one(struct dirty *dirty, const struct attempt *attempt);
int dirty_capture_one(struct dirty *dirty, const struct image *image,
		      struct avc_error *err) warn_unused;
int dirty_apply_one(struct dirty *dirty, struct image *image, struct avc_error *err) warn_unused;
int dirty_check_one(struct dirty *dirty, const struct image *image,
		    struct avc_error *err) warn_unused;
void dirty_follow_one(struct dirty *dirty, struct image *image);
void dirty_recycle_one(struct dirty *dirty, struct image *image);
void dirty_take_spare_one(struct dirty *dirty, struct generation *generation);
bool dirty_wants_spare_one(struct dirty *dirty, const struct image *image);
/* Its idle template is of no use for a copy. */
bool dirty_is_stale_one(const struct dirty *dirty);
void dirty_compare_one(struct dirty *dirty, const struct image *image, uint64_t number);
/* Forgets the idle template, which keeps running. */
void dirty_leave_idle_one(struct dirty *dirty);
void dirty_drop_idle_one(struct dirty *dirty);
void dirty_free_one(struct dirty *dirty);

/* ---- dirty_template.c -------------------------------------------------------------------------- */

/* Calls that an idle template makes, as many at a time as there is room for. */
struct template_calls {
	const struct parasite *parasite;
	struct idle_template *idle;
	uint32_t slot, count;
	struct inj_syscall *list;
};

struct template_calls template_calls_begin(const struct parasite *parasite,
					   struct idle_template *idle, uint32_t slot);
int template_call(struct template_calls *calls, const struct inj_syscall *call,
		  struct avc_error *err) warn_unused;
/* Makes the calls not made yet.  AVC_RETRY: one failed. */
int template_calls_end(struct template_calls *calls, struct avc_error *err) warn_unused;

/* Changes its mappings to those of `layout`, which is /proc/PID/maps of the process.  AVC_RETRY:
 * not possible. */
int template_follow_layout(struct template_calls *calls, char *layout,
			   struct avc_error *err) warn_unused;
/* Sets the end of its heap, to the byte: mappings show only pages. */
int template_set_break(struct template_calls *calls, int64_t end,
		       struct avc_error *err) warn_unused;

/* ---- dirty_copy.c ------------------------------------------------------------------------------ */

#define COPY_BATCH_PAGES 1024 /* copied at a time                                */

bool copy_make_room(struct dirty *dirty, size_t bytes);
/* While the application runs: copies stale pages, as far as possible. */
void copy_stale(struct dirty *dirty, const struct process *process);
/* Reads these pages of another template of the process; false as for copy_read(). */
bool copy_read_template(struct dirty *dirty, pid_t template, const struct pageset *pages);
/* While it is stopped: reads stale pages; false: too many, or not readable. */
bool copy_read(struct dirty *dirty, const struct process *process);
/* When it runs again: writes to the template what was read. */
int copy_write(struct dirty *dirty, struct template_calls *calls,
	       struct avc_error *err) warn_unused;

/* ---- dirty_reads.c ----------------------------------------------------------------------------- */

/* Adds the pages that its threads are reading files into.  False: not all could be. */
bool reads_under_way(const struct process *process, struct pageset *pages) warn_unused;

#endif
