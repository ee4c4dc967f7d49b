/* SPDX-License-Identifier: Apache-2.0
 *
 * Shared by the files that inject parasite and holder.
 *
 *   infect.c   the parasite
 *   cave.c     where in the app's code the first instructions fit
 *   porter.c   the task that maps the parasite
 *   holder.c   the holder
 */
#ifndef AVCKPT_INFECT_H
#define AVCKPT_INFECT_H

#include "process.h"

/* ---- infect.c ------------------------------------------------------------------------------- */

/* Stops all threads, until process_go_on(), and returns the main one, read.  NULL: all run again. */
struct thread *infect_stop_all(struct process *process, timer_t timer, uint64_t deadline_ns,
			       struct avc_error *err) warn_unused;

/* ---- cave.c --------------------------------------------------------------------------------- */

/* Finds a cave, and the parasites of guards that died.  Fails if the stopped main thread, which is at
 * `pc`, is still in one of those, or in a stub. */
int cave_find(struct process *process, avc_remote pc, avc_remote *cave,
	      struct avc_error *err) warn_unused;
int cave_write(const struct process *process, avc_remote cave, const uint8_t *stub, size_t bytes,
	       struct avc_error *err) warn_unused;
int cave_erase(const struct process *process, avc_remote cave, size_t bytes) warn_unused;
/* The stub there stays until process_drop_stubs(). */
void cave_keep(struct process *process, avc_remote cave);

/* ---- porter.c ------------------------------------------------------------------------------- */

/* Whether it can be a thread of the process: a thread has a table of descriptors of its own, which is
 * reachable only through its own pidfd (since Linux 6.9). */
bool porter_can_be_thread(void);
/* Whether a parasite may be mapped here. */
bool porter_is_place(avc_remote base);
/* Has the stopped main thread clone a porter, from the stub in `cave`, which maps a new parasite of
 * `bytes` (parasite_layout()).  *stub_is_free: false if a porter is still there. */
int porter_bring(struct process *process, struct thread *thread, avc_remote cave, size_t bytes,
		 bool *stub_is_free, struct avc_error *err) warn_unused;

#endif
