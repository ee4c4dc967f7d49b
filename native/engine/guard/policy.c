/* SPDX-License-Identifier: Apache-2.0
 *
 * What the guard decides (policy.h).
 *
 * A bug that is in the state and not in the moment comes back with every restore, and with every
 * checkpoint taken after one.  So for restore_window_ns after a restore the process is on
 * probation: checkpoints of it are of the same lineage as the generation it came from, inherit its
 * crash count, and replace only that lineage, so that older generations stay.
 */
#include <signal.h>
#include <sys/wait.h>

#include "policy.h"

#define MISSES_UNTIL_UNPROTECTED 3
#define MISSES_NS (1000 * MS)
#define MS UINT64_C(1000000)
#define FIRST_NS (500 * MS)
#define WRITES_NS (3000 * MS)
#define PROOF_NS (1000 * MS) /* an app that lives this long has made progress */
#define AGAIN_NS (50 * MS)
#define ROOM_NS (1000 * MS)
#define AVERAGE_OF 8
#define SAMPLES 3
#define FORKS 64
#define LOOK_NS (20 * MS)
#define SOON_NS (100 * MS)
#define AGAIN_LEAST_NS (1000 * MS)
#define LONG_NS UINT64_C(60000000000)
#define CROWDED_NS UINT64_C(10000000000)
#define HOUR_NS UINT64_C(3600000000000)
#define LIVED_NS UINT64_C(10000000000)
/* The CPU time that a checkpoint itself makes an idle app use: restarted calls. */
#define NOISE_NS (MS / 5)
/* After a restore: an app that dies within this time has met the bug in the image. */
#define AT_ONCE_NS UINT64_C(1000000000)

static uint64_t lesser(uint64_t a, uint64_t b)
{
	return a < b ? a : b;
}

bool policy_on_probation(const struct policy *policy, const struct avc_config *config, uint64_t now)
{
	return policy->restored_ns && now - policy->restored_ns < config->restore_window_ns;
}

static int newest_vouched(const struct policy *policy)
{
	for (uint32_t i = policy->count; i-- > 0;)
		if (policy->held[i].vouched)
			return (int)i;
	return -1;
}

/* Waits to be vouched for, unless it is that one. */
static int newest_seen(const struct policy *policy)
{
	for (uint32_t i = policy->count; i-- > 0;)
		if (policy->held[i].seen)
			return (int)i;
	return -1;
}

/* ---- checkpoints ------------------------------------------------------------- */

uint64_t policy_first_due(const struct avc_config *config, uint64_t now)
{
	const uint64_t due = policy_due(config, now);

	return policy_is_automatic(config) && due > now + FIRST_NS ? now + FIRST_NS : due;
}

uint64_t policy_due(const struct avc_config *config, uint64_t now)
{
	return config->interval_ns ? now + config->interval_ns : POLICY_NEVER;
}

uint64_t policy_due_after(uint64_t due, uint64_t pause_ns, uint64_t now)
{
	return due > now + pause_ns ? due : now + pause_ns;
}

/* After a clone, first writes take that time before the app is as quick as it was. */
uint64_t policy_rest(uint64_t held_ns, uint64_t writes_ns)
{
	return held_ns + lesser(2 * writes_ns, WRITES_NS);
}

/* Several threads write side by side; one that waits for a CPU takes longer. */
uint64_t policy_writes(uint64_t cost_ns, const struct policy_run *run)
{
	const uint64_t threads = run->passed_ns ? run->cpu_ns / run->passed_ns + 1 : 1;

	if (run->ran_ns)
		cost_ns +=
			(uint64_t)((double)cost_ns * (double)run->waited_ns / (double)run->ran_ns);
	return lesser(cost_ns / threads, run->passed_ns);
}

/* Never later than planned, unless there are to be none. */
uint64_t policy_due_again(const struct avc_config *config, uint64_t due, uint64_t now)
{
	const uint64_t next = policy_due(config, now);

	return next < due || next == POLICY_NEVER ? next : due;
}

struct policy_generation policy_new_generation(struct policy *policy,
					       const struct avc_config *config, uint64_t number,
					       uint64_t now)
{
	struct policy_generation fresh = { .number = number, .taken_ns = now };

	if (!policy->count)
		policy->held_ns = now;
	if (!policy_on_probation(policy, config, now)) {
		policy->restored_ns = 0;
		policy->lineage = ++policy->lineages;
	}
	fresh.lineage = policy->lineage;
	fresh.proves = !policy_is_automatic(config) || !policy->restored_ns ||
		       now - policy->restored_ns >= PROOF_NS;
	for (uint32_t i = 0; i < policy->count; i++)
		if (policy->held[i].lineage == fresh.lineage) {
			if (policy->held[i].crashes > fresh.crashes)
				fresh.crashes = policy->held[i].crashes;
			fresh.looping |= policy->held[i].looping;
		}
	return fresh;
}

static uint64_t apart_ns(const struct avc_config *config)
{
	if (!config->apart_ns && policy_is_automatic(config))
		return config->interval_ns;
	return config->apart_ns;
}

uint32_t policy_replaced(const struct policy *policy, const struct avc_config *config, uint64_t now)
{
	const int vouched = newest_vouched(policy), seen = newest_seen(policy);

	if (policy_on_probation(policy, config, now))
		for (uint32_t i = policy->count; i-- > 0;)
			if (policy->held[i].lineage == policy->lineage && (int)i != vouched &&
			    (int)i != seen)
				return i;
	/* If taken often, they would all be of the last moments: the newest is replaced until it is
	 * as far from the one before it as if they were taken seldom. */
	if (policy->count > 1) {
		const uint32_t i = policy->count - 1;

		if ((int)i != vouched && (int)i != seen &&
		    policy->held[i].taken_ns - policy->held[i - 1].taken_ns < apart_ns(config))
			return i;
	}
	return policy_dispensable(policy);
}

struct policy_line policy_line(const struct policy *policy, const struct avc_config *config,
			       uint32_t i, uint64_t now)
{
	return (struct policy_line){
		.held = true,
		.kept = (int)i == newest_vouched(policy) || (int)i == newest_seen(policy),
		.suspect = policy_on_probation(policy, config, now) &&
			   policy->held[i].lineage == policy->lineage,
	};
}

/* Nobody can go back to a line that somebody lacks.  The rest is as in policy_replaced(), for all
 * of them at once. */
uint32_t policy_line_replaced(const struct policy *policy, const struct policy_line *said)
{
	for (uint32_t i = 0; i < policy->count; i++)
		if (!said[i].held)
			return i;
	for (uint32_t i = policy->count; i-- > 0;)
		if (said[i].suspect && !said[i].kept)
			return i;
	for (uint32_t i = 0; i < policy->count; i++)
		if (!said[i].kept)
			return i;
	return 0;
}

void policy_hold(struct policy *policy, struct policy_generation fresh)
{
	policy->held[policy->count++] = fresh;
	policy->misses = 0;
	policy_retry(policy);
	/* Only a health check can show that a process does not hang; and an immediate checkpoint of
	 * one that was just restored shows no progress. */
	if (!policy->vouching && fresh.proves)
		policy->proved = true;
}

/* A child process may be gone at the next attempt: existing generations stay valid for a while.
 * While another process traces it there is no new one: a debugger, or a crash reporter (breakpad,
 * gdb) that the app has started, and whose report may be followed by a death. */
bool policy_missed(struct policy *policy, enum avc_code code, bool of_main, uint64_t now)
{
	if (code == AVC_BUSY)
		return !policy->count;
	if (code != AVC_UNSUPPORTED && code != AVC_DENIED)
		return false;
	if (of_main || !policy->count)
		return true;
	if (!policy->misses++)
		policy->missed_ns = now;
	return policy->misses >= MISSES_UNTIL_UNPROTECTED && now - policy->missed_ns >= MISSES_NS;
}

static uint64_t as_long_again(uint64_t *since, uint64_t least, uint64_t now)
{
	uint64_t pause;

	if (!*since)
		*since = now;
	pause = now - *since;
	if (pause < least)
		pause = least;
	return now + (pause < LONG_NS ? pause : LONG_NS);
}

uint64_t policy_refused(struct policy *policy, uint64_t due, uint64_t now)
{
	const uint64_t pause = due > now ? due - now : 0;

	if (due == POLICY_NEVER)
		return due;
	return as_long_again(&policy->refused_ns, lesser(pause, AGAIN_LEAST_NS), now);
}

uint64_t policy_without(struct policy *policy, uint64_t due, uint64_t now)
{
	uint64_t again;

	if (policy->count || due == POLICY_NEVER)
		return due;
	again = as_long_again(&policy->without_ns, SOON_NS, now);
	return due < again ? due : again;
}

void policy_retry(struct policy *policy)
{
	policy->refused_ns = policy->without_ns = 0;
}

/* Never later than planned: a program may execute itself again and again. */
uint64_t policy_executed(struct policy *policy, const struct avc_config *config, uint64_t due,
			 uint64_t now)
{
	const bool refused = policy->refused_ns;
	const uint64_t first = policy_first_due(config, now);

	policy_retry(policy);
	if (!refused || first == POLICY_NEVER)
		return due;
	return lesser(due, lesser(first, now + AGAIN_LEAST_NS));
}

/* ---- avckpt.interval=auto ------------------------------------------------------ */

bool policy_is_automatic(const struct avc_config *config)
{
	return config->interval_min_ns > 0;
}

uint64_t policy_interval(const struct policy_pace *pace, const struct avc_config *config)
{
	return policy_is_automatic(config) && pace->samples[pace->method] ? pace->interval_ns
									  : config->interval_ns;
}

static uint64_t average(uint64_t before, uint64_t now)
{
	return before - before / AVERAGE_OF + now / AVERAGE_OF;
}

/* The first one injects the parasite: the second says more; and the third, as the machine may have
 * stood still for a moment. */
static void learn(struct policy_cost *known, uint32_t *samples, struct policy_cost cost)
{
	if (*samples == SAMPLES) {
		known->held_ns = average(known->held_ns, cost.held_ns);
		known->cpu_ns = average(known->cpu_ns, cost.cpu_ns);
	} else if (++*samples < SAMPLES) {
		*known = cost;
	} else {
		known->held_ns = lesser(known->held_ns, cost.held_ns);
		known->cpu_ns = lesser(known->cpu_ns, cost.cpu_ns);
	}
}

/* As often as the budgets allow, or as avckpt.interval.min does. */
static uint64_t within_budgets(const struct policy_cost *cost, const struct avc_config *config)
{
	const uint64_t held = cost->held_ns * 1000000 / config->budget_freeze_ppm,
		       cpu = cost->cpu_ns * 1000000 / config->budget_cpu_ppm,
		       more = held > cpu ? held : cpu;

	return more > config->interval_min_ns ? more : config->interval_min_ns;
}

static uint64_t affordable(const struct policy_cost *cost, const struct avc_config *config)
{
	return lesser(within_budgets(cost, config), config->interval_ns);
}

void policy_pay(struct policy_pace *pace, const struct avc_config *config,
		enum policy_method method, struct policy_cost cost, uint64_t now)
{
	pace->method = method;
	learn(&pace->cost[method], &pace->samples[method], cost);
	pace->interval_ns = affordable(&pace->cost[method], config);
	pace->failures /= 2;
	pace->taken_ns = now;
	if (pace->spent_ns < now)
		pace->spent_ns = now;
	pace->spent_ns += pace->interval_ns;
	/* On command they come as often as requested. */
	if (pace->spent_ns > now + 2 * pace->interval_ns)
		pace->spent_ns = now + 2 * pace->interval_ns;
}

/* By a quarter, so that what is measured does not matter where both cost the same. */
static bool is_dearer(const struct policy_cost *cost, const struct policy_cost *than,
		      const struct avc_config *config)
{
	return within_budgets(cost, config) / 5 > within_budgets(than, config) / 4;
}

/* Forks are measured before memory is watched, which is a part of what copies cost. */
bool policy_prefers_forks(struct policy_pace *pace, const struct avc_config *config)
{
	const struct policy_cost *forks = &pace->cost[POLICY_FORKS],
				 *copies = &pace->cost[POLICY_COPIES];

	if (pace->forking) {
		pace->forking--;
		if (is_dearer(forks, copies, config))
			pace->forking = 0;
		/* They may cost less now. */
		if (!pace->forking)
			pace->samples[POLICY_COPIES] = 0;
	} else if (pace->samples[POLICY_COPIES] == SAMPLES && is_dearer(copies, forks, config)) {
		pace->forking = FORKS;
		pace->samples[POLICY_FORKS] = 1;
	}
	return pace->forking || pace->samples[POLICY_FORKS] < SAMPLES;
}

uint64_t policy_try_again(struct policy_pace *pace, const struct avc_config *config, uint64_t now)
{
	uint64_t pause = policy_interval(pace, config);

	if (!pace->samples[pace->method] || pause < AGAIN_NS)
		pause = AGAIN_NS;
	for (uint32_t i = 0; i < pace->failures && pause < config->interval_ns; i++)
		pause *= 2;
	pace->failures++;
	return now + (pause < config->interval_ns ? pause : config->interval_ns);
}

uint64_t policy_ready(const struct policy_pace *pace, const struct avc_config *config)
{
	const uint64_t least = pace->taken_ns + config->interval_min_ns;
	const uint64_t afford = pace->spent_ns > pace->interval_ns
					? pace->spent_ns - pace->interval_ns
					: 0;

	return afford > least ? afford : least;
}

bool policy_wants(const struct policy_pace *pace, const struct avc_config *config,
		  struct policy_activity activity, uint64_t now)
{
	if (activity.sent)
		return now >= policy_ready(pace, config);
	if (now < pace->spent_ns || activity.cpu_ns <= NOISE_NS)
		return false;
	/* What is at stake should exceed the cost of saving it. */
	return activity.sends || activity.cpu_ns >= pace->cost[pace->method].cpu_ns ||
	       now - pace->taken_ns >= config->interval_ns;
}

uint64_t policy_look_again(const struct policy_pace *pace, const struct avc_config *config,
			   uint64_t now)
{
	const uint64_t longest = config->interval_ns / 4;
	uint64_t pause = (now - pace->taken_ns) / 4;

	if (now < pace->spent_ns)
		return pace->spent_ns;
	if (pause > longest)
		pause = longest;
	return now + (pause > LOOK_NS ? pause : LOOK_NS);
}

/* ---- what is held ------------------------------------------------------------ */

void policy_drop(struct policy *policy, uint32_t i)
{
	policy->count--;
	for (; i < policy->count; i++)
		policy->held[i] = policy->held[i + 1];
}

uint64_t policy_killed(struct policy *policy, uint64_t now)
{
	if (now - policy->held_ns >= LIVED_NS)
		policy->spared_ns = 0;
	else if (policy->spared_ns)
		policy->spared_ns = lesser(2 * policy->spared_ns, LONG_NS);
	else
		policy->spared_ns = AGAIN_LEAST_NS;
	policy->resumes_ns = now + policy->spared_ns;
	return policy->spared_ns;
}

void policy_roomier(struct policy *policy)
{
	policy->spared_ns = policy->resumes_ns = 0;
	policy->crowded_ns = policy->spares_ns = 0;
}

uint64_t policy_crowded(struct policy *policy, uint64_t now)
{
	policy->crowded_ns = policy->crowded_ns ? lesser(2 * policy->crowded_ns, HOUR_NS)
						: CROWDED_NS;
	policy->spares_ns = now + policy->crowded_ns;
	return policy->spares_ns;
}

/* The oldest, but not what a rollback of a hung process would need. */
uint32_t policy_dispensable(const struct policy *policy)
{
	const int vouched = newest_vouched(policy), seen = newest_seen(policy);

	for (uint32_t i = 0; i < policy->count; i++)
		if ((int)i != vouched && (int)i != seen)
			return i;
	return vouched == 0 && policy->count > 1 ? 1 : 0;
}

void policy_shrink(struct policy *policy)
{
	policy->room = policy->count ? policy->count - 1 : 0;
}

bool policy_refill(struct policy *policy, const struct avc_config *config)
{
	const bool short_before = policy->room != config->keep;

	policy->room = config->keep;
	policy_roomier(policy);
	return short_before && !policy->count && config->interval_ns;
}

/* A container that lost generations because memory is short continues without them. */
void policy_resize(struct policy *policy, uint32_t was, uint32_t keep)
{
	if (policy->room == was || policy->room > keep)
		policy->room = keep;
}

/* A check that has just passed may have seen what a now hung app left a moment ago: what was taken
 * since the previous one waits for the next. */
void policy_vouch(struct policy *policy)
{
	policy->vouching = true;
	policy->proved = true;
	for (uint32_t i = 0; i < policy->count; i++) {
		policy->held[i].vouched |= policy->held[i].seen;
		policy->held[i].seen = true;
	}
}

void policy_unvouch(struct policy *policy)
{
	policy->vouching = false;
	for (uint32_t i = 0; i < policy->count; i++)
		policy->held[i].vouched = policy->held[i].seen = false;
}

/* ---- deaths ------------------------------------------------------------------- */

struct policy_verdict policy_judge(const struct avc_config *config, int status, bool stop_asked,
				   enum avc_reason asked)
{
	if (stop_asked)
		return (struct policy_verdict){ false, AVC_REASON_STOPPED };
	if (asked)
		return (struct policy_verdict){ true, asked };
	if (WIFSIGNALED(status) && config->restore_on_signal)
		return (struct policy_verdict){ true, AVC_REASON_SIGNAL };
	if (WIFSIGNALED(status))
		return (struct policy_verdict){ false, AVC_REASON_POLICY };
	if (WEXITSTATUS(status) == 0)
		return (struct policy_verdict){ false, AVC_REASON_CLEAN_EXIT };
	if (config->restore_on_exit || config->restore_on_status[WEXITSTATUS(status)])
		return (struct policy_verdict){ true, AVC_REASON_EXIT };
	return (struct policy_verdict){ false, AVC_REASON_POLICY };
}

/* What it came from is suspect.  A hang is detected late, so a hung process is on probation until
 * it was healthy once. */
static void count_crash(struct policy *policy, const struct avc_config *config, bool hung,
			uint64_t now)
{
	const bool probation = policy_on_probation(policy, config, now) ||
			       (hung && !policy->proved);

	for (uint32_t i = 0; i < policy->count; i++) {
		struct policy_generation *held = &policy->held[i];

		if (held->lineage == policy->lineage)
			held->crashes = probation ? held->crashes + 1 : 0;
		if (held->number == policy->restored_from)
			held->lost = probation && !policy->proved ? held->lost + 1 : 0;
	}
}

/* A death possibly caused from outside says nothing about the image.  The sender of a signal that
 * programs usually cause themselves is unknown; but a process that reached the next checkpoint did
 * not die of the image. */
static bool is_its_own(const struct policy *policy, int status)
{
	if (WIFEXITED(status))
		return true;
	switch (WTERMSIG(status)) {
	case SIGSEGV:
	case SIGBUS:
	case SIGFPE:
	case SIGILL:
	case SIGTRAP:
	case SIGABRT:
	case SIGSYS:
		return !policy->proved;
	default:
		return false;
	}
}

/* The same death as after the previous restore, and again at once. */
static void count_at_once(struct policy *policy, const struct avc_config *config, int status,
			  uint64_t now)
{
	const int what = WIFEXITED(status) ? status : WTERMSIG(status); /* without WCOREDUMP */
	const bool again = policy->at_once_status == what &&
			   policy->at_once_lineage == policy->lineage;

	if (!policy_on_probation(policy, config, now) || now - policy->restored_ns >= AT_ONCE_NS ||
	    !is_its_own(policy, status)) {
		policy->at_once_status = 0;
		return;
	}
	policy->at_once_status = what;
	policy->at_once_lineage = policy->lineage;
	for (uint32_t i = 0; again && i < policy->count; i++)
		policy->held[i].looping |= policy->held[i].lineage == policy->lineage;
}

/* If there is an older one, half of the restores are enough. */
static bool is_trusted(const struct policy *policy, const struct avc_config *config, uint32_t i,
		       bool used_up)
{
	const struct policy_generation *held = &policy->held[i];
	const uint32_t tries = i > 0 ? (config->restore_max + 1) / 2 : config->restore_max;

	return !held->looping && !(used_up && (held->crashes || held->lost)) &&
	       held->lost < (tries ? tries : 1);
}

struct policy_fallback policy_crashed(struct policy *policy, const struct avc_config *config,
				      int status, bool hung, uint64_t now)
{
	const bool used_up = policy_restores_within(policy, config, now) >= config->restore_max;
	struct policy_fallback left = { .healthy = policy->count };

	count_crash(policy, config, hung, now);
	if (!hung)
		count_at_once(policy, config, status, now);
	/* Checkpoints may have been taken while the hang was not yet detected. */
	if (hung && policy->count) {
		const int vouched = newest_vouched(policy);

		left.healthy = vouched < 0 ? 1 : (uint32_t)vouched + 1;
	}
	left.trusted = left.healthy;
	left.looping = left.healthy && policy->held[left.healthy - 1].looping;
	while (left.trusted && !is_trusted(policy, config, left.trusted - 1, used_up))
		left.trusted--;
	return left;
}

void policy_restored(struct policy *policy, uint32_t i, bool crashed, uint64_t now)
{
	policy->lineage = policy->held[i].lineage;
	policy->restored_from = policy->held[i].number;
	policy->proved = false;
	if (!crashed)
		return;
	policy->restored_ns = now;
	policy->restored_at[policy->restores++ % AVC_RESTORES_MAX] = now;
}

bool policy_awaits_room(uint64_t died_ns, uint64_t now)
{
	return now < died_ns + ROOM_NS;
}

uint32_t policy_restores_within(const struct policy *policy, const struct avc_config *config,
				uint64_t now)
{
	uint32_t n = 0;

	for (uint32_t i = 0; i < AVC_RESTORES_MAX; i++)
		n += policy->restored_at[i] &&
		     now - policy->restored_at[i] < config->restore_window_ns;
	return n;
}
