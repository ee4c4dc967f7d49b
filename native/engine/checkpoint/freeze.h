/* SPDX-License-Identifier: Apache-2.0
 *
 * Shared by the files of a freeze.
 *
 *   freeze.c        one checkpoint
 *   freeze_stop.c   stops and releases all processes
 *   freeze_clone.c  reads and clones
 */
#ifndef AVCKPT_FREEZE_H
#define AVCKPT_FREEZE_H

#include "checkpoint.h"

/* ---- freeze_stop.c ------------------------------------------------------------------------ */

/* Before anything is stopped.  Fails if a signal is killing one of them. */
int freeze_stop_prepare(struct tree *tree, struct avc_error *err) warn_unused;
/* Those that are infected; another child may have to execute a program before its parent can be
 * stopped (vfork(2)). */
int freeze_stop_known(struct tree *tree, struct avc_error *err) warn_unused;
/* Until a walk of the whole tree finds no process that is not stopped: processes create processes
 * meanwhile. */
int freeze_stop_others(struct tree *tree, struct avc_error *err) warn_unused;

/* ---- freeze_clone.c ----------------------------------------------------------------------- */

/* An estimate for all processes, those that have no template yet as well. */
uint64_t freeze_clones_time_ns(const struct tree *tree);
/* As soon as all known processes are stopped: starts their clones, as far as they are short, while
 * they answer queries.  A process that is found later is stopped, too, and cannot have changed the
 * memory of the others. (One that shares it is not protected: find_others().) One that has no
 * holder yet waits for the others. */
int freeze_begin_known(struct freeze *freeze, struct avc_error *err) warn_unused;
/* Those found since.  Without a holder they are only read and queried. */
int freeze_begin_others(struct freeze *freeze, struct avc_error *err) warn_unused;
/* The main process is cloned by its own main thread, any other by its holder, which shares its
 * memory and descriptors: no process finds children that it has not created. */
int freeze_start_clone(struct process *process, uint32_t slot, struct avc_error *err) warn_unused;
int freeze_await_clone(struct process *process, pid_t *template, struct avc_error *err) warn_unused;
/* After cloning, the main thread has a few more steps before it can be released. */
int freeze_park_main(const struct process *main, struct thread *main_thread, struct avc_error *err);
/* The answers of all others, also of those that were asked before one failed. */
int freeze_await_answers(struct tree *tree, struct avc_error *err) warn_unused;
/* Abandoned clones: of a process that was killed meanwhile, and all of them when the checkpoint
 * failed. */
void freeze_drop_clones(struct tree *tree);

#endif
