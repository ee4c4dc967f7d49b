/* SPDX-License-Identifier: Apache-2.0
 *
 * Live processes of the app.
 *
 *   process.c       one of them: opened, its threads queried
 *   stop.c          ... stopped, released
 *   infect.c        injects the parasite (infect.h)
 *   holder.c        ... and the holder
 *   executed.c      ... which are gone when it executes another program
 *   tracker.c       which of its pages are written
 *   watcher.c       ... where its container may not watch memory
 *   support.c       what cannot be protected; quiescence
 *   waits.c         ends calls whose timeout has expired
 *   dying.c         in its own handler of a fatal signal
 *   fence.c         ... or in a Landlock domain of its own
 *   tree.c          all of them
 */
#ifndef AVCKPT_PROCESS_H
#define AVCKPT_PROCESS_H

#include "files.h"

#define PROCESSES_MAX 512 /* of one app                                     */

/* One process of the app, as found by tree_scan(). */
struct tree_entry {
	pid_t pid;
	int parent;  /* index, PARENT_INIT; the main process is 0           */
	bool ended;  /* a zombie                                         */
	bool ending; /* exiting, but no zombie yet                       */
	struct proc_stat stat;
	struct process *process;
};

/* All processes of an app (tree.c). */
struct tree {
	pid_t init;
	uint32_t slots;           /* of a parasite                                        */
	struct tree_entry *entry; /* those found; parents before children              */
	uint32_t count;
	/* The main one first, which always stays; others also after their end, as long as there are
	 * images of them. */
	struct process **process;
	uint32_t processes, process_room;
	/* Children of init that are tracees, found while clones were being made: templates, unless
	 * tree_check_made() finds another one. */
	pid_t *made;
	uint32_t made_count;
	/* One that shares its descriptor table or directory with another: refused if it stays. */
	pid_t sharer;
	uint64_t sharer_since_ns;
	/* Whether this child of init is one of our own. */
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
/* Memory for threads and all else that a process has; false: out of memory. */
bool process_make_room(struct process *process);
void process_free_room(struct process *process);
int process_open(struct process *process, pid_t pid, pid_t inside,
		 struct avc_error *err) warn_unused;
/* Before anything else is done with it: the main thread may have ended while others continue
 * (pthread_exit(3)). */
int process_follow(struct process *process, struct avc_error *err) warn_unused;
/* Kills all its threads, even if some have ended meanwhile. */
void process_kill(const struct process *process);
/* After that: gives the threads whose end we wait for our priority. */
void process_hasten(const struct process *process);
/* One that has not ended in time has its own again. */
void process_hasten_no_more(const struct process *process);
/* Forgets the process (our view of the parasite stays mapped: templates use it). */
void process_close(struct process *process);
/* What can be read of a stopped thread from outside: mask, robust list, rseq, scheduling. */
int thread_read(struct thread *thread, struct avc_error *err) warn_unused;
/* What only a thread itself can query (clear_child_tid, sigaltstack, credentials): added to calls
 * that it makes anyway, and their results.  `with_locks`: also what its process locks in future
 * (mlockall(2)), for which it temporarily has one more mapping. */
void thread_ask_add(const struct process *process, bool with_locks, struct inj_call *call,
		    struct questions *questions);
int thread_ask_answer(struct process *process, struct thread *thread, const struct inj_call *call,
		      const struct questions *questions, struct avc_error *err) warn_unused;
/* Has a stopped thread make only those; if it is the main thread, thread_ask_others(). */
int thread_ask(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
/* If the main thread's credentials have changed since `was`: all threads may have changed theirs
 * (nptl(7), setuid(3)), so they have to be queried again, too (AVC_RETRY). */
int thread_ask_others(struct process *process, const struct thread *thread, const struct creds *was,
		      struct avc_error *err) warn_unused;
/* Lists the threads there are now; those that ended are forgotten. */
int process_list_threads(struct process *process, struct avc_error *err) warn_unused;
/* Before a freeze: queries every thread that is not known yet, while all of them are stopped.  Up to
 * *later of them, which then counts down, are left to the freeze. */
int process_query_new_threads(struct process *process, timer_t timer, uint64_t deadline_ns,
			      uint32_t *later, struct avc_error *err) warn_unused;

/* ---- fence.c -------------------------------------------------------------------- */

/* Adds calls to those that a thread makes, with 16 bytes at `out` (its own address). */
void fence_ask(const struct process *process, struct inj_call *call, avc_remote out,
	       struct questions *questions);
/* Sets creds.fenced.  AVC_RETRY: the holder was too old to tell. */
int fence_answer(struct process *process, struct thread *thread, const struct questions *questions,
		 struct avc_error *err) warn_unused;

/* ---- dying.c ------------------------------------------------------------------- */

/* Before a freeze: notes for which fatal signals it has handlers. */
void dying_note_caught(struct process *process, const struct proc_status *status);
/* In a freeze: before its threads are checked, and when none was in a handler. */
void dying_begin(struct process *process);
void dying_end(struct process *process);
/* For a stopped thread that was read: AVC_RETRY, it is in the handler of a fatal signal. */
int dying_check(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
/* Whether one of the (stopped) threads is in a handler that returns to what a dead guard has left: a
 * thread that goes home by itself may get a signal on the way. */
bool process_needs_old(const struct process *process);
/* Whether no (stopped) thread is in the parasite, nor in a handler that returns there. */
bool process_is_home(const struct process *process);

/* ---- stop.c --------------------------------------------------------------------- */

/* Before any stop: fails with AVC_GONE when a signal is killing it.  A stop would wake the thread that
 * writes its core into a pipe, and the kernel would give the core up (fs/coredump.c, dump_emit()). */
int process_check_dying(const struct process *process, struct avc_error *err) warn_unused;
/* Stops every thread of one process; process_let_go() releases them.  A thread of ordinary priority
 * may have to wait for a CPU before it stops, during which one of real-time priority should not
 * stand still: those are stopped last and released first. */
int process_stop(struct process *process, struct avc_error *err) warn_unused;
/* The same in parts, for several at a time: forgets the state of the last freeze; interrupts known
 * threads of one kind, and says whether there are any of the other; waits for those; waits for all,
 * and finds the others. */
void process_stop_begin(struct process *process);
bool process_interrupt(struct process *process, bool real_time);
int process_await(struct process *process, struct avc_error *err) warn_unused;
int process_stop_all(struct process *process, struct avc_error *err) warn_unused;
void process_let_go(struct process *process);
/* Ends a stop of the whole process that began with rt_priority_begin() and tracee_deadline_set(): all run
 * again. */
void process_go_on(struct process *process, timer_t timer);

/* ---- infect.c ----------------------------------------------------------------- */

/* Injects the parasite by the main thread.  The other threads keep running. */
int process_infect(struct process *process, uint32_t slots, timer_t timer, uint64_t deadline_ns,
		   struct avc_error *err) warn_unused;
/* The same while everything is stopped. */
int process_infect_stopped(struct process *process, uint32_t slots,
			   struct avc_error *err) warn_unused;
/* Erases the stubs that have stayed (cave.c).  No thread may be in one, or need it
 * (process_needs_old()). */
void process_drop_stubs(struct process *process);

/* ---- holder.c ----------------------------------------------------------------- */

/* Makes the holder. */
int process_hold(struct process *process, timer_t timer, uint64_t deadline_ns,
		 struct avc_error *err) warn_unused;
/* The same of one that is not the main process, by its stopped main thread. */
int process_hold_stopped(struct process *process, pid_t init, struct avc_error *err) warn_unused;
/* Drops it.  process_unhold_soon() does not wait until its descriptors are closed and its memory is
 * freed. */
void process_unhold(struct process *process);
void process_unhold_soon(struct process *process);
/* From then on the holder belongs to the caller, with its pidfd (-1: there was none). */
pid_t process_detach_holder(struct process *process, int *pidfd);
/* Whether it has other directories, or another umask (-1: to be looked up), than its holder, which
 * its templates get. */
bool process_has_moved(struct process *process, int32_t umask);
/* Makes a stopped process that adopts orphans (PR_SET_CHILD_SUBREAPER) leave them to init.  If we
 * die meanwhile, it resumes by itself. */
int process_pause_adoption(struct process *process, struct avc_error *err) warn_unused;
int process_resume_adoption(struct process *process, struct avc_error *err) warn_unused;

/* ---- executed.c ---------------------------------------------------------------------- */

/* Whether the (running, infected) process has executed another program: parasite and holder are of
 * the old one. */
bool process_has_executed(const struct process *process);
/* From now on process->exec_sign.fd becomes ready (poll(2)) when it has, or when its main thread
 * has ended.  false: the kernel does not support this. */
bool process_listen_for_exec(struct process *process);
void process_listen_no_more(struct process *process);

/* ---- watcher.c -------------------------------------------------------------------- */

/* Before the guard comes under a filter, if it needs one.  False: there is none. */
bool watcher_start(void);
bool watcher_is_there(void);
/* Has a task, which makes that call and has no tracer, make it (TRACKER_UFFD_FLAGS). The task is
 * killed.  -1: it did not. */
int watcher_open(pid_t tid, int pidfd) warn_unused;

/* ---- tracker.c -------------------------------------------------------------------- */

/* Sets that scans add to. */
#define TRACKER_SETS (AVC_KEEP_MAX + 3)

/* Watches a process's private memory: the kernel records which pages are written, in the process's
 * page table, without a fault that has to be handled.  When our descriptor, the last one, is
 * closed, nothing of it remains in the process. */
#ifndef UFFD_USER_MODE_ONLY
#define UFFD_USER_MODE_ONLY 1 /* linux/userfaultfd.h */
#endif
#define TRACKER_UFFD_FLAGS (O_CLOEXEC | UFFD_USER_MODE_ONLY)

struct tracker {
	uint64_t number; /* unique: results of another tracker do not count               */
	int uffd, pagemap;
	uint32_t areas, area_room; /* the mappings that are watched, in order             */
	struct stretch {
		avc_remote start, end;
	} * area;
	uint32_t files, file_room; /* those of files                                      */
	struct stretch *file;
	uint64_t scanned_ns;       /* when the last scan ended                           */
	uint32_t parts, part_room; /* where they have pages of their own, in chunks       */
	struct stretch *part;
	struct pageset found;
	struct pageset of_files; /* pages of private mappings of files, found in a scan   */
	struct pageset *set[TRACKER_SETS];
	uint32_t sets;
	bool over;   /* its process has ended                                   */
	bool broken; /* incomplete: out of memory                               */
};

/* By a task with the memory of the holder.  AVC_UNSUPPORTED: the kernel cannot do it. */
int tracker_begin(struct process *process, timer_t timer, struct avc_error *err) warn_unused;
void tracker_end(struct process *process);
/* Watches all its private mappings, as listed in `layout`, a fresh /proc/PID/maps.
 * AVC_UNSUPPORTED: some cannot be watched. */
int tracker_watch(struct process *process, char *layout, struct avc_error *err) warn_unused;
/* Adds pages written since the last scan to all sets; `template`: its own pages also count as
 * written where the process was not known to have any, 0: none.  *pages: how many.  -1: not all of
 * it is watched any more. */
int tracker_scan(struct tracker *tracker, pid_t template, uint64_t *pages) warn_unused;
/* Scans add to this set from now on, or no more. */
bool tracker_add(struct tracker *tracker, struct pageset *set);
void tracker_remove(struct tracker *tracker, const struct pageset *set);

/* ---- support.c --------------------------------------------------------------------- */

/* Looks at a running app for what cannot be protected.  0, or -1 with
 * AVC_UNSUPPORTED and the reason in words. */
int support_check(struct process *process, const struct process *parent,
		  struct avc_error *err) warn_unused;
/* True if no thread seems to be in the middle of work. */
bool process_is_quiescent(const struct process *process);

/* ---- tree.c --------------------------------------------------------------------- */

/* Of an app with this main process.  -1: out of memory. */
int tree_init(struct tree *tree, struct process *main) warn_unused;
/* Finds all processes; opens new ones. */
int tree_scan(struct tree *tree, struct avc_error *err) warn_unused;
/* After the clones: AVC_RETRY if one of those made meanwhile is not known, and not in a parasite. */
int tree_check_made(const struct tree *tree, bool (*is_known)(pid_t pid, const void *arg),
		    const void *arg, struct avc_error *err) warn_unused;
/* Whether entry[i] or an ancestor adopts orphans, or could not be queried for that. */
bool tree_has_reaper(const struct tree *tree, uint32_t i);
/* Whether this is in one of their parasites: then the task there is not the app's. */
bool tree_has_parasite(const struct tree *tree, avc_remote pc);
/* Whether entry[i] shares its parent's memory: after vfork(2) until it has executed a program. */
bool tree_shares_memory(const struct tree *tree, uint32_t i);
/* Frees those that have ended and of which there is no image. */
void tree_sweep(struct tree *tree);
/* It has ended, or executed another program: we must not keep its descriptors open. */
void tree_let_go(struct process *process);
/* Of all but the main process, which is the caller's. */
void tree_free(struct tree *tree);

/* ---- waits.c ---------------------------------------------------------------------- */

/* Before a freeze: rewind_prepare() for its threads. */
void waits_prepare(struct process *process);
/* Ends rewound calls whose time is up; the next is due at process->due_ns (UINT64_MAX: none). */
void waits_end(struct process *process, timer_t timer);

#endif
