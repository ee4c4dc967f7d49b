/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.interval=auto: measures what checkpoints cost and what the app does between them, and when
 * to take the next one (policy_wants()).
 */
#include <inttypes.h>
#include <stdio.h>
#include <time.h>

#include "guard.h"

#define TOLD_NS NS_PER_S
#define SENDS_NS (10 * NS_PER_S) /* an app that has sent counts as a sender for so long      */

static uint64_t app_cpu_ns(const struct avc_guard *guard)
{
	uint64_t sum = 0;

	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (guard->tree.process[i]->pid)
			sum += proc_cpu_ns(guard->tree.process[i]->leader);
	return sum;
}

static uint64_t app_faults(const struct avc_guard *guard)
{
	uint64_t sum = 0;

	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		struct proc_stat stat;

		if (guard->tree.process[i]->pid &&
		    proc_stat(guard->tree.process[i]->leader, &stat) == 0)
			sum += stat.faults;
	}
	return sum;
}

/* The app's work from here on is not in the newest generation. */
static void begin_rest(struct avc_guard *guard)
{
	guard->sent = false;
	guard->pace_app_cpu_ns = app_cpu_ns(guard);
	guard->next_ns = policy_ready(&guard->pace, &guard->config);
}

void guard_pace_begin(struct avc_guard *guard)
{
	if (policy_is_automatic(&guard->config))
		guard->pace_began_ns = clock_ns(CLOCK_PROCESS_CPUTIME_ID);
}

void guard_pace_end(struct avc_guard *guard)
{
	if (policy_is_automatic(&guard->config))
		guard->pace_cpu_ns += clock_ns(CLOCK_PROCESS_CPUTIME_ID) - guard->pace_began_ns;
}

static uint64_t faults_since(struct avc_guard *guard)
{
	const uint64_t faults = app_faults(guard), before = guard->pace_faults;

	guard->pace_faults = faults;
	return before && faults > before ? faults - before : 0;
}

/* Cost of first writes to pages after the clone; other faults look the same, so it counts for no
 * more than the freeze itself. */
static uint64_t faults_ns(struct avc_guard *guard, uint64_t freeze_ns)
{
	const uint64_t ns = faults_since(guard) * first_write_ns();

	return ns < freeze_ns ? ns : freeze_ns;
}

static uint64_t since(uint64_t now, uint64_t before)
{
	return before && now > before ? now - before : 0;
}

/* Since the last time. */
static struct policy_run app_run(struct avc_guard *guard)
{
	struct policy_run now = { .passed_ns = now_ns(), .cpu_ns = app_cpu_ns(guard) };
	const struct policy_run before = guard->ran;
	char text[64];

	if (proc_read(guard->main.leader, "schedstat", text, sizeof text) > 0)
		(void)sscanf(text, "%" SCNu64 " %" SCNu64, &now.ran_ns, &now.waited_ns);
	guard->ran = now;
	return (struct policy_run){ .passed_ns = since(now.passed_ns, before.passed_ns),
				    .cpu_ns = since(now.cpu_ns, before.cpu_ns),
				    .ran_ns = since(now.ran_ns, before.ran_ns),
				    .waited_ns = since(now.waited_ns, before.waited_ns) };
}

#define FEW 8 /* writes to all pages together take less than such a part of the interval */

/* The same with a fixed interval, and for no more than all that was cloned.  Most applications are too
 * small for that to matter, however long they wait for a CPU: they are spared the looks. */
static uint64_t writes_ns(struct avc_guard *guard)
{
	/* 0: somebody has killed its templates already. */
	const struct generation *newest = guard->count ? &guard->generations[guard->count - 1]
						       : NULL;
	struct policy_run run;
	uint64_t faults, pages = 0;

	for (uint32_t i = 0; newest && i < newest->images; i++)
		pages += (uint64_t)newest->image[i].anon_pages;
	if (FEW * pages * first_write_ns() < guard->config.interval_ns) {
		guard->ran = (struct policy_run){ 0 };
		guard->pace_faults = 0;
		return 0;
	}
	run = app_run(guard);
	faults = faults_since(guard);
	return policy_writes((faults < pages ? faults : pages) * first_write_ns(), &run);
}

enum avc_fork_reason guard_why_fork(struct avc_guard *guard)
{
	if (!guard_has_room_for_copies(guard))
		return AVC_FORK_ROOM;
	if (guard->config.images != AVC_IMAGES_AUTO || !policy_is_automatic(&guard->config) ||
	    !policy_prefers_forks(&guard->pace, &guard->config))
		return AVC_FORK_NONE;
	return guard->pace.forking ? AVC_FORK_BUDGET : AVC_FORK_FIRST;
}

void guard_pace_taken(struct avc_guard *guard, const struct avc_event *event)
{
	struct policy_cost cost;

	if (!policy_is_automatic(&guard->config)) {
		if (guard->config.interval_ns)
			guard->writes_ns = writes_ns(guard);
		return;
	}
	guard_pace_end(guard);
	/* Making the template, and freeing it later. */
	cost.cpu_ns = guard->pace_cpu_ns + 2 * event->clone_ns;
	cost.held_ns = guard->held_ns + faults_ns(guard, event->freeze_ns);
	guard->pace_cpu_ns = 0;
	policy_pay(&guard->pace, &guard->config,
		   event->images == AVC_IMAGES_FORK ? POLICY_FORKS : POLICY_COPIES, cost, now_ns());
	begin_rest(guard);
}

/* A failed checkpoint has stopped the app, too: the pause after it keeps to the budget, but is no
 * longer than a fixed interval would be. */
static uint64_t pause_to_pay(const struct avc_guard *guard)
{
	const uint64_t pause = guard->held_ns * 1000000 / guard->config.budget_freeze_ppm,
		       longest = guard->config.interval_ns;

	return pause < longest ? pause : longest;
}

void guard_pace_missed(struct avc_guard *guard)
{
	const uint64_t now = now_ns();

	if (!policy_is_automatic(&guard->config))
		return;
	guard_pace_end(guard);
	guard->next_ns = policy_due_after(policy_try_again(&guard->pace, &guard->config, now),
					  pause_to_pay(guard), now);
}

void guard_pace_restored(struct avc_guard *guard)
{
	guard->next_ns = policy_due(&guard->config, now_ns());
	faults_disarm(&guard->faults); /* it was the dead one's */
	guard->pace_faults = 0;
	if (!policy_is_automatic(&guard->config))
		return;
	guard->pace.taken_ns = now_ns();
	begin_rest(guard);
}

void guard_pace_listen(struct avc_guard *guard)
{
	if (!output_heard(&guard->output))
		return;
	guard->sent = true;
	guard->sent_ns = now_ns();
	guard->next_ns = guard->sent_ns;
}

static bool wants(const struct avc_guard *guard, uint64_t now)
{
	const uint64_t used = app_cpu_ns(guard);
	const struct policy_activity activity = {
		.cpu_ns = used - guard->pace_app_cpu_ns,
		.sent = guard->sent,
		.sends = guard->sent_ns && now - guard->sent_ns < SENDS_NS,
	};

	return used < guard->pace_app_cpu_ns || /* one of them has ended */
	       policy_wants(&guard->pace, &guard->config, activity, now);
}

/* Nearly all looks at an idle app find nothing, so they skip the rest of the guard's cycle. */
bool guard_pace_dozes(struct avc_guard *guard)
{
	const uint64_t now = now_ns();

	if (!policy_is_automatic(&guard->config) || !guard->attached || !guard->output.armed ||
	    now < guard->next_ns || wants(guard, now))
		return false;
	guard->next_ns = policy_look_again(&guard->pace, &guard->config, now);
	return true;
}

bool guard_pace_wants(struct avc_guard *guard)
{
	const uint64_t now = now_ns();

	if (!guard->count && now < guard->policy.resumes_ns) {
		guard->next_ns = guard->policy.resumes_ns;
		return false;
	}
	/* With strict files, writes by other processes count, too. */
	if (!policy_is_automatic(&guard->config) || !guard->count ||
	    guard->config.files == AVC_FILES_STRICT || wants(guard, now)) {
		output_disarm(&guard->output);
		return true;
	}
	guard_pace_begin(guard);
	output_arm(&guard->output, &guard->tree);
	guard_pace_end(guard);
	guard->next_ns = policy_look_again(&guard->pace, &guard->config, now);
	return false;
}

/* ---- events -------------------------------------------------------------------- */

/* Fifty events a second would be noise: once a second, one reports how many and at what cost. */
void guard_tell_taken(struct avc_guard *guard, struct avc_event *event)
{
	struct avc_event *told = &guard->untold;

	event->interval_ns = policy_interval(&guard->pace, &guard->config);
	event->checkpoints = told->checkpoints + 1;
	event->freeze_max_ns = event->freeze_ns > told->freeze_max_ns ? event->freeze_ns
								      : told->freeze_max_ns;
	*told = *event;
	if (event->ticket || !policy_is_automatic(&guard->config) || guard->unprotected ||
	    event->error.code || now_ns() - guard->told_ns >= TOLD_NS)
		guard_tell_untold(guard);
}

bool guard_take_untold(struct avc_guard *guard, struct avc_event *event)
{
	if (!guard->untold.checkpoints)
		return false;
	*event = guard->untold;
	guard->untold = (struct avc_event){ 0 };
	guard->told_ns = now_ns();
	return true;
}

void guard_tell_untold(struct avc_guard *guard)
{
	struct avc_event event;

	if (guard_take_untold(guard, &event))
		guard_emit(guard, &event);
}

uint64_t guard_tell_due(const struct avc_guard *guard)
{
	return guard->untold.checkpoints ? guard->told_ns + TOLD_NS : UINT64_MAX;
}
