/* SPDX-License-Identifier: Apache-2.0
 *
 * Shared by the files that restore several processes.
 *
 *   restore_tree.c  all of it
 *   restore_fork.c  forks each, under its PID, in its session
 */
#ifndef AVCKPT_RESTORE_TREE_H
#define AVCKPT_RESTORE_TREE_H

#include "restore.h"

/* From a fork of its parent to what its template is. */
enum stage {
	STAGE_NONE,   /* not forked yet, or will be a zombie                     */
	STAGE_FORKED, /* runs to its first stop                                  */
	STAGE_MOVES,  /* in its parent's parasite: maps its own                  */
	STAGE_MAPS,   /* gets its mappings                                       */
	STAGE_FILLS,  /* gets everything else                                    */
	STAGE_WHOLE
};

struct forked {
	pid_t pid; /* 0: not forked yet */
	int pidfd;
	bool traced;
	bool fresh; /* its first stop has not been awaited yet                 */
	enum stage stage;
	pid_t group, session; /* as inherited                                           */
	struct syscall_batch batch;
	struct fd_channel inherited; /* through which it gets descriptors                       */
	struct sandbox *sandbox;     /* NULL: it is not traced, and waits to go */
	/* As a parent. */
	bool forking;   /* in the stop of its last fork; its list of calls goes on from there */
	uint32_t calls; /* on that list                                            */
	bool asked;     /* for `channel`                                           */
	struct fd_channel channel; /* through which it gets its children's                  */
	int passed;                /* the last of these, there; -1: none                       */
	uint32_t born;             /* in its parasite, and where they begin:                  */
	uint32_t bed[BATCH_BEDS];  /* the images; 0: none                                     */
	uint64_t flush;            /* signals of children that exited (sigset_t) */
};

/* A task that lives until all processes exist: it clones children of its host in a session that the
 * host is not in, or leads a group (places.c). */
struct keeper {
	uint32_t host; /* the place of its image                                 */
	pid_t session; /* PLACE_ANY: for a group */
	struct forked task;
};

struct restore_tree {
	struct restore *restore;
	struct generation *generation;
	struct copier *copier;
	pid_t last_number; /* the PID assigned last; 0: unknown */
	struct keeper *keeper;
	uint32_t keepers, keeper_room;
	struct forked forked[]; /* by image                                    */
};

/* Forks the process of images[index], by the process of its place; calls `meanwhile` during the
 * fork.  It is `fresh`, or in its first stop. */
int restore_fork(struct restore_tree *tree, uint32_t index, void (*meanwhile)(void *arg), void *arg,
		 struct avc_error *err) warn_unused;
/* Waits for its first stop, unless that was done. */
int restore_fork_await(struct forked *forked, struct avc_error *err) warn_unused;
/* A parent rests in the parasite again, and can make other calls than forks. */
int restore_fork_rest(struct forked *forked, struct avc_error *err) warn_unused;
/* Before it begins its own session: makes keepers for its children in this one. */
int restore_fork_keeper(struct restore_tree *tree, uint32_t index, pid_t session,
			struct avc_error *err) warn_unused;
/* Ensures that a group with that number exists in its session. */
int restore_fork_group(struct restore_tree *tree, uint32_t index, pid_t group,
		       struct avc_error *err) warn_unused;
/* When all exist, and are in their groups. */
int restore_fork_end(struct restore_tree *tree, struct avc_error *err) warn_unused;
void restore_fork_kill(struct restore_tree *tree);
/* A child of it has exited, or will, and it is notified. */
void restore_fork_note(struct forked *parent, int exit_signal);

#endif
