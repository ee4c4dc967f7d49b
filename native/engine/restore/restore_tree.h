/* SPDX-License-Identifier: Apache-2.0
 *
 * What the files of a restore of several processes give each other.
 *
 *   restore_tree.c  all of it
 *   restore_fork.c  each is forked, under its number, in its session
 */
#ifndef AVCKPT_RESTORE_TREE_H
#define AVCKPT_RESTORE_TREE_H

#include "restore.h"

struct forked {
	pid_t pid; /* 0: not made yet                                         */
	int pidfd;
	bool traced;
	struct syscall_batch batch;
	struct sandbox *sandbox; /* NULL: it is on its own, and waits to go            */
};

/* A task that is there until all processes are: it makes children of its host's in another session
 * than that is in, or leads a group (places.c). */
struct keeper {
	uint32_t host; /* the place of its image                                 */
	pid_t session; /* PLACE_ANY: it is there for a group                      */
	struct forked task;
};

struct restore_tree {
	struct restore *restore;
	struct generation *generation;
	struct copier *copier;
	struct fd_channel fd_channel; /* of the main process's children                  */
	uint64_t flush;               /* signals of children that ended (sigset_t)       */
	pid_t last_number;            /* the number given out last; 0: not known          */
	struct keeper *keeper;
	uint32_t keepers, keeper_room;
	struct forked forked[]; /* by image                                    */
};

/* Made of images[index], which is not there yet, by the process of its place; its parent gets on
 * with `meanwhile` while that takes time.  In its first stop. */
int restore_fork(struct restore_tree *tree, uint32_t index, void (*meanwhile)(void *arg), void *arg,
		 struct avc_error *err) warn_unused;
/* It is about to begin a session of its own, and has children in this one. */
int restore_fork_keeper(struct restore_tree *tree, uint32_t index, pid_t session,
			struct avc_error *err) warn_unused;
/* There is a group with that number, in its session. */
int restore_fork_group(struct restore_tree *tree, uint32_t index, pid_t group,
		       struct avc_error *err) warn_unused;
/* When all are there, and in their groups. */
int restore_fork_end(struct restore_tree *tree, struct avc_error *err) warn_unused;
void restore_fork_kill(struct restore_tree *tree);
/* Has ended, or will, and its parent is told. */
void restore_fork_note(struct restore_tree *tree, int exit_signal);

#endif
