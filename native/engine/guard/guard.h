/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard's own state, and what its files give each other.
 *
 *   guard.c             waits, obeys, tells
 *   guard_configure.c   what it is told to do
 *   guard_generations.c which generations are held
 *   guard_checkpoint.c  when and how a checkpoint is taken
 *   guard_death.c       what follows a death
 *   guard_group.c       ... together with others
 *   guard_pace.c        when the next checkpoint is worth its price
 *   output.c            hears that the app sends
 *   policy.c            what is decided in these
 */
#ifndef AVCKPT_GUARD_H
#define AVCKPT_GUARD_H

#include <poll.h>

#include "avckpt/guard.h"
#include "policy.h"
#include "restore.h"

#define OUTBOX_MAX 64 /* events that the daemon has not taken yet                */
#define DYING_NS NS_PER_S
#define AHEAD_AFTER_NS (20 * NS_PER_MS) /* the app has been held up, and goes first          */

/* A descriptor each, of a thread and what it makes. */
struct output_event {
	int fd;
	pid_t tid, leader;
	uint64_t start;
};

/* All zero at the start. */
struct output {
	int tracepoint; /* its number; 0: not looked for yet, -1: there is none   */
	int signal_fd;
	bool armed;
	uint32_t count;
	struct output_event *event;
};

/* A death that is undone together with the group. */
struct group_death {
	bool waits; /* for the group                                    */
	struct avc_report report;
	enum avc_reason reason;
	uint64_t ticket, until_ns;
	uint32_t had;   /* generations when it died                         */
	uint32_t ended; /* connections that could not go back with it       */
};

struct avc_guard {
	struct avc_config config;
	uint64_t cookie;
	int socket; /* to the daemon (avckpt/guard.h)                   */
	bool stop;  /* the daemon wants it to, or is gone               */
	struct avc_event outbox[OUTBOX_MAX];
	uint32_t outbox_count;
	timer_t timer;
	struct init_channel channel;
	struct last_pid *helper; /* of the restore that is about to begin           */
	uint64_t helper_for;     /* number of its generation                        */
	pid_t foreseen;          /* the main process whose end has been seen        */
	bool attached, unprotected;
	struct process main; /* the app's main process                         */
	struct tree tree;    /* it and the others                              */
	struct pollfd *fds;  /* room for wait_for_news()                       */
	nfds_t fds_room;
	struct generation generations[AVC_KEEP_MAX]; /* oldest first            */
	uint32_t count;
	struct dirty_tree dirty;
	uint64_t number; /* of the last generation taken             */
	uint64_t started_ns, next_ns, stragglers_since_ns, told_stragglers_ns;
	uint64_t dying_until_ns; /* it was found dying: guard_reap_unknown() until then    */
	bool cramped;            /* there is no room for spares              */
	uint64_t spare_ns;       /* when the last one was made               */
	uint64_t ahead_ns;       /* when to guard_work_ahead(); UINT64_MAX: never  */
	struct policy policy;    /* held[i] is of generations[i]             */
	uint32_t restores;
	uint64_t restore_ticket;       /* of a command that has killed the app     */
	enum avc_reason restore_asked; /* NONE: nobody has                      */
	uint64_t restore_generation;   /* by that command; 0: the newest          */
	uint64_t late_ns;              /* when a restore is not wanted any more; 0: never */
	struct files_written *written; /* avckpt.files; NULL: not watched           */
	struct policy_pace pace;       /* avckpt.interval=auto                      */
	/* Of us, since the last checkpoint and at the begin of what we do now; of the app, at
	 * the last checkpoint. */
	uint64_t pace_cpu_ns, pace_began_ns, pace_app_cpu_ns, pace_faults;
	struct output output;
	uint64_t sent_ns;              /* when it was heard last; 0: never                  */
	bool sent;                     /* since the last checkpoint                         */
	struct avc_meeting *meeting;   /* of the group, that is under way; NULL: none     */
	uint32_t members, steps, step; /* of it; the step that comes next           */
	uint64_t line, recall;         /* ... its line, and the generation to go back to */
	struct group_death dead;
	struct avc_event untold; /* checkpoints that were not told of yet          */
	uint64_t told_ns;        /* of the last that were                           */
	/* The holder of an app that has died, for whoever looks at its memory; 0: there is none */
	struct {
		pid_t pid;
		int pidfd;
		uint64_t until_ns;
	} remains;
};

/* ---- guard.c: what is told ------------------------------------------------- */

struct avc_event guard_event(const struct avc_guard *guard, enum avc_event_kind kind);
void guard_emit(struct avc_guard *guard, const struct avc_event *event);
void guard_emit_error(struct avc_guard *guard, enum avc_event_kind kind, uint64_t ticket,
		      const struct avc_error *error);
void guard_refuse(struct avc_guard *guard, uint64_t ticket, enum avc_code code, const char *why);

/* Looks after the threads that are on their way back; how many are left. */
uint32_t guard_tend_stragglers(struct avc_guard *guard);

/* ---- guard_configure.c ----------------------------------------------------- */

void guard_set_config(struct avc_guard *guard, const struct avc_config *config);
/* What is held stays, unless there are more than are wanted now. */
void guard_take_config(struct avc_guard *guard, const struct avc_config *config);

/* ---- guard_generations.c --------------------------------------------------- */

void guard_drop_generation(struct avc_guard *guard, uint32_t i);
void guard_drop_all(struct avc_guard *guard);
/* Its index, or -1: it is not held. */
int guard_find_generation(const struct avc_guard *guard, uint64_t number);
/* Somebody wants that one: of what came after it nothing is true any more.  If it was lost since
 * it was asked for, the next older one is as near as it gets. */
void guard_drop_newer(struct avc_guard *guard, uint64_t number);
uint32_t guard_free_slot(const struct avc_guard *guard);
void guard_lose_generation(struct avc_guard *guard, uint32_t i, enum avc_reason reason,
			   uint64_t ticket);
/* A template or holder; with the app's own processes. */
bool guard_owns(pid_t pid, const void *guard);
bool guard_knows_process(pid_t pid, const void *guard);
/* Gives up a process that is gone.  What it had open must not stay open by us: somebody may
 * be reading a pipe to its end. */
void guard_release(struct avc_guard *guard, struct process *process);
/* Processes of the app that have ended, or are another program now. */
void guard_let_ended_go(struct avc_guard *guard);
void guard_tend_tree(struct avc_guard *guard);
/* Gives up what was brought into processes that have executed another program since;
 * `all`: whether or not it is time to look.  When it is: CLOCK_MONOTONIC, UINT64_MAX: never. */
bool guard_let_executed_go(struct avc_guard *guard, bool all);
/* There is news of this descriptor: that process is looked at next. */
void guard_hear_exec(struct avc_guard *guard, int fd);
uint64_t guard_exec_check_due(const struct avc_guard *guard);
/* Tracees of ours that nobody knows of. */
void guard_kill_lost(struct avc_guard *guard);
void guard_await_spares(struct avc_guard *guard);
/* Those that are just ending, for 50 ms at most. */
void guard_wait_ended(void);
void guard_reap_dead(struct avc_guard *guard);
/* A tracee that is a thread of the app's, or ours (tracee_know()). */
bool guard_knows_tracee(pid_t tid, const void *guard);
void guard_reap_unknown(const struct avc_guard *guard);
void guard_keep_generation(struct avc_guard *guard, struct generation *fresh);
/* After a crash with that status: leaves the generation to restore from as the newest, or none, and
 * then says why. */
enum avc_reason guard_fall_back(struct avc_guard *guard, int status, bool hung);
void guard_note_written(struct avc_guard *guard);
int guard_check_files(struct avc_guard *guard, const struct generation *generation, pid_t pid,
		      int pidfd, struct avc_error *err) warn_unused;

/* ---- guard_memory.c ------------------------------------------------------- */

/* Tells the OOM killer whom of ours to take, and when.  After each change of what is held. */
void guard_rank_generations(struct avc_guard *guard);
/* Whether the app fills its container's memory by itself: to go back to now would be to be
 * killed again at once. */
bool guard_app_is_full(const struct avc_guard *guard);

/* ---- guard_checkpoint.c ---------------------------------------------------- */

void guard_unprotect(struct avc_guard *guard, uint64_t ticket, const struct avc_error *error);
int guard_find_app(struct avc_guard *guard, struct avc_error *err);
void guard_checkpoint(struct avc_guard *guard, uint64_t ticket);
/* Threads of it do not stop; or is there a better reason than that? */
void guard_tell_unstoppable(struct avc_guard *guard, const struct avc_error *error);
/* Of what a restore from the newest generation can be spared, some; when nobody is just ending,
 * which takes a CPU as well. */
void guard_work_ahead(struct avc_guard *guard);

/* ---- guard_pace.c ----------------------------------------------------------- */

/* Around whatever is done for checkpoints: its CPU time is counted. */
void guard_pace_begin(struct avc_guard *guard);
void guard_pace_end(struct avc_guard *guard);
/* After guard_pace_begin(): that was one, or none.  They say when to look again. */
void guard_pace_taken(struct avc_guard *guard, const struct avc_event *event);
void guard_pace_missed(struct avc_guard *guard, uint64_t held_ns);
void guard_pace_restored(struct avc_guard *guard);
/* Looks whether the app has sent. */
void guard_pace_listen(struct avc_guard *guard);
/* It is time to look: whether a checkpoint is due now. */
bool guard_pace_wants(struct avc_guard *guard);
/* It is time to look, and nothing else: whether the next look is all that there is to wait for. */
bool guard_pace_dozes(struct avc_guard *guard);
/* Tells of a checkpoint, or soon; of those that were not told yet; when that is due. */
void guard_tell_taken(struct avc_guard *guard, struct avc_event *event);
void guard_tell_untold(struct avc_guard *guard);
uint64_t guard_tell_due(const struct avc_guard *guard);

/* ---- output.c --------------------------------------------------------------- */

/* From now on the next output is heard, of all processes that there are; a second time changes
 * nothing.  Where that is not to be had, nothing is heard. */
void output_arm(struct output *output, const struct tree *tree);
void output_disarm(struct output *output);
/* Readable when there is some; -1: it is not armed. */
int output_fd(const struct output *output);
/* Whether there was some.  Then it is not armed any more. */
bool output_heard(struct output *output);
void output_end(struct output *output);

/* ---- guard_death.c --------------------------------------------------------- */

/* The main process has ended; init has not told how yet, and whether it is restored is open. */
void guard_app_dies(struct avc_guard *guard);
void guard_app_died(struct avc_guard *guard, const struct avc_report *report);
/* Nobody looks at the dead app's memory any more. */
void guard_release_remains(struct avc_guard *guard);
/* They were killed, or looked at for long enough. */
void guard_tend_remains(struct avc_guard *guard);
/* The newest generation; when restores are used up, the one before it.  There were `had` when
 * the app died.  Of a group: the newest, or none. */
bool guard_bring_back(struct avc_guard *guard, const struct avc_report *report,
		      enum avc_reason reason, uint32_t had, struct avc_error *error);
void guard_give_up(struct avc_guard *guard, const struct avc_report *report, enum avc_reason reason,
		   const struct avc_error *error);
/* After a restore: a death in quick succession should be as cheap as the first. */
void guard_hold_all(struct avc_guard *guard);

/* ---- guard_group.c --------------------------------------------------------- */

/* What the daemon wants; `fd` stays the caller's. */
void guard_take_line(struct avc_guard *guard, const struct avc_request *request, int fd);
void guard_recall(struct avc_guard *guard, const struct avc_request *request, int fd);
void guard_forget(struct avc_guard *guard, uint64_t generation);
void guard_abandon(struct avc_guard *guard, uint64_t ticket);
/* Of a checkpoint: it is ready; it stands still (freeze.meet). */
int guard_meet_ready(struct avc_guard *guard, struct avc_error *err) warn_unused;
int guard_meet_frozen(void *guard, struct generation *whole, struct avc_error *err) warn_unused;
/* Of a restore: everything is there. */
int guard_meet_restored(struct avc_guard *guard, struct avc_error *err) warn_unused;
/* There is no meeting, or it is one to which it can still come. */
bool guard_may_meet(const struct avc_guard *guard);
/* Whatever was not reached of it will not be. */
void guard_leave_meeting(struct avc_guard *guard);
/* The app has died, and its own processes with it: it goes back with the group. */
void guard_go_back(struct avc_guard *guard, const struct avc_report *report, enum avc_reason reason,
		   uint32_t had);
/* Looks after one that waits for its group. */
void guard_tend_dead(struct avc_guard *guard);

/* ---- guard.c ---------------------------------------------------------------- */

/* One guard, from its AVC_REQUEST_START on `socket` to its end.  Returns the exit status:
 * 0, unless it could not start. */
int guard_run(int socket);

/* ---- probe.c ---------------------------------------------------------------- */

/* Can this machine and this process do it?  Touches no process but a child of its own. */
int guard_probe(struct avc_error *err);

#endif
