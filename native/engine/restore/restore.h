/* SPDX-License-Identifier: Apache-2.0
 *
 * Templates become the app again.
 *
 *   restore.c       the main process
 *   restore_tree.c  a restored process makes its children
 *   restore_fork.c  ... each under its PID, in its session
 *   remap.c         ... and their memory
 *   copier.c        ... which a second thread helps to copy
 */
#ifndef AVCKPT_RESTORE_H
#define AVCKPT_RESTORE_H

#include "checkpoint.h"

/* ---- restore.c ------------------------------------------------------------------ */

/* A process that takes less than about a millisecond to fork gets its PID sooner or later, even
 * where others fork all the time.  One with more pages is copied first (spare.c), and so is any where
 * there are several guards. */
#define COPIED_PAGES 16384

/* Restores an app from a generation. */
struct restore {
	struct generation *generation;
	struct init_channel *channel;
	const struct avc_config *config;
	timer_t timer;
	uint64_t died_ns;
	/* Called when everything is ready, before anything runs: sends the verdict. */
	int (*ready)(void *arg, struct avc_error *err);
	void *arg;
	struct last_pid *helper; /* of restore_ahead(); NULL: it is started now; is ended    */
	/* The result: the new main process, the times, what could not be restored. */
	pid_t pid;
	uint64_t restore_ns, fork_ns, threads_ns;
	int dropped; /* descriptors whose input was dropped */
	struct avc_error notes;
	/* While it lasts. */
	int pidfd;
	struct sandbox *sandbox;
	struct restore_tree *tree; /* NULL: there is one process                       */
};

/* Started before it is clear whether the generation is restored: the helper enters the container's
 * PID namespace, while the dead application is cleaned up.  NULL: restore_app() tries again.
 * last_pid_end() ends it. */
struct last_pid *restore_ahead(const struct generation *generation,
			       const struct init_channel *channel);
int restore_app(struct restore *restore, struct avc_error *err) warn_unused;
/* Whether to try again to get it: while a dead process has it, which is waited for, and for a second
 * since then, or since `*since_ns`. */
bool restore_number_gets_free(const struct restore *restore, pid_t number, uint64_t *since_ns);
/* Begins a step, which has its own deadline. */
void restore_go_on(const struct restore *restore);
/* Fails with who has a PID of the container of `init`: as its own, or as that of its group or
 * session.  Always returns -1. */
int restore_fail_taken(pid_t init, pid_t number, struct avc_error *err);

/* ---- restore.c, for one process of several ----------------------------------------- */

/* For a stopped process that equals its template: has it restore itself, with the help that it needs
 * for TIDs (NULL: it has one thread); waits until it has; reports what failed; releases it. */
int restore_start(const struct image *image, struct last_pid *helper, pid_t pid,
		  struct sandbox **sandbox, struct avc_error *err) warn_unused;
/* Waits until it needs no more help, at most; not for one in a sandbox. */
void restore_await_spawned(const struct image *image, int pidfd);
int restore_await(const struct image *image, int pidfd, struct sandbox *sandbox,
		  struct avc_error *err) warn_unused;
void restore_note(const struct image *image, pid_t pid, struct avc_error *notes);
void restore_go(const struct image *image, struct sandbox *sandbox);

/* ---- restore_tree.c ------------------------------------------------------------------------- */

/* All processes of a generation, of which the main one exists; each is stopped. */
struct restore_tree;
struct restore_tree *restore_tree_new(struct restore *restore, struct avc_error *err);
/* The main process (a stopped tracee) forks the others. */
int restore_tree_make(struct restore_tree *tree, struct avc_error *err) warn_unused;
/* They restore themselves, except the main one: at first those that need nothing for it, which is
 * done while that does; then the others, until all are ready. */
int restore_tree_begin(struct restore_tree *tree, struct avc_error *err) warn_unused;
int restore_tree_start(struct restore_tree *tree, struct avc_error *err) warn_unused;
void restore_tree_go(struct restore_tree *tree);
void restore_tree_kill(struct restore_tree *tree);
void restore_tree_free(struct restore_tree *tree);
/* An image's process, when all exist. */
pid_t restore_tree_pid(const struct restore_tree *tree, uint32_t index);
int restore_tree_pidfd(const struct restore_tree *tree, uint32_t index); /* the tree's own */

/* ---- remap.c ------------------------------------------------------------------------ */

struct copier;

/* Lists the calls for it, in a batch that is in the parasite of the plan's process already: first
 * its mappings, which have to exist (if any of them is `changed`) before they are filled; then what
 * is in them.  The copier may not have finished. */
int remap_map(const struct remap *plan, struct syscall_batch *batch, bool *changed,
	      struct avc_error *err) warn_unused;
int remap_fill(const struct remap *plan, struct syscall_batch *batch, struct copier *copier,
	       struct avc_error *err) warn_unused;

/* ---- copier.c ----------------------------------------------------------------------- */

struct copier;

struct copier *copier_new(struct avc_error *err); /* NULL on error */
/* What is added from here on goes from `template` to `pid`. */
int copier_open(struct copier *copier, pid_t template, pid_t pid,
		struct avc_error *err) warn_unused;
/* One stretch of memory.  `plain`: the mapping may be read and written. */
int copier_add(struct copier *copier, avc_remote from, avc_remote to, bool plain,
	       struct avc_error *err) warn_unused;
/* Helps to copy; false when nothing is left, and then it can be finished. */
bool copier_help(struct copier *copier);
int copier_finish(struct copier *copier, struct avc_error *err) warn_unused;
void copier_free(struct copier *copier);

#endif
