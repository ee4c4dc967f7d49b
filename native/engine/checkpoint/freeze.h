/* SPDX-License-Identifier: Apache-2.0
 *
 * What the files of a freeze give each other.
 *
 *   freeze.c        one checkpoint
 *   freeze_stop.c   stops everybody, and lets everybody go
 *   freeze_clone.c  reads and clones
 */
#ifndef AVCKPT_FREEZE_H
#define AVCKPT_FREEZE_H

#include "checkpoint.h"

/* ---- freeze_stop.c ------------------------------------------------------------------------ */

/* Those that have something of ours; another child may have to execute a program before its
 * parent can be stopped (vfork(2)). */
int freeze_stop_known(struct tree *tree, struct avc_error *err) warn_unused;
/* Until a look at the whole tree finds nobody who is not stopped: processes create
 * processes while we look. */
int freeze_stop_others(struct tree *tree, struct avc_error *err) warn_unused;

/* ---- freeze_clone.c ----------------------------------------------------------------------- */

/* As soon as everybody stands still who is known to be there: their clones begin, as far as
 * they do not take long, and they answer meanwhile what they are asked.  Whoever is found after
 * that is stopped, too, and has had nothing to do with the memory of the others.  (One that shares
 * it is not protected: find_others().)  One that has no holder yet waits for the others. */
int freeze_begin_known(struct freeze *freeze, struct avc_error *err) warn_unused;
/* Those that have been found since.  Without a holder they are only read and asked. */
int freeze_begin_others(struct freeze *freeze, struct avc_error *err) warn_unused;
/* The main process is cloned by its own main thread, any other by its holder, which shares its
 * memory and descriptors: nobody finds children that he has not made. */
int freeze_start_clone(struct process *process, uint32_t slot, struct avc_error *err) warn_unused;
int freeze_await_clone(struct process *process, pid_t *template, struct avc_error *err) warn_unused;
/* The main thread that has cloned has a few steps to go before it can be let go. */
int freeze_rest_main(const struct process *main, struct thread *main_thread, struct avc_error *err);
/* The answers of all others, also of those that were asked before one failed. */
int freeze_hear_all(struct tree *tree, struct avc_error *err) warn_unused;
/* Clones that nobody waits for any more: of a process that was killed meanwhile, and all of
 * them when the checkpoint failed. */
void freeze_drop_clones(struct tree *tree);

#endif
