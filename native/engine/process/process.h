/* SPDX-License-Identifier: Apache-2.0
 *
 * Live processes of the app.
 *
 *   process.c        one of them: looked at, asked, stopped
 *   stop.c          ... stopped, let go
 *   infect.c        parasite and holder brought into it
 *   executed.c      ... which are gone when it executes another program
 *   tracker.c       which of its pages are written
 *   support.c       what cannot be protected; quiescence
 *   waits.c         calls that are to be ended
 *   dying.c         in its own handler of a fatal signal
 *   tree.c          all of them
 */
#ifndef AVCKPT_PROCESS_H
#define AVCKPT_PROCESS_H

#include "files.h"

#define PROCESSES_MAX 512 /* of one app                                     */

/* One process of the app, as it was found. */
struct tree_entry {
	pid_t pid;
	int parent;  /* index, PARENT_INIT; the main process is 0           */
	bool ended;  /* a zombie                                         */
	bool ending; /* neither a process any more nor a zombie yet      */
	struct proc_stat stat;
	struct process *process;
};

/* All processes of an app (tree.c). */
struct tree {
	pid_t init;
	uint32_t slots;           /* of a parasite                                        */
	struct tree_entry *entry; /* who was found; parents before children            */
	uint32_t count;
	/* The main one first, which stays whatever becomes of it; of the others those that have
	 * ended as long as there are images of them. */
	struct process **process;
	uint32_t processes;
	/* Is this child of init one of our own? */
	bool (*is_ours)(pid_t pid, const void *arg);
	const void *arg;
};

#define PIDFD_THREAD_ O_EXCL /* linux/pidfd.h, since Linux 6.9 */

static inline struct process *tree_main(const struct tree *tree)
{
	return tree->process[0];
}

/* ---- process.c ----------------------------------------------------------------- */

void process_init(struct process *process);
/* Room for threads and all else that a process has; false: out of memory. */
bool process_make_room(struct process *process);
void process_free_room(struct process *process);
int process_open(struct process *process, pid_t pid, pid_t inside,
		 struct avc_error *err) warn_unused;
/* Before anything else is done with it: the main thread may have ended, and others go
 * on (pthread_exit(3)). */
int process_follow(struct process *process, struct avc_error *err) warn_unused;
/* All of it, whichever of its threads have ended meanwhile. */
void process_kill(const struct process *process);
/* Forgets the process (the parasite stays mapped here: templates live in it). */
void process_close(struct process *process);
/* What ptrace can read of a stopped thread: mask, robust list, rseq. */
int thread_read(struct thread *thread, struct avc_error *err) warn_unused;
/* What only a thread itself can tell (clear_child_tid, sigaltstack, credentials): added to
 * calls that it makes anyway, and what came of it.  `with_locks`: of its process, what is to
 * be locked in memory; there is a mapping more while that is found out. */
void thread_ask_add(const struct process *process, bool with_locks, struct inj_call *call,
		    struct questions *questions);
int thread_ask_answer(struct thread *thread, const struct inj_call *call,
		      const struct questions *questions, struct avc_error *err) warn_unused;
/* Asks a stopped thread just that; if it is the main thread, thread_ask_others(). */
int thread_ask(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
/* The main thread was asked, and had other credentials before: a change may be one of all
 * threads (nptl(7), setuid(3)), so these are to be asked again, too (AVC_RETRY). */
int thread_ask_others(struct process *process, const struct thread *thread, const struct creds *was,
		      struct avc_error *err) warn_unused;
/* The threads there are now; those that ended are forgotten. */
int process_list_threads(struct process *process, struct avc_error *err) warn_unused;
/* Gets known every thread that is not yet, one at a time, before a freeze. */
int process_query_new_threads(struct process *process, timer_t timer, uint64_t deadline_ns,
			      struct avc_error *err) warn_unused;

/* ---- dying.c ------------------------------------------------------------------- */

/* Before a freeze: of which fatal signals it has handlers. */
void dying_note_caught(struct process *process);
/* In a freeze: before its threads are checked, and when none was in a handler. */
void dying_begin(struct process *process);
void dying_end(struct process *process);
/* Of a stopped thread that was read: AVC_RETRY, it is in the handler of a fatal signal. */
int dying_check(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;

/* ---- stop.c --------------------------------------------------------------------- */

/* Every thread of one process is stopped; all go on. */
int process_stop(struct process *process, struct avc_error *err) warn_unused;
/* The same in parts, for several at a time: what is known of the last time is forgotten; those
 * threads are interrupted that are known; all are waited for, and the others found. */
void process_stop_begin(struct process *process);
void process_interrupt(struct process *process);
int process_stop_all(struct process *process, struct avc_error *err) warn_unused;
void process_let_go(struct process *process);

/* ---- infect.c ----------------------------------------------------------------- */

/* Brings the parasite into the app, through its main thread.  The other threads run. */
int process_infect(struct process *process, uint32_t slots, timer_t timer, uint64_t deadline_ns,
		   struct avc_error *err) warn_unused;
/* The same while everything is stopped. */
int process_infect_stopped(struct process *process, uint32_t slots,
			   struct avc_error *err) warn_unused;
/* The holder of one that is not the main process, by its stopped main thread. */
int process_hold_stopped(struct process *process, pid_t init, struct avc_error *err) warn_unused;
/* A stopped process that adopts orphans (PR_SET_CHILD_SUBREAPER) does not for a while: they
 * are init's.  If we die meanwhile it does again all by itself. */
int process_pause_adoption(struct process *process, struct avc_error *err) warn_unused;
int process_resume_adoption(struct process *process, struct avc_error *err) warn_unused;
/* Makes the holder; process_unhold() drops it.  process_unhold_soon() does not wait until what it
 * has open is closed and its memory gone. */
int process_hold(struct process *process, timer_t timer, uint64_t deadline_ns,
		 struct avc_error *err) warn_unused;
void process_unhold(struct process *process);
void process_unhold_soon(struct process *process);
/* The holder is the caller's from here on, with its pidfd (-1: there was none). */
pid_t process_detach_holder(struct process *process, int *pidfd);

/* ---- executed.c ---------------------------------------------------------------------- */

/* Whether the (running, infected) process has another program: what was brought into it
 * is gone. */
bool process_has_executed(const struct process *process);
/* From now on process->exec_sign.fd has news (poll(2)) when it may have: it has, or its main thread
 * has ended.  false: the kernel does not tell. */
bool process_listen_for_exec(struct process *process);
void process_listen_no_more(struct process *process);

/* ---- tracker.c -------------------------------------------------------------------- */

/* Sets that are added to. */
#define TRACKER_SETS (AVC_KEEP_MAX + 3)

/* Whose private memory is watched: the kernel notes which pages are written, in the process's page
 * table and by no fault that anybody waits for.  With the last descriptor, which is ours, all of it
 * goes from the process. */
struct tracker {
	uint64_t number; /* none has the same: what was known by another one is not known */
	int uffd, pagemap;
	uint32_t areas, area_room; /* the mappings that are watched, in order             */
	struct stretch {
		avc_remote start, end;
	} * area;
	uint32_t parts, part_room; /* where they have pages of their own, in chunks       */
	struct stretch *part;
	struct pageset found;
	struct pageset *set[TRACKER_SETS];
	uint32_t sets;
	bool over;   /* the process is another one                              */
	bool broken; /* there was no memory to note something in                */
};

/* By a task with the memory of the holder.  AVC_UNSUPPORTED: the kernel cannot do it. */
int tracker_begin(struct process *process, timer_t timer, struct avc_error *err) warn_unused;
void tracker_end(struct process *process);
/* All of its mappings that are private, by /proc/PID/maps of just now.  AVC_UNSUPPORTED: there are
 * some that cannot be watched. */
int tracker_watch(struct process *process, char *layout, struct avc_error *err) warn_unused;
/* What was written since the last time is added to all sets; `template`: a process of which pages
 * count as written where it has any and the other has not been known to, 0: none.  *pages: how many.
 * -1: not all of it is watched any more. */
int tracker_scan(struct tracker *tracker, pid_t template, uint64_t *pages) warn_unused;
/* From now on, or no more. */
bool tracker_add(struct tracker *tracker, struct pageset *set);
void tracker_remove(struct tracker *tracker, const struct pageset *set);

/* ---- support.c --------------------------------------------------------------------- */

/* Looks at a running app for what cannot be protected.  0, or -1 with
 * AVC_UNSUPPORTED and the reason in words. */
int support_check(struct process *process, struct avc_error *err) warn_unused;
/* True if this looks like a moment at which nobody is in the middle of anything. */
bool process_is_quiescent(const struct process *process);

/* ---- tree.c --------------------------------------------------------------------- */

/* Of one whose main process is this.  -1: out of memory. */
int tree_init(struct tree *tree, struct process *main) warn_unused;
/* Looks who there is; new ones are opened. */
int tree_scan(struct tree *tree, struct avc_error *err) warn_unused;
/* Whether entry[i] or a process above it adopts orphans, or could not be asked whether it does. */
bool tree_has_reaper(const struct tree *tree, uint32_t i);
/* Whether entry[i] has its parent's memory, and not its own: after vfork(2) until it has
 * executed a program. */
/* Whether that is in one of their parasites: then it is none of the app's that is there. */
bool tree_has_parasite(const struct tree *tree, avc_remote pc);
bool tree_shares_memory(const struct tree *tree, uint32_t i);
/* Frees those that have ended and of which there is no image. */
void tree_sweep(struct tree *tree);
/* It is gone, or another program: what it had open must not stay open by us. */
void tree_let_go(struct process *process);
/* Of all but the main process, which is the caller's. */
void tree_free(struct tree *tree);

/* ---- waits.c ---------------------------------------------------------------------- */

/* Before a freeze: looks at those that may be waiting. */
void waits_prepare(struct process *process);
/* Ends the calls that were rewound and whose time is up; the next one's is at
 * process->due_ns (UINT64_MAX: none). */
void waits_end(struct process *process, timer_t timer);

#endif
