/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard's state, and what its files share.
 *
 *   guard.c             waits, executes commands, reports
 *   guard_configure.c   its settings
 *   guard_generations.c which generations are held
 *   guard_checkpoint.c  when and how a checkpoint is taken
 *   guard_death.c       what follows a death
 *   guard_group.c       ... together with others
 *   guard_memory.c      which of its processes the OOM killer takes first
 *   guard_tasks.c       how many of its container's tasks may be ours
 *   guard_pace.c        when the next checkpoint is worth its cost
 *   filter.c            its own seccomp filter
 *   thread_events.c     perf events of all threads of the app
 *   output.c            ... which detect that the app sends
 *   faults.c            ... or has handled a fault
 *   policy.c            the decisions behind these
 */
#ifndef AVCKPT_GUARD_H
#define AVCKPT_GUARD_H

#include <poll.h>

#include "avckpt/guard.h"
#include "policy.h"
#include "restore.h"

#define OUTBOX_MAX 64 /* events that the daemon has not taken yet                */
#define DYING_NS NS_PER_S
/* A crash is often followed by another one, before the core of the first is written. */
#define REMAINS_MAX 2
#define AHEAD_AFTER_NS (20 * NS_PER_MS) /* the app was stopped, and goes first               */

/* A perf event of one thread, inherited by the threads that it creates. */
struct thread_event {
	int fd;
	pid_t tid, leader;
	uint64_t start;
	uint64_t heard; /* so many times */
};

struct thread_event_kind {
	const char *tracepoint; /* below the root of tracefs              */
	const char *filter;     /* what counts, or NULL: everything       */
	bool signals;           /* each one sends us SIGIO                */
};

/* All zero at the start. */
struct thread_events {
	int number; /* of the tracepoint; 0: not looked up yet, -1: it cannot be used */
	uint32_t count;
	struct thread_event *event;
};

/* All zero at the start. */
struct output {
	struct thread_events events;
	int signal_fd;
	bool begun, armed;
};

/* All zero at the start. */
struct faults {
	struct thread_events events;
	bool armed;
	uint64_t heard_ns; /* the last one; 0: none since it was armed              */
	uint32_t put_off;  /* the checkpoint that is due: so many times      */
	uint32_t survived; /* checkpoints that were put off, and then taken  */
};

/* A death after which the whole group goes back. */
struct group_death {
	bool waits; /* for the group                                    */
	struct avc_report report;
	enum avc_reason reason;
	uint64_t ticket, until_ns;
	uint32_t had; /* generations when it died                         */
	struct group_ended ended;
};

struct avc_guard {
	struct avc_config config;
	uint64_t cookie;
	int socket; /* to the daemon (avckpt/guard.h)                   */
	bool stop;  /* requested by the daemon, or it is gone           */
	struct avc_event outbox[OUTBOX_MAX];
	uint32_t outbox_count;
	timer_t timer;
	struct init_channel channel;
	struct last_pid *helper; /* of the restore that is about to begin           */
	uint64_t helper_for;     /* number of its generation                        */
	bool attached, unprotected;
	bool filter_decided; /* whether it has a seccomp filter of its own      */
	struct process main; /* the app's main process                         */
	struct tree tree;    /* it and the others                              */
	struct pollfd *fds;  /* room for wait_for_news()                       */
	nfds_t fds_room;
	struct generation generations[AVC_KEEP_MAX]; /* oldest first            */
	uint32_t count;
	struct dirty_tree dirty;
	uint64_t number; /* of the last generation taken             */
	uint64_t started_ns, next_ns, stragglers_since_ns, told_stragglers_ns;
	uint64_t dying_until_ns; /* the app was found dying: guard_reap_unknown() until then */
	uint64_t tables_ns;      /* when the last look at shared tables was  */
	bool cramped;            /* there is no room for spares              */
	uint64_t spare_ns;       /* when the last spare was made             */
	uint64_t ahead_ns;       /* when to guard_work_ahead(); UINT64_MAX: never  */
	uint64_t hold_ns;        /* when to guard_hold_missing(); UINT64_MAX: never */
	uint32_t hold_tries;
	struct policy policy; /* held[i] belongs to generations[i]        */
	uint32_t restores;
	uint64_t restore_ticket;       /* of a command that has killed the app     */
	enum avc_reason restore_asked; /* NONE: not requested                      */
	uint64_t restore_generation;   /* requested by it; 0: the newest           */
	uint64_t init_seen_ns;         /* alive, during a restore                  */
	uint64_t late_ns;              /* when it is too late for a restore; 0: never */
	struct files_written *written; /* avckpt.files; NULL: not watched           */
	struct policy_pace pace;       /* avckpt.interval=auto                      */
	/* CPU time of the guard: since the last checkpoint, and when the current work began.
	 * CPU time and faults of the app: as of the last checkpoint. */
	uint64_t pace_cpu_ns, pace_began_ns, pace_app_cpu_ns, pace_faults;
	uint64_t held_ns;      /* the app was stopped, by all attempts at this one */
	uint64_t writes_ns;    /* its first writes have taken since the last one; auto: 0 */
	struct policy_run ran; /* up to that one */
	uint64_t looked_ns;    /* at whether the main process has ended (take())    */
	struct output output;
	struct faults faults;
	uint64_t sent_ns;              /* when the app was last seen to send; 0: never      */
	bool sent;                     /* since the last checkpoint                         */
	struct avc_meeting *meeting;   /* of the group, under way; NULL: none             */
	uint32_t members, steps, step; /* of the meeting; step: the next one        */
	uint64_t line, recall;         /* ... its line, and the generation to go back to */
	struct group_death dead;
	bool urgent;             /* it goes back because others do: rt_priority_end() is due */
	pid_t daemon;            /* our parent                                      */
	struct avc_event untold; /* checkpoints not reported yet                    */
	uint64_t told_ns;        /* when checkpoints were last reported             */
	/* The holders of dead apps, for tools that read their memory; oldest first */
	struct {
		pid_t pid;
		int pidfd;
		uint64_t until_ns;
	} remains[REMAINS_MAX];
	uint32_t remains_count;
	pid_t unseen; /* the same, as told to the daemon, which has to look yet; 0: need not */
};

/* ---- guard.c: events ------------------------------------------------------- */

struct avc_event guard_event(const struct avc_guard *guard, enum avc_event_kind kind);
void guard_emit(struct avc_guard *guard, const struct avc_event *event);
/* Without waking the daemon now: it is sent with the next one, or by guard_send_posted(). */
void guard_post(struct avc_guard *guard, const struct avc_event *event);
void guard_send_posted(struct avc_guard *guard);
void guard_emit_error(struct avc_guard *guard, enum avc_event_kind kind, uint64_t ticket,
		      const struct avc_error *error);
void guard_refuse(struct avc_guard *guard, uint64_t ticket, enum avc_code code, const char *why);

/* Before the container ends: gives the daemon a moment to look at the memory of the dead. */
void guard_await_seen(struct avc_guard *guard);

/* Releases threads that stop late or return late; how many are left. */
uint32_t guard_tend_stragglers(struct avc_guard *guard);
/* Calls of the app that a checkpoint has interrupted: ends those whose time is up.  When the next
 * one is due. */
uint64_t guard_end_waits(struct avc_guard *guard);

/* ---- guard_configure.c ----------------------------------------------------- */

void guard_set_config(struct avc_guard *guard, const struct avc_config *config);
/* Generations stay, unless there are more than are to be kept now. */
void guard_take_config(struct avc_guard *guard, const struct avc_config *config);

/* ---- guard_generations.c --------------------------------------------------- */

void guard_drop_generation(struct avc_guard *guard, uint32_t i);
void guard_drop_all(struct avc_guard *guard);
/* Its index, or -1: it is not held. */
int guard_find_generation(const struct avc_guard *guard, uint64_t number);
/* Before a restore of that one: all newer ones become invalid.  If it was lost since the request,
 * the next older one is the best there is. */
void guard_drop_newer(struct avc_guard *guard, uint64_t number);
uint32_t guard_free_slot(const struct avc_guard *guard);
void guard_lose_generation(struct avc_guard *guard, uint32_t i, enum avc_reason reason,
			   uint64_t ticket);
/* A template or holder. */
bool guard_owns(pid_t pid, const void *guard);
/* Gives up a process that is gone.  We must not keep its descriptors open: a reader may be waiting
 * for the end of a pipe. */
void guard_release(struct avc_guard *guard, struct process *process);
/* Releases processes of the app that have ended; guard_tend_tree(): or executed a program. */
void guard_let_ended_go(struct avc_guard *guard);
void guard_tend_tree(struct avc_guard *guard);
/* Releases processes that have executed another program, and with it lost the parasite; `all`: also
 * those whose check is not due.  Returns whether there was one. */
bool guard_let_executed_go(struct avc_guard *guard, bool all);
/* This descriptor became readable: its process is checked next. */
void guard_hear_exec(struct avc_guard *guard, int fd);
/* When the next check is due: CLOCK_MONOTONIC, UINT64_MAX: never. */
uint64_t guard_exec_check_due(const struct avc_guard *guard);
/* Our tracees that are on no list. */
void guard_kill_lost(struct avc_guard *guard);
void guard_await_spares(struct avc_guard *guard);
/* Waits for those that are just ending, for 50 ms at most, also until init has reaped them: until then
 * they count where processes are limited. */
void guard_wait_ended(struct avc_guard *guard);
void guard_reap_dead(struct avc_guard *guard);
/* A tracee that is a known thread of the app, or ours (tracee_know()). */
bool guard_knows_tracee(pid_t tid, const void *guard);
void guard_reap_unknown(const struct avc_guard *guard);
/* Returns the number of the generation that it replaces, 0: none. */
uint64_t guard_keep_generation(struct avc_guard *guard, struct generation *fresh);
/* After a crash with that status: leaves the generation to restore from as the newest, or none;
 * returns why there is none. */
enum avc_reason guard_fall_back(struct avc_guard *guard, int status, bool hung);
void guard_note_written(struct avc_guard *guard);
int guard_check_files(struct avc_guard *guard, const struct generation *generation, pid_t pid,
		      int pidfd, struct avc_error *err) warn_unused;

/* ---- guard_memory.c ------------------------------------------------------- */

/* Sets which of our processes the OOM killer takes, and when.  After each change of generations. */
void guard_rank_generations(struct avc_guard *guard);
/* Whether the app alone fills its container's memory: if restored to this state, it would be
 * killed again at once. */
bool guard_app_is_full(const struct avc_guard *guard);
/* Whether there is memory for copies: what templates then have of their own must fit into the
 * container's limit, beside the app; without one, into a part of what the host has available. */
bool guard_has_room_for_copies(const struct avc_guard *guard);

/* ---- guard_tasks.c --------------------------------------------------------- */

/* After tree_scan(), and before any process is given a holder: gives up what another checkpoint leaves
 * no room for.  -1: that is not enough. */
int guard_make_room_for_tasks(struct avc_guard *guard, struct avc_error *err) warn_unused;

/* ---- guard_checkpoint.c ---------------------------------------------------- */

void guard_unprotect(struct avc_guard *guard, uint64_t ticket, const struct avc_error *error);
int guard_find_app(struct avc_guard *guard, struct avc_error *err);
void guard_checkpoint(struct avc_guard *guard, uint64_t ticket);
/* Threads of the app do not stop: reports `error`, or a more specific reason if it finds one. */
void guard_tell_unstoppable(struct avc_guard *guard, const struct avc_error *error);
/* Does some of the work of a restore from the newest generation in advance; not while processes of
 * ours are ending, which takes a CPU as well. */
void guard_work_ahead(struct avc_guard *guard);

/* ---- guard_pace.c ----------------------------------------------------------- */

/* Around all work for checkpoints: its CPU time is counted. */
void guard_pace_begin(struct avc_guard *guard);
void guard_pace_end(struct avc_guard *guard);
/* Why the next one is not to be a copy, although it may be possible; or NONE. */
enum avc_fork_reason guard_why_fork(struct avc_guard *guard);
/* After guard_pace_begin(): a checkpoint was taken, or failed.  Both set when to look again. */
void guard_pace_taken(struct avc_guard *guard, const struct avc_event *event);
void guard_pace_missed(struct avc_guard *guard);
void guard_pace_restored(struct avc_guard *guard);
/* Checks whether the app has sent. */
void guard_pace_listen(struct avc_guard *guard);
/* When a look is due: whether a checkpoint is due now. */
bool guard_pace_wants(struct avc_guard *guard);
/* When only a look is due: true if no checkpoint is; then the time of the next look is set. */
bool guard_pace_dozes(struct avc_guard *guard);
/* Reports a checkpoint, now or soon; reports those not reported yet; when that is due. */
void guard_tell_taken(struct avc_guard *guard, struct avc_event *event);
void guard_tell_untold(struct avc_guard *guard);
/* They are reported otherwise.  False: there are none. */
bool guard_take_untold(struct avc_guard *guard, struct avc_event *event);
uint64_t guard_tell_due(const struct avc_guard *guard);

/* ---- thread_events.c ------------------------------------------------------- */

/* Looks the tracepoint up: it takes calls that the guard's own filter does not allow. */
void thread_events_learn(struct thread_events *events, const struct thread_event_kind *kind);
/* Of all threads of all existing processes.  False: there are none, and never will be. */
bool thread_events_enable(struct thread_events *events, const struct thread_event_kind *kind,
			  const struct tree *tree);
void thread_events_disable(const struct thread_events *events);
/* Whether it has happened, while they were enabled, since the last call. */
bool thread_events_heard(struct thread_events *events);
/* For now, and for good. */
void thread_events_drop(struct thread_events *events);
void thread_events_close(struct thread_events *events);

/* ---- output.c --------------------------------------------------------------- */

/* thread_events_learn() */
void output_learn(struct output *output);
/* From now on the next output of any existing process is detected; a second call changes nothing.
 * Best effort. */
void output_arm(struct output *output, const struct tree *tree);
void output_disarm(struct output *output);
/* Readable after output; -1: not armed. */
int output_fd(const struct output *output);
/* Whether there was output.  Then it is no longer armed. */
bool output_heard(struct output *output);
void output_end(struct output *output);

/* ---- faults.c --------------------------------------------------------------- */

/* thread_events_learn() */
void faults_learn(struct faults *faults);
/* When to begin counting before a checkpoint that is due then; UINT64_MAX: need not. */
uint64_t faults_due(const struct faults *faults, const struct tree *tree, uint64_t checkpoint_ns);
void faults_arm(struct faults *faults, const struct tree *tree);
/* What has been heard is of no importance any more. */
void faults_disarm(struct faults *faults);
/* A checkpoint has been taken or missed; the next one is due then. */
void faults_settle(struct faults *faults, const struct tree *tree, uint64_t next_ns);
/* Whether there was one since the last look. */
bool faults_heard(struct faults *faults);
/* Until when a checkpoint that is due now is put off; 0: it is not. */
uint64_t faults_put_off(struct faults *faults, uint64_t now);
void faults_end(struct faults *faults);

/* ---- filter.c --------------------------------------------------------------- */

/* Comes under it, with all threads, for good.  0 or -1. */
int guard_filter_enter(void) warn_unused;
/* The same, once all of the app's threads have been looked at, if none has filters that may have to
 * be suspended. */
void guard_filter(struct avc_guard *guard);

/* ---- guard_death.c --------------------------------------------------------- */

void guard_app_died(struct avc_guard *guard, const struct avc_report *report);
/* init has ended as well, as it does at once when there is nothing to be restored: tells why. */
void guard_app_ended(struct avc_guard *guard, const struct avc_report *report);
/* The memory of a dead app is not read any more. */
void guard_release_remains(struct avc_guard *guard, pid_t pid);
/* No more than that many are to be left. */
void guard_release_oldest_remains(struct avc_guard *guard, uint32_t left);
/* Releases them when they were killed, or their time is up. */
void guard_tend_remains(struct avc_guard *guard);
/* From here to restore_patience_end(): what a restore waits for is waited for, and init told. */
void guard_begin_patience(struct avc_guard *guard);
/* Restores from the newest generation; if that fails, from the one before it; in a group only from
 * the newest.  `had`: how many there were when the app died. */
bool guard_bring_back(struct avc_guard *guard, const struct avc_report *report,
		      enum avc_reason reason, uint32_t had, struct avc_error *error);
void guard_give_up(struct avc_guard *guard, const struct avc_report *report, enum avc_reason reason,
		   const struct avc_error *error);
/* After a restore: another death soon after should cost no more than the first. */
void guard_hold_all(struct avc_guard *guard);
/* The same, when hold_ns has come. */
void guard_hold_missing(struct avc_guard *guard);

/* ---- guard_group.c --------------------------------------------------------- */

/* The daemon's requests; `fd` stays the caller's. */
void guard_take_line(struct avc_guard *guard, const struct avc_request *request, int fd);
void guard_recall(struct avc_guard *guard, const struct avc_request *request, int fd);
void guard_abandon(struct avc_guard *guard, uint64_t ticket);
/* Of a checkpoint: ready to freeze; frozen (freeze.meet); complete. */
int guard_meet_ready(struct avc_guard *guard, struct avc_error *err) warn_unused;
int guard_meet_frozen(void *guard, struct generation *whole, struct avc_error *err) warn_unused;
int guard_meet_taken(struct avc_guard *guard, struct avc_error *err) warn_unused;
/* Index of the generation that all members replace by the line just taken. */
uint32_t guard_line_replaced(const struct avc_guard *guard);
/* Of a restore: complete. */
int guard_meet_restored(struct avc_guard *guard, struct avc_error *err) warn_unused;
/* It has gone back, or does not: what waited for it needs no more haste. */
void guard_end_recall(struct avc_guard *guard);
/* There is no meeting, or its next step can still be reached. */
bool guard_may_meet(const struct avc_guard *guard);
/* Breaks it, unless all its steps were reached. */
void guard_leave_meeting(struct avc_guard *guard);
/* The app has died, with all its processes: it goes back with the group. */
void guard_go_back(struct avc_guard *guard, const struct avc_report *report, enum avc_reason reason,
		   uint32_t had);
/* While a dead app waits for its group: gives it up when that takes too long. */
void guard_tend_dead(struct avc_guard *guard);

/* ---- guard.c ---------------------------------------------------------------- */

/* One guard, from AVC_REQUEST_START on `socket` to its end.  Returns the exit status: 0, unless it
 * could not start. */
int guard_run(int socket);

/* ---- probe.c ---------------------------------------------------------------- */

/* Whether this machine and this process support it.  Touches no process but its own child. */
int guard_probe(struct avc_error *err);

#endif
