/* SPDX-License-Identifier: Apache-2.0
 *
 * A checkpoint taken, and what is kept of it.
 *
 *   freeze.c        stop everything, read it, clone it, let go; see freeze.h
 *   generation.c    templates kept
 *   dirty*.c        ... and brought up to date, instead of being forked anew
 *   layout.c        ... whose mappings have to be the process's for that
 *   spare.c         ... and forked ahead of the next restore
 *   stand_in.c      ... or given to it, while an older one takes their place
 *   snapshot.c      mappings and pages of a template
 *   remap_plan.c    how the memory of one differs from another's
 *   restore_plan.c  ... of all the processes from that of their parents
 *   places.c        where each is to be forked, to be in its session
 */
#ifndef AVCKPT_CHECKPOINT_H
#define AVCKPT_CHECKPOINT_H

#include "process.h"

/* For the next restore: a fork of a template (spare.c), or one that another stands in for
 * (stand_in.c). */
struct spare {
	pid_t pid; /* 0: none                                           */
	int pidfd;
	struct arch_regs base;
	bool tried;    /* it was begun to make one                               */
	bool unwanted; /* it was one process too many for a restore              */
	/* What the template has been told to do for it and has not done yet. */
	enum { SPARE_NO_WORK, SPARE_FORK, SPARE_REST } work;
	struct scheduling scheduling; /* the template's own                        */
	bool aside;                   /* it has another policy for as long         */
};

/* A template that no generation has any more, of which it is known where it is out of date. */
struct idle_template {
	pid_t pid; /* 0: none                                           */
	int pidfd;
	struct arch_regs base;
	struct inherited *inherited;
	struct pageset *stale;
	uint64_t tracker, forked_ns, copied, kinds;
	/* Where it may differ from the template of a generation, which has this number: what was
	 * stale when that was taken, and what was written, and copied, since.  0: anywhere. */
	uint64_t near;
	struct pageset differs;
	bool catching_up; /* it is the same as what is stale: nothing was looked for since */
};

/* Checkpoints by copies of what was written, of one process (dirty.c). */
struct dirty {
	struct process *process;
	pid_t leader; /* as long as it is that one                               */
	uint64_t start;
	struct idle_template idle;
	bool fork_next; /* the last attempt has found that it takes a fork     */
	/* AVC_IMAGES_AUTO: how many are forked before the next attempt, and why. */
	uint32_t rest;
	enum avc_fork_reason rest_reason;
	uint32_t failures, successes; /* attempts that came to nothing, but for the last ones */
	enum avc_fork_reason reason;  /* why this one is forked                          */
	uint64_t refused_nonce;       /* the parasite with which it could not be watched  */
	uint64_t fork_ns;             /* what the last fork took                          */
	long own_pages;               /* of the process, then                             */
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
	bool standing_in; /* the idle one is a generation's already, but not whole yet */
};

/* ... of all of them (dirty_tree.c). */
struct dirty_tree {
	struct dirty **of;
	uint32_t count, room;
	uint64_t fork_ns; /* what the clones of the last checkpoint by forks took   */
	/* Of the last one: why one of them was forked, or none was; pages.         */
	enum avc_fork_reason reason;
	uint64_t copied;
	uint8_t *batch; /* what is copied at a time                                */
	size_t batch_bytes;
};

/* What is saved of an app at one instant. */
struct generation {
	uint64_t number; /* 0: not whole yet                                  */
	/* Of each process: the main one's first, parents before their children. */
	struct image *image;
	uint32_t images;
	uint64_t taken_ns;
	uint64_t clone_ns; /* what the clones of it took                      */
	uint64_t freeze_ns;
	bool quiescent;
	char written[FILES_NAME];  /* avckpt.files: what was written since; "": none */
	struct spare spare;        /* of the main process                              */
	struct restore_plan *plan; /* restore_plan.c; NULL: not begun                   */
	struct group_ends *ends;   /* of connections in its group; NULL: none           */
};

/* ---- freeze.c ------------------------------------------------------------------ */

/* One checkpoint. */
struct freeze {
	struct tree *tree;
	struct generation *generation; /* which has an image of the main process          */
	struct dirty_tree *dirty;      /* process.recycling                                  */
	timer_t timer;
	uint64_t deadline_ns;
	struct mem_seen seen; /* the shared memory that is prepared for already   */
	/* Of one that is part of a line: called when everything has been read and cloned, or (NULL)
	 * could not be, and before anything is let go.  NULL: it is not. */
	int (*meet)(void *arg, struct generation *whole, struct avc_error *err);
	void *arg;
	/* What it took. */
	uint64_t freeze_ns, stop_ns, clone_ns;
};

/* On return the app runs, whatever happened. */
int freeze_tree(struct freeze *freeze, struct avc_error *err) warn_unused;

/* ---- generation.c -------------------------------------------------------------- */

/* With an image of the main process, and of no other one yet. */
int generation_new(struct generation *generation, struct process *main, uint32_t slot,
		   struct avc_error *err) warn_unused;
/* Room for so many images. */
int generation_make_room(struct generation *generation, uint32_t images,
			 struct avc_error *err) warn_unused;
/* After the app runs again: finishes templates and slots. */
int generation_finish(struct generation *generation, struct avc_error *err) warn_unused;
void generation_drop(struct generation *generation);
/* That of this process; NULL: there is none. */
struct image *generation_image(const struct generation *generation, const struct process *process);
/* Of all its processes. */
uint32_t generation_threads(const struct generation *generation);
/* What could not be read, or cannot be put back; the first of it. */
const struct avc_error *generation_notice(const struct generation *generation);
int generation_files_error(const struct generation *generation, struct avc_error *err) warn_unused;
/* Closes what the template of a process that has ended still has open. */
void generation_close_files(const struct image *image);
/* The same of all processes but the main one, once they are restored and have tables of
 * their own: before they go on, for what they close is to be closed. */
void generation_close_tables(const struct generation *generation);

/* ---- layout.c ------------------------------------------------------------------ */

/* All of /proc/PID/maps, into *text, which grows; false with errno. */
bool layout_read(pid_t pid, char **text, size_t *bytes);
/* Whether two of them are of the same mappings, wherever the kernel has them in pieces. */
bool layout_equal(char *a, char *b);

struct layout_step {
	avc_remote start, end;
	enum layout_step_kind {
		LAYOUT_UNMAP,
		LAYOUT_MAP, /* private memory of no file                     */
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

/* What a process has to do to come from the one to the other, in this order.  false: there is no way
 * but a fork, as to files that are mapped, or no memory. */
bool layout_steps_find(char *is, char *want, struct layout_steps *steps);

/* ---- dirty_tree.c -------------------------------------------------------------- */

/* Before a freeze: process.recycling, or why not; what can be copied while the app runs, is. */
void dirty_prepare(struct dirty_tree *dirty, const struct tree *tree,
		   const struct avc_config *config, uint32_t slot, timer_t timer);
/* During it, while main threads answer: what is left is read. */
int dirty_capture(struct dirty_tree *dirty, const struct generation *generation,
		  struct avc_error *err) warn_unused;
/* When the app runs again: idle templates become the images'.  AVC_RETRY: it takes a fork. */
int dirty_apply(struct dirty_tree *dirty, struct generation *generation,
		struct avc_error *err) warn_unused;
/* After that, of images of which all is known: as above. */
int dirty_check(struct dirty_tree *dirty, const struct generation *generation,
		struct avc_error *err) warn_unused;
/* From now on it is noted where they get out of date. */
void dirty_follow(struct dirty_tree *dirty, const struct generation *generation);
/* Their templates are not needed any more: they become idle ones, if they can. */
void dirty_recycle(struct dirty_tree *dirty, const struct generation *generation);
/* Once a generation is kept: where the idle template of the main process differs from it. */
void dirty_compare(struct dirty_tree *dirty, const struct generation *generation);
void dirty_drop_idle(struct dirty_tree *dirty);
/* Those that have been killed. */
void dirty_drop_ended(struct dirty_tree *dirty);
/* Of a process that is gone, or another program. */
void dirty_forget(struct dirty_tree *dirty, const struct process *process);
bool dirty_owns(const struct dirty_tree *dirty, pid_t pid);
/* Of the main process. */
struct dirty *dirty_find(const struct dirty_tree *dirty, const struct process *process);
void dirty_free(struct dirty_tree *dirty);

/* ---- spare.c ------------------------------------------------------------------------ */

/* Makes one for a generation that is whole, if the kernel lets it, and if it comes to that
 * before the deadline.  -1: nothing can be restored from the generation any more. */
int spare_make(struct generation *generation, struct avc_error *err) warn_unused;
/* While the app is dead: at the template's own priority, and until it is there or refused. */
int spare_make_now(struct generation *generation, struct avc_error *err) warn_unused;
/* Before the template is used for anything else: waits until it has done what it had not at
 * the deadline of spare_make().  -1: it has not, AVC_DEADLINE, or as above. */
int spare_await(struct generation *generation, struct avc_error *err) warn_unused;
bool spare_is_there(struct generation *generation);
/* There may be one that only the kernel knows of (init_channel_kill_lost). */
bool spare_is_unknown(const struct generation *generation);
void spare_drop(struct generation *generation);

/* ---- stand_in.c --------------------------------------------------------------------- */

/* Whether a restore of the generation could do without a fork. */
bool stand_in_is_there(const struct dirty_tree *dirty, const struct generation *generation);
/* While the app is dead: the idle template becomes the generation's, whose own one becomes its
 * spare.  What they differ in is read from that now, and written to the other one by
 * stand_in_finish(), before anything else is made of it.  If it cannot be, nothing has changed. */
void stand_in_begin(struct dirty_tree *dirty, struct generation *generation, timer_t timer);
/* While it runs, and nothing else is to be done: copies some of that, so that a restore need not, nor
 * the next checkpoint; false: there is no more. */
bool stand_in_catch_up(struct dirty_tree *dirty, const struct generation *generation,
		       timer_t timer);
/* false: nothing can be restored from the generation any more. */
bool stand_in_finish(struct dirty_tree *dirty, struct generation *generation, timer_t timer);

/* ---- snapshot.c --------------------------------------------------------------------- */

struct mappings {
	struct mapping *map;
	uint32_t count, room;
};

/* A stretch of a mapping, and what pagemap says of each page. */
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
	struct pages *pages; /* by mapping, of those that were asked for              */
};

/* `image`: of the same process. */
struct snapshot *snapshot_new(pid_t template, const struct mem_image *image, struct avc_error *err);
void snapshot_free(struct snapshot *snapshot);
/* Frees what it knows of pages, until it is asked for them again; NULL: nothing to do. */
void snapshot_rest(struct snapshot *snapshot);
/* Of one of its mappings, a private one.  NULL on error. */
const struct pages *snapshot_pages(struct snapshot *snapshot, const struct mapping *mapping,
				   struct avc_error *err);
/* From `address` on; NULL where there is nothing.  `*end` is lowered to where that changes;
 * `*next`, 0 at first, is where the search for a higher address begins. */
const uint64_t *pages_frames(const struct pages *pages, uint32_t *next, avc_remote address,
			     avc_remote *end);

/* ---- remap.c ----------------------------------------------------------------------- */

struct remap;

/* What makes the memory of a fork of `is` that of `want`.  Both snapshots have to stay.
 * NULL on error. */
struct remap *remap_plan(const struct process *process, struct snapshot *want, struct snapshot *is,
			 struct avc_error *err);
/* Whether there is a way from the one to the other, while it is not needed yet: of some mappings
 * only who has them can give them to others, and only by a fork. */
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
	bool renewed; /* forked by a keeper with the number of the session's leader, who is gone */
};

/* For each image.  -1: one could not come to be where it is. */
int places_find(const struct generation *generation, struct place *place,
		struct avc_error *err) warn_unused;

/* ---- restore_plan.c --------------------------------------------------------------------- */

/* Of a generation that is whole; once is enough.  `ahead_ns`: CPU time that restore_plan_next() may
 * spend on it, about. */
int restore_plan_begin(struct generation *generation, uint64_t ahead_ns,
		       struct avc_error *err) warn_unused;
/* Whose process is to fork that of an image, not the main one's, and in which session. */
const struct place *restore_plan_place(const struct generation *generation, uint32_t index);
/* How it is made of that fork; NULL on error. */
const struct remap *restore_plan_of(struct generation *generation, uint32_t index,
				    struct avc_error *err);
/* Of a checkpoint: whether the processes can be made of their parents at all. */
int restore_plan_check(const struct generation *generation, struct avc_error *err) warn_unused;
/* Finds out about one more of them, so that a restore need not; false: that is all. */
bool restore_plan_next(struct generation *generation);
void restore_plan_free(struct restore_plan *plan);

#endif
