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

struct forked {
	pid_t pid; /* 0: not forked yet */
	int pidfd;
	bool traced;
	struct syscall_batch batch;
	struct sandbox *sandbox; /* NULL: it is not traced, and waits to go */
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
	struct fd_channel fd_channel; /* of the main process's children                  */
	uint64_t flush;               /* signals of children that exited (sigset_t) */
	pid_t last_number;            /* the PID assigned last; 0: unknown */
	struct keeper *keeper;
	uint32_t keepers, keeper_room;
	struct forked forked[]; /* by image                                    */
};

/* Forks the process of images[index], by the process of its place; calls `meanwhile` during the
 * fork.  It is in its first stop. */
int restore_fork(struct restore_tree *tree, uint32_t index, void (*meanwhile)(void *arg), void *arg,
		 struct avc_error *err) warn_unused;
/* Before it begins its own session: makes keepers for its children in this one. */
int restore_fork_keeper(struct restore_tree *tree, uint32_t index, pid_t session,
			struct avc_error *err) warn_unused;
/* Ensures that a group with that number exists in its session. */
int restore_fork_group(struct restore_tree *tree, uint32_t index, pid_t group,
		       struct avc_error *err) warn_unused;
/* When all exist, and are in their groups. */
int restore_fork_end(struct restore_tree *tree, struct avc_error *err) warn_unused;
void restore_fork_kill(struct restore_tree *tree);
/* Has exited, or will, and its parent is notified. */
void restore_fork_note(struct restore_tree *tree, int exit_signal);

#endif
