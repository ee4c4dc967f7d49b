/* SPDX-License-Identifier: Apache-2.0
 *
 * Checkpoints: how they are taken, and what is kept.
 *
 *   freeze.c        stops, reads, clones and releases the app; see freeze.h
 *   generation.c    the templates of one checkpoint
 *   dirty*.c        brings templates up to date instead of forking new ones
 *   layout.c        ... and how their mappings differ from the process's
 *   spare.c         forks a template ahead of the next restore
 *   stand_in.c      lets a restore have a template, which an idle one replaces
 *   snapshot.c      mappings and pages of a template
 *   remap_plan.c    how the memory of one template differs from another's
 *   restore_plan.c  ... for each process, from that of its parent
 *   places.c        where to fork each process, so that it is in its session
 */
#ifndef AVCKPT_CHECKPOINT_H
#define AVCKPT_CHECKPOINT_H

#include "process.h"

/* For the next restore: a fork of a template (spare.c), or a template that another one replaces
 * (stand_in.c). */
struct spare {
	pid_t pid; /* 0: none                                           */
	int pidfd;
	struct arch_regs base;
	bool tried;    /* one was begun                                          */
	bool unwanted; /* one was a process too many for a restore               */
	bool alone;    /* the template has not got its memory yet (stand_in.c)   */
	/* What the template is still doing for it. */
	enum { SPARE_NO_WORK, SPARE_FORK, SPARE_REST } work;
	struct scheduling scheduling; /* the template's own                        */
	bool aside;                   /* it has another policy meanwhile           */
};

/* A template that no generation has any more, and whose stale pages are known. */
struct idle_template {
	pid_t pid; /* 0: none                                           */
	int pidfd;
	struct arch_regs base;
	struct inherited *inherited;
	struct pageset *stale;
	uint64_t tracker, kinds;
	uint64_t forked_ns; /* from the process, it or the template that it was forked from */
	uint64_t copied;    /* pages written to it since it was forked, at most             */
	/* Pages that may differ from the template of the generation with this number: those that
	 * were stale when that was taken, and those written, and copied, since.  0: any page. */
	uint64_t near;
	struct pageset differs;
	bool catching_up; /* `differs` equals `stale`: no scan since             */
};

/* Checkpoints of one process by copies of written pages (dirty.c). */
struct dirty {
	struct process *process;
	pid_t leader; /* with `start`: which process this is about               */
	uint64_t start;
	struct idle_template idle;
	bool fork_next; /* the last attempt has found that a fork is needed    */
	/* AVC_IMAGES_AUTO: how many are forked before the next attempt, and why. */
	uint32_t rest;
	enum avc_fork_reason rest_reason;
	uint32_t failures, successes; /* attempts that failed; that succeeded since then */
	enum avc_fork_reason reason;  /* why this one is forked                          */
	uint64_t refused_nonce;       /* the parasite with which it could not be watched  */
	uint64_t fork_ns;             /* estimate of the last fork                        */
	long own_pages;               /* of the process, at that time                     */
	uint64_t copied;              /* pages, of this checkpoint                       */
	/* Read in the freeze, written to the template when the app runs again. */
	struct run *run;
	uint32_t runs, run_room;
	uint8_t *data;
	size_t data_bytes, used;
	size_t wanted;               /* room for what is written until the freeze                */
	char *layout, *other_layout; /* /proc/PID/maps, the last and the one before      */
	size_t layout_bytes, other_layout_bytes;
	struct inherited now;
	int64_t dumpable;
	bool standing_in; /* the idle one already belongs to a generation, but is incomplete */
};

/* ... of all processes (dirty_tree.c). */
struct dirty_tree {
	struct dirty **of;
	uint32_t count, room;
	uint64_t fork_ns; /* duration of the clones of the last checkpoint by forks */
	/* Of the last one: why a process was forked, if one was; pages copied.     */
	enum avc_fork_reason reason;
	uint64_t copied;
	uint8_t *batch; /* buffer of the rounds                                    */
	size_t batch_bytes;
};

/* The state of an app saved at one instant. */
struct generation {
	uint64_t number; /* 0: not complete yet                               */
	/* Of each process: the main one's first, parents before their children. */
	struct image *image;
	uint32_t images;
	uint64_t taken_ns;
	uint64_t clone_ns; /* duration of its clones                          */
	uint64_t freeze_ns;
	bool quiescent;
	bool watched;              /* avckpt.files: all writes since count             */
	char written[FILES_NAME];  /* what was written since; "": none                 */
	struct spare spare;        /* of the main process                              */
	struct restore_plan *plan; /* restore_plan.c; NULL: not begun                   */
	struct group_ends *ends;   /* of connections in its group, or within it; NULL   */
};

/* ---- freeze.c ------------------------------------------------------------------ */

/* One checkpoint. */
struct freeze {
	struct tree *tree;
	struct generation *generation; /* which has an image of the main process          */
	struct dirty_tree *dirty;      /* process.recycling                                  */
	timer_t timer;
	uint64_t deadline_ns;
	struct mem_seen seen; /* shared memory that is already prepared for       */
	/* If it is part of a line: called when everything has been read and cloned, or (whole:
	 * NULL) could not be, and before anything is released.  NULL: it is not part of one. */
	int (*meet)(void *arg, struct generation *whole, struct avc_error *err);
	void *arg;
	/* Durations. */
	uint64_t freeze_ns, stop_ns, clone_ns, wait_ns;
};

/* On return the app runs, whatever happened. */
int freeze_tree(struct freeze *freeze, struct avc_error *err) warn_unused;

/* ---- generation.c -------------------------------------------------------------- */

/* With an image of the main process only. */
int generation_new(struct generation *generation, struct process *main, uint32_t slot,
		   struct avc_error *err) warn_unused;
/* Room for so many images. */
int generation_make_room(struct generation *generation, uint32_t images,
			 struct avc_error *err) warn_unused;
/* When the app runs again: finishes templates and slots. */
int generation_finish(struct generation *generation, struct avc_error *err) warn_unused;
void generation_drop(struct generation *generation);
/* The image of this process; NULL: there is none. */
struct image *generation_image(const struct generation *generation, const struct process *process);
/* Of all its processes. */
uint32_t generation_threads(const struct generation *generation);
/* The first thing that could not be read, or cannot be restored. */
const struct avc_error *generation_notice(const struct generation *generation);
int generation_files_error(const struct generation *generation, struct avc_error *err) warn_unused;
/* Closes what the template of a process that has ended still has open; or leaves it to one that
 * shares the table, and lives. */
void generation_close_files(const struct image *image, bool shared);
/* The same for all processes but the main one, once they are restored and have descriptors of their
 * own: before they continue, because what they close must be closed; `late`: what is left
 * (files_late.c). */
void generation_close_tables(const struct generation *generation, bool late);

/* ---- layout.c ------------------------------------------------------------------ */

/* All of /proc/PID/maps, into *text, which grows; false with errno. */
bool layout_read(pid_t pid, char **text, size_t *bytes);
/* Whether two of them show the same mappings, however the kernel splits them. */
bool layout_equal(char *a, char *b);

struct layout_step {
	avc_remote start, end;
	enum layout_step_kind {
		LAYOUT_UNMAP,
		LAYOUT_MAP, /* private anonymous memory                      */
		LAYOUT_PROTECT,
		LAYOUT_SHRINK, /* the heap, down to `start`                     */
		LAYOUT_GROW,   /* ... up to `end`                               */
		LAYOUT_STACK,  /* the main thread's, down to `start`           */
	} kind;
	int protection;
};

struct layout_steps {
	struct layout_step *step;
	uint32_t count, room;
};

/* How a process gets from one to the other, in this order.  false: only a fork can, for example
 * where mapped files differ; or out of memory. */
bool layout_steps_find(char *is, char *want, struct layout_steps *steps);

/* With avckpt.images=auto, a process with less anonymous memory is forked. */
#define DIRTY_SMALL_PAGES 8192

/* ---- dirty_tree.c -------------------------------------------------------------- */

/* Before a freeze: decides about process.recycling, and copies what it can while the app runs.
 * `fork`: why not to copy this time, AVC_FORK_NONE: no reason. */
void dirty_prepare(struct dirty_tree *dirty, const struct tree *tree,
		   const struct avc_config *config, enum avc_fork_reason fork, uint32_t slot,
		   timer_t timer);
/* During it, while main threads answer: reads what is left. */
int dirty_capture(struct dirty_tree *dirty, const struct generation *generation,
		  struct avc_error *err) warn_unused;
/* When the app runs again: idle templates become the images'.  AVC_RETRY: a fork is needed. */
int dirty_apply(struct dirty_tree *dirty, struct generation *generation,
		struct avc_error *err) warn_unused;
/* After that, when the images are complete; errors as above. */
int dirty_check(struct dirty_tree *dirty, const struct generation *generation,
		struct avc_error *err) warn_unused;
/* From now on, stale pages of its templates are recorded. */
void dirty_follow(struct dirty_tree *dirty, const struct generation *generation);
/* Whether a spare of the newest would be a better idle template than the one there is. */
bool dirty_wants_spare(const struct dirty_tree *dirty, const struct generation *newest);
/* When that spare has been made: an idle template with many stale pages only takes memory. */
void dirty_drop_stale(struct dirty_tree *dirty, struct generation *newest);
/* Before dirty_prepare(): if there is a spare, it becomes the idle template of the main process. */
void dirty_take_spare(struct dirty_tree *dirty, struct generation *newest);
/* Its templates are no longer needed: they become idle ones, if they can. */
void dirty_recycle(struct dirty_tree *dirty, const struct generation *generation);
/* Once a generation is kept: where the idle template of the main process differs from it. */
void dirty_compare(struct dirty_tree *dirty, const struct generation *generation);
void dirty_drop_idle(struct dirty_tree *dirty);
/* Drops idle templates that were killed. */
void dirty_drop_ended(struct dirty_tree *dirty);
/* When a process has ended, or executed another program. */
void dirty_forget(struct dirty_tree *dirty, const struct process *process);
bool dirty_owns(const struct dirty_tree *dirty, pid_t pid);
/* NULL: there is none of this process. */
struct dirty *dirty_find(const struct dirty_tree *dirty, const struct process *process);
void dirty_free(struct dirty_tree *dirty);

/* ---- spare.c ------------------------------------------------------------------------ */

/* Makes one for a complete generation, if the kernel permits it, and there is time for it before
 * the deadline.  -1: the generation cannot be restored any more. */
int spare_make(struct generation *generation, struct avc_error *err) warn_unused;
/* While the app is dead: at the template's own priority, and until it exists or is refused. */
int spare_make_now(struct generation *generation, struct avc_error *err) warn_unused;
/* Before the template is used for anything else: waits for work left over at the deadline of
 * spare_make().  -1: AVC_DEADLINE, still not done; or as above. */
int spare_await(struct generation *generation, struct avc_error *err) warn_unused;
bool spare_is_there(struct generation *generation);
/* Whether there is one, which is a template from now on: the caller takes it. */
bool spare_becomes_template(struct generation *generation);
/* There may be one whose PID we have not learned (init_channel_kill_lost). */
bool spare_is_unknown(const struct generation *generation);
void spare_drop(struct generation *generation);

/* ---- stand_in.c --------------------------------------------------------------------- */

/* Whether a restore of the generation could do without a fork. */
bool stand_in_is_there(const struct dirty_tree *dirty, const struct generation *generation);
/* While the app is dead: the idle template becomes the generation's, whose own one becomes its
 * spare.  Pages that differ are read from that now, and written to the idle one by
 * stand_in_finish(), before it is used.  If that is not possible, the generation is unchanged. */
void stand_in_begin(struct dirty_tree *dirty, struct generation *generation, timer_t timer);
/* While the app runs and the guard is idle: copies some of those pages, so that neither a restore
 * nor the next checkpoint needs to; false: there are no more. */
bool stand_in_catch_up(struct dirty_tree *dirty, const struct generation *generation,
		       timer_t timer);
/* false: the generation cannot be restored any more. */
bool stand_in_finish(struct dirty_tree *dirty, struct generation *generation, timer_t timer);

/* ---- snapshot.c --------------------------------------------------------------------- */

struct mappings {
	struct mapping *map;
	uint32_t count, room;
};

/* Part of a mapping, with the pagemap entry of each page. */
struct extent {
	avc_remote start, end;
	uint64_t *frame;
};

struct pages {
	bool known;
	uint32_t count, room;
	struct extent *extent; /* in order                                           */
};

struct snapshot {
	pid_t template;
	int pagemap;
	uint64_t read_bytes; /* of the mappings whose pages are known           */
	struct mappings maps;
	struct pages *pages; /* by mapping, of those requested                        */
};

/* `image`: of the same process. */
struct snapshot *snapshot_new(pid_t template, const struct mem_image *image, struct avc_error *err);
void snapshot_free(struct snapshot *snapshot);
/* Frees what it has read of pages, until they are requested again; NULL: nothing to do. */
void snapshot_rest(struct snapshot *snapshot);
/* The pages of one of its private mappings.  NULL on error. */
const struct pages *snapshot_pages(struct snapshot *snapshot, const struct mapping *mapping,
				   struct avc_error *err);
/* Entries from `address` on; NULL where there are none.  `*end` is lowered to where that changes;
 * `*next`, 0 at first, is where the search for a higher address begins. */
const uint64_t *pages_frames(const struct pages *pages, uint32_t *next, avc_remote address,
			     avc_remote *end);

/* ---- remap.c ----------------------------------------------------------------------- */

struct remap;

/* How the memory of a fork of `is` becomes that of `want`.  Both snapshots have to stay.  NULL on
 * error. */
struct remap *remap_plan(const struct process *process, struct snapshot *want, struct snapshot *is,
			 struct avc_error *err);
/* Whether there is a way from one to the other, checked before it is needed: some mappings can only
 * be inherited by a fork from a process that has them. */
int remap_check(const struct process *process, struct snapshot *want, struct snapshot *is,
		struct avc_error *err) warn_unused;
void remap_free(struct remap *plan);

/* ---- places.c ---------------------------------------------------------------------------- */

#define PLACE_ANY (-1)

/* Of one image. */
struct place {
	uint32_t host;   /* the image of the process that forks it, or whose keeper does  */
	uint32_t memory; /* the same, or whose memory that has: it may be one that ends again */
	/* The session that it is forked in; 0: the one that the main process was started in. */
	pid_t born;
	pid_t before; /* of one that begins a session: where it has a keeper before that     */
	bool renewed; /* forked by a keeper that has the PID of the session's dead leader    */
};

/* For each image.  -1: one cannot be restored in its session. */
int places_find(const struct generation *generation, struct place *place,
		struct avc_error *err) warn_unused;

/* ---- restore_plan.c --------------------------------------------------------------------- */

/* Of a complete generation; once is enough.  `ahead_ns`: CPU time that restore_plan_next() may
 * spend on it, about. */
int restore_plan_begin(struct generation *generation, uint64_t ahead_ns,
		       struct avc_error *err) warn_unused;
/* Which process is to fork that of an image (not the main one), and in which session. */
const struct place *restore_plan_place(const struct generation *generation, uint32_t index);
/* How the memory of that fork becomes the image's; NULL on error. */
const struct remap *restore_plan_of(struct generation *generation, uint32_t index,
				    struct avc_error *err);
/* At a checkpoint: whether the processes can be made from their parents at all. */
int restore_plan_check(const struct generation *generation, struct avc_error *err) warn_unused;
/* Plans one more of them, so that a restore need not; false: there are no more. */
bool restore_plan_next(struct generation *generation);
void restore_plan_free(struct restore_plan *plan);

#endif
