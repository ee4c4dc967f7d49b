/* SPDX-License-Identifier: Apache-2.0
 *
 * libavckpt: freeze, clone and restore.
 *
 * An *engine* owns a queue of events. A *guard* protects one container: it is a separate process
 * (avckpt-guard), which makes every ptrace(2) call for that container, takes checkpoints on the
 * interval, and restores when avckpt-init reports a death, with no call back into the caller
 * between death and resume. Their protocol is in avckpt/guard.h. When the caller exits, its guards
 * release their containers and exit.
 *
 * Functions return 0, or -1 with *err filled in, unless said otherwise. All of them may be called
 * from any thread; none blocks for longer than it takes to send a message, except avc_guard_stop(),
 * avc_engine_probe() and avc_engine_free().
 */
#ifndef AVCKPT_ENGINE_H
#define AVCKPT_ENGINE_H

#include <stdint.h>

#include "avckpt/error.h"

#define AVC_KEEP_MAX 16
#define AVC_RESTORES_MAX 64 /* of avc_config.restore_max */

/* Regular files at a restore. */
enum avc_files {
	AVC_FILES_REWIND = 0, /* their offsets are the checkpoint's               */
	AVC_FILES_KEEP = 1,   /* their offsets stay                               */
	AVC_FILES_STRICT = 2, /* as REWIND; and no restore if one that is open for
	                       * writing was written since the checkpoint         */
	AVC_FILES_AUTO = 3    /* the same if one was written other than at its end */
};

/* Established TCP connections at a restore, and Unix connections to processes outside, of which
 * nobody counts the bytes. */
enum avc_tcp {
	AVC_TCP_RESET_MOVED = 0, /* those on which bytes may have moved since are reset */
	AVC_TCP_RESET = 1,       /* are reset, and read as closed                  */
	AVC_TCP_KEEP = 2,        /* go on                                          */
	AVC_TCP_MESSAGES = 3     /* those that it leaves in the middle of a message */
};

/* How a checkpoint saves the memory of a process. */
enum avc_images {
	AVC_IMAGES_FORK = 0,  /* by a fork of it                                    */
	AVC_IMAGES_DIRTY = 1, /* by a copy of what was written since an older one, where
	                       * that is possible                                   */
	AVC_IMAGES_AUTO = 2   /* and where it stops the application for less time, and there
	                       * is memory for it */
};

/* What a restore changes when the last one was not long ago. */
enum avc_again {
	AVC_AGAIN_SAME = 0,
	AVC_AGAIN_DROP_INPUT = 1, /* what the app has not read yet is dropped, if the kernel has
	                           * it in pipes, sockets and their queues          */
	AVC_AGAIN_STAGGER = 2     /* each thread goes on at a random time of its own */
};

/* Why a process was forked instead of copied. */
enum avc_fork_reason {
	AVC_FORK_NONE = 0,      /* it was not                                      */
	AVC_FORK_CONFIG = 1,    /* AVC_IMAGES_FORK                                 */
	AVC_FORK_FIRST = 2,     /* there is no older one to be used yet */
	AVC_FORK_PROCESSES = 3, /* it is new, or has ended, or one above it adopts orphans */
	AVC_FORK_KERNEL = 4,    /* the kernel cannot watch memory (before 6.7)     */
	AVC_FORK_SANDBOX = 5,   /* it has a seccomp filter of its own, or is not dumpable */
	AVC_FORK_MEMORY = 6,    /* of a kind that cannot be watched or copied      */
	AVC_FORK_PINNED = 7,    /* a device or the kernel may write to it unseen   */
	AVC_FORK_CHANGED = 8,   /* what a fork inherits has changed                */
	AVC_FORK_LAYOUT = 9,    /* its mappings have changed                       */
	AVC_FORK_WRITES = 10,   /* so much was written that a fork takes less      */
	AVC_FORK_AGE = 11,      /* the older ones were not forked for a minute     */
	AVC_FORK_COPIES = 12,   /* ... or have too many pages of their own         */
	AVC_FORK_SMALL = 13,    /* it is so small that a fork takes less           */
	AVC_FORK_ROOM = 14,     /* the container, or the host, has no memory for copies */
	AVC_FORK_BUDGET = 15    /* avckpt.interval=auto, and forks may be more frequent */
};

/* The settings of a guard. Durations in nanoseconds. */
struct avc_config {
	int32_t init_pidfd;   /* pidfd of avckpt-init; duplicated, stays the
	                              * caller's                                  */
	uint32_t keep;        /* generations kept, 1..AVC_KEEP_MAX         */
	uint64_t interval_ns; /* between checkpoints; 0: only on command   */
	/* Not 0: as often as the budgets allow, between this and interval_ns apart; not while the
	 * app does nothing. Budgets in millionths of the time: for which checkpoints may stop the
	 * app, and that they may use of one CPU. */
	uint64_t interval_min_ns;
	uint32_t budget_freeze_ppm;
	uint32_t budget_cpu_ppm;
	/* All generations but the newest are at least so far apart; 0: with interval_min_ns it is
	 * interval_ns, else no matter. */
	uint64_t apart_ns;
	uint64_t freeze_deadline_ns; /* the app is never held longer than this to
	                              * get it stopped; 0: 50 ms                  */
	uint64_t quiesce_ns;         /* how long to wait for a quiescent moment */
	/* restore_max restores within this time, then one of each older generation
	 * that has not crashed, then give up.  A generation that dies again before
	 * a checkpoint was possible gets half of them if there is an older one.  */
	uint64_t restore_window_ns;
	uint32_t restore_max;
	uint64_t shm_bytes;             /* shared memory that is rolled back, at most */
	uint64_t deadline_ns;           /* a restore that is not there so long after the
	                                 * death is given up; 0: none is          */
	uint64_t remains_ns;            /* how long a dead app's memory is kept for
	                                 * whoever looks at it; 0: it is not      */
	uint64_t memory_limit_bytes;    /* of the container, with swap; 0: none known */
	uint64_t tasks_max;             /* of the container; 0: none known            */
	uint8_t restore_on_signal;      /* killed by an unrequested signal */
	uint8_t restore_on_exit;        /* any non-zero exit status                  */
	uint8_t files;                  /* enum avc_files                            */
	uint8_t tcp;                    /* enum avc_tcp                              */
	uint8_t images;                 /* enum avc_images                           */
	uint8_t suspends;               /* the guard takes no seccomp filter of its own,
	                                 * which would hinder it; set by the engine   */
	uint8_t together;               /* one of a group: checkpoints are those of its
	                                 * lines, and it goes back with the others   */
	uint8_t again;                  /* enum avc_again, one or several            */
	uint8_t late;                   /* the app has run without this guard: its first
	                                 * checkpoint is due soon, not after interval_ns */
	uint8_t restore_on_status[256]; /* [n] != 0: exit status n is abnormal    */
};

enum avc_event_kind {
	AVC_EVENT_ATTACHED = 1,    /* init found, versions agree; app_pid is set */
	AVC_EVENT_CHECKPOINT = 2,  /* a generation was taken.  With interval_min_ns
	                            * once a second at most; `checkpoints`        */
	AVC_EVENT_MISSED = 3,      /* a checkpoint could not be taken; `error`.
	                            * The guard tries again at the next interval.
	                            * What was held is, unless it was to make way
	                            * for this one: see `generations`             */
	AVC_EVENT_UNPROTECTED = 4, /* the app cannot be protected as it is; `error` is why. Held
	                            * generations are given up. The guard looks again every
	                            * interval */
	AVC_EVENT_DIED = 5,        /* the app died; wait_status, died_ns          */
	AVC_EVENT_RESTORED = 6,    /* and runs again                              */
	AVC_EVENT_GAVE_UP = 7,     /* a death that was not followed by a restore;
	                            * `reason` and `error` say why; init ends     */
	AVC_EVENT_ENDED = 8,       /* init is gone; the guard's last event, after
	                            * it avc_guard_stop() returns at once         */
	AVC_EVENT_REFUSED = 9,     /* a command could not be carried out          */
	AVC_EVENT_DROPPED = 10,    /* `generation` was given up before its time;
	                            * `reason` is why: CRASHED (`attempt` times),
	                            * UNHEALTHY, MEMORY, KILLED, EXECUTED,
	                            * UNSHARED                                    */
	AVC_EVENT_GUARD_LOST = 11, /* the guard's process has died, or hung and was
	                            * killed; `error` says how.  The application
	                            * runs on, unprotected.  The guard's last event,
	                            * unless `reason` is FILTER                     */
	AVC_EVENT_HELD = 12,       /* answers AVC_COMMAND_LIST, one for each of the
	                            * `generations`, oldest first: its number, age,
	                            * freeze and threads, and as `attempt` its
	                            * crashes; one without a number: none is held */
	AVC_EVENT_WAITS = 13       /* the app died, and waits for its group to go
	                            * back with it; `generation` is the newest that
	                            * it may go back to; `error`: why it has to once
	                            * more.  avc_guard_recall() or ABANDON is due */
};

enum avc_reason {
	AVC_REASON_NONE = 0,
	AVC_REASON_SIGNAL = 1,     /* killed by a signal                          */
	AVC_REASON_EXIT = 2,       /* non-zero exit status                        */
	AVC_REASON_COMMAND = 3,    /* rolled back by AVC_COMMAND_RESTORE          */
	AVC_REASON_CLEAN_EXIT = 4, /* gave up: exit status 0                      */
	AVC_REASON_STOPPED = 5,    /* gave up: somebody asked the app to stop     */
	AVC_REASON_POLICY = 6,     /* gave up: restore_on does not name this end  */
	AVC_REASON_LIMIT = 7,      /* gave up: restores used up                   */
	AVC_REASON_FAILED = 8,     /* gave up: no generation would restore        */
	AVC_REASON_EMPTY = 9,      /* gave up: no generation is held              */
	AVC_REASON_UNHEALTHY = 10, /* rolled back by AVC_COMMAND_UNHEALTHY        */
	AVC_REASON_MEMORY = 11,    /* dropped: AVC_COMMAND_DROP_OLDEST            */
	AVC_REASON_KILLED = 12,    /* dropped: somebody killed the template (the
	                            * OOM killer: guard_memory.c)                 */
	AVC_REASON_CRASHED = 13,   /* dropped: what was restored from it, or what
	                            * it was taken from, keeps crashing           */
	AVC_REASON_EXECUTED = 14,  /* dropped: the app is another program now     */
	AVC_REASON_LOOP = 15,      /* gave up: the same death again, at once      */
	AVC_REASON_LATE = 16,      /* gave up: later than deadline_ns             */
	AVC_REASON_GROUP = 17,     /* rolled back by avc_guard_recall()           */
	AVC_REASON_UNSHARED = 18,  /* dropped: the app has left its table of descriptors
	                            * to its templates                            */
	AVC_REASON_FILTER = 19     /* guard lost: its own seccomp filter does not let it
	                            * suspend the app's; one without has been started */
};

/* An event. Fields that do not apply to a kind are 0. */
struct avc_event {
	int32_t kind;           /* enum avc_event_kind                           */
	int32_t reason;         /* enum avc_reason                               */
	uint64_t cookie;        /* of the guard, as given to avc_guard_start()   */
	uint64_t ticket;        /* of the command this answers, 0: none          */
	uint64_t at_ns;         /* CLOCK_MONOTONIC                               */
	int32_t app_pid;        /* main process, in the caller's PID namespace   */
	int32_t app_pid_inside; /* the same in the container's                   */
	int32_t wait_status;    /* DIED, RESTORED, GAVE_UP: as from waitpid(2)   */
	uint32_t threads;       /* of the checkpoint or restore                  */
	uint64_t generation;    /* number of the generation, from 1              */
	uint64_t line;          /* of the group, that it is of; 0: of none       */
	uint64_t replaced;      /* CHECKPOINT: the generation that it replaces, 0: none */
	uint32_t generations;   /* held now                                      */
	uint32_t attempt;       /* RESTORED: restores within the window          */
	uint32_t quiescent;     /* CHECKPOINT: 1 if taken at a quiescent moment  */
	uint32_t restores;      /* RESTORED: since the guard was started         */
	uint32_t checkpoints;   /* CHECKPOINT: taken since the last that was told */
	int32_t remains_pid;    /* DIED: a stopped task that has its memory, until
	                         * AVC_COMMAND_RELEASE or for remains_ns after the
	                         * restore; 0: there is none                      */
	int32_t likeness_pid;   /* DIED: one with the memory of the newest
	                         * generation; 0: there is none                   */
	uint64_t interval_ns;   /* CHECKPOINT: between two of them, at present    */
	uint64_t freeze_max_ns; /* CHECKPOINT: the longest freeze of them         */
	/* CHECKPOINT, MISSED: first PTRACE_INTERRUPT until the last thread runs
	 * again (RESTORED: of the generation's checkpoint), and parts of it                                                 */
	uint64_t freeze_ns;
	uint64_t stop_ns;  /* of it, until every known thread had stopped   */
	uint64_t clone_ns; /* of it, until everything was read and cloned   */
	uint64_t wait_ns;  /* of it, for the rest of its group              */
	/* CHECKPOINT: how it was made                                            */
	int32_t images;      /* AVC_IMAGES_FORK or AVC_IMAGES_DIRTY           */
	int32_t fork_reason; /* enum avc_fork_reason                          */
	uint64_t copied;     /* pages, before and during the freeze           */
	/* RESTORED                                                               */
	uint64_t died_ns;    /* CLOCK_MONOTONIC when init had reaped the app  */
	uint64_t restore_ns; /* died_ns until the last thread runs again      */
	uint64_t fork_ns;    /* of it, cloning the template                   */
	uint64_t threads_ns; /* of it, creating threads                       */
	uint64_t age_ns;     /* of the generation when the app died           */
	uint32_t again;      /* enum avc_again: what it has changed           */
	uint32_t dropped;    /* descriptors whose input was dropped           */
	/* CHECKPOINT: what of it cannot be restored, RESTORED: what was not (or why not from a
	 * newer generation); else why */
	struct avc_error error;
};

enum avc_command {
	AVC_COMMAND_CHECKPOINT = 1,  /* take one now; answered by CHECKPOINT, MISSED,
	                             * UNPROTECTED or REFUSED                     */
	AVC_COMMAND_RESTORE = 2,     /* kill the live app and restore the newest
	                             * generation, or the one with that number (those
	                             * after it are given up then); RESTORED, GAVE_UP
	                             * or REFUSED                                 */
	AVC_COMMAND_DROP_OLDEST = 3, /* memory is short: give the oldest generation
	                             * up and hold no more than are left, with none
	                             * left take no checkpoints; DROPPED, REFUSED */
	AVC_COMMAND_REFILL = 4,      /* hold `keep` generations again; no answer   */
	AVC_COMMAND_VOUCH = 5,       /* the app is healthy: what was held already at
	                             * the last such command is good to go back to.
	                             * Wants `keep` of 3 or more; no answer       */
	AVC_COMMAND_UNHEALTHY = 6,   /* the app hangs: as a crash, but of what is
	                             * held only what was vouched for is used (the
	                             * oldest, if nothing was); as RESTORE        */
	AVC_COMMAND_UNVOUCH = 7,     /* nobody says any more whether the app is
	                             * healthy; no answer                         */
	AVC_COMMAND_RELEASE = 8,     /* the memory of `ticket`, a remains_pid, has been
	                             * looked at; no answer                       */
	AVC_COMMAND_LIST = 9,        /* what is held; HELD or REFUSED              */
	AVC_COMMAND_ABANDON = 10,    /* the group cannot go back: an app that WAITS for
	                             * it ends; GAVE_UP, or no answer             */
	AVC_COMMAND_SEEN = 11        /* what the memory of `ticket`, a remains_pid (or, if
	                             * there was none, a likeness_pid), tells is known:
	                             * if the death is final, the container may end; no
	                             * answer                                     */
};

struct avc_engine;
struct avc_guard;

/* The library's version, "MAJOR.MINOR.PATCH"; static. */
const char *avc_version(void);

/* Creates an engine whose guards are processes of `program` (avckpt-guard). Errors: AVC_KERNEL. */
struct avc_engine *avc_engine_new(const char *program, struct avc_error *err);

/* A descriptor that is readable (poll(2)) while events are queued. It belongs to the engine. Read
 * the events with avc_engine_next_event(), not the fd. */
int avc_engine_event_fd(struct avc_engine *engine);

/* Takes the oldest event: 1 with *event filled in, 0 if there is none. The queue is bounded (4096);
 * when it is full, the oldest are dropped. */
int avc_engine_next_event(struct avc_engine *engine, struct avc_event *event);

/* Frees the engine.  Every guard must have been stopped. */
void avc_engine_free(struct avc_engine *engine);

/* Whether this machine and a guard support it. Has `program` check architecture, kernel features
 * and privileges; it touches no process but its own child. Errors: AVC_UNSUPPORTED, AVC_DENIED,
 * AVC_KERNEL. */
int avc_engine_probe(const char *program, struct avc_error *err);

/* Starts a guard for the container of which config->init_pidfd is init. Returns NULL with *err
 * filled in when the config is invalid or the guard cannot be started; later errors come as events
 * with `cookie`. The guard waits for init to have set itself up (bounded), then says ATTACHED.
 * Precondition: init is visible in the caller's PID namespace and /proc. */
struct avc_guard *avc_guard_start(struct avc_engine *engine, const struct avc_config *config,
				  uint64_t cookie, struct avc_error *err);

/* The PID, or 0 when it has exited. */
int32_t avc_guard_pid(struct avc_guard *guard);

/* Kills a guard that has given no sign of life for `patience_ns`, unless it is only waiting for a
 * CPU; then GUARD_LOST follows. To be called periodically. */
void avc_guard_check(struct avc_guard *guard, uint64_t patience_ns);

/* Sends a command. The answer is an event with the same ticket (not 0). What the guard has not
 * begun by until_ns (CLOCK_MONOTONIC; 0: any time) is refused. `generation`: which is to be
 * restored, 0: the newest. Errors: AVC_GONE when the guard has ended, AVC_BUSY when it does not
 * accept them. */
int avc_guard_command(struct avc_guard *guard, enum avc_command command, uint64_t ticket,
		      uint64_t generation, uint64_t until_ns, struct avc_error *err);

/* New settings for a running guard (their init_pidfd is ignored). They apply from the next
 * checkpoint and the next death on. Held generations stay, up to the new `keep`; when that is more
 * than the guard has had before, they are replaced by new ones at the next checkpoint. Returns
 * before they are in force. Errors: AVC_CONFIG, and nothing changes; AVC_GONE when the guard has
 * ended. */
int avc_guard_configure(struct avc_guard *guard, const struct avc_config *config,
			struct avc_error *err);

/* Creates the memory where the guards of a group meet (avckpt/guard.h), once: for one line or one
 * rollback to one. A descriptor, or -1. */
int avc_meeting_new(uint32_t members, struct avc_error *err);

/* Has a guard take a checkpoint that is part of a line of its group: no app is released before all
 * members of `meeting` are stopped, and either all of them hold it afterwards, or none.  Each
 * member gets the same meeting. Answered as AVC_COMMAND_CHECKPOINT. */
int avc_guard_line(struct avc_guard *guard, int meeting, uint64_t line, uint64_t ticket,
		   struct avc_error *err);

/* Has it go back to `generation`, of that line: no app is killed before all members are able to,
 * none is restored before all are dead, and none runs before all are restored. RESTORED; or
 * REFUSED, and nothing has changed; or WAITS or GAVE_UP. */
int avc_guard_recall(struct avc_guard *guard, int meeting, uint64_t line, uint64_t generation,
		     uint64_t ticket, struct avc_error *err);

/* Releases the app (it keeps running, unprotected), drops every generation, waits for the process
 * to exit (it is killed after 15 s) and frees the guard. Blocks for as long as a checkpoint or
 * restore that is under way. Events that it sent until then are queued. */
void avc_guard_stop(struct avc_guard *guard);

#endif
