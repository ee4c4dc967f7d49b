/* SPDX-License-Identifier: Apache-2.0
 *
 * Shared by the files about seccomp filters.
 *
 *   seccomp.c            which filters there are, and whether injected code can live with them
 *   seccomp_filter.c     what one of them says of a call
 *   seccomp_calls.c      the calls of injected code
 *   seccomp_supervise.c  suspends filters for them
 */
#ifndef AVCKPT_SECCOMP_H
#define AVCKPT_SECCOMP_H

#include <linux/filter.h>

#include "trace.h"

/* ---- seccomp_calls.c -------------------------------------------------------------------------- */

#define ANY (~UINT64_C(0))

/* A system call, with the first argument where a filter is likely to check it. */
struct kind {
	long nr;
	uint64_t arg; /* ANY: it varies */
};

struct kinds {
	const struct kind *kind;
	size_t count;
};

/* The calls of injected code. */
extern const struct kinds seccomp_wanted;
/* And those of a process being restored: one with its own filters is then supervised in any case
 * (sandbox.c). */
extern const struct kinds seccomp_wanted_to_restore;
/* Of processes below the main one, which are made as forks of it.  They are not supervised for all
 * of these: the application's own filters must allow them, and those above. */
extern const struct kinds seccomp_wanted_for_trees;
/* What the container's own filters must allow, too, if none can be suspended: an application need not
 * make such calls. */
extern const struct kinds seccomp_needed;
extern const struct kinds seccomp_needed_to_watch;
/* INJ_CLOSE_CLAIMS */
extern const struct kinds seccomp_needed_to_ask;
/* What must not be refused when the guard has died in the middle: the thread's signals would stay
 * blocked, its memory would stay as it is for a clone, a porter would call exit(2) for ever.  And
 * nothing could be restored without rt_sigreturn(2). */
extern const struct kinds seccomp_homeward;
extern const char *const seccomp_homeward_name[];
/* Where the kernel would continue an interrupted call. */
extern const struct kinds seccomp_restarts;
/* ... and we (cut.c): with another first argument, and from elsewhere. */
extern const struct kinds seccomp_rests;

/* Threads of a process being restored (parasite.c, spawn()). */
#define SPAWN_FLAGS                                                                         \
	(CLONE_VM | CLONE_FS | CLONE_FILES | CLONE_SIGHAND | CLONE_THREAD | CLONE_SYSVSEM | \
	 CLONE_SETTLS)

/* ---- seccomp_filter.c ------------------------------------------------------------------------- */

/* Of seccomp(2): a program in classic BPF. */
struct filter {
	struct sock_filter insn[BPF_MAXINSNS];
	long count;
};

enum verdict {
	PASSES,
	REFUSES,
	MAY_REFUSE,
	ENDS /* the task, or the call is not what it seems: it asks another process, or lies   */
};

/* Whether it prevents a call, and how. */
enum verdict filter_verdict(const struct filter *filter, const struct kind *kind);
bool filter_refuses_any(const struct filter *filter, const struct kinds *kinds);

/* ---- seccomp.c -------------------------------------------------------------------------------- */

/* The ptrace option that suspends filters; 0 for a guard that has one of its own. */
long seccomp_suspend_option(void);

#endif
