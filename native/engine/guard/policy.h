/* SPDX-License-Identifier: Apache-2.0
 *
 * What the guard decides: which deaths are undone, which generation is restored and which one is
 * replaced, when to give up, when the next checkpoint is due (docs/policy.md).
 *
 * Pure functions: none makes a system call, reads a clock or has state of its own: each reads its
 * arguments and changes at most the `struct policy` that it is given.  So all of it is tested
 * without an application (tests/unit/test_guard_policy.py).  Times are nanoseconds of
 * CLOCK_MONOTONIC.
 */
#ifndef AVCKPT_POLICY_H
#define AVCKPT_POLICY_H

#include <stdbool.h>
#include <stdint.h>

#include "avckpt/engine.h"

#define POLICY_NEVER UINT64_MAX

/* What is known about a generation that is held. */
struct policy_generation {
	uint64_t number;
	uint64_t line; /* of the group; 0: none                            */
	uint64_t taken_ns;
	/* A generation taken on probation is of the lineage of the one that its process was
	 * restored from, and as suspect.  Any other one begins a lineage. */
	uint32_t lineage;
	uint32_t crashes; /* of its lineage, soon after a restore             */
	uint32_t lost;    /* restores from it that failed */
	bool looping;     /* restores from its lineage led to the same death at once, twice */
	bool seen;        /* held when the app was healthy; again so: vouched */
	bool vouched;     /* the app was healthy well after it was taken      */
	bool proves;      /* its process has made progress since a restore */
};

/* All zero except `room` at the start. */
struct policy {
	struct policy_generation held[AVC_KEEP_MAX]; /* oldest first        */
	uint32_t count;
	uint32_t room;      /* generations that may be held now                */
	uint32_t lineages;  /* that have existed */
	uint32_t misses;    /* in a row, because of a child process */
	uint64_t missed_ns; /* the first of these                            */
	uint32_t restores;  /* after a crash, not on command                   */
	uint64_t restored_at[AVC_RESTORES_MAX]; /* the last of these        */
	bool vouching;                          /* a health check says when the app is healthy */
	/* The process that runs now. */
	uint32_t lineage;
	uint64_t restored_from; /* generation, 0: never restored              */
	uint64_t restored_ns;   /* after a crash; 0: not, or long ago         */
	bool proved;            /* has made progress since it was restored */
	uint64_t refused_ns;    /* since when it cannot be protected; 0: it can   */
	uint64_t without_ns;    /* since when one is missed and none is held; 0: no  */
	uint64_t held_ns;       /* since when at least one is held                 */
	uint64_t spared_ns;     /* since its last one was killed there is none for so long */
	uint64_t resumes_ns;    /* ... until then                                      */
	uint64_t crowded_ns;    /* for so long there is no spare                       */
	uint64_t spares_ns;     /* ... until then                                      */
	/* The last immediate death that was the program's own. */
	int at_once_status;
	uint32_t at_once_lineage;
};

/* What the app has done in some time. */
struct policy_run {
	uint64_t passed_ns, cpu_ns;
	uint64_t ran_ns, waited_ns; /* its main thread: for a CPU */
};

/* ---- checkpoints ------------------------------------------------------------- */

/* The first one: the app should make progress before. */
uint64_t policy_first_due(const struct avc_config *config, uint64_t now);
/* An interval from now; POLICY_NEVER: on command only. */
uint64_t policy_due(const struct avc_config *config, uint64_t now);
/* `due`, or later: the app is to run first for as long as that. */
uint64_t policy_due_after(uint64_t due, uint64_t pause_ns, uint64_t now);
/* How long it is to run after a checkpoint for which it was stopped for `held_ns`: stops and first
 * writes to what was cloned take at most half of its time.  For the latter it is 3 s at most. */
uint64_t policy_rest(uint64_t held_ns, uint64_t writes_ns);
/* How long first writes that cost `cost_ns` of CPU time have held it up. */
uint64_t policy_writes(uint64_t cost_ns, const struct policy_run *run);
/* The one that was due at `due`, by a new configuration. */
uint64_t policy_due_again(const struct avc_config *config, uint64_t due, uint64_t now);

/* The record of a generation that was just taken.  Then policy_replaced() says what to replace
 * while there is no room, and policy_hold() adds it. */
struct policy_generation policy_new_generation(struct policy *policy,
					       const struct avc_config *config, uint64_t number,
					       uint64_t now);
uint32_t policy_replaced(const struct policy *policy, const struct avc_config *config,
			 uint64_t now);
void policy_hold(struct policy *policy, struct policy_generation fresh);

/* In a group: what to say about held[i] to the others, and what all together have said. */
struct policy_line {
	bool held;    /* by all                                       */
	bool kept;    /* a health check needs it                      */
	bool suspect; /* of the lineage of a process on probation     */
};

struct policy_line policy_line(const struct policy *policy, const struct avc_config *config,
			       uint32_t i, uint64_t now);
/* Instead of policy_replaced(): the same one for all members that hold the same lines. */
uint32_t policy_line_replaced(const struct policy *policy, const struct policy_line *said);

/* A checkpoint has failed because of the main process, or of another one.  True: no generation is
 * valid, the app is unprotected.  False: it is retried when it is due. */
bool policy_missed(struct policy *policy, enum avc_code code, bool of_main, uint64_t now);
/* It is unprotected: when to try again.  At `due` or after a second, and then after as long again as
 * it has been refused, up to a minute: what lasts for a moment costs little protection, even if the
 * interval is an hour, and an app that cannot be protected is hardly ever stopped. */
uint64_t policy_refused(struct policy *policy, uint64_t due, uint64_t now);
/* One was missed: when to try again.  At `due`; but if nothing is held to go back to, after as long
 * again as that has been so, at least 0.1 s, at most a minute: the machine may have stood still for
 * a moment, and the interval may be an hour.  One that always misses is hardly ever stopped. */
uint64_t policy_without(struct policy *policy, uint64_t due, uint64_t now);
/* On command, or another application: as if it had not been refused, and none missed, yet. */
void policy_retry(struct policy *policy);
/* It has executed another program, which may be one that can be protected: if it was refused, when
 * to try that instead of at `due`: after a second, at most. */
uint64_t policy_executed(struct policy *policy, const struct avc_config *config, uint64_t due,
			 uint64_t now);

/* ---- avckpt.interval=auto ------------------------------------------------------ */

/* What one checkpoint costs. */
struct policy_cost {
	uint64_t held_ns; /* the app was stopped by its freeze, and by the page faults after it */
	uint64_t cpu_ns;  /* by us and our templates */
};

/* How a template is made (dirty.c). */
enum policy_method { POLICY_FORKS, POLICY_COPIES, POLICY_METHODS };

/* How often there may be a checkpoint.  All zero at the start. */
struct policy_pace {
	struct policy_cost cost[POLICY_METHODS]; /* on average                      */
	uint32_t samples[POLICY_METHODS];
	enum policy_method method; /* of the last one                                 */
	uint32_t forking;          /* so many more, until copies are tried again      */
	uint32_t failures;         /* in a row                                        */
	uint64_t interval_ns;      /* between two, by the budgets                     */
	uint64_t taken_ns;         /* when the app resumed after the last one */
	uint64_t spent_ns;         /* until then the budgets are used up              */
};

/* What the app has done since the last one. */
struct policy_activity {
	uint64_t cpu_ns;
	bool sent;  /* just now                                        */
	bool sends; /* it sends regularly */
};

bool policy_is_automatic(const struct avc_config *config);
/* The current interval, automatic or not. */
uint64_t policy_interval(const struct policy_pace *pace, const struct avc_config *config);
/* One was taken by that method, at that cost. */
void policy_pay(struct policy_pace *pace, const struct avc_config *config,
		enum policy_method method, struct policy_cost cost, uint64_t now);
/* Where copies are possible: whether the next one is to be a fork all the same, because more of
 * them are affordable, or because it is not known yet what they cost. */
bool policy_prefers_forks(struct policy_pace *pace, const struct avc_config *config);
/* Nothing was taken; when to try again. */
uint64_t policy_try_again(struct policy_pace *pace, const struct avc_config *config, uint64_t now);
/* One more than the budgets allow on average may come right after output: the earliest time. */
uint64_t policy_ready(const struct policy_pace *pace, const struct avc_config *config);
/* Whether one is due. */
bool policy_wants(const struct policy_pace *pace, const struct avc_config *config,
		  struct policy_activity activity, uint64_t now);
/* It is not: when to check again.  Work that begins meanwhile is noticed a quarter of avckpt.interval late, at most. */
uint64_t policy_look_again(const struct policy_pace *pace, const struct avc_config *config,
			   uint64_t now);

/* ---- what is held ------------------------------------------------------------ */

/* held[i] is gone, whatever the reason. */
void policy_drop(struct policy *policy, uint32_t i);
/* The last one held was killed, as by the OOM killer: for how long there is no other one.  If at least
 * one was held for ten seconds, 0; else a second, twice as long each time, at most a minute: where each
 * is killed at once the app pays for it, and gains nothing. */
uint64_t policy_killed(struct policy *policy, uint64_t now);
/* A spare had to make way for a template, at a limit of processes that we do not know: until when there
 * is no other one.  For ten seconds, twice as long each time, at most an hour. */
uint64_t policy_crowded(struct policy *policy, uint64_t now);
/* There may be room again for what was killed, or had to make way. */
void policy_roomier(struct policy *policy);
/* Which one to drop next.  There is at least one. */
uint32_t policy_dispensable(const struct policy *policy);
/* Memory is short: from now on holds one fewer than now. */
void policy_shrink(struct policy *policy);
/* Memory is available again.  True: none is held, so a checkpoint is due at once. */
bool policy_refill(struct policy *policy, const struct avc_config *config);
/* `keep` has changed from `was`. */
void policy_resize(struct policy *policy, uint32_t was, uint32_t keep);

/* A health check has passed. */
void policy_vouch(struct policy *policy);
/* There will be no more health checks. */
void policy_unvouch(struct policy *policy);

/* ---- deaths ------------------------------------------------------------------- */

struct policy_verdict {
	bool restore;
	enum avc_reason reason;
};

/* The reason for an exit with this status (waitpid(2)).  `asked`: why we have killed it ourselves;
 * NONE: we have not. */
struct policy_verdict policy_judge(const struct avc_config *config, int status, bool stop_asked,
				   enum avc_reason asked);

/* Whether the process (that died) was restored after a crash not long ago. */
bool policy_on_probation(const struct policy *policy, const struct avc_config *config,
			 uint64_t now);

/* How many of the oldest are left: after `healthy`, the app may have hung already; those between
 * the two keep crashing.  The newest of `trusted` is to be restored; 0: give up. */
struct policy_fallback {
	uint32_t healthy, trusted;
	bool looping; /* the newest is not trusted for that: the same death at once, twice  */
};

/* The process that ran has died, with that status (waitpid(2)), unrequested. */
struct policy_fallback policy_crashed(struct policy *policy, const struct avc_config *config,
				      int status, bool hung, uint64_t now);

/* held[i] runs again.  `crashed`: not on command. */
void policy_restored(struct policy *policy, uint32_t i, bool crashed, uint64_t now);

/* A restore of what died at `died_ns` has failed because we had no descriptors or memory left: whether
 * to wait until there may be some again.  Whoever took them may need them for a moment only. */
bool policy_awaits_room(uint64_t died_ns, uint64_t now);

/* The number of restores after a crash that count now. */
uint32_t policy_restores_within(const struct policy *policy, const struct avc_config *config,
				uint64_t now);

#endif
